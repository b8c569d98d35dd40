"""Closing the loop: fit, criticise, add an effect, confirm on held-out data, go round again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism import findings
from pbrl_ppl.criticism.findings import Added, Estimate, Findings, Numerical
from pbrl_ppl.criticism.held_out import HeldOut, standard_error
from pbrl_ppl.criticism.misfit import find_remainder
from pbrl_ppl.criticism.resolution import choose_horizon, noisy, shift, with_enough_substeps
from pbrl_ppl.criticism.score import Signature, inseparable, rank_candidates, twins
from pbrl_ppl.effects import Attached, Effect, Noise, attach, candidates
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.history import History
from pbrl_ppl.model import Problem, build_model
from pbrl_ppl.modes import Mode, find_mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.posterior import compare, identify, interval, versions
from pbrl_ppl.posterior import draws as posterior_draws
from pbrl_ppl.sampling import fit
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
#: Names are not to be trusted if what is left is more than this share of what they explained (of
#: the squared error); with less, the verdict is what was added, and the rest is reported beside it.
LARGE_REMAINDER = 0.1
#: Draws kept of each chain, tuning draws at least, and engine steps of a long recording.
DRAWS, LEAST_TUNE, LONG = 800, 100, 20_000


def revise(
    scene: Scene,
    train: History,
    test: History | None = None,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    horizon: int | None = None,
    substeps: int | None = None,
    draws: int | None = None,
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
    draws : int, optional
        Posterior draws kept of each chain; 800 by default, half of that for long recordings.
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
    loop = _Loop(scene, train, HeldOut(test, seed), catalogue, seed, say)
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
    if len(added) > 1:
        say("checking that each added effect is still needed")
        current, added = loop.prune(current, added)
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
    held_out: HeldOut
    catalogue: tuple[Effect, ...]
    seed: int
    say: Callable[[str], None]

    def declared_mode(self, horizon: int | None, substeps: int | None) -> Mode:
        """Mode of the declared model, with the horizon chosen and the engine's error small."""
        problem = Problem.of(
            self.scene,
            self.train,
            attach(self.scene, (), self.catalogue),
            horizon=1 if horizon is None else horizon,
            substeps=substeps,
            threads=2,
        )
        mode = find_mode(problem, seed=self.seed)
        mode = choose_horizon(mode) if horizon is None else noisy(mode)
        return with_enough_substeps(mode, self.say)

    def missing(self, mode: Mode) -> tuple[Attached, ...]:
        """Candidate effects for a model."""
        return candidates(self.scene, mode.problem.physics.effects, self.catalogue)

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
        effects = (*mode.problem.physics.effects, signature.attached)
        problem = mode.problem.with_physics(effects=effects)
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
        fitted = with_enough_substeps(noisy(fitted, rounds=1), self.say)
        gains = self.held_out.gains(mode, fitted)
        total, error = float(gains.sum()), standard_error(gains)
        fall = self.held_out.fall(mode, fitted)
        if total < MIN_ELPD or total < MIN_ELPD_SE * error or fall < MIN_ERROR_FALL:
            return None
        return _Step(signature, inseparable(signature, ranked), fitted, total, error)

    def prune(self, mode: Mode, steps: list[_Step]) -> tuple[Mode, list[_Step]]:
        """Drop effects that later ones have made unnecessary; what gained most comes first."""
        for step in sorted(steps, key=lambda each: each.elpd_difference):
            without = self._without(mode, step.signature.attached)
            gains = self.held_out.gains(without, mode)
            if gains.sum() < MIN_ELPD or gains.sum() < MIN_ELPD_SE * standard_error(gains):
                mode = without
                steps = [each for each in steps if each is not step]
        return mode, sorted(steps, key=lambda each: -each.elpd_difference)

    def _without(self, mode: Mode, effect: Attached) -> Mode:
        kept = tuple(each for each in mode.problem.physics.effects if each != effect)
        problem = mode.problem.with_physics(effects=kept)
        labels = mode.problem.layout.labels
        phi = [mode.phi[labels.index(label)] for label in problem.layout.labels]
        return noisy(find_mode(problem, initial=np.array(phi)), rounds=1)

    def posterior(self, mode: Mode, draws: int | None) -> Any:
        """Sample a mode's model; the Laplace approximation to begin with needs little tuning."""
        problem = mode.problem
        if draws is None:
            steps = problem.segments.n * problem.data.horizon * problem.simulator.steps
            draws = DRAWS if steps < LONG else DRAWS // 2
        model = build_model(problem.with_physics(threads=1))
        tune = max(LEAST_TUNE, 5 * draws // 8)
        fitted = fit(model, seed=self.seed, draws=draws, tune=tune, start=mode, progress=False)
        if "interrupted" in fitted.attrs:  # half a posterior is no ground for a verdict
            raise KeyboardInterrupt
        return fitted

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
        horizon = revised.problem.data.horizon
        held_out = self.held_out
        rollout = held_out.rollout_horizon(horizon, self.scene.time_step)
        errors = [
            held_out.errors(mode, revised, posterior, rollout)
            for mode, posterior in ((declared, before), (revised, after))
        ]
        verdict = findings.EFFECTS_ADDED if steps else findings.ADEQUATE
        if remainder is not None:
            square_before, square_after = (each.normalised_rmse**2 for each in errors)
            explained = square_before - square_after
            if not steps or remainder.share * square_after > LARGE_REMAINDER * explained:
                verdict = findings.UNEXPLAINED
        return Findings(
            scene=self.scene,
            verdict=verdict,
            numerical=Numerical(
                self.scene.substeps, revised.problem.physics.substeps, shift(revised)
            ),
            candidates=tuple(each.candidate for each in first),
            added=tuple(_added(step, revised, after) for step in steps),
            unexplained=remainder,
            before=errors[0],
            after=errors[1],
            noise_floor=held_out.noise_floor(revised, rollout),
            posterior_before=before,
            posterior_after=after,
            residuals_before=held_out.residuals(declared, revised),
            residuals_after=held_out.residuals(revised, revised),
            rollout=held_out.rollout(declared, revised),
            horizon=horizon,
            rollout_horizon=rollout,
            provenance={
                "seed": self.seed,
                "versions": versions(),
                "data_sha256": self.train.data_sha256,
                "test_sha256": held_out.history.data_sha256,
                "transitions": self.train.n_transitions,
                "test_transitions": held_out.history.n_transitions,
                "horizon": horizon,
                "rollout_horizon": rollout,
                "rollout_seconds": rollout * self.scene.time_step,
            },
            identifiability=identify(after, mode=revised),
            loo=compare(before, after),
        )


def _added(step: _Step, revised: Mode, posterior: Any) -> Added:
    """Summarise an added effect with its posterior."""
    candidate, effect = step.signature.candidate, step.signature.attached.effect
    named = posterior_draws(posterior)
    bodies = [one.body for one in revised.problem.physics.effects if one.effect.name == effect.name]
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


def _distinct(ranked: list[Signature], order: list[str]) -> list[Signature]:
    """Significant candidates, best first; of twins, the one that the catalogue names first.

    The noise's shape is scored and never added: misfit would pass for noise. A scene declares it.
    """
    kept: list[Signature] = []
    for each in sorted(ranked, key=lambda each: order.index(each.attached.effect.name)):
        if isinstance(each.attached.effect.stage, Noise):
            continue
        significant = each.candidate.p_value < TRY_P
        if significant and not any(twins(each, other) for other in kept):
            kept.append(each)
    return sorted(kept, key=lambda each: each.log_p)


def _log_likelihood(mode: Mode) -> float:
    problem = mode.problem
    residual = problem.residual(mode.phi)
    return float(problem.log_density(residual, mode.sigma, mode.phi).sum())
