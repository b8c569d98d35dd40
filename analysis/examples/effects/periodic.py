"""A force along a line, and a torque, that repeat with the time since a trajectory began.

cosine cos(2 pi t / period) + sine sin(2 pi t / period). A law that depends on the time: it finds it
in command[9], which is infinite after the recording, where nobody knows the phase.
"""

import math

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.effects import is_unpivoted


def force(state, command, parameters, wrench):
    """Add the force; the parameters are cosine, sine, period and direction."""
    if command[9] < math.inf:
        phase = 2.0 * math.pi * command[9] / parameters[2]
        size = parameters[0] * math.cos(phase) + parameters[1] * math.sin(phase)
        wrench[0] += math.cos(parameters[3]) * size
        wrench[1] += math.sin(parameters[3]) * size


def torque(state, command, parameters, wrench):
    """Add the torque; the parameters are cosine, sine and period."""
    if command[9] < math.inf:
        phase = 2.0 * math.pi * command[9] / parameters[2]
        wrench[2] += parameters[0] * math.cos(phase) + parameters[1] * math.sin(phase)


def scan_torque(scene, history, body):
    """Return periods of whole trajectories to four intervals; the derivative is by the sizes."""
    longest = float(np.nanmax(history.elapsed, initial=0.0))
    periods = [longest / n for n in (1, 2, 4, 8, 16) if longest / n > 4.0 * scene.time_step]
    return np.array([(np.nan, np.nan, period) for period in periods]).reshape(-1, 3)


def scan_force(scene, history, body):
    """Return the same periods along each axis."""
    rows = [
        (*row, turn) for row in scan_torque(scene, history, body) for turn in (0.0, 0.5 * np.pi)
    ]
    return np.array(rows).reshape(-1, 4)


SIZE = pp.Prior("normal", sigma=1.0)
PERIOD = pp.EffectParameter(
    "period", "s", pp.Prior("log_normal", mu=-1.5, sigma=1.0), null=0.2, scale="time"
)

periodic_force = pp.Effect(
    "periodic_force",
    (
        pp.EffectParameter("cosine", "N", SIZE, scale="force"),
        pp.EffectParameter("sine", "N", SIZE, scale="force"),
        PERIOD,
        pp.EffectParameter("direction", "rad", pp.Prior("von_mises", mu=0.0, kappa=0.0)),
    ),
    "a force along a line that repeats with the time since a trajectory began: a shaken table",
    "harmonic force, a cos(2 pi t / T) + b sin(2 pi t / T)",
    pp.Force(force, timed=True),
    applies=is_unpivoted,
    scan=scan_force,
    log_odds=-6.0,
    unusual="it takes any oscillation, and few rigs are shaken",
)

periodic_torque = pp.Effect(
    "periodic_torque",
    (
        pp.EffectParameter("cosine", "N m", SIZE, scale="torque"),
        pp.EffectParameter("sine", "N m", SIZE, scale="torque"),
        PERIOD,
    ),
    "a torque that repeats with the time since a trajectory began",
    "harmonic torque, a cos(2 pi t / T) + b sin(2 pi t / T)",
    pp.Force(torque, timed=True),
    scan=scan_torque,
    log_odds=-6.0,
    unusual="it takes any oscillation, and few rigs are shaken",
)
