"""Findings of a closed loop, put together from modes, posteriors, tests and held-out errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pbrl_ppl.criticism import loop as findings
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.criticism.loop import Findings
from pbrl_ppl.criticism.misfit import Misfit
from pbrl_ppl.criticism.resolution import shift
from pbrl_ppl.criticism.results import (
    Acceleration,
    Added,
    Candidate,
    Errors,
    Estimate,
    Numerical,
    Unexplained,
)
from pbrl_ppl.criticism.rivals import keep_groups
from pbrl_ppl.criticism.selection import Step
from pbrl_ppl.criticism.unexplained import Left, noise_alone
from pbrl_ppl.history import History
from pbrl_ppl.modes import Mode
from pbrl_ppl.posterior import compare, identify, interval, versions
from pbrl_ppl.posterior import draws as posterior_draws


@dataclass(frozen=True, eq=False)
class Models:
    """The declared and the revised model: modes, posteriors, what they leave."""

    declared: Mode
    revised: Mode
    before: Any
    after: Any
    left_before: Left
    left_after: Left


def put_together(
    train: History,
    held_out: HeldOut,
    models: Models,
    candidates: tuple[Candidate, ...],
    small: tuple[Candidate, ...],
    steps: list[Step],
    misfit: Misfit,
    criteria: Criteria,
    horizon: int,
) -> Findings:
    """Findings from what the loop's stages gave: verdict, held-out errors, provenance.

    Parameters
    ----------
    train : History
        What was fitted.
    held_out : HeldOut
        What errors are measured on, touched here for the first time.
    models : Models
        The declared and the revised one.
    candidates : tuple of Candidate
        Of the first round.
    small : tuple of Candidate
        Effects that are significant and negligible.
    steps : list of Step
        Effects that were added.
    misfit : Misfit
        What the revised model leaves.
    criteria : Criteria
        Which chains have converged.
    horizon : int
        Intervals of forecasts, where held-out trajectories are as long.
    """
    declared, revised = models.declared, models.revised
    scene = declared.problem.scene
    rollout = held_out.longest(horizon)
    before = held_out.errors(declared, revised, models.before, rollout)
    after = before
    if revised is not declared:
        after = held_out.errors(revised, revised, models.after, rollout)
    verdict = findings.EFFECTS_ADDED if steps else findings.ADEQUATE
    unexplained = misfit.unexplained
    # names that leave an acceleration unexplained are the nearest there are at best
    if unexplained is not None and not (steps and misfit.predicts):
        verdict = findings.UNEXPLAINED
    most = (1.0 + criteria.negligible) * before.normalised_rmse
    if steps and after.normalised_rmse > most:
        verdict, unexplained = findings.UNEXPLAINED, unexplained or _worse(before, after)
    if not all(converged(posterior, criteria) for posterior in (models.before, models.after)):
        verdict = findings.NOT_CONVERGED
    added = tuple(_added(step, revised, models.after) for step in steps)
    keep_groups(models.after, added)
    return Findings(
        scene=scene,
        verdict=verdict,
        numerical=Numerical(scene.substeps, revised.problem.physics.substeps, shift(revised)),
        candidates=candidates,
        added=added,
        unexplained=unexplained,
        before=before,
        after=after,
        noise_floor=held_out.noise_floor(revised, noise_alone(revised, models.left_after), rollout),
        posterior_before=models.before,
        posterior_after=models.after,
        residuals_before=held_out.residuals(declared, revised),
        residuals_after=held_out.residuals(revised, revised),
        rollout=held_out.rollout(declared, revised),
        rollout_horizon=rollout,
        provenance={
            "seed": held_out.seed,
            "versions": versions(),
            "data_sha256": train.data_sha256,
            "test_sha256": held_out.history.data_sha256,
            "transitions": train.n_transitions,
            "test_transitions": held_out.history.n_transitions,
            "rollout_horizon": rollout,
            "rollout_seconds": rollout * scene.time_step,
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


def converged(posterior: Any, criteria: Criteria = DEFAULT) -> bool:
    """Whether chains agree well enough for a verdict; warnings begin earlier."""
    attrs = posterior.attrs
    r_hat, ess = attrs.get("max_rhat", np.inf), attrs.get("min_ess", 0.0)
    return bool(r_hat <= criteria.worst_rhat and ess >= criteria.least_ess)


def _worse(before: Errors, after: Errors) -> Unexplained:
    """What is said where the revised model's held-out error is the larger one."""
    rise = after.normalised_rmse / before.normalised_rmse - 1.0
    return Unexplained(
        body="",
        dimension="",
        depends_on="nothing that was recorded",
        share=0.0,
        p_value=float("nan"),
        sentence=(
            "the revised model forecasts the held-out trajectories worse than the declared one: its"
            f" error is {100 * rise:.2g} % larger, {after.normalised_rmse:.3g} against"
            f" {before.normalised_rmse:.3g} times the noise"
        ),
    )


def _added(step: Step, revised: Mode, posterior: Any) -> Added:
    """Summarise an added effect with its posterior."""
    candidate, effect = step.signature.candidate, step.signature.attached.effect
    named = posterior_draws(posterior)
    bodies = [
        attached.body
        for attached in revised.problem.physics.effects
        if attached.effect.name == effect.name
    ]
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
