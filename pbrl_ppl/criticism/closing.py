"""Closing the loop: fit, criticise, add an effect, confirm on held-out data, go round again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pbrl_ppl.criticism.assembly import Models, converged, put_together
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.drift import same_noise, with_correlated_errors
from pbrl_ppl.criticism.held_out import HeldOut, rollout_horizon
from pbrl_ppl.criticism.histories import checked_histories
from pbrl_ppl.criticism.loop import Findings
from pbrl_ppl.criticism.misfit import PRIOR, beside_names, find_misfit
from pbrl_ppl.criticism.outliers import outliers
from pbrl_ppl.criticism.prior_check import prior_predictive_check, telling_horizon
from pbrl_ppl.criticism.ranking import declared_mode
from pbrl_ppl.criticism.results import ResidualTest
from pbrl_ppl.criticism.score import Signature, rank_candidates
from pbrl_ppl.criticism.selection import Selection, Step
from pbrl_ppl.criticism.unexplained import (
    Left,
    unexplained_acceleration,
    without_acceleration,
)
from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import ConvergenceWarning, PriorWarning
from pbrl_ppl.history import History, without_measurements
from pbrl_ppl.model import Problem, build_model
from pbrl_ppl.modes import Mode
from pbrl_ppl.physics import try_effect
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Scene

#: Draws of each chain, then those where that is not enough; independent draws; least tuning draws.
DRAWS, INDEPENDENT, LEAST_TUNE = (300, 1000), (125,), 100
#: Times that the noise is mended and the search for effects begun again, at most.
_NOISES = 4
#: Draws from the prior, of which some must reach what was measured.
PRIOR_DRAWS = 100


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
    criteria: Criteria = DEFAULT,
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
    criteria : Criteria
        Thresholds of the decisions.
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

    Warns
    -----
    PriorWarning
        Before anything is fitted, if the declared prior could not have made ``train``.
    """
    # matrices are small: threads of linear algebra only get in each other's way
    with threadpool_limits(1, "blas"):
        return _revised(
            scene, train, test, tuple(catalogue), seed, substeps, draws, method, criteria,
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
    criteria: Criteria,
    say: Callable[[str], None],
) -> Findings:
    """Go through the stages of :func:`revise`."""
    if test is None:
        train, test = train.split(0.25, seed)
    elif scene.test_is_later:  # what lasts from some trajectory on holds in it
        test = test.numbered(float(train.dataset["number"].max()) + 1.0)
    if substeps is not None:
        scene.replace(substeps=substeps)  # it is checked there
    train, test, unused, bad = checked_histories(scene, train, test)
    for sentence in (*(velocity.sentence for velocity in unused), *bad):
        say(sentence)
    held_out = HeldOut(test, seed)
    for effect in catalogue:
        if effect not in full_catalogue:
            try_effect(effect, scene, train)
    selection = Selection(scene, catalogue, criteria, say)
    effects = attach(scene, (), catalogue)
    say("looking whether the prior could have made the data")
    prior = _prior_test(scene, train, effects, seed)
    if not prior.passed:  # of wrong units nobody wants the fit
        hint = "the declared prior does not explain this recording, unless a missing effect is why"
        warnings.warn(f"{hint}: {prior.sentence}", PriorWarning, stacklevel=3)
    say("fitting the declared model")
    declared = declared_mode(scene, train, effects, seed, substeps, say, criteria)
    first, current, added = _with_effects(declared, selection, criteria, say, mendable=True)
    # under the right noise effects may show that were hidden before
    for again in reversed(range(_NOISES)):
        train, frames = without_measurements(train, outliers(current))
        if frames:
            for sentence in map(str, frames):
                say(sentence)
            bad += tuple(map(str, frames))
            declared = declared_mode(scene, train, effects, seed, substeps, say, criteria)
        else:
            tracked = with_correlated_errors(current, criteria)
            if tracked is None:
                break
            say("errors of measuring are correlated: looking again")
            declared = same_noise(declared, tracked)
        first, current, added = _with_effects(
            declared, selection, criteria, say, mendable=again > 0
        )
    as_tested = replace(current, problem=held_out.problem(current))
    test, frames = without_measurements(test, outliers(as_tested))
    if frames:
        held_out, bad = HeldOut(test, seed), (*bad, *(f"held out: {frame}" for frame in frames))
    say("testing what is left")
    before, left = (unexplained_acceleration(mode, criteria) for mode in (declared, current))
    horizon = rollout_horizon(train, scene.time_step)
    with_added = prior
    if added and not prior.passed:  # what was missing may be why
        own = dict(zip(current.problem.layout.labels, current.phi.tolist(), strict=True))
        held = {label: own[label] for each in added for label in each.signature.attached.labels}
        effects = current.problem.physics.effects
        with_added = _prior_test(scene, train, effects, seed, held)
    misfit = find_misfit(current, left, horizon=horizon, seed=seed).with_test(with_added)
    remains = _remains(before, left) if added and misfit.unexplained is not None else 0.0
    small = left.worst < criteria.negligible
    large = remains > (criteria.large_if_small if small else criteria.large_remainder)
    if large and not misfit.random:
        without = find_misfit(declared, before, horizon=horizon, seed=seed)
        followed = misfit.predictable < criteria.most_predictable * without.predictable
        if remains > criteria.large_if_small or not followed:
            # part of a misfit goes to whatever is there: no name is to be had from that
            say("no effect of the catalogue explains what is missing")
            selection.withdraw(added)
            added, current, left = [], declared, before
            misfit = without.with_test(prior)
    if added:
        misfit = beside_names(misfit, current, left)
    say("sampling the posterior of the declared model")
    posterior = _posterior(declared, method, seed, draws, criteria, say)
    revised = posterior
    if added:
        say("sampling the posterior of the revised model")
        revised = _posterior(current, method, seed, draws, criteria, say)
    say("comparing errors on held-out data")
    models = Models(declared, current, posterior, revised, before, left)
    told = selection.explained(first), tuple(selection.small)
    findings = put_together(train, held_out, models, *told, added, misfit, criteria, horizon)
    return replace(findings, velocities_not_used=unused, bad_frames=bad)


