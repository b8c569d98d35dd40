"""Held-out errors: log predictive density, rollouts, and the noise floor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl.criticism.findings import Errors, Rollout
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History
from pbrl_ppl.model import Data, Problem, StartNoise
from pbrl_ppl.modes import Mode
from pbrl_ppl.posterior import parameter_draws
from pbrl_ppl.state import STATE_UNITS

Array = NDArray[np.float64]

#: Rollouts of the error table last this long (s), or a whole trajectory.
ROLLOUT_SECONDS = 1.0
_DRAWS = 100


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Held-out trajectories, and the seed of the draws that models are judged with.

    Parameters
    ----------
    history : History
        Measured transitions that no fit has seen.
    seed : int
        Of the posterior draws.
    """

    history: History
    seed: int
    _data: dict[int, Data] = field(default_factory=dict, init=False, repr=False)
    _noisy: WeakKeyDictionary[Mode, dict[int, Problem]] = field(
        default_factory=WeakKeyDictionary, init=False, repr=False
    )

    def problem(self, mode: Mode, horizon: int | None = None) -> Problem:
        """A mode's problem on the held-out history, its start states taken as exact."""
        horizon = mode.problem.data.horizon if horizon is None else horizon
        if horizon not in self._data:
            data = replace(mode.problem.data, history=self.history, horizon=horizon)
            measured, trained = data.observations, mode.problem.observations
            if measured.columns != trained.columns:
                raise HistoryError(
                    f"test history measures {', '.join(measured.names)}, the training history"
                    f" {', '.join(trained.names)}; they must be the same"
                )
            self._data[horizon] = data
        return mode.problem.on(self._data[horizon])

    def noisy(self, mode: Mode, horizon: int | None = None) -> Problem:
        """The held-out problem with the start states' noise, linearised at the mode once."""
        horizon = mode.problem.data.horizon if horizon is None else horizon
        known = self._noisy.setdefault(mode, {})
        if horizon not in known:
            problem = self.problem(mode, horizon)
            measured = problem.observations.measured.reshape(problem.segments.n, -1)
            sensitivity = problem.sensitivity(mode.phi, mode.sigma, problem.one_world)
            start = StartNoise.of(sensitivity, measured, mode.sigma)
            known[horizon] = problem.with_noise(start=start)
        return known[horizon]

    def gains(self, before: Mode, after: Mode) -> Array:
        """Held-out log predictive density gained, shape (transition,)."""
        rng = np.random.default_rng(self.seed)
        return _elpd(self.noisy(after), *_laplace_draws(after, rng)) - _elpd(
            self.noisy(before), *_laplace_draws(before, rng)
        )

    def fall(self, before: Mode, after: Mode) -> float:
        """Share by which the residual falls, in units of the later model's noise."""
        scale = self.noisy(after)
        return 1.0 - _normalised(scale, after, after) / _normalised(scale, before, after)

    def residuals(self, mode: Mode, unit: Mode) -> dict[str, Array]:
        """Residuals of a mode in units of another's noise, by state dimension."""
        scale = self.noisy(unit)
        observations = scale.observations
        z = _whitened(scale, mode, unit).reshape(observations.values.shape)
        return {
            name: z[..., i][observations.measured[..., i]]
            for i, name in enumerate(observations.names)
        }

    def rollout_horizon(self, horizon: int, time_step: float) -> int:
        """Intervals of the rollouts in the error table: a second, or a whole trajectory."""
        longest = int(self.history.dataset["n_rows"].min()) - 1
        return min(longest, max(horizon, round(ROLLOUT_SECONDS / time_step)))

    def errors(self, mode: Mode, scale: Mode, posterior: Any, rollout: int) -> Errors:
        """Errors of a model; ``scale`` is the model whose noise is the unit."""
        problem = self.noisy(mode)
        pick = np.random.default_rng(self.seed)
        phi, sigma = parameter_draws(mode.problem, posterior)
        chosen = pick.choice(len(phi), min(_DRAWS, len(phi)), replace=False)
        return Errors(
            one_step_rmse=_rmse(self.problem(mode, 1), mode),
            rollout_rmse=_rmse(self.problem(mode, rollout), mode),
            normalised_rmse=_normalised(self.noisy(scale), mode, scale),
            elpd=float(_elpd(problem, phi[chosen], sigma[chosen]).sum()),
        )

    def noise_floor(self, mode: Mode, rollout: int) -> Errors:
        """Noise floor: errors from measurement noise alone, at both ends of a prediction."""

        def expected(problem: Problem) -> dict[str, float]:
            names = problem.observations.names
            noise = problem.noise.start
            gain = noise.gain if noise else np.ones(1)
            gain = np.broadcast_to(gain, (problem.segments.n, gain.shape[-1]))
            gain = gain.reshape(problem.observations.values.shape)[:, -1]
            seen = problem.observations.measured[:, -1]
            square = ((gain * mode.sigma) ** 2 * seen).sum((0, 1)) / np.maximum(seen.sum((0, 1)), 1)
            return dict(zip(names, np.sqrt(square).tolist(), strict=True))

        problem = self.noisy(mode)
        measured = problem.observations.measured
        at_mode = problem.log_density(
            np.zeros_like(problem.observations.values), mode.sigma, mode.phi
        )
        return Errors(
            one_step_rmse=expected(self.noisy(mode, 1)),
            rollout_rmse=expected(self.noisy(mode, rollout)),
            normalised_rmse=1.0,
            elpd=float(at_mode.sum() - 0.5 * measured.sum()),
        )

    def rollout(self, declared: Mode, revised: Mode) -> Rollout:
        """Follow the body that moves most over the first held-out trajectory."""
        scene = revised.problem.scene
        length = int(self.history.dataset["n_rows"].min()) - 1
        problem = self.problem(revised, length)
        first = slice(0, 1)
        start, actions = problem.segments.start[first], problem.segments.inputs[first]
        measured = problem.observations.values[0]
        columns = problem.observations.columns
        spread = np.nanstd(measured, axis=0)
        body = int(np.argmax(np.nansum(spread / np.maximum(revised.sigma, 1e-12), axis=1)))
        predictions = [
            np.concatenate([start, mode.problem.one_world(mode.phi, start, actions)[0]])
            for mode in (declared, revised)
        ]
        origin = np.where(np.isfinite(start[0, body]), start[0, body], np.nan)
        return Rollout(
            body=scene.moving[body].name,
            time=np.arange(length + 1, dtype=float) * scene.time_step,
            names=problem.observations.names,
            units=tuple(STATE_UNITS[d] for d in columns),
            measured=np.vstack([origin[list(columns)], measured[:, body]]),
            before=predictions[0][:, body][:, columns],
            after=predictions[1][:, body][:, columns],
        )


