"""What a scan looks at: sizes of commanded forces, places of a body, points on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.history import History
from pbrl_ppl.scene import Body

Array = NDArray[np.float64]

#: Points tried on a body, as shares of its half extent.
_ON_BODY = np.array([(0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7)])


def force_levels(history: History, body: Body, most: int) -> Array:
    """Sizes between those of the forces commanded to a body, at most so many, shape (level, 1), N.

    Parameters
    ----------
    history : History
        What was recorded.
    body : Body
        The one that the forces act on.
    most : int
        Levels at most.
    """
    action = history.dataset["action"].sel(body=body.name).to_numpy()[..., :2]
    size = np.unique(np.round(np.linalg.norm(action, axis=-1), 9))
    size = size[size > 0]  # not NaN either
    if len(size) > most + 1:
        size = np.unique(np.quantile(size, np.linspace(0, 1, most + 1)))
    return np.asarray(0.5 * (size[1:] + size[:-1]))[:, None]


def places(history: History, body: Body) -> Array:
    """Where a body was measured to be, shape (n, 2), m."""
    place = history.dataset["start"].sel(body=body.name).to_numpy()[..., :2].reshape(-1, 2)
    return np.asarray(place[np.isfinite(place).all(axis=1)])


def body_points(body: Body) -> Array:
    """The middle of a body and points to all four sides of it, in its frame, shape (5, 2), m."""
    x_min, x_max, y_min, y_max = body.shape.bounds
    return np.asarray(0.5 * np.array([x_max - x_min, y_max - y_min]) * _ON_BODY)
