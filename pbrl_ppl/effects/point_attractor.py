"""Attraction to a place that falls off with the distance."""

from itertools import product
from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.hinge import hangs_in_none
from pbrl_ppl.effects.scans import places
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

#: Places tried along each axis, and how far beyond where the body has been (share of the range).
_LOOKS, _BEYOND = 9, 0.15
#: Depths tried (m).
_DEPTHS = (0.08, 0.25)


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    x, y = parameters[1] - state[0], parameters[2] - state[1]
    strength = parameters[0] * (x * x + y * y + parameters[3] * parameters[3]) ** -1.5
    wrench[0] += strength * x
    wrench[1] += strength * y


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Places in and about where the body has been; the strength is differentiated."""
    place = places(history, body)
    if not len(place):
        return np.empty((0, 4))
    low, high = place.min(axis=0), place.max(axis=0)
    wider = _BEYOND * (high - low)
    x, y = np.linspace(low - wider, high + wider, _LOOKS).T
    looks = product(np.unique(x), np.unique(y), _DEPTHS)
    return np.array([(np.nan, *there) for there in looks])


point_attractor = Effect(
    "point_attractor",
    (
        EffectParameter("strength", "N m^2", Prior("normal", sigma=10.0)),
        EffectParameter("x", "m", Prior("normal", sigma=10.0)),
        EffectParameter("y", "m", Prior("normal", sigma=10.0)),
        EffectParameter("depth", "m", Prior("log_normal", mu=-1.6, sigma=0.7), null=0.2),
    ),
    "a pull towards a place, or a push away, that is strong near it and weak far off: a magnet",
    "inverse-square law, of a source below or above the plane",
    Force(_law),
    applies=hangs_in_none,
    scan=_scan,
)
