"""Held-out errors: log predictive density, forecasts, and the noise floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from pbrl_ppl.criticism.forecast import forecast, whole_rollouts
from pbrl_ppl.criticism.results import Errors, Rollout
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, longest_gap
from pbrl_ppl.likelihood import FilteredProblem, along_trajectories, in_pieces, observed_coordinates
from pbrl_ppl.modes import MOST_GROWTH, FilteredMode, fit_pieces, growth
from pbrl_ppl.posterior import Fit
from pbrl_ppl.scene import Scene, motion_time, state_sizes
from pbrl_ppl.state import STATE, STATE_UNITS, THETA, Floats


def rollout_horizon(history: History, scene: Scene, motion_times: float = 4.0) -> int:
    """Return the intervals of a recording's forecasts: some motion times, or a whole trajectory.

    More where bodies are seen less often.
    """
    intervals = math.ceil(motion_times * motion_time(scene) / scene.time_step)
    return longest_rollout(history, max(longest_gap(history), intervals))


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
        """Linearise a fitted model along held-out trajectories.

        Raises
        ------
        HistoryError
            If they measure what the training history does not.
        """
        coordinates = mode.problem.likelihood.noise.coordinates
        measured = observed_coordinates(mode.problem.scene, history).sensors
        if not set(measured) <= set(coordinates.sensors):
            names = [
                ", ".join(STATE[d] for d in dimensions)
                for dimensions in (measured, coordinates.sensors)
            ]
            raise HistoryError(
                f"test history measures {names[0]}, the training history {names[1]}; they must"
                " be the same"
            )
        problem = mode.problem.with_data(history=history, states=None)
        return cls(mode, along_trajectories(problem, mode.phi, mode.sigma, coordinates))

    def whitened(self, unit: HeldOut) -> Floats:
        """Return the linearised innovations in units of another model's noise."""
        physics = self.mode.problem.physics
        model = unit.problem.with_physics(effects=physics.effects, substeps=physics.substeps)
        return model.whitened(self.mode.phi, unit.mode.sigma, model.physics.one_world)

    def residuals(self, unit: HeldOut) -> dict[str, Floats]:
        """Return innovations in units of another model's noise, by state dimension."""
        noise = unit.problem.likelihood.noise
        z = self.whitened(unit)
        dimension, seen = noise.coordinates.places % len(STATE), noise.seen
        return {
            STATE[d]: z[:, dimension == d][seen[:, dimension == d]]
            for d in np.unique(dimension)
            if seen[:, dimension == d].any()
        }

    def errors(
        self,
        unit: HeldOut,
        fit: Fit,
        rollout: int,
        seed: int,
        noise: Floats,
        most_draws: int = 100,
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
        names = fitted.problem.observations.names
        return dict(zip(names, fitted.sigma.tolist(), strict=True))

    def noise_floor(self, sigma: Floats, rollout: int) -> Errors:
        """Return the errors that measurement noise alone makes, at both ends of a forecast.

        ``sigma`` are the noise parameters of :func:`pbrl_ppl.criticism.unexplained.noise_alone`.
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
        rows = (
            np.arange(states.shape[1]) < self.problem.data.history.dataset["n_rows"].values[:, None]
        )
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
    sensors = revised.mode.problem.likelihood.noise.coordinates.sensors
    noise = dict(zip(sensors, revised.mode.sigma.tolist(), strict=False))
    sizes = state_sizes(scene)
    seen = measured[..., columns]
    with np.errstate(invalid="ignore"):  # one body may lack what was measured of another
        spread = np.fmax.reduce(seen, axis=0) - np.fmin.reduce(seen, axis=0)
    spread /= [noise.get(d, float(sizes[d])) for d in columns]
    free = np.array([not body.kinematic for body in scene.moving])
    body = int(np.argmax(np.where(free, np.nansum(spread, axis=1), -1.0)))
    predicted = []
    for model in (declared, revised):
        whole = whole_rollouts(model.problem, model.mode.phi, model.mode.sigma)[0]
        predicted.append(whole[: length + 1, body][:, columns])
    return Rollout(
        body=scene.moving[body].name,
        time=np.arange(length + 1, dtype=float) * scene.time_step,
        names=tuple(STATE[d] for d in columns),
        units=tuple(STATE_UNITS[d] for d in columns),
        measured=measured[:, body][:, columns],
        before=predicted[0],
        after=predicted[1],
    )
