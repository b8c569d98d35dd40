"""Measured next states of segments, and estimates of their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import Segments
from pbrl_ppl.state import STATE, THETA, wrapped

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Observations:
    """Measured next states of segments.

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
        """Return the observations of segments, of all measured or these dimensions.

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
        """Names of the measured dimensions."""
        return tuple(STATE[d] for d in self.columns)

    @property
    def measured(self) -> Bools:
        """Mask of measured values, shape as ``values``."""
        return np.isfinite(self.values)

    def wrapped(self, difference: Array) -> Array:
        """Wrap the angles of state differences (..., state) to (-pi, pi], in place."""
        for i, d in enumerate(self.columns):
            if d == THETA:
                difference[..., i] = wrapped(difference[..., i])
        return difference

    def residual(self, predicted: Array) -> Array:
        """Return measured minus predicted states, angles wrapped, 0 where missing.

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


def sigma_prior(observations: Observations, segments: Segments) -> tuple[Array, float]:
    """Return median and log-scale of a weak prior of sigma: a tenth of the states' change.

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
    """Return the maximum-likelihood sigma of each dimension under Eq. 11, shape (state,).

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
