"""Rows in which tracking was lost: the last pose repeated, or zeros in place of one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from pbrl_ppl.history.kinematics import finest_step
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, Bools, Floats


def without_lost_rows(
    frame: pd.DataFrame, scene: Scene, say: Callable[[str], None]
) -> pd.DataFrame:
    """Return a table whose states are empty where tracking was lost.

    Paths of kinematic bodies are kept: they need every row.

    Parameters
    ----------
    frame : pandas.DataFrame
        With ``trajectory``, ``body`` and states in SI units, rows in order of time.
    scene : Scene
        Says which bodies are kinematic.
    say : callable
        Takes a sentence on each kind of lost rows.
    """
    places = [name for name in STATE[:3] if name in frame]
    if not places or not {"trajectory", "body"} <= {*frame}:
        return frame
    poses = frame[places].apply(pd.to_numeric, errors="coerce").to_numpy(float, copy=True)
    zero, frozen = (np.zeros(len(frame), dtype=bool) for _ in range(2))
    follows = {body.name for body in scene.moving if body.kinematic}
    for rows in frame.groupby(["trajectory", "body"], sort=False).indices.values():
        if frame["body"].iloc[rows[0]] in follows:
            continue
        if len(places) > 1:  # an angle alone may pass through 0 turn by turn
            zero[rows] = zero_poses(poses[rows])
        seen = rows[~zero[rows]]
        frozen[seen] = frozen_poses(poses[seen])
    names = " = ".join(places)
    if zero.any():
        say(f"{names} = 0 in {int(zero.sum())} rows, far from the rows beside: read as not seen")
    if frozen.any():
        say(
            f"{int(frozen.sum())} rows repeat the pose before and the next is as far as if the body"
            " had moved on: read as not seen"
        )
    lost = zero | frozen
    if not lost.any():
        return frame
    states = [name for name in STATE if name in frame]
    return frame.assign(**{name: frame[name].mask(lost) for name in states})


def zero_poses(poses: Floats, far: float = 5.0) -> Bools:
    """Return the rows where all coordinates are 0, far from those before and after, shape (row,).

    Parameters
    ----------
    poses : ndarray
        Shape (row, coordinate).
    far : float
        The typical changes between rows that they are away from those seen before.
    """
    zero = np.all(poses == 0.0, axis=1)
    seen = np.flatnonzero(~zero & np.isfinite(poses).all(axis=1))
    if not zero.any() or len(seen) < 2:
        return np.zeros(len(poses), dtype=bool)
    step = float(np.median(np.linalg.norm(np.diff(poses[seen], axis=0), axis=1)))
    away = np.linalg.norm(poses[seen], axis=1)
    at = np.searchsorted(seen, np.flatnonzero(zero))
    near = np.minimum(away[np.clip(at - 1, 0, len(seen) - 1)], away[np.clip(at, 0, len(seen) - 1)])
    zero[zero] = near > far * step
    return np.asarray(zero)


def frozen_poses(poses: Floats, *, far: float = 2.5) -> Bools:
    """Return the rows that repeat the pose before although the body went on, shape (row,).

    Where a body rests and then goes on, the first step is as short as those after it. After a pose
    that was repeated because nothing was seen, the first step holds the way of all these rows. A
    resting body, or a coarse encoder, whose steps are as large as its resolution, is not frozen.

    Parameters
    ----------
    poses : ndarray
        Shape (row, coordinate), NaN where missing.
    far : float
        A step of more than so many resolutions of its coordinate counts.
    """
    frozen = np.zeros(len(poses), dtype=bool)
    first = np.flatnonzero(np.append(True, (np.diff(poses, axis=0) != 0.0).any(axis=1)))
    if len(first) < 4:
        return frozen
    change, rows = np.abs(np.diff(poses[first], axis=0)), np.diff(first)
    finest = np.array([finest_step(column) for column in poses.T])
    size, rate = np.linalg.norm(change, axis=1), np.linalg.norm(change, axis=1) / rows
    usual = np.fmax(np.append(rate[0], rate[:-1]), np.append(rate[1:], rate[-1]))
    jumps = (change > far * finest).any(axis=1) & (size > 0.5 * (rows + 1) * usual)
    # one coordinate may have a value twice by chance
    for k in np.flatnonzero(jumps & (rows > (1 if poses.shape[1] > 1 else 2))):
        frozen[first[k] + 1 : first[k + 1]] = True
    return frozen
