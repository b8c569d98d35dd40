"""Pushes that get weaker in the course of each trajectory: a battery runs down, a motor gets hot.

f = u exp(-rate t). A law of the command that depends on the time: it finds it in command[9], which
is infinite after the recording, where the battery is full again.
"""

import math

import pbrl_ppl as pp


def law(state, command, parameters, wrench):
    """Weaken the commanded wrench; the parameter is the rate."""
    if command[9] < math.inf:
        left = math.exp(-parameters[0] * command[9])
        for i in range(3):
            wrench[i] *= left


fading_gain = pp.Effect(
    "fading_gain",
    (pp.EffectParameter("rate", "1/s", pp.Prior("half_normal", sigma=0.5), scale="/time"),),
    "pushes get weaker in the course of each trajectory: a battery runs down, a motor gets hot",
    "f = u exp(-a t)",
    pp.Command(law, timed=True),
    log_odds=-3.0,
    unusual="batteries and motors fade over hours, recordings last minutes",
)
