"""Derivatives by finite differences, all columns in one call of a batched function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def differentiate(
    function: Callable[[Array], Array], point: Array, steps: Array, lower: Array, upper: Array
) -> Array:
    """Derivative by finite differences: central where the bounds leave room, one-sided elsewhere.

    Parameters
    ----------
    function : callable
        Takes points of shape (2 p, p), gives values of shape (2 p, ...).
    point, steps, lower, upper : ndarray
        Point, step and bounds of each parameter, shape (p,); a step of zero leaves its column zero.

    Returns
    -------
    ndarray
        Shape (..., p).

    Examples
    --------
    >>> x, far = np.array([3.0]), np.array([np.inf])
    >>> differentiate(lambda points: points[:, 0] ** 2, x, np.array([1e-4]), -far, far).round(6)
    array([6.])
    """
    forward = np.minimum(point + steps, upper)
    backward = np.maximum(point - steps, lower)
    p = len(point)
    points = np.tile(point, (2 * p, 1))
    points[np.arange(p), np.arange(p)] = forward
    points[p + np.arange(p), np.arange(p)] = backward
    values = function(points)
    width = np.maximum(forward - backward, 1e-300)
    return np.asarray(np.moveaxis(values[:p] - values[p:], 0, -1) / width)
