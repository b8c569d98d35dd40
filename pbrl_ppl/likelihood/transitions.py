"""Eqs. 11 and 12: the likelihood of Gaussian or Student-t next states."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import Segments
from pbrl_ppl.likelihood.trajectory_noise import TrajectoryNoise
from pbrl_ppl.state import STATE, THETA, wrapped

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: Degrees of freedom from which on a Student-t counts as Gaussian.
GAUSSIAN = 1e7


@dataclass(frozen=True)
class Observations:
    """Measured next states of segments, with the state dimensions that were measured at all.

    Parameters
    ----------
    values : ndarray
        Shape (transition, H, body, state), NaN where missing.
    columns : tuple of int
        Which of the six state dimensions the last axis holds.
    """

    values: Array
    columns: tuple[int, ...]

    @classmethod
    def of(cls, segments: Segments, columns: tuple[int, ...] | None = None) -> Observations:
        """Take the dimensions that were measured anywhere, or these.

        Raises
        ------
        HistoryError
            If nothing was measured.
        """
        observed = segments.observed
        measured = tuple(
            d for d in range(len(STATE)) if observed.size and np.isfinite(observed[..., d]).any()
        )
        if not measured:
            raise HistoryError(
                "history: it has no measured next state within"
                f" {segments.horizon} interval{'s' * (segments.horizon > 1)} of a complete state;"
                " use a longer horizon, or record more"
            )
        columns = measured if columns is None else columns
        return cls(observed[..., columns], columns)

    @property
    def names(self) -> tuple[str, ...]:
        """The measured dimensions' names."""
        return tuple(STATE[d] for d in self.columns)

    @property
    def measured(self) -> Bools:
        """Whether a cell was measured, shape as ``values``."""
        return np.isfinite(self.values)

    def wrapped(self, difference: Array) -> Array:
        """Differences of states, shape (..., state), with angles wrapped in place to (-pi, pi]."""
        for i, d in enumerate(self.columns):
            if d == THETA:
                difference[..., i] = wrapped(difference[..., i])
        return difference

    def residual(self, predicted: Array) -> Array:
        """Measured minus predicted, angles wrapped to (-pi, pi], 0 where missing.

        Parameters
        ----------
        predicted : ndarray
            Shape (..., transition, H, body, 6).

        Returns
        -------
        ndarray
            Shape (..., transition, H, body, state).
        """
        difference = self.wrapped(self.values - predicted[..., self.columns])
        difference[..., ~self.measured] = 0.0
        return np.asarray(difference)


def whiten(residual: Array, sigma: Array, noise: TrajectoryNoise | None) -> Array:
    """Residuals in units of their noise, independent of each other if the model is right.

    Parameters
    ----------
    residual : ndarray
        Shape (..., transition, H, body, state).
    sigma : ndarray
        Noise of each state dimension, shape (state,) or (..., state) with the same leading axes.
    noise : TrajectoryNoise or None
        What correlates residuals along trajectories; without it they are independent (Eq. 11).

    Returns
    -------
    ndarray
        Shape (..., transition, cell), dimensionless.
    """
    if noise is not None:
        return noise.whiten(residual, sigma)
    scaled = residual / np.asarray(sigma)[..., None, None, None, :]
    return np.asarray(scaled.reshape(*scaled.shape[:-3], -1))


def log_density(
    residual: Array,
    sigma: Array,
    noise: TrajectoryNoise | None,
    measured: Bools,
    nu: float | Array | None = None,
) -> Array:
    """Log-likelihood of each transition (Eq. 11), in numpy.

    Parameters
    ----------
    residual : ndarray
        Shape (..., transition, H, body, state).
    sigma : ndarray
        Shape (..., state).
    noise : TrajectoryNoise or None
        What correlates residuals along trajectories.
    measured : ndarray
        Shape (transition, H, body, state).
    nu : float or ndarray, optional
        Degrees of freedom of a Student-t distribution, broadcasting against the residual; without
        it, or where it is infinite, Gaussian.

    Returns
    -------
    ndarray
        Shape (..., transition); minus infinity where the engine diverged.
    """
    if noise is not None:
        z, log_scale = noise.whitened(residual, sigma)
        nu = noise.of_cells(nu, residual.shape)
        norm = np.where(noise.seen, log_norm(nu), 0.0).sum(axis=-1)
        result = norm - 0.5 * (robust(z, nu) ** 2).sum(-1) - log_scale
        return np.where(np.isnan(result), -np.inf, result)
    z = whiten(residual, sigma, noise)
    log_sigma = np.where(measured, np.log(sigma)[..., None, None, None, :], 0.0).sum((-1, -2, -3))
    norm = np.where(measured, log_norm(nu), 0.0).sum((-1, -2, -3))
    result = -0.5 * (robust(z, cells(nu, residual.shape)) ** 2).sum(-1) - log_sigma + norm
    return np.where(np.isnan(result), -np.inf, result)


def cells(nu: float | Array | None, shape: tuple[int, ...]) -> float | Array | None:
    """Degrees of freedom of whitened residuals (..., transition, cell), for this shape."""
    if not isinstance(nu, np.ndarray) or nu.ndim == 0:
        return nu
    return np.broadcast_to(nu, shape).reshape(*shape[:-3], -1)


def robust(z: Array, nu: float | Array | None) -> Array:
    """Least-squares residuals: half their squares are the negative log-density but a constant.

    Parameters
    ----------
    z : ndarray
        Residuals in units of their noise, any shape.
    nu : float, ndarray or None
        Degrees of freedom; None or infinite for a Gaussian, whose residuals stay as they are.

    Examples
    --------
    >>> robust(np.array([0.1, 30.0]), 4.0).round(2)
    array([0.11, 5.21])
    """
    if nu is None:
        return z
    heavy = np.less(nu, GAUSSIAN)
    nu = np.where(heavy, nu, 1.0)
    return np.asarray(np.where(heavy, np.sign(z) * np.sqrt((nu + 1) * np.log1p(z**2 / nu)), z))


def log_norm(nu: float | Array | None) -> Array:
    """Logarithm of a standard Student-t's (or normal's) density at zero."""
    normal = np.asarray(-0.5 * math.log(2 * math.pi))
    if nu is None:
        return normal
    heavy = np.less(nu, GAUSSIAN)
    nu = np.where(heavy, nu, 1.0)
    norm = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi)
    return np.asarray(np.where(heavy, norm, normal))


def next_state_random(
    predicted: Any,
    sigma: Any,
    rng: np.random.Generator,
    size: Any = None,
    nu: float | Array | None = None,
) -> Array:
    """Draw next states by Eq. 13, shape as ``predicted``: (..., transition, H, body, state)."""
    predicted = np.asarray(predicted)
    shape = predicted.shape
    if nu is None:
        z = rng.standard_normal(shape)
    elif np.ndim(nu) == 0:
        z = rng.standard_t(nu, shape)
    else:
        heavy = np.less(nu, GAUSSIAN)
        heavy_z = rng.standard_t(np.where(heavy, nu, 1.0), shape)
        z = np.where(heavy, heavy_z, rng.standard_normal(shape))
    return np.asarray(predicted + z * np.asarray(sigma))
