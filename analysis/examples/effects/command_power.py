"""Pushes that grow with a power of the command: the thrust of a propeller, by its speed squared.

f = f0 (u / f0)^p, f0 a typical force; torques likewise.
"""

import math

import pbrl_ppl as pp


def law(state, command, parameters, wrench):
    """Bend the command; the parameter is exponent, then a typical force and torque."""
    force, torque = math.hypot(wrench[0], wrench[1]) / parameters[1], abs(wrench[2]) / parameters[2]
    if force > 0.0:
        wrench[0] *= force ** (parameters[0] - 1.0)
        wrench[1] *= force ** (parameters[0] - 1.0)
    if torque > 0.0:
        wrench[2] *= torque ** (parameters[0] - 1.0)


command_power = pp.Effect(
    "command_power",
    (pp.EffectParameter("exponent", "1", pp.Prior("log_normal", mu=0.0, sigma=0.5), null=1.0),),
    "the push grows with a power of the command, not in proportion: the thrust of a propeller grows"
    " with the square of its speed",
    "f = f0 (u / f0)^p, with a typical force f0",
    pp.Command(law),
    constants=("force", "torque"),
    log_odds=-1.0,
    family="shape of the command",
    unusual="a power of the command stands in for friction, which takes small commands",
)
