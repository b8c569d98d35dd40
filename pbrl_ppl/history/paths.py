"""Recorded paths of kinematic bodies: complete, and as the velocities that lead along them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.cells import Rows
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, wrapped

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def kinematic_bodies(scene: Scene) -> Bools:
    """Which of the moving bodies are kinematic, shape (body,)."""
    return np.array([body.kinematic for body in scene.moving], dtype=bool)


def check_paths(rows: Rows, scene: Scene) -> None:
    """Raise `HistoryError` where a kinematic body's pose is missing on a row."""
    follows = kinematic_bodies(scene)[rows.body]
    empty = np.isnan(rows.state[:, :3]) & follows[:, None]
    if empty.any():
        row, column = (int(i) for i in np.argwhere(empty)[0])
        raise HistoryError(
            f"{rows.at(row)}: {STATE[column]} of body"
            f' "{scene.moving[rows.body[row]].name}" is empty in {rows.of(row)}; the body is'
            " kinematic and goes where its path leads: expected a number on every row; fill it in"
            " (theta of a round body may be 0 throughout)"
        )


def path_velocities(poses: Floats, time_step: float) -> Floats:
    """Constant velocities that lead from each pose to the next.

    Parameters
    ----------
    poses : ndarray
        Shape (..., time, body, 3): x, y, theta (m, m, rad).
    time_step : float
        Between poses (s).

    Returns
    -------
    ndarray
        Shape (..., time - 1, body, 3): m/s, m/s, rad/s, the shorter way round.
    """
    change = np.diff(poses, axis=-3)
    change[..., 2] = wrapped(change[..., 2])
    return np.asarray(change / time_step)


def fill_path_velocities(state: Floats, scene: Scene) -> None:
    """Fill missing velocities of kinematic bodies in place, by differences of their positions.

    Parameters
    ----------
    state : ndarray
        Shape (trajectory, time, body, 6); changed.
    scene : Scene
        Says which bodies are kinematic.
    """
    follows = kinematic_bodies(scene)
    if not follows.any():
        return
    path = state[:, :, follows]
    rate = path_velocities(path[..., :3], scene.time_step)
    # the velocity of the interval that begins there, of a last row the one that ends
    ahead = np.concatenate([rate, rate[:, -1:]], axis=1)
    behind = np.concatenate([rate[:, :1], rate], axis=1)
    filled = np.where(np.isnan(ahead), behind, ahead)
    path[..., 3:] = np.where(np.isnan(path[..., 3:]), filled, path[..., 3:])
    state[:, :, follows] = path
