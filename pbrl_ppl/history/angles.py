"""Angles without jumps of a turn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def unwrapped(time: Floats, angle: Floats, rate: Floats) -> Floats:
    """Angles without jumps; measured rates say how often a body has turned round meanwhile.

    Parameters
    ----------
    time, angle, rate : ndarray
        Shape (n,): s, rad, rad/s. A rate that is not known everywhere is not used.

    Examples
    --------
    >>> time = np.arange(4.0)
    >>> unwrapped(time, np.array([0.0, 1.0, 2.0, 3.0]), np.full(4, 7.0)).round(3)
    array([ 0.   ,  7.283, 14.566, 21.85 ])
    """
    if not np.isfinite(rate).all():
        return np.asarray(np.unwrap(angle))
    turned = np.cumsum(0.5 * np.diff(time) * (rate[1:] + rate[:-1]))
    turned = np.concatenate([np.zeros(1), turned])
    return np.asarray(np.unwrap(angle - turned) + turned)
