"""Held-out errors: log predictive density, forecasts, and the noise floor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl.criticism.forecast import filtered_states, forecast
from pbrl_ppl.criticism.results import Errors, Rollout
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, longest_gap
from pbrl_ppl.likelihood import Problem, along_trajectories, cells_of
from pbrl_ppl.modes import Mode
from pbrl_ppl.posterior import parameter_draws
from pbrl_ppl.state import STATE, STATE_UNITS

Array = NDArray[np.float64]

#: Forecasts of the error table last this long (s), or a whole trajectory.
ROLLOUT_SECONDS = 1.0
_DRAWS = 100


def rollout_horizon(history: History, time_step: float) -> int:
    """Intervals of a recording's forecasts: a second, or a whole trajectory.

    More than a second where bodies are seen less often.
    """
    longest = int(history.dataset["n_rows"].min()) - 1
    return min(longest, max(longest_gap(history), round(ROLLOUT_SECONDS / time_step)))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Held-out trajectories, and the seed of the draws that models are judged with.

    Parameters
    ----------
    history : History
        Measured transitions that neither a fit nor a choice between models has seen.
    seed : int
        Of the posterior draws.
    """

    history: History
    seed: int
    _problems: WeakKeyDictionary[Mode, Problem] = field(
        default_factory=WeakKeyDictionary, init=False, repr=False
    )

    def problem(self, mode: Mode) -> Problem:
        """A mode's problem on the held-out trajectories, linearised there once.

        Raises
        ------
        HistoryError
            If they do not measure what the training history measures.
        """
        if mode not in self._problems:
            cells = mode.problem.trajectory_noise.cells
            measured = cells_of(mode.problem.scene, self.history).sensors
            if not set(measured) <= set(cells.sensors):
                names = [", ".join(STATE[d] for d in own) for own in (measured, cells.sensors)]
                raise HistoryError(
                    f"test history measures {names[0]}, the training history {names[1]}; they must"
                    " be the same"
                )
            problem = mode.problem.with_data(history=self.history, states=None)
            self._problems[mode] = along_trajectories(problem, mode.phi, mode.sigma, cells)
        return self._problems[mode]

    def residuals(self, mode: Mode, unit: Mode) -> dict[str, Array]:
        """Innovations of a mode in units of another's noise, by state dimension."""
        noise = self.problem(unit).trajectory_noise
        z = self._whitened(mode, unit)
        dimension, seen = noise.cells.places % len(STATE), noise.seen
        return {
            STATE[d]: z[:, dimension == d][seen[:, dimension == d]]
            for d in np.unique(dimension)
            if seen[:, dimension == d].any()
        }

    def longest(self, intervals: int) -> int:
        """Intervals of forecasts that all of its trajectories have, at most so many."""
        return min(intervals, int(self.history.dataset["n_rows"].min()) - 1)

    def errors(self, mode: Mode, scale: Mode, posterior: Any, rollout: int) -> Errors:
        """Errors of a model; ``scale`` is the model whose noise is the unit."""
        problem = self.problem(mode)
        pick = np.random.default_rng(self.seed)
        phi, sigma = parameter_draws(mode.problem, posterior)
        chosen = pick.choice(len(phi), min(_DRAWS, len(phi)), replace=False)
        seen = self.problem(scale).trajectory_noise.seen
        return Errors(
            one_step_rmse=forecast(problem, mode.phi, mode.sigma, 1).rmse(),
            rollout_rmse=forecast(problem, mode.phi, mode.sigma, rollout).rmse(),
            normalised_rmse=float(np.sqrt((self._whitened(mode, scale) ** 2).sum() / seen.sum())),
            elpd=float(_elpd(problem, phi[chosen], sigma[chosen]).sum()),
        )

    def noise_floor(self, mode: Mode, sigma: Array, rollout: int) -> Errors:
        """Noise floor: errors from the noise of measurements alone, at both ends of a forecast.

        Its size is that of ``sigma``, see :func:`pbrl_ppl.criticism.unexplained.noise_alone`.
        """
        problem = self.problem(mode)
        noise = problem.trajectory_noise
        at_best, cells = -noise.log_scale(mode.sigma).sum(), noise.seen.sum()
        return Errors(
            one_step_rmse=forecast(problem, mode.phi, sigma, 1).floor(),
            rollout_rmse=forecast(problem, mode.phi, sigma, rollout).floor(),
            normalised_rmse=1.0,
            elpd=float(at_best - 0.5 * cells * (1.0 + np.log(2 * np.pi))),
        )

    def rollout(self, declared: Mode, revised: Mode) -> Rollout:
        """Follow the body that moves most over the first held-out trajectory."""
        problem = self.problem(revised)
        scene, dataset = problem.scene, self.history.dataset
        length = int(dataset["n_rows"].min()) - 1
        measured = dataset["observed"].to_numpy()[0, : length + 1]
        columns = [d for d in range(len(STATE)) if np.isfinite(measured[..., d]).any()]
        noise = _by_dimension(revised)
        spread = np.nanstd(measured[..., columns], axis=0) / [noise.get(d, 1.0) for d in columns]
        free = np.array([not body.kinematic for body in scene.moving])
        body = int(np.argmax(np.where(free, np.nansum(spread, axis=1), -1.0)))
        predicted = []
        for mode in (declared, revised):
            own = self.problem(mode)
            start = filtered_states(own, mode.phi, mode.sigma)[:1, 0]
            inputs = own.inputs[:length, 0][None]
            states = own.one_world(mode.phi, start, inputs)[0]
            predicted.append(np.concatenate([start, states])[:, body][:, columns])
        return Rollout(
            body=scene.moving[body].name,
            time=np.arange(length + 1, dtype=float) * scene.time_step,
            names=tuple(STATE[d] for d in columns),
            units=tuple(STATE_UNITS[d] for d in columns),
            measured=measured[:, body][:, columns],
            before=predicted[0],
            after=predicted[1],
        )

    def _whitened(self, mode: Mode, unit: Mode) -> Array:
        """Innovations of a mode, linearised and in units of noise as another says."""
        physics = mode.problem.physics
        model = self.problem(unit).with_physics(effects=physics.effects, substeps=physics.substeps)
        return model.whitened(mode.phi, unit.sigma, model.one_world)


def _by_dimension(mode: Mode) -> dict[int, float]:
    """Standard deviation of measuring each state dimension."""
    sensors = mode.problem.trajectory_noise.cells.sensors
    return dict(zip(sensors, mode.sigma.tolist(), strict=False))


def _elpd(problem: Problem, phi: Array, sigma: Array) -> Array:
    """Log predictive density of each held-out transition, shape (transition,)."""
    density = problem.log_density(problem.residual(phi, problem.one_world), sigma, phi)
    return np.asarray(logsumexp(density, axis=0) - np.log(len(phi)))
