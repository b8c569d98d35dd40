"""A mass that swings within the body: a liquid, a loose load, a flexible mast.

The mass hangs on a spring and a damper, and is at rest in the body when a transition begins. A law
with numbers of its own: `rate` gives their rates of change, `begin` their values at the start.
"""

import math

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.effects import is_unpivoted


def law(state, command, parameters, wrench):
    """Add the force of spring and damper; the parameters are mass, frequency and damping."""
    rate = 2.0 * math.pi * parameters[1]
    for i in range(2):
        off, speed = command[12 + i] - state[i], command[14 + i] - state[3 + i]
        wrench[i] += parameters[0] * (rate * rate * off + 2.0 * parameters[2] * rate * speed)


def swing(state, command, parameters, change):
    """Set the rates of change of the mass's place and velocity, which are command[12:16]."""
    rate = 2.0 * math.pi * parameters[1]
    for i in range(2):
        off, speed = command[12 + i] - state[i], command[14 + i]
        change[i] = speed
        change[2 + i] = -rate * rate * off - 2.0 * parameters[2] * rate * (speed - state[3 + i])


def at_rest(state, command, parameters, memory):
    """Set the mass's place and velocity to the body's."""
    for i in range(2):
        memory[i], memory[2 + i] = state[i], state[3 + i]


def scan(scene, history, body):
    """Return frequencies of some intervals; the derivative is taken by the mass."""
    return np.array([(np.nan, 1.0 / (n * scene.time_step), 0.05) for n in (6, 12, 25)])


sloshing = pp.Effect(
    "sloshing",
    (
        pp.EffectParameter("mass", "kg", pp.Prior("half_normal", sigma=0.5), scale="mass"),
        pp.EffectParameter(
            "frequency",
            "Hz",
            pp.Prior("log_normal", mu=-2.0, sigma=1.0),
            null=0.1,
            scale="/interval",
        ),
        pp.EffectParameter("damping", "1", pp.Prior("half_normal", sigma=0.2), null=0.05),
    ),
    "a mass that swings within the body, beside the body's own: a liquid, a loose load, a flexible"
    " mast",
    "a mass on a spring and a damper, at rest in the body when a transition begins",
    pp.Force(law, memory=4, rate=swing, begin=at_rest),
    applies=is_unpivoted,
    scan=scan,
    log_odds=-4.0,
    unusual="few rigs carry a liquid or a loose part",
)
