"""A wheel that the model declares none of."""

from itertools import product
from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

_COLUMNS = ("w_x", "w_y", "w_theta", "mu_x", "mu_y")
_ANGLES = 4


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    for name in _COLUMNS:
        properties[name] = properties[name] + parameters[name]


def _has_none(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0 and not body.wheel


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Places on the body and angles within a quarter turn; the frictions are differentiated."""
    x_min, x_max, y_min, y_max = body.shape.bounds
    places = product((x_min / 2, 0.0, x_max / 2), (y_min / 2, 0.0, y_max / 2))
    angles = np.linspace(0.0, np.pi / 2, _ANGLES, endpoint=False)
    return np.array([(*at, angle, np.nan, np.nan) for at, angle in product(places, angles)])


wheel = Effect(
    "wheel",
    (
        EffectParameter("w_x", "m", Prior("normal", sigma=0.5)),
        EffectParameter("w_y", "m", Prior("normal", sigma=0.5)),
        EffectParameter("w_theta", "rad", Prior("von_mises", mu=0.0, kappa=0.0)),
        EffectParameter("mu_x", "1", Prior("half_normal", sigma=0.5)),
        EffectParameter("mu_y", "1", Prior("half_normal", sigma=0.5)),
    ),
    "friction at a point of the body that is larger across a wheel than along it",
    "anisotropic Coulomb friction, J_w of Scholz et al. (ICML 2014), section 3.2",
    Properties(_modify),
    applies=_has_none,
    scan=_scan,
)
