"""Noise along trajectories: errors of measured states, and what a step adds, told apart."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.model.cells import Cells
from pbrl_ppl.model.kalman import adjoint, gains, innovations, score
from pbrl_ppl.model.sensitivity import Sensitivity

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryNoise:
    """Two noises of transitions that are linearised along their trajectories.

    Neighbouring transitions share a measured state, so their residuals are correlated. Whitened
    along the trajectory they are the innovations of a Kalman filter. The noise parameters are the
    standard deviations of a measurement, R, one a measured state dimension, followed by those of an
    unexplained acceleration, held over an interval, Q, one a velocity, and of what comes on top of
    it where bodies touch: how they part hangs on more than any engine knows.

    Parameters
    ----------
    cells : Cells
        Coordinates of the state.
    slope : ndarray
        Derivative F of the next state by the state, shape (transition, cell, cell).
    first : ndarray of bool
        Whether a transition is its trajectory's first, shape (transition,).
    seen : ndarray of bool
        Whether a cell was measured at the transition's end, shape (transition, cell).
    measured : ndarray
        Measured minus linearised state at the transition's end, shape (transition, cell).
    begin : ndarray
        The same before the transition, for the first of a trajectory; 0 where not measured.
    wide : ndarray
        Variance of that where it was not measured, 0 elsewhere, shape (transition, cell).
    sigma : ndarray
        Noise parameters at which it was linearised, shape (parameter,).
    touching : ndarray of bool
        Whether bodies touch in a transition, shape (transition,).
    sensitivity : Sensitivity, optional
        How the states that were linearised at follow the parameters; without it they stay.
    """

    cells: Cells
    slope: Array
    first: Bools
    seen: Bools
    measured: Array
    begin: Array
    wide: Array
    sigma: Array
    touching: Bools
    sensitivity: Sensitivity | None = None
    _known: dict[bytes, tuple[Array, Array, Array, Array]] = field(
        default_factory=dict, init=False, repr=False
    )

    def gains(self, sigma: Array) -> tuple[Array, Array, Array, Array]:
        """Gain, scale and covariance of a filter at noise parameters, and the log of the scale.

        The first three are as of :func:`kalman.gains`; the last is summed, shape (transition,).
        """
        key = np.ascontiguousarray(sigma).tobytes()
        known = self._known.get(key)
        if known is None:
            if len(self._known) > 3:
                self._known.clear()
            sensor = self.cells.errors(sigma) ** 2
            gain, scale, after = gains(
                self.slope, self.first, self.seen, self._begin(sigma), sensor,
                self.cells.steps(sigma), self.kind,
            )  # fmt: skip
            known = self._known[key] = gain, scale, after, np.log(scale).sum(axis=1)
        return known

    @property
    def last(self) -> Bools:
        """Whether a transition is its trajectory's last, shape (transition,)."""
        return np.append(self.first[1:], True)

    @property
    def kind(self) -> Ints:
        """1 where bodies touch in a transition and 0 elsewhere, shape (transition,)."""
        return self.touching.astype(np.int64)

    def whiten(self, residual: Array, sigma: Array) -> Array:
        """Innovations over their standard deviations.

        Parameters
        ----------
        residual : ndarray
            Linearised minus predicted states, shape (..., transition, 1, body, state).
        sigma : ndarray
            Noise parameters, shape (parameter,) or (..., parameter) with the same leading axes.

        Returns
        -------
        ndarray
            Shape (..., transition, cell), dimensionless; 0 where nothing was measured.
        """
        return self.whitened(residual, sigma)[0]

    def whitened(self, residual: Array, sigma: Array) -> tuple[Array, Array]:
        """As :meth:`whiten`, with the logarithm of the standard deviations.

        The latter is summed over the cells, shape (..., transition) as that of sigma leads.
        """
        cells = self.cells.of_residual(residual)
        lead = cells.shape[:-2]
        rows = cells.reshape(-1, *cells.shape[-2:])
        if sigma.ndim == 1:
            return self.filtered(rows, sigma)[0].reshape(cells.shape), self.gains(sigma)[3]
        sigmas = np.broadcast_to(sigma, (*lead, sigma.shape[-1])).reshape(-1, sigma.shape[-1])
        own, which = np.unique(sigmas, axis=0, return_inverse=True)
        white, log_scale = np.empty_like(rows), np.empty(rows.shape[:-1])
        for i, row in enumerate(own):
            mine = which.ravel() == i
            white[mine], log_scale[mine] = self.filtered(rows[mine], row)[0], self.gains(row)[3]
        return white.reshape(cells.shape), log_scale.reshape(cells.shape[:-1])

    def filtered(self, residual: Array, sigma: Array) -> tuple[Array, Array]:
        """White innovations and filtered deviations of cells' residuals (set, transition, cell)."""
        gain, scale, *_ = self.gains(sigma)
        rows = np.ascontiguousarray(residual)  # another layout would be compiled for, too
        white, state = innovations(
            self.slope, self.first, self.seen, gain, scale, rows, self.begin, self.measured
        )
        return white, state

    def of_cells(self, nu: float | Array | None, shape: tuple[int, ...]) -> float | Array | None:
        """Degrees of freedom of each innovation, of those of residuals of this shape."""
        if not isinstance(nu, np.ndarray) or nu.ndim == 0:
            return nu
        return self.cells.of_residual(np.broadcast_to(nu, shape))

    def log_scale(self, sigma: Array) -> Array:
        """Logarithm of the innovations' standard deviations, summed, shape (transition,)."""
        return self.gains(sigma)[3]

    def smoothed(self, residual: Array, sigma: Array) -> tuple[Array, Array]:
        """Smoothed deviations before and after each transition, shape (transition, cell) each."""
        white, filtered = self.filtered(residual[None], sigma)
        before, _, after = self.pulled(white[0], sigma)
        return (
            self.begin - self._begin(sigma) * before,
            filtered[0] - np.einsum("kab,kb->ka", self.gains(sigma)[2], after),
        )

    def pulled(self, weighted: Array, sigma: Array) -> tuple[Array, Array, Array]:
        """Derivatives of a sum of white innovations, see :func:`kalman.adjoint`."""
        gain, scale, *_ = self.gains(sigma)
        pulled: tuple[Array, Array, Array] = adjoint(
            self.slope, self.last, self.seen, gain, scale, weighted
        )
        return pulled

    def score(self, residual: Array, sigma: Array) -> tuple[float, Array]:
        """Gaussian log-likelihood, and its derivative by the logarithm of the noise parameters.

        Parameters
        ----------
        residual : ndarray
            Shape (transition, 1, body, state).
        sigma : ndarray
            Shape (parameter,).
        """
        white = self.filtered(self.cells.of_residual(residual)[None], sigma)[0][0]
        gain, scale, _, log_scale = self.gains(sigma)
        sensor, step, begin = score(self.slope, self.last, self.seen, gain, scale, white, self.kind)
        # measured states begin a trajectory: their error is that of measuring
        begun = np.where(self.first[:, None] & ~(self.wide > 0), begin, 0.0).sum(axis=0)
        cells, slope = self.cells, np.zeros(len(sigma))
        free = cells.sensor >= 0
        np.add.at(slope, cells.sensor[free], (sensor + begun)[free])
        steps = np.where(cells.always[:, None, None], step.sum(axis=0), step[1])
        np.add.at(slope, cells.pushed, np.einsum("ja,jab,jb->j", cells.push, steps, cells.push))
        norm = -0.5 * np.log(2 * np.pi) * self.seen.sum()
        value = norm - 0.5 * float((white**2).sum()) - float(log_scale.sum())
        return value, sigma**2 * slope

    def foreseen(self, residual: Array, sigma: Array) -> tuple[Array, Array]:
        """Mean and covariance of each measurement, as deviations, given those before it.

        Parameters
        ----------
        residual : ndarray
            Shape (transition, cell).
        sigma : ndarray
            Shape (parameter,).

        Returns
        -------
        mean, covariance : ndarray
            Shapes (transition, cell) and (transition, cell, cell).
        """
        after, filtered = self.gains(sigma)[2], self.filtered(residual[None], sigma)[1][0]
        first = self.first[:, None]
        state = np.where(first, self.begin, np.roll(filtered, 1, axis=0))
        begin = self._begin(sigma)[:, :, None] * np.eye(len(self.cells.places))
        known = np.where(first[..., None], begin, np.roll(after, 1, axis=0))
        step = self.cells.steps(sigma)[self.kind]
        covariance = self.slope @ known @ self.slope.transpose(0, 2, 1) + step
        return (
            np.einsum("kab,kb->ka", self.slope, state) - residual,
            covariance + np.diag(self.cells.errors(sigma) ** 2),
        )

    def random(
        self, predicted: Array, linearised: Array, sigma: Array, rng: np.random.Generator
    ) -> Array:
        """Draw measured next states, given those before (Eq. 13), shape of ``predicted``.

        Parameters
        ----------
        predicted, linearised : ndarray
            States, shape (transition, 1, body, state).
        sigma : ndarray
            Noise parameters, shape (parameter,).
        """
        mean, covariance = self.foreseen(self.cells.of_residual(linearised - predicted), sigma)
        factor = np.linalg.cholesky(covariance)
        drawn = mean + np.einsum("kab,kb->ka", factor, rng.standard_normal(mean.shape))
        result = linearised.copy()
        body, dimension = np.divmod(self.cells.places, 6)
        result[:, 0, body, np.searchsorted(self.cells.columns, dimension)] += drawn
        return result

    def _begin(self, sigma: Array) -> Array:
        """Variance of the state before each transition that is its trajectory's first."""
        return np.where(self.wide > 0, self.wide, self.cells.errors(sigma) ** 2)
