"""Measurement and process noise along linearised trajectories."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pbrl_ppl.likelihood.coordinates import Coordinates, step_covariances
from pbrl_ppl.likelihood.kalman import adjoint, gains, innovations, score, whitened
from pbrl_ppl.likelihood.sensitivity import Sensitivity
from pbrl_ppl.physics import Memory
from pbrl_ppl.state import Bools, Floats, Ints
from pbrl_ppl.threads import in_parallel, processors


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryNoise:
    """Two noises of transitions that are linearised along their trajectories.

    Neighbouring transitions share a measured state, so their residuals are correlated. Whitened
    along the trajectory they are the innovations of a Kalman filter. The noise parameters are the
    standard deviations of a measurement, R, one a measured state dimension, followed by those of an
    unexplained acceleration, held over an interval, Q, one a velocity, of what comes on top of it
    where bodies touch: how they part depends on more than any engine knows; and of errors of
    measuring that are correlated from row to row.

    The filter's state is the coordinates as measured without a row's own error, which is the state
    plus the correlated errors, followed by those errors: each measurement then is of one of them.

    Parameters
    ----------
    coordinates : Coordinates
        Coordinates of the state.
    slope : ndarray
        Derivative F of the next state by the state, shape (transition, coordinate, coordinate).
    first : ndarray of bool
        Whether a transition is its trajectory's first, shape (transition,).
    seen : ndarray of bool
        Whether a coordinate was measured at the transition's end, shape (transition, coordinate).
    measured : ndarray
        Measured minus linearised state at the transition's end, shape (transition, coordinate).
    begin : ndarray
        The same before the transition, for the first of a trajectory; 0 where not measured.
    wide : ndarray
        Variance of that where it was not measured, 0 elsewhere, shape (transition, coordinate).
    sigma : ndarray
        Noise parameters at which it was linearised, shape (parameter,).
    touching : ndarray of bool
        Whether bodies touch in a transition, shape (transition,).
    sensitivity : Sensitivity, optional
        Derivative of the states that were linearised at by phi; without it they stay.

    Attributes
    ----------
    memory : Memory
        The filter's gains at the last few noise parameters.
    """

    coordinates: Coordinates
    slope: Floats
    first: Bools
    seen: Bools
    measured: Floats
    begin: Floats
    wide: Floats
    sigma: Floats
    touching: Bools
    sensitivity: Sensitivity | None = None
    memory: Memory = field(default_factory=Memory, init=False, repr=False)

    @cached_property
    def _extended(self) -> Extended:
        """The filter's linear model."""
        return Extended.of(self.coordinates, self.slope, self.seen)

    def _gains(self, sigma: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Gain, scale and covariance of the filter at noise parameters, and the log of the scale.

        The first three are as of :func:`kalman.gains`; the last is summed, shape (transition,).
        """
        return self.memory.recall((sigma,), self._filter_gains)

    def _filter_gains(self, sigma: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        extended = self._extended
        gain, scale, after = gains(
            extended.slope, self.first, extended.seen, self._begin(sigma),
            extended.padded(self.coordinates.white(sigma) ** 2), extended.steps(sigma), self.kind,
        )  # fmt: skip
        return gain, scale, after, np.log(scale).sum(axis=1)

    def scale(self, sigma: Floats) -> Floats:
        """Standard deviation of each innovation (transition, coordinate); 1 where not seen."""
        return self._gains(sigma)[1][:, : len(self.coordinates.places)]

    def covariance(self, sigma: Floats) -> Floats:
        """Covariance of filtered states, shape (transition, coordinate, coordinate)."""
        return self._extended.covariance(self.coordinates, self._gains(sigma)[2])

    @property
    def last(self) -> Bools:
        """Whether a transition is its trajectory's last, shape (transition,)."""
        return np.append(self.first[1:], True)

    @property
    def kind(self) -> Ints:
        """1 where bodies touch in a transition and 0 elsewhere, shape (transition,)."""
        return self.touching.astype(np.int64)

    def whiten(self, residual: Floats, sigma: Floats) -> Floats:
        """Return the whitened innovations.

        Parameters
        ----------
        residual : ndarray
            Linearised minus predicted states, shape (..., transition, 1, body, state).
        sigma : ndarray
            Noise parameters, shape (parameter,) or (..., parameter) with the same leading axes.

        Returns
        -------
        ndarray
            Shape (..., transition, coordinate), dimensionless; 0 where nothing was measured.
        """
        return self.whitened(residual, sigma)[0]

    def whitened(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return whitened innovations with the log of their standard deviations.

        The latter is summed over the coordinates, shape (..., transition) as that of sigma leads.
        """
        coordinates = self.coordinates.of_residual(residual)
        lead = coordinates.shape[:-2]
        rows = coordinates.reshape(-1, *coordinates.shape[-2:])
        if sigma.ndim == 1:
            return self.filtered(rows, sigma)[0].reshape(coordinates.shape), self._gains(sigma)[3]
        sigmas = np.broadcast_to(sigma, (*lead, sigma.shape[-1])).reshape(-1, sigma.shape[-1])
        white, log_scale = self._whitened(rows, sigmas)
        return white.reshape(coordinates.shape), log_scale.reshape(coordinates.shape[:-1])

    def _whitened(
        self, rows: Floats, sigmas: Floats, *, threads_from: int = 20_000
    ) -> tuple[Floats, Floats]:
        """Return the same of residuals (set, transition, coordinate) with a noise for each set.

        ``threads_from``: numbers to filter from which threads pay.
        """
        extended, d = self._extended, len(self.coordinates.places)
        sensor = extended.padded(self.coordinates.white(sigmas) ** 2)
        variance, step = self._begin(sigmas), extended.steps(sigmas)
        begin, measured = extended.padded(self.begin), extended.padded(self.measured)

        def some(chosen: slice) -> tuple[Floats, Floats]:
            residual = np.ascontiguousarray(extended.padded(rows[chosen]))
            result: tuple[Floats, Floats] = whitened(
                extended.slope, self.first, extended.seen, variance[chosen], sensor[chosen],
                step[chosen], self.kind, residual, begin, measured,
            )  # fmt: skip
            return result

        a_thread = -(-len(rows) // processors())
        slices = [slice(i, i + a_thread) for i in range(0, len(rows), a_thread)]
        many = rows.size > threads_from
        parts = in_parallel(some, slices) if many else list(map(some, slices))
        white, log_scale = (np.concatenate(column) for column in zip(*parts, strict=True))
        return white[..., :d], log_scale

    def filtered(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return whitened innovations and filtered deviations of residuals."""
        white, state = self._filtered(residual, sigma)
        coordinates = self.coordinates
        return white[..., : len(coordinates.places)], self._extended.states(coordinates, state)

    def _filtered(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return the same as :meth:`filtered` in the filter's extended state."""
        extended, (gain, scale, *_) = self._extended, self._gains(sigma)
        # another layout would be compiled, too
        rows = np.ascontiguousarray(extended.padded(residual))
        white, state = innovations(
            extended.slope, self.first, extended.seen, gain, scale, rows,
            extended.padded(self.begin), extended.padded(self.measured),
        )  # fmt: skip
        return white, state

    def of_coordinates(
        self, nu: float | Floats | None, shape: tuple[int, ...]
    ) -> float | Floats | None:
        """Return the degrees of freedom of each innovation, from those of residuals."""
        if not isinstance(nu, np.ndarray) or nu.ndim == 0:
            return nu
        return self.coordinates.of_residual(np.broadcast_to(nu, shape))

    def log_scale(self, sigma: Floats) -> Floats:
        """Return the summed log standard deviations of innovations, shape (transition,)."""
        return self._gains(sigma)[3]

    def smoothed(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return smoothed deviations (transition, coordinate) before and after transitions."""
        extended, coordinates = self._extended, self.coordinates
        white, filtered = self._filtered(residual[None], sigma)
        before, _, after = self._pulled(white[0], sigma)
        begin = extended.padded(self.begin) - self._begin(sigma) * before
        end = filtered[0] - np.einsum("kab,kb->ka", self._gains(sigma)[2], after)
        return extended.states(coordinates, begin), extended.states(coordinates, end)

    def pulled(self, weighted: Floats, sigma: Floats) -> Floats:
        """Return the derivative of weighted innovations by predictions (transition, coordinate)."""
        padded = self._extended.padded(weighted)
        return self._pulled(padded, sigma)[1][:, : weighted.shape[1]]

    def _pulled(self, weighted: Floats, sigma: Floats) -> tuple[Floats, Floats, Floats]:
        """Return :func:`kalman.adjoint` of weighted innovations."""
        extended, (gain, scale, *_) = self._extended, self._gains(sigma)
        pulled: tuple[Floats, Floats, Floats] = adjoint(
            extended.slope, self.last, extended.seen, gain, scale, weighted
        )
        return pulled

    def score(self, residual: Floats, sigma: Floats) -> tuple[float, Floats]:
        """Return the Gaussian log-likelihood and its derivative by the log noise parameters.

        Parameters
        ----------
        residual : ndarray
            Shape (transition, 1, body, state).
        sigma : ndarray
            Shape (parameter,).
        """
        extended, coordinates, d = self._extended, self.coordinates, len(self.coordinates.places)
        white = self._filtered(coordinates.of_residual(residual)[None], sigma)[0][0]
        gain, scale, _, log_scale = self._gains(sigma)
        sensor, step, begin, _ = score(
            extended.slope, self.last, extended.seen, gain, scale, white, self.kind
        )
        # measured states begin a trajectory: their error is that of measuring
        began = np.where(self.first[:, None], begin, 0.0)
        measured = np.where(self.wide > 0, 0.0, began[:, :d]).sum(axis=0)
        slope = np.zeros(len(sigma))
        free = coordinates.sensor >= 0
        np.add.at(slope, coordinates.sensor[free], (sensor[:d] + measured)[free])
        np.add.at(slope, coordinates.drifted[1], began[:, d:].sum(axis=0))
        steps = np.where(extended.always[:, None, None], step.sum(axis=0), step[1])
        np.add.at(
            slope, extended.pushed, np.einsum("ja,jab,jb->j", extended.push, steps, extended.push)
        )
        norm = -0.5 * np.log(2 * np.pi) * self.seen.sum()
        value = norm - 0.5 * float((white**2).sum()) - float(log_scale.sum())
        return value, sigma**2 * slope

    def auxiliary(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return standardised residuals of each measurement given all others.

        Parameters
        ----------
        residual : ndarray
            Of coordinates, shape (transition, coordinate).
        sigma : ndarray
            Shape (parameter,).

        Returns
        -------
        end, begin : ndarray
            At a transition's end, and before the first of a trajectory, shape (transition,
            coordinate) each; 0 where nothing was measured.
        """
        extended, (gain, scale, *_) = self._extended, self._gains(sigma)
        white = self._filtered(residual[None], sigma)[0][0]
        every = score(extended.slope, self.last, extended.seen, gain, scale, white, self.kind)[3]
        end, begin = every[..., : residual.shape[1]]
        return end, np.where(self.first[:, None] & ~(self.wide > 0), begin, 0.0)

    def predictive(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return the one-step predictive mean and covariance of each measurement, as deviations.

        Parameters
        ----------
        residual : ndarray
            Shape (transition, coordinate).
        sigma : ndarray
            Shape (parameter,).

        Returns
        -------
        mean, covariance : ndarray
            Shapes (transition, coordinate) and (transition, coordinate, coordinate).
        """
        extended, d, first = self._extended, len(self.coordinates.places), self.first[:, None]
        after, filtered = self._gains(sigma)[2], self._filtered(residual[None], sigma)[1][0]
        state = np.where(first, extended.padded(self.begin), np.roll(filtered, 1, axis=0))
        begin = self._begin(sigma)[:, :, None] * np.eye(extended.slope.shape[1])
        known = np.where(first[..., None], begin, np.roll(after, 1, axis=0))
        covariance = (
            extended.slope @ known @ extended.slope.transpose(0, 2, 1)
            + extended.steps(sigma)[self.kind]
        )
        return (
            np.einsum("kab,kb->ka", extended.slope, state)[:, :d] - residual,
            covariance[:, :d, :d] + np.diag(self.coordinates.white(sigma) ** 2),
        )

    def random(
        self, predicted: Floats, linearised: Floats, sigma: Floats, rng: np.random.Generator
    ) -> Floats:
        """Draw measured next states given those before (Eq. 13), shape of ``predicted``.

        Parameters
        ----------
        predicted, linearised : ndarray
            States, shape (transition, 1, body, state).
        sigma : ndarray
            Noise parameters, shape (parameter,).
        """
        mean, covariance = self.predictive(
            self.coordinates.of_residual(linearised - predicted), sigma
        )
        factor = np.linalg.cholesky(covariance)
        drawn = mean + np.einsum("kab,kb->ka", factor, rng.standard_normal(mean.shape))
        result = linearised.copy()
        body, dimension = np.divmod(self.coordinates.places, 6)
        result[:, 0, body, np.searchsorted(self.coordinates.columns, dimension)] += drawn
        return result

    def _begin(self, sigma: Floats) -> Floats:
        """Return the variance of the filter's first states at sigma (..., parameter).

        Shape (..., transition, extended).
        """
        sensor = self.coordinates.white(sigma)[..., None, :] ** 2
        state = np.where(self.wide > 0, self.wide, sensor)
        error = sigma[..., None, self.coordinates.drifted[1]] ** 2
        error = np.broadcast_to(error, (*state.shape[:-1], error.shape[-1]))
        return np.concatenate([state, error], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class Extended:
    """Linear model of the filter: coordinates plus their correlated errors, then those errors.

    A correlated error e follows ``e' = rho e + u`` (Harvey, Forecasting, Structural Time Series
    Models and the Kalman Filter, 1989, section 3.2). With ``z = x + e`` and ``x' = F x + w``,
    ``z' = F z + (rho - F) e + w + u``, and each measurement is of one coordinate of z. Without
    correlated errors it is that of the coordinates.

    Parameters
    ----------
    slope : ndarray
        Shape (transition, extended, extended).
    seen : ndarray of bool
        Shape (transition, extended).
    push : ndarray
        What a unit of each noise parameter's acceleration or error adds, shape (push, extended).
    pushed : ndarray of int
        Which noise parameter each row is of, shape (push,).
    always : ndarray of bool
        Which rows act in every step, shape (push,).
    """

    slope: Floats
    seen: Bools
    push: Floats
    pushed: Ints
    always: Bools

    @classmethod
    def of(cls, coordinates: Coordinates, slope: Floats, seen: Bools) -> Extended:
        """Return the extended model of the coordinates; arguments as of `TrajectoryNoise`."""
        at, parameters = coordinates.drifted
        if not len(at):
            return cls(slope, seen, coordinates.push, coordinates.pushed, coordinates.always)
        (n, d), k, rho = seen.shape, len(at), coordinates.memory
        chosen = np.zeros((d, k))
        chosen[at, np.arange(k)] = 1.0
        whole = np.zeros((n, d + k, d + k))
        whole[:, :d, :d] = slope
        whole[:, :d, d:] = rho * chosen - slope @ chosen
        whole[:, d:, d:] = rho * np.eye(k)
        new = np.sqrt(1.0 - rho**2) * np.hstack([chosen.T, np.eye(k)])
        push = np.vstack([np.pad(coordinates.push, ((0, 0), (0, k))), new])
        return cls(
            whole,
            np.pad(seen, ((0, 0), (0, k))),
            push,
            np.concatenate([coordinates.pushed, parameters]),
            np.concatenate([coordinates.always, np.ones(k, dtype=bool)]),
        )

    def steps(self, sigma: Floats) -> Floats:
        """Return the process noise of a step without and with contact, at sigma (..., parameter).

        Shape (..., 2, extended, extended).
        """
        return step_covariances(self.push, sigma[..., self.pushed], self.always)

    def padded(self, values: Floats) -> Floats:
        """Return values of coordinates (..., coordinate), padded with zeros for the errors."""
        more = self.slope.shape[1] - values.shape[-1]
        return np.pad(values, (*[(0, 0)] * (values.ndim - 1), (0, more))) if more else values

    def states(self, coordinates: Coordinates, extended: Floats) -> Floats:
        """Return coordinates without their errors, shape (..., coordinate)."""
        at, d = coordinates.drifted[0], len(coordinates.places)
        if not len(at):
            return extended
        result = extended[..., :d].copy()
        result[..., at] -= extended[..., d:]
        return result

    def covariance(self, coordinates: Coordinates, whole: Floats) -> Floats:
        """Return the covariance (transition, coordinate, coordinate) without errors."""
        half = self.states(coordinates, whole)
        return self.states(coordinates, half.swapaxes(-1, -2))
