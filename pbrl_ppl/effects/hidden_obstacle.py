"""Static obstacle, a disc, that the scene does not show."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Disc, Structure
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

_LOOKS = 60


def _discs(parameters: Any) -> tuple[Disc, ...]:
    return (Disc(parameters["x"], parameters["y"], parameters["radius"]),)


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Discs that the body runs into head-on where its speed changes most in an interval."""
    start = history.dataset["start"].sel(body=body.name).to_numpy()
    begin, end = start[:, :-1].reshape(-1, 6), start[:, 1:].reshape(-1, 6)
    seen = np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)
    begin, end = begin[seen], end[seen]
    speed = np.linalg.norm(begin[:, 3:5], axis=1)
    change = np.linalg.norm(end[:, 3:5] - begin[:, 3:5], axis=1)
    order = np.argsort(-change)
    order = order[speed[order] > 0][:_LOOKS]
    ahead = begin[order, 3:5] / speed[order, None]
    reach = body.shape.bounding_radius
    size = 0.25 * reach
    way = reach + size + 0.5 * speed[order] * scene.time_step
    place = begin[order, :2] + way[:, None] * ahead
    return np.column_stack([place, np.full(len(place), size)])


hidden_obstacle = Effect(
    "hidden_obstacle",
    (
        EffectParameter("x", "m", Prior("normal", sigma=10.0)),
        EffectParameter("y", "m", Prior("normal", sigma=10.0)),
        EffectParameter("radius", "m", Prior("half_normal", sigma=0.5)),
    ),
    "the body ran into something that the scene does not show",
    "contact with a static disc",
    Structure(_discs),
    scan=_scan,
)
