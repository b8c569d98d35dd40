"""Forecasts, and held-out errors: log predictive density, simulations, and the noise floor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from pbrl_ppl.criticism.results import Errors, Rollout
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import FilteredProblem, TrajectoryNoise, along_trajectories, in_pieces
from pbrl_ppl.modes import MOST_GROWTH, FilteredMode, fit_pieces, growth
from pbrl_ppl.posterior import Fit
from pbrl_ppl.scene import Scene, motion_time, state_sizes
from pbrl_ppl.state import STATE, STATE_UNITS, THETA, Floats, Ints

#: Rows after which a filter's covariance is in steady state.
_STEADY_STATE_ROWS = 5


@dataclass(frozen=True, eq=False)
class Forecast:
    """Errors at the end of forecasts, and their size under noise alone.

    Parameters
    ----------
    error : ndarray
        Measured minus predicted, shape (start, cell), SI units; NaN where not measured, infinite
        where the prediction diverges.
    variance : ndarray
        Expected square of the error under measurement noise, shape (start, cell).
    dimension : ndarray of int
        State dimension of each cell, shape (cell,).
    """

    error: Floats
    variance: Floats
    dimension: Ints

    def rmse(self) -> dict[str, float]:
        """Return the root mean square error of each measured state dimension, in its unit."""
        return self._by_dimension(self.error**2)

    def floor(self) -> dict[str, float]:
        """Return the same for the noise alone."""
        return self._by_dimension(np.where(np.isnan(self.error), np.nan, self.variance))

    def _by_dimension(self, square: Floats) -> dict[str, float]:
        """Return root mean squares by state dimension."""
        columns = {STATE[d]: square[:, self.dimension == d] for d in np.unique(self.dimension)}
        seen = {name: each for name, each in columns.items() if not np.isnan(each).all()}
        return {name: float(np.sqrt(np.nanmean(each))) for name, each in seen.items()}


def filtered_states(problem: FilteredProblem, phi: Floats, sigma: Floats) -> Floats:
    """Return the filtered states, shape (trajectory, time, body, 6), SI units."""
    noise = problem.likelihood.noise
    coordinates, segments = noise.coordinates, problem.segments
    residual = coordinates.of_residual(problem.residual(phi))
    deviation = noise.filtered(residual[None], sigma)[1][0]
    states = problem.data.smoothed_states.copy()
    flat = states.reshape(*states.shape[:2], -1)
    flat[segments.trajectory[:, None], segments.step[:, None] + 1, coordinates.places] += deviation
    # the first row has no earlier one: it is as measured, or as smoothed over the next rows
    few = replace(noise, seen=noise.seen & (segments.step < _STEADY_STATE_ROWS)[:, None])
    hidden = (noise.initial_variance > 0).any(axis=1, keepdims=True)
    first = np.where(hidden, few.smoothed(residual, sigma)[0], noise.begin)[noise.first]
    flat[segments.trajectory[noise.first, None], 0, coordinates.places] += first
    return coordinates.completed(problem.scene, states)


def rollout(problem: FilteredProblem, phi: Floats, start: Floats, inputs: Floats) -> Floats:
    """Return predicted states after each interval, NaN from where a prediction diverges.

    Parameters
    ----------
    problem : FilteredProblem
        A problem of whole trajectories.
    phi : ndarray
        Shape (p,).
    start : ndarray
        Filtered states, shape (n, body, 6), SI units: not finite where the filter diverges.
    inputs : ndarray
        Inputs of the intervals, shape (n, H, body, 3 or 9).

    Returns
    -------
    ndarray
        Shape (n, H, body, 6), SI units.
    """
    states = np.full((*inputs.shape[:2], *start.shape[1:]), np.nan)
    finite = np.isfinite(start).all(axis=(1, 2))
    states[finite] = problem.physics.one_world(phi, start[finite], inputs[finite])
    states[~np.isfinite(states)] = np.nan
    return states


def _finite_part(problem: FilteredProblem, phi: Floats, start: Floats, inputs: Floats) -> Floats:
    """Return a prediction that diverges up to there, shape (H, body, 6), then NaN.

    The engine returns none of it: the longest prediction that it returns is found by bisection.
    """
    low, high = 0, inputs.shape[1]
    result = np.full((high, *start.shape[1:]), np.nan)
    while high - low > 1:
        middle = (low + high) // 2
        states = rollout(problem, phi, start, inputs[:, :middle])[0]
        if np.isfinite(states).all():
            low, result[:middle] = middle, states
        else:
            high = middle
    return result


def forecast(
    problem: FilteredProblem,
    phi: Floats,
    sigma: Floats,
    intervals: int,
    *,
    allowed: Floats | None = None,
) -> Forecast:
    """Predict several intervals from filtered states all along the trajectories.

    Parameters
    ----------
    problem : FilteredProblem
        A problem of whole trajectories.
    phi, sigma : ndarray
        Parameters and noise parameters, shapes (p,) and (parameter,).
    intervals : int
        Length of a forecast.
    allowed : ndarray, optional
        Constant accelerations that count as noise in the expected square, shape (velocity,),
        m/s^2 and rad/s^2.
    """
    noise = problem.likelihood.noise
    coordinates, segments = noise.coordinates, problem.segments
    begins = np.flatnonzero(noise.first)
    lengths = np.diff(np.append(begins, segments.n))
    starts = []
    for begin, length in zip(begins, lengths, strict=True):
        if length >= intervals:
            first = min(_STEADY_STATE_ROWS, length - intervals)
            rows = begin + np.arange(first, length - intervals + 1)
            measured = noise.seen[rows + intervals - 1].any(axis=1)
            starts.append(rows[measured][:: max(1, intervals // 2)])
    at = np.concatenate(starts) if starts else np.zeros(0, dtype=np.intp)
    if not len(at):
        none = np.zeros((0, len(coordinates.places)))
        return Forecast(none, none, coordinates.places % len(STATE))
    trajectory, step = segments.trajectory[at], segments.step[at]
    every = at[:, None] + np.arange(intervals)
    states = filtered_states(problem, phi, sigma)[trajectory, step]
    inputs = problem.inputs[every, 0]
    ends = coordinates.of(rollout(problem, phi, states, inputs)[:, -1])
    observed = problem.data.history.dataset["observed"].to_numpy()
    measured_ends = coordinates.of(observed[trajectory, step + intervals])
    error = coordinates.wrapped(measured_ends - ends)
    error[np.isfinite(measured_ends) & np.isnan(ends)] = np.inf
    covariance = noise.covariance(sigma)[at - 1]
    for begin in np.flatnonzero(step == 0):
        covariance[begin] = _first_spread(noise, sigma, int(at[begin]))
    free, touching = coordinates.steps(sigma)
    contact = touching - free  # uncertainty of how bodies part
    pushes = np.zeros((len(coordinates.places), 0))
    if allowed is not None:
        rate = coordinates.pushed[coordinates.always] - len(coordinates.sensors)
        pushes = (coordinates.push[coordinates.always] * allowed[rate][:, None]).T
    pushed = np.zeros((len(at), *pushes.shape))
    with np.errstate(over="ignore", invalid="ignore"):  # unstable motions spread without limit
        for i in range(intervals):
            slope = noise.slope[every[:, i]]
            covariance = slope @ covariance @ slope.transpose(0, 2, 1)
            covariance = covariance + noise.touching[every[:, i], None, None] * contact
            pushed = slope @ pushed + pushes
        variance = np.diagonal(covariance, axis1=1, axis2=2) + coordinates.errors(sigma) ** 2
        variance = variance + (pushed**2).sum(axis=2)
    variance = np.where(np.isnan(variance), np.inf, variance)
    return Forecast(error, variance, coordinates.places % len(STATE))


def _first_spread(noise: TrajectoryNoise, sigma: Floats, first: int) -> Floats:
    """Return the covariance of a trajectory's first filtered state, shape (cell, cell)."""
    error = noise.coordinates.errors(sigma)
    initial_variance = noise.initial_variance[first]
    if not initial_variance.any():
        return np.diag(error**2)
    # the information of the first rows, with no process noise between them
    scale = np.where(initial_variance > 0, np.sqrt(initial_variance), error)
    information, way = np.eye(len(scale)), np.diag(scale)
    for k in range(first, min(first + _STEADY_STATE_ROWS, len(noise.first))):
        if k > first and noise.first[k]:
            break
        way = noise.slope[k] @ way
        seen = way[noise.seen[k]] / error[noise.seen[k], None]
        information += seen.T @ seen
    return np.asarray(scale[:, None] * np.linalg.inv(information) * scale)


