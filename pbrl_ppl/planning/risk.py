"""Risk over draws: the mean cost, or the conditional value at risk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def tail_mean(values: Array, tail: float) -> Array:
    """Mean of the worst share ``tail`` of values over the first axis; 1 is the expectation.

    Less than 1 is the conditional value at risk (Rockafellar and Uryasev, 2000).

    Examples
    --------
    >>> float(tail_mean(np.array([1.0, 2.0, 6.0, 8.0]), 0.5))
    7.0
    """
    n = len(values)
    worst = max(1, int(np.ceil(tail * n - 1e-9)))
    if worst == n:
        return np.asarray(values.mean(axis=0))
    return np.asarray(np.partition(values, n - worst, axis=0)[n - worst :].mean(axis=0))
