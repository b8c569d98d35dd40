"""Contact penalty of a goal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import overlap
from pbrl_ppl.planning.goals import Goal
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Shapes this near touch (m): the engine lets bodies that rest on each other sink in a little.
_TOUCH = 0.005


def contact_cost(goal: Goal, scene: Scene, states: Array) -> Array:
    """Penalty of a second in contact, as a mean over the draws.

    Parameters
    ----------
    goal : Goal
        Its penalty.
    scene : Scene
        What there is to touch.
    states : ndarray
        Shape (draw, n, body, 6), SI units.

    Returns
    -------
    ndarray
        Shape (n,); infinite where what is forbidden is touched under any draw.
    """
    if not goal.contact_penalty:
        return np.zeros(states.shape[1])
    poses = np.nan_to_num(states[..., :3]).reshape(-1, states.shape[2], 3)
    share = (overlap(scene, poses) > -_TOUCH).reshape(states.shape[:2]).mean(axis=0)
    return np.where(share > 0, goal.contact_penalty * np.maximum(share, 1e-9), 0.0)
