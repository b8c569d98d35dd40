"""Histories rebuilt from the segments that a problem or a posterior file holds."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pbrl_ppl.history.history import History
from pbrl_ppl.history.paths import kinematic_bodies
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, WRENCH

Array = NDArray[np.float64]


def from_segments(scene: Scene, start: Array, actions: Array, observed: Array) -> History:
    """A history of segments; arguments as of :func:`segment_rows`.

    Actions of shape (n, H, body, 9) are inputs as in :data:`pbrl_ppl.state.INPUT`: they also say
    what acted before, and when.
    """
    wrench = actions[..., : len(WRENCH)]
    history = History.from_dataframe(segment_rows(scene, start, wrench, observed), scene)
    if actions.shape[-1] == len(WRENCH):
        return history
    previous, (number, begin, end) = actions[..., 3:6], np.moveaxis(actions[:, :, 0, 6:], -1, 0)
    data = history.dataset.copy()
    data["before"] = data["before"].copy(data=previous[:, 0])
    data["number"] = data["number"].copy(data=number[:, 0])
    data["clock"] = data["clock"].copy(data=np.concatenate([begin, end[:, -1:]], axis=1))
    return History(data)


def segment_rows(scene: Scene, start: Array, actions: Array, observed: Array) -> pd.DataFrame:
    """A history's rows, of one trajectory a segment, each from its own start state.

    Parameters
    ----------
    scene : Scene
        Names the bodies and the time step.
    start : ndarray
        Complete start states, shape (n, body, 6), SI units.
    actions : ndarray
        Wrenches, shape (n, H, body, 3); of a kinematic body its velocities.
    observed : ndarray
        Next states, shape (n, H, body, 6), NaN where missing.
    """
    n, h, k = actions.shape[:3]
    states = np.concatenate([start[:, None], observed], axis=1)
    wrenches = np.concatenate([actions, np.full((n, 1, k, len(WRENCH)), np.nan)], axis=1)
    follows = kinematic_bodies(scene)
    way = scene.time_step * np.cumsum(actions[:, :, follows], axis=1)
    states[:, 1:, follows, :3] = start[:, None, follows, :3] + way
    wrenches[:, :, follows] = np.nan
    trajectory, step, body = np.indices((n, h + 1, k)).reshape(3, -1)
    return pd.DataFrame(
        {
            "trajectory": trajectory,
            "step": step,
            "time": step * scene.time_step,
            "body": np.array([mover.name for mover in scene.moving])[body],
            **dict(zip(STATE, states.reshape(-1, len(STATE)).T, strict=True)),
            **dict(zip(WRENCH, wrenches.reshape(-1, len(WRENCH)).T, strict=True)),
        }
    )