def rollout_horizon(history: History, scene: Scene, motion_times: float = 4.0) -> int:
    """Return the intervals of a recording's forecasts: some motion times, or a whole trajectory.

    More where bodies are seen less often.
    """
    intervals = math.ceil(motion_times * motion_time(scene) / scene.time_step)
    return longest_rollout(history, max(history.longest_gap, intervals))


def longest_rollout(history: History, intervals: int) -> int:
    """Return the intervals of forecasts that all trajectories have, at most so many."""
    return min(intervals, int(history.dataset["n_rows"].min()) - 1)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A fitted model on held-out trajectories.

    Parameters
    ----------
    mode : FilteredMode
        The fitted model, with its training data.
    problem : FilteredProblem
        The same model on the held-out trajectories, linearised there.
    """

    mode: FilteredMode
    problem: FilteredProblem

    @classmethod
    def of(cls, mode: FilteredMode, history: History) -> HeldOut:
        """Linearise a fitted model along held-out trajectories, which measure nothing else."""
        coordinates = mode.problem.likelihood.noise.coordinates
        problem = mode.problem.with_data(history=history, states=None)
        return cls(mode, along_trajectories(problem, mode.phi, mode.sigma, coordinates))

    def rollouts(self) -> dict[int, Floats]:
        """Predict whole trajectories, each from its filtered first state.

        That state is as measured, or fitted to the first rows where its velocities were not
        measured.

        Returns
        -------
        dict of int to ndarray
            By trajectory: predicted states from the first one on, shape (time, body, 6), SI units;
            NaN from where the prediction diverges.
        """
        problem, phi = self.problem, self.mode.phi
        noise, segments = problem.likelihood.noise, problem.segments
        begins = np.flatnonzero(noise.first)
        lengths = np.diff(np.append(begins, segments.n))
        trajectory = segments.trajectory[begins]
        start = filtered_states(problem, phi, self.mode.sigma)[trajectory, 0]
        # shorter trajectories repeat their last command, and what follows is left out
        steps = np.minimum(np.arange(lengths.max()), lengths[:, None] - 1)
        inputs = problem.inputs[begins[:, None] + steps, 0]
        states = rollout(problem, phi, start, inputs)
        for i in np.flatnonzero(~np.isfinite(states).all(axis=(1, 2, 3))):
            states[i] = _finite_part(problem, phi, start[i : i + 1], inputs[i : i + 1])
        states = np.concatenate([start[:, None], states], axis=1)
        whole = zip(trajectory.tolist(), states, lengths.tolist(), strict=True)
        return {which: paths[: length + 1] for which, paths, length in whole}

    def whitened(self, unit: HeldOut) -> Floats:
        """Return the linearised innovations in units of another model's noise."""
        physics = self.mode.problem.physics
        model = unit.problem.with_physics(effects=physics.effects, substeps=physics.substeps)
        return model.whitened(self.mode.phi, unit.mode.sigma, model.physics.one_world)

    def errors(
        self, unit: HeldOut, fit: Fit, rollout: int, seed: int, noise: Floats, most_draws: int = 100
    ) -> Errors:
        """Return the model's errors.

        Parameters
        ----------
        unit : HeldOut
            The model with which innovations are filtered.
        fit : Fit
            This model with its posterior.
        rollout : int
            Intervals of the forecasts.
        seed : int
            Chooses the posterior draws of the predictive density.
        noise : ndarray
            Noise parameters of ``unit`` without any unexplained acceleration, shape (parameter,):
            the unit of the normalised error.
        most_draws : int
            Posterior draws of the predictive density, at most.
        """
        mode, of_unit = self.mode, unit.problem.likelihood.noise
        seen = of_unit.seen
        whitened = self.whitened(unit) * of_unit.scale(unit.mode.sigma) / of_unit.scale(noise)
        phi = fit.draws[0]
        rng = np.random.default_rng(seed)
        phi = phi[rng.choice(len(phi), min(most_draws, len(phi)), replace=False)]
        residual = self.problem.residual(phi, self.problem.physics.one_world)
        density = self.problem.log_density(residual, np.tile(mode.sigma, (len(phi), 1)), phi)
        return Errors(
            one_step_rmse=forecast(self.problem, mode.phi, mode.sigma, 1).rmse(),
            rollout_rmse=forecast(self.problem, mode.phi, mode.sigma, rollout).rmse(),
            normalised_rmse=float(np.sqrt((whitened[seen] ** 2).sum() / seen.sum())),
            elpd=float((logsumexp(density, axis=0) - np.log(len(phi))).sum()),
        )

    def simulated(self) -> dict[str, float]:
        """Return the errors of whole trajectories, simulated from initial states fitted to them.

        They are root mean squares by measured state dimension, in its unit, less the degrees of
        freedom of the initial states; empty where simulations magnify them, or trajectories
        are too short.
        """
        longest = int(self.problem.data.history.dataset["n_rows"].max()) - 1
        if longest < 3:
            return {}
        pieces = in_pieces(self.problem, longest, self.problem.data.smoothed_states)
        fitted = fit_pieces(pieces, self.mode.phi, initial_states_alone=True)
        if growth(fitted.problem) > MOST_GROWTH:
            return {}
        return dict(zip(fitted.problem.observations.names, fitted.sigma.tolist(), strict=True))

    def noise_floor(self, sigma: Floats, rollout: int) -> Errors:
        """Return the errors that measurement noise alone makes, at both ends of a forecast.

        ``sigma`` are the noise parameters of :func:`pbrl_ppl.criticism.innovations.noise_alone`.
        """
        noise, phi = self.problem.likelihood.noise, self.mode.phi
        at_best, cells = -noise.log_scale(self.mode.sigma).sum(), noise.seen.sum()
        return Errors(
            one_step_rmse=forecast(self.problem, phi, sigma, 1).floor(),
            rollout_rmse=forecast(self.problem, phi, sigma, rollout).floor(),
            normalised_rmse=1.0,
            elpd=float(at_best - 0.5 * cells * (1.0 + np.log(2 * np.pi))),
            simulated_rmse=self.measurement_errors(sigma),
        )

    def motion(self) -> dict[str, float]:
        """Return the standard deviation of each state dimension's motion, in its unit."""
        states = self.problem.data.smoothed_states.copy()
        states[..., THETA] = np.unwrap(states[..., THETA], axis=1)
        n_rows = self.problem.data.history.dataset["n_rows"].to_numpy()
        rows = np.arange(states.shape[1]) < n_rows[:, None]
        sizes = np.nanmax(np.std(states[rows], axis=0), axis=0)
        return dict(zip(STATE, sizes.tolist(), strict=True))

    def measurement_errors(self, sigma: Floats) -> dict[str, float]:
        """Return the standard deviation of each measured state dimension's errors, in its unit."""
        sensors = self.problem.likelihood.noise.coordinates.sensors
        return {STATE[d]: float(sd) for d, sd in zip(sensors, sigma, strict=False)}


