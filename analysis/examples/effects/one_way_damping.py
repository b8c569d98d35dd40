"""Viscous friction in a hinge that is stronger one way than the other.

tau = -coefficient |omega|, beside the same both ways: a one-way clutch, a damper with a valve.
"""

import pbrl_ppl as pp
from pbrl_ppl.effects import is_pivoted


def law(state, command, parameters, wrench):
    """Add the torque; the parameter is the coefficient."""
    wrench[2] -= parameters[0] * abs(state[5])


pivot_one_way_damping = pp.Effect(
    "pivot_one_way_damping",
    (
        pp.EffectParameter(
            "coefficient", "N m s", pp.Prior("normal", sigma=1.0), scale="torque/turn_rate"
        ),
    ),
    "viscous friction in the hinge that is stronger one way than the other",
    "viscous torque by direction, tau = -c |omega| beside -c omega",
    pp.Force(law),
    applies=is_pivoted,
    log_odds=-3.0,
    unusual="few hinges have a one-way clutch or a damper with a valve",
)
