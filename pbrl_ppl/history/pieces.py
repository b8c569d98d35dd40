"""Cuts of trajectories into pieces of a horizon's length."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]


def cut(complete: npt.NDArray[np.bool_], intervals: Ints, horizon: int) -> tuple[Ints, Ints]:
    """Trajectory and first step of pieces that do not overlap.

    A piece starts at the first complete state after the piece before it, and must end within its
    trajectory. A trajectory too short for any has one that its end cuts short.

    Parameters
    ----------
    complete : ndarray
        Whether a piece may start there, shape (trajectory, time).
    intervals : ndarray
        Of each trajectory, shape (trajectory,).
    horizon : int
        Intervals of a piece.

    Examples
    --------
    >>> cut(np.array([[True] * 6, [False, True, True, False, False, False]]), np.array([5, 3]), 2)
    (array([0, 0, 1]), array([0, 2, 1]))
    """
    trajectory, step = [], []
    for i, count in enumerate(intervals):
        starts = np.flatnonzero(complete[i, :count])
        own: list[int] = []
        at = 0
        while (place := int(np.searchsorted(starts, at))) < len(starts):
            at = int(starts[place]) + horizon
            if at > count and own:
                break
            own.append(at - horizon)
        trajectory += [i] * len(own)
        step += own
    return np.array(trajectory, dtype=np.int64), np.array(step, dtype=np.int64)
