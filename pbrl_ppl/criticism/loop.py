"""Closing the loop: fit, criticise, add an effect, confirm on held-out data, go round again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pbrl_ppl.criticism import findings
from pbrl_ppl.criticism.findings import Findings
from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.criticism.histories import checked_histories, named
from pbrl_ppl.criticism.misfit import PRIOR, Misfit, find_misfit
from pbrl_ppl.criticism.prior_check import prior_predictive_check, telling_horizon
from pbrl_ppl.criticism.ranking import declared_mode
from pbrl_ppl.criticism.resolution import shift
from pbrl_ppl.criticism.results import (
    Acceleration,
    Added,
    Candidate,
    Estimate,
    Numerical,
    ResidualTest,
)
from pbrl_ppl.criticism.rivals import keep_groups
from pbrl_ppl.criticism.score import Signature, rank_candidates
from pbrl_ppl.criticism.selection import Selection, Step
from pbrl_ppl.criticism.unexplained import Left, unexplained_acceleration
from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import ConvergenceWarning
from pbrl_ppl.history import History
from pbrl_ppl.model import Problem, build_model
from pbrl_ppl.modes import Mode
from pbrl_ppl.physics import try_effect
from pbrl_ppl.posterior import compare, identify, interval, versions
from pbrl_ppl.posterior import draws as posterior_draws
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Scene

#: Effects added at most.
MOST_ADDED = 5
#: With more than this share of what was missing (of its square) left there are no names to be had;
#: where what remains is small (a share of the bodies' acceleration), more may.
LARGE_REMAINDER, SMALL, LARGE_IF_SMALL = 0.2, 0.01, 0.5
#: Draws of each chain, then those where that is not enough; independent draws; least tuning draws.
DRAWS, INDEPENDENT, LEAST_TUNE = (300, 1000), (125,), 100
#: Draws from the prior, of which some must reach what was measured.
PRIOR_DRAWS = 100
#: Chains with a larger R-hat or fewer effective draws give no verdict.
WORST_RHAT, LEAST_ESS = 1.05, 100.0


def revise(
    scene: Scene,
    train: History,
    test: History | None = None,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    substeps: int | None = None,
    draws: int | None = None,
    method: str = "metropolis",
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
    substeps : int, optional
        Engine steps an interval to begin with; the scene's by default.
    draws : int, optional
        Posterior draws of each chain; by default 300, or 1000 where chains have not converged.
    method : str
        Of :func:`pbrl_ppl.fit`, for the posteriors; with ``laplace`` the verdict stands on modes.
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
    # matrices are small: threads of linear algebra only get in each other's way
    with threadpool_limits(1, "blas"):
        return _revised(
            scene, train, test, tuple(catalogue), seed, substeps, draws, method,
            progress or (lambda stage: None),
        )  # fmt: skip


def _revised(
    scene: Scene,
    train: History,
    test: History | None,
    catalogue: tuple[Effect, ...],
    seed: int,
    substeps: int | None,
    draws: int | None,
    method: str,
    say: Callable[[str], None],
) -> Findings:
    """Go through the stages of :func:`revise`."""
    if test is None:
        train, test = train.split(0.25, seed)
    if substeps is not None:
        scene.replace(substeps=substeps)  # it is checked there
    train, test, derived = checked_histories(scene, train, test)
    if derived.any():
        say(f"taking {named(scene, derived)} for computed from positions, which count alone")
    loop = _Loop(scene, train, HeldOut(test, seed), seed, method, say)
    for effect in catalogue:
        if effect not in full_catalogue:
            try_effect(effect, scene, train)
    selection = Selection(scene, catalogue, say)
    effects = attach(scene, (), catalogue)
    say("looking whether the prior could have made the data")
    prior = _prior_test(scene, train, effects, seed)
    say("fitting the declared model")
    declared = declared_mode(scene, train, effects, seed=seed, substeps=substeps, say=say)
    say("scoring what the model might lack")
    first = rank_candidates(declared, selection.missing(declared))
    current, ranked = declared, first
    added: list[Step] = []
    while ranked and len(added) < MOST_ADDED:
        step = selection.best_addition(current, ranked)
        if step is None:
            break
        say(f"added {step.signature.candidate.effect} on {step.signature.candidate.body}")
        added.append(step)
        current = step.after
        ranked = rank_candidates(current, selection.missing(current))
    if len(added) > 1:
        say("checking that each added effect is still needed")
        current, added = selection.prune(current, added)
    say("testing what is left")
    before, left = unexplained_acceleration(declared), unexplained_acceleration(current)
    horizon = loop.held_out.rollout_horizon(scene.time_step)
    with_added = prior
    if added and not prior.passed:  # what was missing may be why
        with_added = _prior_test(scene, train, current.problem.physics.effects, seed)
    misfit = find_misfit(current, left, horizon=horizon, seed=seed).with_test(with_added)
    remains = _remains(before, left) if added and misfit.unexplained is not None else 0.0
    if remains > (LARGE_IF_SMALL if left.worst < SMALL else LARGE_REMAINDER):
        # part of a misfit goes to whatever is there: no name is to be had from that
        say("no effect of the catalogue explains what is missing")
        added, current, left = [], declared, before
        misfit = find_misfit(current, left, horizon=horizon, seed=seed).with_test(prior)
    say("sampling the posterior of the declared model")
    posterior = loop.posterior(declared, draws)
    revised = posterior
    if added:
        say("sampling the posterior of the revised model")
        revised = loop.posterior(current, draws)
    say("comparing errors on held-out data")
    models = _Models(declared, current, posterior, revised, before, left)
    return loop.findings(models, first, added, misfit, tuple(selection.small))


@dataclass(frozen=True, eq=False)
class _Models:
    """The declared and the revised model: modes, posteriors, what they leave."""

    declared: Mode
    revised: Mode
    before: Any
    after: Any
    left_before: Left
    left_after: Left


def _prior_test(
    scene: Scene, train: History, effects: tuple[Attached, ...], seed: int
) -> ResidualTest:
    """Whether the prior of a model with these effects could have made the data, as a test."""
    problem = Problem.of(scene, train, effects, horizon=telling_horizon(train), threads=2)
    checked = prior_predictive_check(build_model(problem), draws=PRIOR_DRAWS, seed=seed)
    share = float(checked.dataset["share_beyond"].max())
    return ResidualTest(
        PRIOR, float("nan"), share, not checked.sentences, "; ".join(checked.summary)
    )


def _remains(before: Left, after: Left) -> float:
    """Share of what was missing, of its square, that remains."""
    return after.square / before.square if before.square > 0 else 0.0


@dataclass(frozen=True, eq=False)
class _Loop:
    """The data and settings that every stage shares."""

    scene: Scene
    train: History
    held_out: HeldOut
    seed: int
    method: str
    say: Callable[[str], None]

    def posterior(self, mode: Mode, draws: int | None) -> Any:
        """Sample a mode's model; the Laplace approximation to begin with needs little tuning."""
        # a chain a processor: more threads would wait for each other
        mode = replace(mode, problem=mode.problem.with_physics(threads=1))
        model = build_model(mode.problem)
        chains = self.method != "laplace"
        for n in (DRAWS if chains else INDEPENDENT) if draws is None else (draws,):
            tune = max(LEAST_TUNE, 5 * n // 8)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                fitted = fit(
                    model, method=self.method, seed=self.seed, draws=n, tune=tune, start=mode,
                    progress=False,
                )  # fmt: skip
            if "interrupted" in fitted.attrs:  # half a posterior is no ground for a verdict
                raise KeyboardInterrupt
            if _converged(fitted):
                break
            self.say(f"the chains have not converged after {n} draws each")
        for warning in caught:  # of the last; independent draws are no chains that converge
            if chains or not issubclass(warning.category, ConvergenceWarning):
                warnings.warn(warning.message, stacklevel=2)
        return fitted

    def findings(
        self,
        models: _Models,
        first: list[Signature],
        steps: list[Step],
        misfit: Misfit,
        small: tuple[Candidate, ...],
    ) -> Findings:
        """Assemble verdict, held-out errors, posteriors and provenance."""
        held_out, declared, revised = self.held_out, models.declared, models.revised
        rollout = held_out.rollout_horizon(self.scene.time_step)
        before = held_out.errors(declared, revised, models.before, rollout)
        after = before
        if revised is not declared:
            after = held_out.errors(revised, revised, models.after, rollout)
        verdict = findings.EFFECTS_ADDED if steps else findings.ADEQUATE
        # names that leave an acceleration unexplained are the nearest there are at best
        if misfit.unexplained is not None and not (steps and misfit.predicts):
            verdict = findings.UNEXPLAINED
        if not all(map(_converged, (models.before, models.after))):
            verdict = findings.NOT_CONVERGED
        added = tuple(_added(step, revised, models.after) for step in steps)
        keep_groups(models.after, added)
        return Findings(
            scene=self.scene,
            verdict=verdict,
            numerical=Numerical(
                self.scene.substeps, revised.problem.physics.substeps, shift(revised)
            ),
            candidates=tuple(signature.candidate for signature in first),
            added=added,
            unexplained=misfit.unexplained,
            before=before,
            after=after,
            noise_floor=held_out.noise_floor(revised, rollout),
            posterior_before=models.before,
            posterior_after=models.after,
            residuals_before=held_out.residuals(declared, revised),
            residuals_after=held_out.residuals(revised, revised),
            rollout=held_out.rollout(declared, revised),
            rollout_horizon=rollout,
            provenance={
                "seed": self.seed,
                "versions": versions(),
                "data_sha256": self.train.data_sha256,
                "test_sha256": held_out.history.data_sha256,
                "transitions": self.train.n_transitions,
                "test_transitions": held_out.history.n_transitions,
                "rollout_horizon": rollout,
                "rollout_seconds": rollout * self.scene.time_step,
            },
            tests=misfit.tests,
            acceleration=_acceleration(models.left_before, models.left_after),
            correlations=misfit.correlations,
            growth=misfit.growth,
            small=small,
            identifiability=identify(models.after, mode=revised),
            loo=compare(models.before, models.after),
        )


def _acceleration(before: Left, after: Left) -> Acceleration:
    """Unexplained accelerations of both models, for the report."""

    def named(left: Left, values: Any) -> dict[str, Any]:
        return dict(zip(left.names, values.tolist(), strict=True))

    return Acceleration(
        named(before, before.size),
        named(after, after.size),
        named(before, before.relative),
        named(after, after.relative),
        named(after, after.certain),
    )


def _converged(posterior: Any) -> bool:
    """Whether chains agree well enough for a verdict; warnings begin earlier."""
    attrs = posterior.attrs
    r_hat, ess = attrs.get("max_rhat", np.inf), attrs.get("min_ess", 0.0)
    return bool(r_hat <= WORST_RHAT and ess >= LEAST_ESS)


def _added(step: Step, revised: Mode, posterior: Any) -> Added:
    """Summarise an added effect with its posterior."""
    candidate, effect = step.signature.candidate, step.signature.attached.effect
    named = posterior_draws(posterior)
    bodies = [a.body for a in revised.problem.physics.effects if a.effect.name == effect.name]
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
