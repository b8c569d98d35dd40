"""Dry friction that is stronger at one end of the room, or of a rail.

mu (1 + (along_x, along_y) . (x - x0) / r0) under a body, F + (along_x, along_y) . (x - x0) / r0 in
a slider, with the mean place x0 and a typical range r0. They change other dry friction, which is in
the scene or named with them.
"""

import pbrl_ppl as pp
from pbrl_ppl.effects import Friction
from pbrl_ppl.effects.effect import is_sliding


def on_floor(state, load, parameters, most):
    """Scale the greatest force; the parameters are along_x, along_y, then x0, y0 and r0."""
    share = parameters[0] * (state[0] - parameters[2]) + parameters[1] * (state[1] - parameters[3])
    most[0] *= 1.0 + share / parameters[4]


def on_rail(state, load, parameters, most):
    """Add to the greatest force; the parameters are along_x, along_y, then x0, y0 and r0."""
    off = parameters[0] * (state[0] - parameters[2]) + parameters[1] * (state[1] - parameters[3])
    most[0] += off / parameters[4]


def is_pressed(scene, body):
    """Return whether bodies lie on a floor: a top view."""
    return scene.normal_gravity > 0


DIFFERENCE = pp.Prior("normal", sigma=0.5)

friction_by_place = pp.Effect(
    "friction_by_place",
    (
        pp.EffectParameter("along_x", "1", DIFFERENCE),
        pp.EffectParameter("along_y", "1", DIFFERENCE),
    ),
    "dry friction on the floor that is stronger at one end of the room, by this share at the"
    " typical distance from the middle",
    "Coulomb's law, mu (1 + a . (x - x0) / r0), with the mean place x0 and a typical range r0",
    Friction(on_floor, under=True),
    applies=is_pressed,
    constants=("x", "y", "range"),
    log_odds=-3.0,
    unusual="few floors are rough at one end; it takes any misfit of a place",
    needs=("places",),
)

slider_place_friction = pp.Effect(
    "slider_place_friction",
    (
        pp.EffectParameter("along_x", "N", DIFFERENCE, scale="force"),
        pp.EffectParameter("along_y", "N", DIFFERENCE, scale="force"),
    ),
    "dry friction in the slider that is stronger at one end of the rail, by this force at the"
    " typical distance from the middle",
    "Coulomb's law, F + a . (x - x0) / r0, with the mean place x0 and a typical range r0",
    Friction(on_rail),
    applies=is_sliding,
    constants=("x", "y", "range"),
    log_odds=-3.0,
    family="dry friction",
    unusual="few rails rub at one end; it takes any misfit of a place",
    needs=("places",),
)
