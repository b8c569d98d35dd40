"""Pushes that are stronger one way than the other: a propeller or a valve is not symmetric.

f = u + share |u|, of each component of the commanded wrench.
"""

import pbrl_ppl as pp


def law(state, command, parameters, wrench):
    """Strengthen what is positive and weaken what is negative; the parameter is share."""
    for i in range(3):
        wrench[i] += parameters[0] * abs(wrench[i])


SHARE = pp.Prior("truncated_normal", mu=0.0, sigma=0.3, lower=-1.0, upper=1.0)

gain_by_sign = pp.Effect(
    "gain_by_sign",
    (pp.EffectParameter("share", "1", SHARE),),
    "pushes one way are stronger than the other way, by this share of the command each: a propeller"
    " or a valve is not symmetric",
    "gain of an actuator by sign, f = u + a |u|",
    pp.Command(law),
    log_odds=-1.0,
    family="shape of the command",
    unusual="few drives push more one way; a constant force looks the same",
)
