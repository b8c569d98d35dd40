"""Measurement noise: Eq. 11's sigma, its prior and its tails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.history import Segments
from pbrl_ppl.likelihood.trajectory_noise import TrajectoryNoise
from pbrl_ppl.likelihood.transitions import Observations

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Noise:
    """The noise of a model.

    Parameters
    ----------
    scalar : bool
        One sigma for all state dimensions, as in the paper.
    trajectories : TrajectoryNoise, optional
        Noise of measured states along whole trajectories; without it start states are exact, as in
        Eq. 11.
    nu : float, optional
        Degrees of freedom of Student-t noise; Gaussian without it.
    prior : tuple, optional
        Medians of the noise parameters' prior and its log-scale; by default :func:`sigma_prior`
        takes them from the data.
    """

    scalar: bool = False
    trajectories: TrajectoryNoise | None = None
    nu: float | None = None
    prior: tuple[tuple[float, ...], float] | None = None


def sigma_prior(observations: Observations, segments: Segments) -> tuple[Array, float]:
    """Median and log-scale of the weak prior of sigma: a tenth of how much the state changes.

    Returns
    -------
    median : ndarray
        Shape (state,), in the units of the states.
    spread : float
        Standard deviation of the logarithm.
    """
    columns = observations.columns
    change = observations.residual(segments.start[:, None])
    seen = observations.measured
    typical = np.sqrt((change**2).sum((0, 1, 2)) / np.maximum(seen.sum((0, 1, 2)), 1))
    return np.maximum(0.1 * typical, 1e-9) * np.ones(len(columns)), 2.0


def estimate_sigma(residual: Array, measured: Bools) -> Array:
    """Maximum-likelihood noise of each state dimension under Eq. 11, shape (state,).

    Parameters
    ----------
    residual : ndarray
        Shape (transition, H, body, state).
    measured : ndarray
        Same shape.
    """
    count = np.maximum(measured.sum((0, 1, 2)), 1)
    # histories without noise still need a scale
    return np.asarray(np.maximum(np.sqrt((residual**2).sum((0, 1, 2)) / count), 1e-9))
