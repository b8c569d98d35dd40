"""Noise of measured start states, propagated to first order, and the noise's maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class StartNoise:
    """First-order propagation of a measured start state's noise to the segment's predictions.

    To first order the residual's covariance is ``S + F S F^T``, with ``S = diag(sigma^2)`` and
    ``F`` the derivative of the prediction by the start state. Its correlation and the ratio of its
    scale to sigma are kept; sigma itself stays free. Without it: Eq. 11.

    Parameters
    ----------
    gain : ndarray
        Standard deviation over sigma, shape (transition, cell), cells being H x body x state.
    unmix : ndarray
        Inverse Cholesky factor of the correlation, shape (transition, cell, cell).
    log_det : ndarray
        Sum of log gains and half the log-determinant of the correlation, shape (transition,).
    """

    gain: Array
    unmix: Array
    log_det: Array

    @classmethod
    def of(cls, sensitivity: Array, measured: Bools, sigma: Array) -> StartNoise:
        """Build from a sensitivity at a reference sigma.

        Parameters
        ----------
        sensitivity : ndarray
            F, shape (transition, cell, start cell); start cells being body x state.
        measured : ndarray
            Whether a cell was measured, shape (transition, cell).
        sigma : ndarray
            Reference noise of each state dimension, shape (state,).
        """
        covariance = _covariance(sensitivity, measured, sigma)
        own = np.tile(sigma, sensitivity.shape[1] // len(sigma))
        scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        correlation = covariance / (scale[:, :, None] * scale[:, None, :])
        factor = np.linalg.cholesky(correlation)
        eye = np.broadcast_to(np.eye(factor.shape[-1]), factor.shape)
        gain = np.where(measured, scale / own, 1.0)
        log_det = np.log(gain).sum(axis=1) + np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(
            axis=1
        )
        return cls(gain, np.asarray(np.linalg.solve(factor, eye), dtype=float), log_det)


def _covariance(sensitivity: Array, measured: Bools, sigma: Array) -> Array:
    """S + F S F^T over measured cells; missing ones are independent of the rest."""
    cells, starts = sensitivity.shape[1:]
    spread = sensitivity * np.tile(sigma, starts // len(sigma))
    spread = np.where(measured[:, :, None], spread, 0.0)
    own = np.tile(sigma**2, cells // len(sigma))
    return np.asarray(spread @ spread.transpose(0, 2, 1) + np.eye(cells) * own)


def estimate_sigma(residual: Array, measured: Bools, sensitivity: Array | None) -> Array:
    """Maximum-likelihood noise of each state dimension, given residuals.

    Parameters
    ----------
    residual : ndarray
        Shape (transition, H, body, state).
    measured : ndarray
        Same shape.
    sensitivity : ndarray, optional
        F; without it the start state counts as exact.

    Returns
    -------
    ndarray
        Shape (state,), in the units of the states.
    """
    count = np.maximum(measured.sum((0, 1, 2)), 1)
    sigma = np.sqrt((residual**2).sum((0, 1, 2)) / count)
    sigma = np.maximum(sigma, 1e-9)  # noise-free histories still need a scale
    if sensitivity is None:
        return np.asarray(sigma)
    n = len(residual)
    flat, seen = residual.reshape(n, -1), measured.reshape(n, -1)

    def cost(log_sigma: Array) -> float:
        factor = np.linalg.cholesky(_covariance(sensitivity, seen, np.exp(log_sigma)))
        z = np.linalg.solve(factor, flat[:, :, None])[:, :, 0]
        own = np.tile(log_sigma, seen.shape[1] // len(log_sigma))
        log_det = (
            np.log(np.diagonal(factor, axis1=1, axis2=2)).sum() - np.where(seen, 0.0, own).sum()
        )
        return float(0.5 * (z**2).sum() + log_det)

    begin = np.log(sigma / 1.5)
    result = minimize(cost, begin, method="L-BFGS-B", bounds=[(b - 7, b + 3) for b in begin])
    return np.asarray(np.exp(result.x))
