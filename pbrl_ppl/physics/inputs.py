"""Inputs of intervals: the wrench, the one before, and when."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def after_recording(wrenches: Array, previous: Array) -> Array:
    """Inputs of intervals that begin when the recording has ended.

    Parameters
    ----------
    wrenches, previous : ndarray
        Wrenches of each interval and of the one before, shape (..., 3) each.

    Returns
    -------
    ndarray
        Shape (..., 9), as in :data:`pbrl_ppl.state.INPUT`.
    """
    return np.concatenate([wrenches, previous, np.full_like(wrenches, np.inf)], axis=-1)
