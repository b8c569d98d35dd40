"""Linear spring to a place."""

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

#: Where anchors are tried, along each axis: quantiles of the places that the body has been at.
_QUANTILES = (0.1, 0.5, 0.9)


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] -= parameters[0] * (state[0] - parameters[1])
    wrench[1] -= parameters[0] * (state[1] - parameters[2])


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Anchors among the places that the body has been at; the stiffness is differentiated."""
    place = places(history, body)
    if not len(place):
        return np.empty((0, 3))
    x, y = np.quantile(place, _QUANTILES, axis=0).T
    return np.array([(np.nan, *anchor) for anchor in product(np.unique(x), np.unique(y))])


spring = Effect(
    "spring",
    (
        EffectParameter("stiffness", "N/m", Prior("half_normal", sigma=20.0)),
        EffectParameter("anchor_x", "m", Prior("normal", sigma=10.0)),
        EffectParameter("anchor_y", "m", Prior("normal", sigma=10.0)),
    ),
    "a pull towards a place that grows with the distance: a cable or a hose drags at the body",
    "Hooke's law",
    Force(_law),
    applies=hangs_in_none,
    scan=_scan,
)