def example_rollout(declared: HeldOut, revised: HeldOut) -> Rollout:
    """Return the first held-out trajectory of the body that moves most, with both predictions."""
    problem = revised.problem
    scene, dataset = problem.scene, problem.data.history.dataset
    length = int(dataset["n_rows"].min()) - 1
    measured = dataset["observed"].to_numpy()[0, : length + 1]
    columns = [d for d in range(len(STATE)) if np.isfinite(measured[..., d]).any()]
    noise, sizes = revised.measurement_errors(revised.mode.sigma), state_sizes(scene)
    seen = measured[..., columns]
    with np.errstate(invalid="ignore"):  # one body may lack what was measured of another
        spread = np.fmax.reduce(seen, axis=0) - np.fmin.reduce(seen, axis=0)
    spread /= [noise.get(STATE[d], float(sizes[d])) for d in columns]
    free = np.array([not body.kinematic for body in scene.moving])
    body = int(np.argmax(np.where(free, np.nansum(spread, axis=1), -1.0)))
    before, after = (model.rollouts()[0][: length + 1, body] for model in (declared, revised))
    return Rollout(
        body=scene.moving[body].name,
        time=np.arange(length + 1, dtype=float) * scene.time_step,
        names=tuple(STATE[d] for d in columns),
        units=tuple(STATE_UNITS[d] for d in columns),
        measured=measured[:, body][:, columns],
        before=before[:, columns],
        after=after[:, columns],
    )
