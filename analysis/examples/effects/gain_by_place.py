"""Pushes that are stronger at one end of the room than at the other.

f = u (1 + (along_x, along_y) . (x - x0) / r0), with the mean place x0 and a typical range r0: a law
with constants, natural units of the body, which it finds after its parameters.
"""

import pbrl_ppl as pp


def law(state, command, parameters, wrench):
    """Scale the commanded wrench; the parameters are along_x, along_y, then x0, y0 and r0."""
    share = 1.0 + parameters[0] * (state[0] - parameters[2]) / parameters[4]
    share += parameters[1] * (state[1] - parameters[3]) / parameters[4]
    for i in range(3):
        wrench[i] *= share


SHARE = pp.Prior("normal", sigma=0.3)

gain_by_place = pp.Effect(
    "gain_by_place",
    (pp.EffectParameter("along_x", "1", SHARE), pp.EffectParameter("along_y", "1", SHARE)),
    "pushes are stronger at one end of the room than at the other, by this share of the command at"
    " the typical distance from the middle",
    "f = u (1 + a . (x - x0) / r0), with the mean place x0 and a typical range r0",
    pp.Command(law),
    constants=("x", "y", "range"),
    log_odds=-2.0,
    unusual="few drives push more at one place; it takes any misfit of a place",
    needs=("places",),
)
