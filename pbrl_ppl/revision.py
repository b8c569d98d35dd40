"""Closing the loop: fit, criticise, add an effect, confirm on held-out data, go round again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl import findings
from pbrl_ppl.criticism import Signature, inseparable, rank_candidates, twins
from pbrl_ppl.effects import Attached, Effect, attach, candidates
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.findings import Added, Errors, Estimate, Findings, Numerical, Rollout
from pbrl_ppl.fitting import fit, parameter_draws, versions
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import STATE_UNITS, StartNoise, log_density
from pbrl_ppl.model import Problem, build_model
from pbrl_ppl.modes import Mode, find_mode, inside, with_start_noise
from pbrl_ppl.posterior import draws as posterior_draws
from pbrl_ppl.posterior import interval
from pbrl_ppl.remainder import find_remainder
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: A candidate is tried if chance alone gives its statistic less often than this (corrected).
TRY_P = 0.01
#: It is kept if it gains this much log predictive density, in nats and in standard errors ...
MIN_ELPD, MIN_ELPD_SE = 4.0, 2.0
#: ... and makes the held-out error this much smaller.
MIN_ERROR_FALL = 0.01
#: Candidates that are refitted in a round, and effects added at most.
TRIED, MOST_ADDED = 4, 5
#: A candidate with less than this share of the leader's statistic waits until that has failed.
WORTH_A_REFIT = 0.5
#: Likelihoods that differ by less do not choose between effects: the catalogue's order does.
TIE = 1.0
#: A doubling of the substeps may move predictions by this share of the noise.
SMALL_SHIFT = 0.1
MOST_SUBSTEPS = 640
#: A start state's noise may spread to this many times the noise of the measured end.
LARGEST_SPREAD = 3.0
HORIZONS = (1, 2, 5, 10, 20, 50, 100)
#: Rollouts of the error table last this long (s), or a whole trajectory.
ROLLOUT_SECONDS = 1.0
#: With less structure than this left (share of variance), added effects are the verdict.
LARGE_REMAINDER = 0.1
LEAST_TUNE = 250
_ELPD_DRAWS = 100


def revise(
    scene: Scene,
    train: History,
    test: History | None = None,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    horizon: int | None = None,
    substeps: int | None = None,
    draws: int = 800,
    progress: Callable[[str], None] | None = None,
) -> Findings:
    """Fit a declared model, trace its residual to missing effects, add them, and compare.

    Parameters
    ----------
    scene : Scene
        The declared model.
    train, test : History
        Measured transitions to fit and to judge by; without ``test``, a quarter of the whole
        trajectories of ``train`` is held out.
    catalogue : iterable of Effect
        Effects to consider; add your own to the package's.
    seed : int
        The same seed gives the same findings.
    horizon : int, optional
        Intervals predicted from one measured state; chosen from the data by default.
    substeps : int, optional
        Engine steps an interval to begin with; the scene's by default.
    draws : int
        Posterior draws kept of each chain.
    progress : callable, optional
        Told the name of each stage.

    Returns
    -------
    Findings
        Verdict, effects, errors before and after, and both posteriors.

    Raises
    ------
    HistoryError
        If the histories do not fit each other or are too short.
    EffectError
        If the scene declares an unknown effect.
    """
    say = progress or (lambda stage: None)
    catalogue = tuple(catalogue)
    if test is None:
        train, test = train.split(0.25, seed)
    loop = _Loop(scene, train, test, catalogue, seed, say)
    say("fitting the declared model")
    declared = loop.declared_mode(horizon, substeps)
    say("scoring what the model might lack")
    first = rank_candidates(declared, loop.missing(declared))
    current, ranked = declared, first
    added: list[_Step] = []
    while ranked and len(added) < MOST_ADDED:
        step = loop.best_addition(current, ranked)
        if step is None:
            break
        say(f"added {step.signature.candidate.effect} on {step.signature.candidate.body}")
        added.append(step)
        current = step.after
        ranked = rank_candidates(current, loop.missing(current))
    say("testing what is left")
    remainder = find_remainder(current, seed=seed)
    say("sampling the posterior of the declared model")
    before = loop.posterior(declared, draws)
    after = before
    if added:
        say("sampling the posterior of the revised model")
        after = loop.posterior(current, draws)
    say("comparing errors on held-out data")
    return loop.findings(declared, current, first, added, remainder, before, after)


@dataclass(frozen=True, eq=False)
class _Step:
    """One effect added: its signature, the new mode and what it gained."""

    signature: Signature
    not_separable_from: tuple[str, ...]
    after: Mode
    elpd_difference: float
    elpd_difference_se: float


@dataclass(frozen=True, eq=False)
class _Loop:
    """The data and settings that every stage shares."""

    scene: Scene
    train: History
    test: History
    catalogue: tuple[Effect, ...]
    seed: int
    say: Callable[[str], None]

    def declared_mode(self, horizon: int | None, substeps: int | None) -> Mode:
        """Mode of the declared model, with the horizon chosen and the engine's error small."""
        problem = Problem(
            scene=self.scene,
            history=self.train,
            effects=attach(self.scene, (), self.catalogue),
            horizon=1 if horizon is None else horizon,
            substeps=substeps or self.scene.substeps,
            threads=2,
        )
        mode = find_mode(problem, seed=self.seed)
        mode = self._choose_horizon(mode) if horizon is None else _noisy(mode)
        return self.with_enough_substeps(mode)

    def _choose_horizon(self, mode: Mode) -> Mode:
        """Shortest horizon at which the start state's noise does not drown the prediction."""
        longest = int(self.train.dataset["n_rows"].min()) - 1
        tried: list[tuple[float, Mode]] = []
        for horizon in HORIZONS:
            if horizon > max(1, longest // 2):
                break
            problem = replace(mode.problem, horizon=horizon, noise=None)
            mode = _noisy(mode if horizon == 1 else find_mode(problem, initial=mode.phi))
            gain = mode.problem.noise.gain if mode.problem.noise else np.ones((1, 1))
            cells = len(mode.problem.scene.dynamic) * len(mode.sigma)  # of the last interval
            spread = np.sqrt(np.maximum(gain[:, -cells:] ** 2 - 1.0, 0.0))
            worst = float(np.median(spread, axis=0).max())
            tried.append((worst, mode))
            if worst <= LARGEST_SPREAD:
                break
        return min(tried, key=lambda each: each[0])[1]

    def with_enough_substeps(self, mode: Mode) -> Mode:
        """Double the substeps until that no longer moves predictions, and refit."""
        begin = mode.problem.substeps
        while shift(mode) > SMALL_SHIFT and mode.problem.substeps < MOST_SUBSTEPS:
            finer = replace(mode.problem, substeps=2 * mode.problem.substeps)
            mode = replace(mode, problem=finer)
        if mode.problem.substeps == begin:
            return mode
        self.say(f"using {mode.problem.substeps} engine steps an interval")
        return _noisy(mode, rounds=1)

    def missing(self, mode: Mode) -> tuple[Attached, ...]:
        """Candidate effects for a model."""
        return candidates(self.scene, mode.problem.effects, self.catalogue)

    def best_addition(self, mode: Mode, ranked: list[Signature]) -> _Step | None:
        """Refit with the leading candidates; the best that held-out data confirm, or None."""
        order = [one.effect.name for one in self.missing(mode)]

        def rank(item: tuple[Signature, Mode]) -> float:
            signature, fitted = item
            penalty = 0.5 * signature.candidate.dof * np.log(fitted.problem.segments.n)
            return float(_log_likelihood(fitted) - penalty)

        waiting = _distinct(ranked, order)[:TRIED]
        while waiting:
            # those far behind the first wait until it has failed
            enough = WORTH_A_REFIT * waiting[0].candidate.statistic
            leading = [each for each in waiting if each.candidate.statistic >= enough]
            waiting = [each for each in waiting if each.candidate.statistic < enough]
            fits = [(each, self._refit(mode, each)) for each in leading]
            while fits:
                best = max(map(rank, fits))
                tied = [item for item in fits if rank(item) > best - TIE]
                item = min(tied, key=lambda each: order.index(each[0].attached.effect.name))
                fits.remove(item)
                step = self._confirm(mode, *item, ranked)
                if step is not None:
                    return step
        return None

    def _refit(self, mode: Mode, signature: Signature) -> Mode:
        """Mode with the candidate in the model, under the same noise structure."""
        effects = (*mode.problem.effects, signature.attached)
        problem = replace(mode.problem, effects=effects)
        labels = list(problem.layout.labels)
        phi = np.array([prior.centre for prior in problem.layout.priors])
        for label, value in zip(mode.problem.layout.labels, mode.phi, strict=True):
            phi[labels.index(label)] = value
        effect = signature.attached.effect
        for name, value in signature.candidate.estimate.items():
            label = f"{effect.name}_{name}[{signature.attached.body}]"
            phi[labels.index(label)] = value
        return find_mode(problem, initial=inside(problem.layout.priors, phi))

    def _confirm(
        self, mode: Mode, signature: Signature, fitted: Mode, ranked: list[Signature]
    ) -> _Step | None:
        """Accept an improvement on held-out data that is clear and that matters."""
        fitted = self.with_enough_substeps(_noisy(fitted, rounds=1))
        rng = np.random.default_rng(self.seed)
        gains = _elpd(self._on_test(fitted), *_laplace_draws(fitted, rng)) - _elpd(
            self._on_test(mode), *_laplace_draws(mode, rng)
        )
        total = float(gains.sum())
        error = float(np.sqrt(len(gains)) * gains.std(ddof=1)) if len(gains) > 1 else np.inf
        scale = self._on_test(fitted)
        fall = 1.0 - _normalised(scale, fitted, fitted) / _normalised(scale, mode, fitted)
        if total < MIN_ELPD or total < MIN_ELPD_SE * error or fall < MIN_ERROR_FALL:
            return None
        return _Step(signature, inseparable(signature, ranked), fitted, total, error)

    def _on_test(self, mode: Mode, horizon: int | None = None) -> Problem:
        """A mode's problem on the held-out history, with its start noise linearised there."""
        problem = replace(
            mode.problem, history=self.test, noise=None, horizon=horizon or mode.problem.horizon
        )
        if problem.observations.columns != mode.problem.observations.columns:
            raise HistoryError(
                f"test history measures {', '.join(problem.observations.names)}, the training"
                f" history {', '.join(mode.problem.observations.names)}; they must be the same"
            )
        measured = problem.observations.measured.reshape(problem.segments.n, -1)
        sensitivity = problem.sensitivity(mode.phi, mode.sigma)
        return replace(problem, noise=StartNoise.of(sensitivity, measured, mode.sigma))

    def posterior(self, mode: Mode, draws: int) -> Any:
        """Sample a mode's model; the Laplace approximation to begin with needs little tuning."""
        model = build_model(replace(mode.problem, threads=1))
        tune = max(LEAST_TUNE, 5 * draws // 8)
        return fit(model, seed=self.seed, draws=draws, tune=tune, start=mode, progress=False)

    def findings(
        self,
        declared: Mode,
        revised: Mode,
        first: list[Signature],
        steps: list[_Step],
        remainder: findings.Unexplained | None,
        before: Any,
        after: Any,
    ) -> Findings:
        """Put everything together."""
        verdict = findings.EFFECTS_ADDED if steps else findings.ADEQUATE
        if remainder is not None and (not steps or remainder.share > LARGE_REMAINDER):
            verdict = findings.UNEXPLAINED
        horizon = revised.problem.horizon
        scale = self._on_test(revised)
        rollout = self._rollout_horizon(horizon)
        return Findings(
            scene=self.scene,
            verdict=verdict,
            numerical=Numerical(self.scene.substeps, revised.problem.substeps, shift(revised)),
            candidates=tuple(each.candidate for each in first),
            added=tuple(self._added(step, after) for step in steps),
            unexplained=remainder,
            before=self._errors(declared, revised, before, rollout),
            after=self._errors(revised, revised, after, rollout),
            noise_floor=self._floor(revised, rollout),
            posterior_before=before,
            posterior_after=after,
            residuals_before=_by_dimension(scale, declared, revised),
            residuals_after=_by_dimension(scale, revised, revised),
            rollout=self._rollout(declared, revised),
            horizon=horizon,
            rollout_horizon=rollout,
            provenance={
                "seed": self.seed,
                "versions": versions(),
                "data_sha256": self.train.data_sha256,
                "test_sha256": self.test.data_sha256,
                "transitions": self.train.n_transitions,
                "test_transitions": self.test.n_transitions,
                "horizon": horizon,
                "rollout_horizon": rollout,
                "rollout_seconds": rollout * self.scene.time_step,
            },
        )

    def _added(self, step: _Step, posterior: Any) -> Added:
        candidate, effect = step.signature.candidate, step.signature.attached.effect
        named = posterior_draws(posterior)
        bodies = [one.body for one in step.after.problem.effects if one.effect.name == effect.name]
        estimates = {}
        for parameter in effect.parameters:
            values = named[effect.variable(parameter)][:, bodies.index(candidate.body)]
            estimates[parameter.name] = Estimate(
                float(values.mean()), float(values.std()), interval(values), parameter.unit
            )
        return Added(
            effect=candidate.effect,
            body=candidate.body,
            sentence=candidate.sentence,
            statistic=candidate.statistic,
            p_value=candidate.p_value,
            parameters=estimates,
            not_separable_from=step.not_separable_from,
            elpd_difference=step.elpd_difference,
            elpd_difference_se=step.elpd_difference_se,
        )

    def _rollout_horizon(self, horizon: int) -> int:
        longest = int(self.test.dataset["n_rows"].min()) - 1
        second = round(ROLLOUT_SECONDS / self.scene.time_step)
        return min(longest, max(horizon, second))

    def _errors(self, mode: Mode, scale: Mode, posterior: Any, rollout: int) -> Errors:
        """Errors of a model; ``scale`` is the model whose noise is the unit."""
        problem = self._on_test(mode)
        pick = np.random.default_rng(self.seed)
        phi, sigma = parameter_draws(mode.problem, posterior)
        chosen = pick.choice(len(phi), min(_ELPD_DRAWS, len(phi)), replace=False)
        return Errors(
            one_step_rmse=_rmse(replace(problem, horizon=1, noise=None), mode),
            rollout_rmse=_rmse(replace(problem, horizon=rollout, noise=None), mode),
            normalised_rmse=_normalised(self._on_test(scale), mode, scale),
            elpd=float(_elpd(problem, phi[chosen], sigma[chosen]).sum()),
        )

    def _floor(self, mode: Mode, rollout: int) -> Errors:
        """Errors that measurement noise alone would give, at both ends of a prediction."""

        def expected(problem: Problem) -> dict[str, float]:
            names = problem.observations.names
            gain = problem.noise.gain if problem.noise else np.ones(1)
            gain = np.broadcast_to(gain, (problem.segments.n, gain.shape[-1]))
            gain = gain.reshape(problem.observations.values.shape)[:, -1]
            seen = problem.observations.measured[:, -1]
            square = ((gain * mode.sigma) ** 2 * seen).sum((0, 1)) / np.maximum(seen.sum((0, 1)), 1)
            return dict(zip(names, np.sqrt(square).tolist(), strict=True))

        problem = self._on_test(mode)
        measured = problem.observations.measured
        at_mode = log_density(
            np.zeros_like(problem.observations.values), mode.sigma, problem.noise, measured
        )
        return Errors(
            one_step_rmse=expected(self._on_test(mode, 1)),
            rollout_rmse=expected(self._on_test(mode, rollout)),
            normalised_rmse=1.0,
            elpd=float(at_mode.sum() - 0.5 * measured.sum()),
        )

    def _rollout(self, declared: Mode, revised: Mode) -> Rollout:
        """Follow the body that moves most over the first held-out trajectory."""
        length = int(self.test.dataset["n_rows"].min()) - 1
        problem = replace(revised.problem, history=self.test, horizon=length, noise=None)
        first = slice(0, 1)
        start, actions = problem.segments.start[first], problem.segments.actions[first]
        measured = problem.observations.values[0]
        columns = problem.observations.columns
        spread = np.nanstd(measured, axis=0)
        body = int(np.argmax(np.nansum(spread / np.maximum(revised.sigma, 1e-12), axis=1)))
        predictions = [
            np.concatenate([start, mode.problem.simulator(mode.phi, start, actions)[0]])
            for mode in (declared, revised)
        ]
        origin = np.where(np.isfinite(start[0, body]), start[0, body], np.nan)
        return Rollout(
            body=self.scene.dynamic[body].name,
            time=np.arange(length + 1, dtype=float) * self.scene.time_step,
            names=problem.observations.names,
            units=tuple(STATE_UNITS[d] for d in columns),
            measured=np.vstack([origin[list(columns)], measured[:, body]]),
            before=predictions[0][:, body][:, columns],
            after=predictions[1][:, body][:, columns],
        )


def _distinct(ranked: list[Signature], order: list[str]) -> list[Signature]:
    """Significant candidates, best first; of twins, the one that the catalogue names first."""
    kept: list[Signature] = []
    for each in sorted(ranked, key=lambda each: order.index(each.attached.effect.name)):
        significant = each.candidate.p_value < TRY_P
        if significant and not any(twins(each, other) for other in kept):
            kept.append(each)
    return sorted(kept, key=lambda each: each.log_p)


def _noisy(mode: Mode, rounds: int = 2) -> Mode:
    """Account for start-state noise and refit; from scratch twice, for it depends on the fit."""
    for _ in range(rounds):
        mode = find_mode(with_start_noise(mode.problem, mode), initial=mode.phi)
    return mode


def shift(mode: Mode) -> float:
    """Root mean square change of predictions in noise units if the substeps are doubled."""
    problem = mode.problem
    finer = replace(problem, substeps=2 * problem.substeps)
    change = (problem.residual(mode.phi) - finer.residual(mode.phi)) / mode.sigma
    if problem.noise is not None:
        change = change / problem.noise.gain.reshape(change.shape)
    return float(np.sqrt(np.nanmean(change**2, axis=(0, 1, 2)).max()))


def _log_likelihood(mode: Mode) -> float:
    problem = mode.problem
    residual = problem.residual(mode.phi)
    measured = problem.observations.measured
    return float(log_density(residual, mode.sigma, problem.noise, measured).sum())


def _laplace_draws(mode: Mode, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draws of phi and sigma from the Laplace approximation, cut at the supports."""
    n, p = _ELPD_DRAWS, len(mode.phi)
    factor = np.linalg.cholesky(mode.covariance + 1e-15 * np.eye(p))
    # directions that the data say nothing about do not matter for prediction
    phi = inside(mode.problem.layout.priors, mode.phi + rng.standard_normal((n, p)) @ factor.T)
    counts = np.maximum(mode.problem.observations.measured.sum((0, 1, 2)), 1)
    sigma = mode.sigma * np.exp(rng.standard_normal((n, len(counts))) * np.sqrt(0.5 / counts))
    return phi, sigma


def _elpd(problem: Problem, phi: Array, sigma: Array) -> Array:
    """Log predictive density of each held-out transition, shape (transition,)."""
    measured = problem.observations.measured
    density = log_density(problem.residual(phi), sigma, problem.noise, measured)
    return np.asarray(logsumexp(density, axis=0) - np.log(len(phi)))


def _rmse(problem: Problem, mode: Mode) -> dict[str, float]:
    """Error at the end of the horizon, per state dimension."""
    residual = problem.residual(mode.phi)[:, -1]
    seen = problem.observations.measured[:, -1]
    square = (residual**2).sum((0, 1)) / np.maximum(seen.sum((0, 1)), 1)
    return dict(zip(problem.observations.names, np.sqrt(square).tolist(), strict=True))


def _normalised(scale: Problem, mode: Mode, unit: Mode) -> float:
    """Root mean square held-out residual of a mode, in units of another's noise."""
    z = _whitened(scale, mode, unit)
    return float(np.sqrt((z**2).sum() / scale.observations.measured.sum()))


def _whitened(scale: Problem, mode: Mode, unit: Mode) -> Array:
    model = replace(mode.problem, history=scale.history, horizon=scale.horizon, noise=scale.noise)
    return model.whitened(mode.phi, unit.sigma)


def _by_dimension(scale: Problem, mode: Mode, unit: Mode) -> dict[str, Array]:
    """Held-out residuals in noise units, by state dimension."""
    observations = scale.observations
    z = _whitened(scale, mode, unit).reshape(observations.values.shape)
    return {
        name: z[..., i][observations.measured[..., i]] for i, name in enumerate(observations.names)
    }
