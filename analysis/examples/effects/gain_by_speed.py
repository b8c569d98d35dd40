"""Pushes that are weaker the faster the body already moves their way: a propeller in its own wind.

f = u (1 - share v / v0), v the speed along the push and v0 a typical one; torques likewise. A law
of the command that depends on the velocity.
"""

import math

import pbrl_ppl as pp


def law(state, command, parameters, wrench):
    """Weaken the commanded wrench; the parameter is share, then typical speeds of both kinds."""
    size = math.hypot(wrench[0], wrench[1])
    if size > 0.0:
        along = (wrench[0] * state[3] + wrench[1] * state[4]) / size
        share = 1.0 - parameters[0] * along / parameters[1]
        wrench[0] *= share
        wrench[1] *= share
    wrench[2] -= parameters[0] * abs(wrench[2]) * state[5] / parameters[2]


gain_by_speed = pp.Effect(
    "gain_by_speed",
    (pp.EffectParameter("share", "1", pp.Prior("half_normal", sigma=0.3)),),
    "a push is weaker the faster the body already moves its way, by this share at the typical"
    " speed: a propeller in its own wind, a motor near its idle speed",
    "f = u (1 - a v / v0), with a typical speed v0",
    pp.Command(law),
    constants=("speed", "turn_rate"),
    log_odds=-1.0,
    family="shape of the command",
    unusual="a drag looks the same wherever commands are of one size",
)
