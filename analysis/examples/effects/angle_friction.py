"""Dry friction in a hinge that is stronger at some angles: the bearing is bent or worn.

tau (1 + cosine cos(theta) + sine sin(theta)). It changes other dry friction, which is in the scene
or named with it.
"""

import math

import pbrl_ppl as pp
from pbrl_ppl.effects import Friction, is_pivoted


def law(state, load, parameters, most):
    """Scale the greatest torque; the parameters are cosine and sine."""
    most[0] *= 1.0 + parameters[0] * math.cos(state[2]) + parameters[1] * math.sin(state[2])


SHARE = pp.Prior("normal", sigma=0.5)

pivot_angle_friction = pp.Effect(
    "pivot_angle_friction",
    (pp.EffectParameter("cosine", "1", SHARE), pp.EffectParameter("sine", "1", SHARE)),
    "dry friction in the hinge that is stronger at some angles, by this share: the bearing is bent"
    " or worn",
    "Coulomb's law with a first harmonic of the angle, tau (1 + a cos(theta) + b sin(theta))",
    Friction(law),
    applies=is_pivoted,
    log_odds=-3.0,
    family="dry friction",
    unusual="few hinges rub at one side; it takes any misfit of an angle",
    needs=("places",),
)
