"""A wheel under a body of which the scene declares none."""

from itertools import product
from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.scans import body_points
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

#: Directions tried, over a right angle.
_TURNS = 3
_NAMES = ("w_x", "w_y", "w_theta", "mu_x", "mu_y")


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    for name in _NAMES:
        properties[name] = properties[name] + parameters[name]


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Places and directions; both frictions are differentiated."""
    turns = np.arange(_TURNS) * (0.5 * np.pi / _TURNS)
    looks = product(body_points(body), turns)
    return np.array([(*place, turn, np.nan, np.nan) for place, turn in looks])


def _has_none(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0 and not body.wheel


wheel = Effect(
    "wheel",
    (
        EffectParameter("w_x", "m", Prior("normal", sigma=0.5)),
        EffectParameter("w_y", "m", Prior("normal", sigma=0.5)),
        EffectParameter("w_theta", "rad", Prior("von_mises", mu=0.0, kappa=0.0)),
        EffectParameter("mu_x", "1", Prior("half_normal", sigma=0.5)),
        EffectParameter("mu_y", "1", Prior("half_normal", sigma=0.5)),
    ),
    "a wheel or a runner that the scene declares none of: dry friction at a point of the body,"
    " of one strength along it and another across",
    "anisotropic Coulomb friction, J_w of Scholz et al., ICML 2014, section 3.2",
    Properties(_modify),
    applies=_has_none,
    scan=_scan,
)