def _with_effects(
    declared: Mode,
    selection: Selection,
    criteria: Criteria,
    say: Callable[[str], None],
    *,
    mendable: bool,
) -> tuple[list[Signature], Mode, list[Step]]:
    """The ranking of the declared model, the model with effects added one by one, and those.

    If the noise is ``mendable`` it ends where outliers show, the last effect unconfirmed.
    """
    say("scoring what the model might lack")
    first = rank_candidates(declared, selection.missing(declared))
    current, ranked = declared, first
    added: list[Step] = []
    while ranked and len(added) < criteria.most_added:
        if mendable and np.isfinite(outliers(current)).any():
            return first, current, added
        step = selection.best_addition(current, ranked, provisional=mendable)
        if step is None and unexplained_acceleration(current, criteria).remains.any():
            alone = without_acceleration(current)
            hidden = rank_candidates(alone, selection.missing(current))
            step = selection.best_addition(current, hidden)
        if step is None:
            break
        say(f"added {step.signature.candidate.effect} on {step.signature.candidate.body}")
        added.append(step)
        current = step.after
        ranked = rank_candidates(current, selection.missing(current))
    if len(added) > 1:
        say("checking that each added effect is still needed")
        current, added = selection.prune(current, added)
    return first, current, added


def _prior_test(
    scene: Scene,
    train: History,
    effects: tuple[Attached, ...],
    seed: int,
    held: Mapping[str, float] | None = None,
) -> ResidualTest:
    """Whether the prior could have made the data, with some parameters held, as a test."""
    problem = Problem.of(scene, train, effects, horizon=telling_horizon(train), threads=2)
    model = build_model(problem)
    checked = prior_predictive_check(model, draws=PRIOR_DRAWS, seed=seed, held=held)
    share = float(checked.dataset["share_beyond"].max())
    said, *more = checked.summary
    if more:
        said = f"{said}; so it is with {len(more)} more"
    return ResidualTest(PRIOR, float("nan"), share, not checked.sentences, said)


def _remains(before: Left, after: Left) -> float:
    """Share of what was missing, of its square, that remains."""
    return after.square / before.square if before.square > 0 else 0.0


def _posterior(
    mode: Mode,
    method: str,
    seed: int,
    draws: int | None,
    criteria: Criteria,
    say: Callable[[str], None],
) -> Any:
    """Sample a mode's model; the Laplace approximation to begin with needs little tuning."""
    # a chain a processor: more threads would wait for each other
    mode = replace(mode, problem=mode.problem.with_physics(threads=1))
    model = build_model(mode.problem)
    chains = method != "laplace"
    for n in (DRAWS if chains else INDEPENDENT) if draws is None else (draws,):
        tune = max(LEAST_TUNE, 5 * n // 8)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fitted = fit(
                model, method=method, seed=seed, draws=n, tune=tune, start=mode,
                progress=False,
            )  # fmt: skip
        if "interrupted" in fitted.attrs:  # half a posterior is no ground for a verdict
            raise KeyboardInterrupt
        if converged(fitted, criteria):
            break
        say(f"the chains have not converged after {n} draws each")
    for warning in caught:  # of the last; independent draws are no chains that converge
        if chains or not issubclass(warning.category, ConvergenceWarning):
            warnings.warn(warning.message, stacklevel=2)
    return fitted
