"""Closing the loop: fit, criticise, add an effect, confirm on held-out data, go round again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from pbrl_ppl.criticism import findings
from pbrl_ppl.criticism.findings import Added, Estimate, Findings, Numerical
from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.criticism.misfit import find_remainder
from pbrl_ppl.criticism.resolution import choose_horizon, noisy, shift, with_enough_substeps
from pbrl_ppl.criticism.score import Signature, rank_candidates
from pbrl_ppl.criticism.selection import Selection, Step
from pbrl_ppl.effects import Effect, attach
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.history import History
from pbrl_ppl.model import Problem, build_model
from pbrl_ppl.modes import Mode, find_mode
from pbrl_ppl.posterior import compare, identify, interval, versions
from pbrl_ppl.posterior import draws as posterior_draws
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Scene

#: Effects added at most.
MOST_ADDED = 5
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
    held_out = HeldOut(test, seed)
    loop = _Loop(scene, train, held_out, catalogue, seed, say)
    selection = Selection(scene, held_out, catalogue, say)
    say("fitting the declared model")
    declared = loop.declared_mode(horizon, substeps)
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
        steps: list[Step],
        remainder: findings.Unexplained | None,
        before: Any,
        after: Any,
    ) -> Findings:
        """Assemble verdict, held-out errors, posteriors and provenance."""
        horizon = revised.problem.data.horizon
        held_out = self.held_out
        rollout = held_out.rollout_horizon(horizon, self.scene.time_step)
        errors = [
            held_out.errors(mode, revised, posterior, rollout)
            for mode, posterior in ((declared, before), (revised, after))
        ]
        verdict = findings.EFFECTS_ADDED if steps else findings.ADEQUATE
        if remainder is not None:
            square_before, square_after = (error.normalised_rmse**2 for error in errors)
            explained = square_before - square_after
            if not steps or remainder.share * square_after > LARGE_REMAINDER * explained:
                verdict = findings.UNEXPLAINED
        return Findings(
            scene=self.scene,
            verdict=verdict,
            numerical=Numerical(
                self.scene.substeps, revised.problem.physics.substeps, shift(revised)
            ),
            candidates=tuple(signature.candidate for signature in first),
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
