"""Measurement and process noise along linearised trajectories, and the states' sensitivity.

A parameter and the states are often known together far better than each alone, such as a wheel's
angle and a heading. With the states held fast, another angle would be judged by motions that no
body made: by slips and stops that are not there. Predictions start from the states that go with the
parameters, to first order, and are taken back along the slope by as much: where the motion is
linear, nothing changes. See E. L. Haseltine and J. B. Rawlings, Critical evaluation of extended
Kalman filtering and moving-horizon estimation (2005), on the point of linearisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pbrl_ppl.likelihood.coordinates import Coordinates
from pbrl_ppl.likelihood.kalman import adjoint, gains, innovations, score, whitened
from pbrl_ppl.parameters import Layout, change_from, covariance_factor
from pbrl_ppl.physics import Memory
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Bools, Floats
from pbrl_ppl.system.threads import in_parallel, processors

#: Predicts next states from phi, initial states and inputs, as a simulator does.
Engine = Callable[[Floats, Floats, Floats], Floats]


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity:
    """Derivative of the initial states of transitions by the parameters.

    Parameters
    ----------
    scene : Scene
        Its hinges hold hung bodies.
    layout : Layout
        Order of phi.
    coordinates : Coordinates
        Coordinates of the state.
    slope : ndarray
        Derivative of the next state by the state, shape (transition, coordinate, coordinate).
    phi : ndarray
        Parameters that the states were smoothed with, one set a transition, shape (transition, p).
    before : ndarray
        Derivative of the state before each transition, shape (transition, coordinate, p).
    """

    scene: Scene
    layout: Layout
    coordinates: Coordinates
    slope: Floats
    phi: Floats
    before: Floats

    @cached_property
    def _sets(self) -> list[tuple[Floats, Bools, Floats]]:
        """Parameter sets of phi, the transitions of each, and their derivatives.

        The latter have the shape (transition * coordinate, p).
        """
        sets, which = np.unique(self.phi, axis=0, return_inverse=True)
        rows = [which.ravel() == i for i in range(len(sets))]
        parts = [self.before[row].reshape(-1, self.phi.shape[1]) for row in rows]
        return list(zip(sets, rows, parts, strict=True))

    def moved(self, phi: Floats) -> Floats:
        """Return the change of the states with phi, shape (..., transition, coordinate)."""
        result = np.empty((*phi.shape[:-1], *self.before.shape[:2]))
        for before, rows, by_phi in self._sets:
            change = change_from(self.layout, phi, before) @ by_phi.T
            result[..., rows, :] = change.reshape(*phi.shape[:-1], -1, result.shape[-1])
        return result

    def begun(self, moved: Floats, start: Floats) -> Floats:
        """Return moved initial states, shape (..., transition, body, 6)."""
        states = np.broadcast_to(start, (*moved.shape[:-2], *start.shape))
        return self.coordinates.completed(self.scene, self._added(states, moved))

    def predicted(self, engine: Engine, phi: Floats, start: Floats, inputs: Floats) -> Floats:
        """Return next states from smoothed initial states, shape (..., transition, 1, body, 6).

        Parameters
        ----------
        engine : callable
            As :class:`pbrl_ppl.physics.PartedSimulator`.
        phi : ndarray
            Parameters, shape (..., p).
        start : ndarray
            Smoothed states before the transitions, shape (transition, body, 6), SI units.
        inputs : ndarray
            What acts, shape (transition, 1, body, 3 or 9).
        """
        # a million times its typical size is divergence
        moved, limit = self.moved(phi), 1e6 * self.coordinates.sizes(self.scene)
        moved = np.where(np.abs(moved) < limit, moved, np.nan)  # nothing is predicted from there
        states = engine(phi, self.begun(np.nan_to_num(moved), start), inputs)
        back = np.matmul(self.slope, moved[..., None])[..., 0]
        return self._added(states, -back[..., None, :])

    def _added(self, states: Floats, change: Floats) -> Floats:
        """Return states (..., body, 6) with changed coordinates (..., coordinate)."""
        states = np.array(states, order="C")  # so that what is reshaped is a view of it
        flat = states.reshape(*states.shape[:-2], -1)
        flat[..., self.coordinates.places] += change
        return states


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryNoise:
    """Two noises of transitions that are linearised along their trajectories.

    Neighbouring transitions share a measured state, so their residuals are correlated. Whitened
    along the trajectory they are the innovations of a Kalman filter. The noise parameters are the
    standard deviations of a measurement, R, one a measured state dimension, followed by those of an
    unexplained acceleration, held over an interval, Q, one a velocity, and of what comes on top of
    it where bodies touch: how they part depends on more than any engine knows.

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
    initial_variance : ndarray
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
    initial_variance: Floats
    sigma: Floats
    touching: Bools
    sensitivity: Sensitivity | None = None
    memory: Memory = field(default_factory=Memory, init=False, repr=False)

    def _gains(self, sigma: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Gain, scale and covariance of the filter at noise parameters, and the log of the scale.

        The first three are as of :func:`kalman.gains`; the last is summed, shape (transition,).
        """
        return self.memory.recall((sigma,), self._filter_gains)

    def _filter_gains(self, sigma: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        gain, scale, after = gains(
            self.slope, self.first, self.seen, self._begin(sigma),
            self.coordinates.errors(sigma) ** 2, self.coordinates.steps(sigma), self.touching,
        )  # fmt: skip
        return gain, scale, after, np.log(scale).sum(axis=1)

    def scale(self, sigma: Floats) -> Floats:
        """Standard deviation of each innovation (transition, coordinate); 1 where not seen."""
        return self._gains(sigma)[1]

    def covariance(self, sigma: Floats) -> Floats:
        """Covariance of filtered states, shape (transition, coordinate, coordinate)."""
        return self._gains(sigma)[2]

    def whitened(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return whitened innovations with the log of their standard deviations.

        Parameters
        ----------
        residual : ndarray
            Linearised minus predicted states, shape (..., transition, 1, body, state).
        sigma : ndarray
            Noise parameters, shape (parameter,) or (..., parameter) with the same leading axes.

        Returns
        -------
        white : ndarray
            Shape (..., transition, coordinate), dimensionless; 0 where nothing was measured, NaN
            where the filter diverged.
        log_scale : ndarray
            Summed over the coordinates, shape (..., transition) as that of sigma leads.
        """
        coordinates = self.coordinates.of_residual(residual)
        lead = coordinates.shape[:-2]
        rows = coordinates.reshape(-1, *coordinates.shape[-2:])
        if sigma.ndim == 1:
            white, log_scale = self.filtered(rows, sigma)[0], self._gains(sigma)[3]
        else:
            sigmas = np.broadcast_to(sigma, (*lead, sigma.shape[-1])).reshape(-1, sigma.shape[-1])
            white, log_scale = self._whitened(rows, sigmas)
            log_scale = log_scale.reshape(coordinates.shape[:-1])
        white = np.where(np.abs(white) < 1e100, white, np.nan)  # squares would overflow
        return white.reshape(coordinates.shape), log_scale

    def _whitened(self, rows: Floats, sigmas: Floats) -> tuple[Floats, Floats]:
        """Return the same of residuals (set, transition, coordinate) with a noise for each set."""
        sensor = self.coordinates.errors(sigmas) ** 2
        variance, step = self._begin(sigmas), self.coordinates.steps(sigmas)

        def some(chosen: slice) -> tuple[Floats, Floats]:
            residual = np.ascontiguousarray(rows[chosen])
            result: tuple[Floats, Floats] = whitened(
                self.slope, self.first, self.seen, variance[chosen], sensor[chosen],
                step[chosen], self.touching, residual, self.begin, self.measured,
            )  # fmt: skip
            return result

        a_thread = -(-len(rows) // processors())
        slices = [slice(i, i + a_thread) for i in range(0, len(rows), a_thread)]
        # threads pay for many numbers alone
        parts = in_parallel(some, slices) if rows.size > 20_000 else list(map(some, slices))
        white, log_scale = (np.concatenate(column) for column in zip(*parts, strict=True))
        return white, log_scale

    def filtered(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return whitened innovations and filtered deviations of residuals."""
        gain, scale, *_ = self._gains(sigma)
        rows = np.ascontiguousarray(residual)  # another layout would be compiled, too
        filtered: tuple[Floats, Floats] = innovations(
            self.slope, self.first, self.seen, gain, scale, rows, self.begin, self.measured
        )
        return filtered

    def log_scale(self, sigma: Floats) -> Floats:
        """Return the summed log standard deviations of innovations, shape (transition,)."""
        return self._gains(sigma)[3]

    def smoothed(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return smoothed deviations (transition, coordinate) before and after transitions."""
        white, filtered = self.filtered(residual[None], sigma)
        before, _, after = self.adjoint(white[0], sigma)
        begin = self.begin - self._begin(sigma) * before
        return begin, filtered[0] - np.einsum("kab,kb->ka", self._gains(sigma)[2], after)

    def adjoint(self, weighted: Floats, sigma: Floats) -> tuple[Floats, Floats, Floats]:
        """Return :func:`kalman.adjoint` of weighted innovations."""
        gain, scale, *_ = self._gains(sigma)
        pulled: tuple[Floats, Floats, Floats] = adjoint(
            self.slope, self.first, self.seen, gain, scale, weighted
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
        coordinates = self.coordinates
        white, sensor, step, begin, _ = self._score(coordinates.of_residual(residual), sigma)
        measured = np.where(self._begun, begin, 0.0).sum(axis=0)
        slope = np.zeros(len(sigma))
        free = coordinates.sensor >= 0
        np.add.at(slope, coordinates.sensor[free], (sensor + measured)[free])
        steps = np.where(coordinates.always[:, None, None], step.sum(axis=0), step[1])
        push = coordinates.push
        np.add.at(slope, coordinates.pushed, np.einsum("ja,jab,jb->j", push, steps, push))
        norm = -0.5 * np.log(2 * np.pi) * self.seen.sum()
        with np.errstate(over="ignore"):  # minus infinity where innovations leave the numbers
            square = float((white**2).sum())
        value = norm - 0.5 * square - float(self.log_scale(sigma).sum())
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
        end, begin = self._score(residual, sigma)[-1]
        return end, np.where(self._begun, begin, 0.0)

    @property
    def _begun(self) -> Bools:
        """Measured states that begin a trajectory, whose error is that of measuring."""
        return self.first[:, None] & ~(self.initial_variance > 0)

    def _score(self, residual: Floats, sigma: Floats) -> tuple[Floats, ...]:
        """Return white innovations of residuals (transition, coordinate), and `kalman.score`."""
        white, (gain, scale, *_) = self.filtered(residual[None], sigma)[0][0], self._gains(sigma)
        return white, *score(self.slope, self.first, self.seen, gain, scale, white, self.touching)

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
        first, coordinates = self.first[:, None], self.coordinates
        after, filtered = self._gains(sigma)[2], self.filtered(residual[None], sigma)[1][0]
        state = np.where(first, self.begin, np.roll(filtered, 1, axis=0))
        begin = self._begin(sigma)[:, :, None] * np.eye(len(coordinates.places))
        known = np.where(first[..., None], begin, np.roll(after, 1, axis=0))
        covariance = self.slope @ known @ self.slope.transpose(0, 2, 1)
        covariance += coordinates.steps(sigma)[self.touching.astype(int)]
        return (
            np.einsum("kab,kb->ka", self.slope, state) - residual,
            covariance + np.diag(coordinates.errors(sigma) ** 2),
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
        factor = covariance_factor(covariance)
        drawn = mean + np.einsum("kab,kb->ka", factor, rng.standard_normal(mean.shape))
        result = linearised.copy()
        body, place = self.coordinates.in_residual
        result[:, 0, body, place] += drawn
        return result

    def _begin(self, sigma: Floats) -> Floats:
        """Return the variance of the filter's first states at sigma (..., parameter).

        Shape (..., transition, coordinate).
        """
        sensor = self.coordinates.errors(sigma)[..., None, :] ** 2
        return np.where(self.initial_variance > 0, self.initial_variance, sensor)
