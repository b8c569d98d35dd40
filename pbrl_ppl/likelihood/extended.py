"""The Kalman filter's state: observed coordinates, extended by correlated errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood.cells import Cells, step_covariances

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class Extended:
    """Linear model of the filter: cells plus their correlated errors, then those errors.

    A correlated error e follows ``e' = rho e + u`` (Harvey, Forecasting, Structural Time Series
    Models and the Kalman Filter, 1989, section 3.2). With ``z = x + e`` and ``x' = F x + w``,
    ``z' = F z + (rho - F) e + w + u``, and each measurement is of one coordinate of z. Without
    correlated errors it is that of the cells.

    Parameters
    ----------
    slope : ndarray
        Shape (transition, coordinate, coordinate).
    seen : ndarray of bool
        Shape (transition, coordinate).
    push : ndarray
        What a unit of each noise parameter's acceleration or error adds, shape (push, coordinate).
    pushed : ndarray of int
        Which noise parameter each row is of, shape (push,).
    always : ndarray of bool
        Which rows act in every step, shape (push,).
    """

    slope: Array
    seen: Bools
    push: Array
    pushed: Ints
    always: Bools

    @classmethod
    def of(cls, cells: Cells, slope: Array, seen: Bools) -> Extended:
        """Return the extended model of the cells; arguments as of `TrajectoryNoise`."""
        at, parameters = cells.drifted
        if not len(at):
            return cls(slope, seen, cells.push, cells.pushed, cells.always)
        (n, d), k, rho = seen.shape, len(at), cells.memory
        chosen = np.zeros((d, k))
        chosen[at, np.arange(k)] = 1.0
        whole = np.zeros((n, d + k, d + k))
        whole[:, :d, :d] = slope
        whole[:, :d, d:] = rho * chosen - slope @ chosen
        whole[:, d:, d:] = rho * np.eye(k)
        new = np.sqrt(1.0 - rho**2) * np.hstack([chosen.T, np.eye(k)])
        push = np.vstack([np.pad(cells.push, ((0, 0), (0, k))), new])
        return cls(
            whole,
            np.pad(seen, ((0, 0), (0, k))),
            push,
            np.concatenate([cells.pushed, parameters]),
            np.concatenate([cells.always, np.ones(k, dtype=bool)]),
        )

    def steps(self, sigma: Array) -> Array:
        """Return the process noise of a step without and with contact.

        Shape (2, coordinate, coordinate).
        """
        return step_covariances(self.push, sigma[self.pushed], self.always)

    def padded(self, values: Array) -> Array:
        """Return values of cells (..., cell), padded with zeros for the errors."""
        more = self.slope.shape[1] - values.shape[-1]
        return np.pad(values, (*[(0, 0)] * (values.ndim - 1), (0, more))) if more else values

    def states(self, cells: Cells, coordinates: Array) -> Array:
        """Return cells without their errors, shape (..., cell)."""
        at, d = cells.drifted[0], len(cells.places)
        if not len(at):
            return coordinates
        result = coordinates[..., :d].copy()
        result[..., at] -= coordinates[..., d:]
        return result

    def covariance(self, cells: Cells, whole: Array) -> Array:
        """Return the covariance of cells without errors, shape (transition, cell, cell)."""
        half = self.states(cells, whole)
        return self.states(cells, half.swapaxes(-1, -2))
