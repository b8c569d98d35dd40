"""Result of a search for a plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: States that a search generates at most, unless it is told otherwise: 15 s or so for one body.
NODES = 2_000_000


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search.

    Attributes
    ----------
    wrenches : ndarray
        World frame, one an interval, shape (time, body, 3), N and N m.
    reached : bool
        Whether the goal is reached, by the model.
    stopped : str
        ``goal``, ``nodes``, ``time``, ``exhausted`` or ``interrupted``.
    nodes : int
        States that were generated, each draw's own.
    seconds : float
        How long it took.
    """

    wrenches: Array
    reached: bool
    stopped: str
    nodes: int
    seconds: float