def standard_error(gains: Array) -> float:
    """Standard error of a sum of independent gains."""
    return float(np.sqrt(len(gains)) * gains.std(ddof=1)) if len(gains) > 1 else np.inf


def _laplace_draws(mode: Mode, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draws of phi and sigma from the Laplace approximation, cut at the supports."""
    # directions that the data say nothing about do not matter for prediction
    phi = mode.draws(rng, _DRAWS)
    counts = np.maximum(mode.problem.observations.measured.sum((0, 1, 2)), 1)
    sigma = mode.sigma * np.exp(rng.standard_normal((_DRAWS, len(counts))) * np.sqrt(0.5 / counts))
    return phi, sigma


def _elpd(problem: Problem, phi: Array, sigma: Array) -> Array:
    """Log predictive density of each held-out transition, shape (transition,)."""
    density = problem.log_density(problem.residual(phi, problem.one_world), sigma, phi)
    return np.asarray(logsumexp(density, axis=0) - np.log(len(phi)))


def _rmse(problem: Problem, mode: Mode) -> dict[str, float]:
    """Error at the end of the horizon, per state dimension."""
    residual = problem.residual(mode.phi, problem.one_world)[:, -1]
    seen = problem.observations.measured[:, -1]
    square = (residual**2).sum((0, 1)) / np.maximum(seen.sum((0, 1)), 1)
    return dict(zip(problem.observations.names, np.sqrt(square).tolist(), strict=True))


def _normalised(scale: Problem, mode: Mode, unit: Mode) -> float:
    """Root mean square held-out residual of a mode, in units of another's noise."""
    z = _whitened(scale, mode, unit)
    return float(np.sqrt((z**2).sum() / scale.observations.measured.sum()))


def _whitened(scale: Problem, mode: Mode, unit: Mode) -> Array:
    physics = mode.problem.physics
    model = scale.with_physics(effects=physics.effects, substeps=physics.substeps)
    return model.whitened(mode.phi, unit.sigma, model.one_world)
