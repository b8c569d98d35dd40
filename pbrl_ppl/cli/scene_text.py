"""Text of a new scene: what is given, and comments that say what else may be declared."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass

_HEAD = """\
# What is known before a measurement. SI units: m, kg, s, N, rad.
# What this file does not say is inferred, under the priors of Table 1:
#   mass          log-normal of median 2.7 kg: mu = 1.0, sigma = 1.5, both of the LOGARITHM of kg
#   r             restitution, log-normal of median 0.22: mu = -1.5, sigma = 1.0, of its logarithm
#   mu_c          friction in contacts, normal cut off to [0, 1]: mu = 0.5, sigma = 1.0
#   mu_x, mu_y    friction along and across a wheel's axle: as mu_c
#   w_x, w_y      where the wheel is (m), normal cut off to the body's bounds: mu = 0, sigma = width
#   w_theta       how the wheel is turned (rad), von Mises: mu = 0, kappa = 0 (uniform)

[world]
"""
_TOP = """\
gravity = [0.0, 0.0]       # m/s^2 in the plane: seen from above
normal_gravity = 9.81      # m/s^2, presses bodies on the floor
"""
_SIDE = """\
gravity = [0.0, -9.81]     # m/s^2 in the plane: seen from the side
"""
_CLOCK = """\
time_step = {time_step:<14g} # s between rows of the history
substeps = 10              # engine steps in that time; close-loop takes more where they matter

# [noise]                  # errors of measuring that are known; what is left out is inferred
# x = 0.002                # one standard deviation, m
# theta = 0.01             # rad
"""
_BODY = """
[[body]]
name = {name:<20} # as in the history's column "body"
shape = {shape}   # m; or {{ kind = "polygon", vertices = [[0, 0], [1, 0], [0, 1]] }}
wheel = {wheel:<20}# whether it resists motion along one axis more than along the other
# known = {{ mass = 6.0 }}                          # kg: given, not inferred
# prior = {{ mass = {{ mu = 1.8, sigma = 0.5 }} }}    # exp(1.8) = 6 kg, within a factor of 1.6
# effects = ["linear_drag"]                       # declared; close-loop finds others
"""
_REST = """
# [[wall]]                 # an edge that bodies hit
# from = [-2.0, -1.0]      # m
# to = [2.0, -1.0]

# [[joint]]
# kind = "hinge"           # or "distance"
# bodies = [{name}, "world"]
# anchor_a = [0.0, 0.1]    # in the body's frame, m
# anchor_b = [0.0, 0.0]    # in the world, m
"""


@dataclass(frozen=True)
class BodyText:
    """A body of a new scene: its name, its shape as TOML, and whether it has a wheel."""

    name: str
    shape: str
    wheel: bool


def scene_text(bodies: Iterable[BodyText], *, side: bool, time_step: float) -> str:
    """A commented scene as TOML.

    Parameters
    ----------
    bodies : iterable of BodyText
        At least one.
    side : bool
        Whether it is seen from the side.
    time_step : float
        Between rows of the history (s).

    Examples
    --------
    >>> cart = BodyText("cart", '{ kind = "box", size = [0.9, 0.55] }', True)
    >>> from pbrl_ppl.scene import Scene
    >>> Scene.from_toml(scene_text([cart], side=False, time_step=0.1)).moving[0].wheel
    True
    """
    names = []
    parts = [_HEAD, _SIDE if side else _TOP, _CLOCK.format(time_step=time_step)]
    for body in bodies:
        names.append(json.dumps(body.name, ensure_ascii=False))
        wheel = str(body.wheel).lower()
        parts.append(_BODY.format(name=names[-1], shape=body.shape, wheel=wheel))
    return "".join([*parts, _REST.format(name=names[0])])
