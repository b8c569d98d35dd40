"""The closed loop: fit, score, add effects, test the residual, compare on held-out data."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pbrl_ppl.background import background
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.held_out import HeldOut, example_rollout, longest_rollout, rollout_horizon
from pbrl_ppl.criticism.loop import ADEQUATE, EFFECTS_ADDED, NOT_CONVERGED, UNEXPLAINED, Loop
from pbrl_ppl.criticism.misfit import (
    NOTHING_RECORDED,
    PRIOR,
    Misfit,
    find_misfit,
    held_out_forecasts,
    with_negligible_acceleration,
)
from pbrl_ppl.criticism.prior_check import prior_predictive_check, telling_horizon
from pbrl_ppl.criticism.ranking import declared_mode
from pbrl_ppl.criticism.recordings import checked_histories, outliers
from pbrl_ppl.criticism.refinement import same_noise, shift, with_correlated_errors
from pbrl_ppl.criticism.results import (
    Acceleration,
    Added,
    Errors,
    Estimate,
    Numerical,
    ResidualTest,
    Stage,
    Unexplained,
)
from pbrl_ppl.criticism.rivals import keep_groups
from pbrl_ppl.criticism.score import Signature, named_beside
from pbrl_ppl.criticism.selection import Selection, Step
from pbrl_ppl.criticism.simulated import SimulatedSearch
from pbrl_ppl.criticism.unexplained import (
    UnexplainedAcceleration,
    measurement_noise,
    noise_alone,
    unexplained_acceleration,
)
from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import (
    ConvergenceWarning,
    HistoryError,
    PriorWarning,
    UninformedWarning,
    warn,
)
from pbrl_ppl.history import History, with_units, without_measurements
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode
from pbrl_ppl.physics import Physics, try_effect
from pbrl_ppl.posterior import MAX_PARETO_K, Fit, compare, identify, interval, versions
from pbrl_ppl.posterior import draws as posterior_draws
from pbrl_ppl.sampling import sample
from pbrl_ppl.scene import Scene
from pbrl_ppl.threads import one_blas_thread

#: Draws of each chain by method, then those where that is not enough.
_DRAWS = {"importance": (180, 600), "laplace": (125,)}
#: The same of all other methods.
_CHAIN_DRAWS = (300, 1000)


@one_blas_thread
def close_loop(
    scene: Scene,
    train: History,
    test: History | None = None,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    substeps: int | None = None,
    draws: int | None = None,
    method: str = "importance",
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> Loop:
    """Fit a model, add the effects that its residual shows, and compare on held-out data.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    train : History
        Measured transitions that the model is fitted to.
    test : History, optional
        Held-out trajectories that errors are measured on; by default a seeded quarter of the
        trajectories of ``train``.
    catalogue : iterable of Effect
        Effects to consider; add your own to the package's.
    seed : int
        The same seed gives the same result.
    substeps : int, optional
        Engine steps an interval to begin with; the scene's by default.
    draws : int, optional
        Posterior draws kept of each chain; by default 180 of importance sampling and 300 of chains,
        more where these do not suffice.
    method : str
        Sampler of :func:`pbrl_ppl.fit`; with ``laplace`` the verdict relies on modes.
    criteria : Criteria
        Thresholds of the decisions.
    progress : callable, optional
        Called with each :class:`Stage`, a sentence with the share of the time at which it usually
        begins, and with sentences on what was found.

    Returns
    -------
    Loop
        Verdict, effects, errors before and after, and both posteriors.

    Raises
    ------
    HistoryError
        If the histories do not fit each other or are too short.
    EffectError
        If the scene declares an unknown effect.
    LoopInterrupted
        If it is interrupted while it samples: the effects are found, and ``finish()`` returns the
        loop with Gaussians at the modes.

    Warns
    -----
    PriorWarning
        Before anything is fitted, if the declared prior could not have made ``train``.

    Examples
    --------
    ::

        loop = pp.close_loop(scene, train, test, seed=1)
        loop.verdict  # 'effects-added'
        pp.report(loop, "report.html")
    """
    say = progress or (lambda stage: None)
    task = _Task(scene, tuple(catalogue), seed, substeps, draws, method, criteria, say)
    if test is None:
        train, test = train.split(0.25, seed)
        numbered = test
    else:  # an effect from some trajectory on still acts in a later test
        after = float(train.dataset["number"].max()) + 1.0
        numbered = test.numbered(after) if scene.test_is_later else test
    return _closed(task, train, numbered, test)


class LoopInterrupted(KeyboardInterrupt):
    """Interrupt of :func:`close_loop` while it samples: the effects are found.

    Parameters
    ----------
    finish : callable
        Returns the loop with Gaussians at the modes in place of samples.
    """

    def __init__(self, finish: Callable[[], Loop]) -> None:
        super().__init__("sampling was interrupted")
        self.finish = finish


@dataclass(frozen=True, eq=False)
class _Task:
    """Arguments of :func:`close_loop`."""

    scene: Scene
    catalogue: tuple[Effect, ...]
    seed: int
    substeps: int | None
    draws: int | None
    method: str
    criteria: Criteria
    say: Callable[[str], None]


@dataclass(frozen=True, eq=False)
class _Model:
    """A fitted model: mode, unexplained acceleration, draws, and held-out trajectories."""

    mode: Mode
    excess: UnexplainedAcceleration
    fit: Fit
    held_out: HeldOut


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for effects: declared model, ranking, model with effects, and the effects' steps."""

    declared: Mode
    first: list[Signature]
    mode: Mode
    steps: list[Step]


def _closed(task: _Task, train: History, test: History, recorded: History) -> Loop:
    """Go through the stages of :func:`close_loop`; ``recorded`` is ``test`` as it was given."""
    seed, criteria, say = task.seed, task.criteria, task.say
    if task.substeps is not None:
        task.scene.replace(substeps=task.substeps)  # it is checked there
    train, test, unused, bad = checked_histories(task.scene, train, test)
    scene = with_units(task.scene, train)
    task = replace(task, scene=scene)
    for sentence in (*(velocity.sentence for velocity in unused), *bad):
        say(sentence)
    for effect in task.catalogue:
        if effect not in full_catalogue:
            try_effect(effect, scene, train)
    selection = Selection(scene, task.catalogue, criteria, say)
    effects = attach(scene, (), task.catalogue)
    say(Stage.CHECK_PRIOR)
    with background(partial(_compile, scene, train, effects)) as compiled:
        prior = _prior_test(task, train, effects)
        if not prior.passed:  # before the long fit: units may be wrong
            hint = "the declared prior does not explain this recording"
            hint = f"{hint}, unless a missing effect is why"
            warn(f"{hint}: {prior.sentence}", PriorWarning)
        say(Stage.FIT)
        declared = declared_mode(scene, train, effects, seed, task.substeps, say, criteria)
        compiled()
    search = _searched(declared, selection)
    # with the right noise model effects may show that were hidden before
    for _ in range(criteria.noise_rounds):
        train, frames = without_measurements(train, outliers(search.mode, criteria))
        if frames:
            for sentence in map(str, frames):
                say(sentence)
            bad += tuple(map(str, frames))
            declared = declared_mode(scene, train, effects, seed, task.substeps, say, criteria)
            search = _searched(declared, selection)
            continue
        correlated = with_correlated_errors(search.mode, criteria)
        if correlated is None:
            break
        say(Stage.REPEAT)
        declared = same_noise(search.declared, correlated)
        search = _grown(replace(search, declared=declared, mode=correlated), selection)
    declared = search.declared
    revised, steps = search.mode, search.steps
    held_out = HeldOut.of(revised, test)
    tested = replace(revised, problem=held_out.problem)
    test, frames = without_measurements(test, outliers(tested, criteria))
    if frames:
        held_out = HeldOut.of(revised, test)
        tested = replace(revised, problem=held_out.problem)
    bad += tuple(f"held out: {frame}" for frame in frames)
    say(Stage.TEST)
    before, after = (unexplained_acceleration(mode, criteria) for mode in (declared, revised))
    horizon = rollout_horizon(train, scene)
    with_added = prior
    if steps and not prior.passed:  # the missing effect may be why
        values = dict(zip(revised.problem.layout.labels, revised.phi.tolist(), strict=True))
        added_values = {
            label: values[label] for step in steps for label in step.signature.attached.labels
        }
        with_added = _prior_test(task, train, revised.problem.physics.effects, added_values)
    misfit = find_misfit(revised, after, horizon=horizon, seed=seed).with_test(with_added)
    if steps:
        misfit = with_negligible_acceleration(misfit, revised, after)
    longest = longest_rollout(test, horizon)
    misfit = misfit.with_test(
        held_out_forecasts(tested, noise_alone(revised, after), longest, criteria)
    )

    def sampled(task: _Task) -> Loop:
        say(Stage.SAMPLE)
        fits = _fits(task, [declared, revised] if steps else [declared])
        first = last = _Model(revised, after, fits[-1], held_out)
        if revised is not declared:
            first = _Model(declared, before, fits[0], HeldOut.of(declared, test))
        say(Stage.COMPARE)
        return replace(
            _put_together(task, train, first, last, steps, misfit, longest),
            candidates=selection.explained(search.first),
            small=tuple(selection.small),
            velocities_not_used=unused,
            bad_frames=bad,
            criteria=criteria,
            held_out=recorded,
            catalogue=task.catalogue,
        )

    try:
        return sampled(task)
    except KeyboardInterrupt:
        raise LoopInterrupted(partial(sampled, replace(task, method="laplace"))) from None


def _compile(scene: Scene, train: History, effects: tuple[Attached, ...]) -> None:
    """Compile the engine's loop unless it is on disk; candidates need it, the fit rarely."""
    physics = Physics(scene, effects, substeps=1, engine="chipmunk")
    rng = np.random.default_rng(0)
    phi = np.array([prior.sample(rng, 1)[0] for prior in physics.layout.priors])
    Problem.of(physics, train).predict(phi)


def _searched(declared: Mode, selection: Selection) -> _Search:
    """Add the effects that simulations name, then smaller ones by innovations."""
    say = selection.say
    say(Stage.SIMULATE)
    simulated = None
    with suppress(HistoryError):  # start states could follow all that was measured
        simulated = SimulatedSearch(selection.missing, selection.criteria, say)(declared)
    say(Stage.SCORE)
    first = selection.rank(declared)
    mode, steps = selection.adopted(declared, simulated, first)
    return _grown(_Search(declared, first, mode, steps), selection)


def _grown(search: _Search, selection: Selection) -> _Search:
    """Add effects by innovations, each ranked beside those before; drop what is then needless."""
    criteria, say = selection.criteria, selection.say
    mode, steps = search.mode, list(search.steps)
    ranked = search.first if mode is search.declared else selection.rank(mode)
    while ranked and len(steps) < criteria.most_added:
        step = selection.best_addition(mode, ranked)
        if step is None:
            break
        say(f"added {step.signature.candidate.effect} on {step.signature.candidate.body}")
        steps.append(step)
        mode = step.after
        ranked = selection.rank(mode)
    if len(steps) > 1:
        say(Stage.PRUNE)
        mode, steps = selection.prune(mode, steps)
    return replace(search, mode=mode, steps=steps)


def _prior_test(
    task: _Task,
    train: History,
    effects: tuple[Attached, ...],
    fixed: Mapping[str, float] | None = None,
) -> ResidualTest:
    """Test whether the prior, with some parameters held, could have made the data."""
    horizon = telling_horizon(train, task.criteria.prior)
    problem = Problem.of(Physics(task.scene, effects, threads=2), train, horizon=horizon)
    checked = prior_predictive_check(
        problem, seed=task.seed, fixed=fixed, criteria=task.criteria.prior
    )
    share = float(checked.dataset["share_beyond"].max())
    sentence, *more = checked.summary
    if more:
        sentence = f"{sentence}; {len(more)} more likewise"
    return ResidualTest(PRIOR, float("nan"), share, not checked.sentences, sentence)


def _fits(task: _Task, modes: list[Mode]) -> list[Fit]:
    """Sample the models of modes, the first beside the others; issue their warnings, each once.

    What the data do not inform is said, and in the report: no conclusion depends on it.
    """
    with background(partial(_fit, task, modes[0])) as first:
        others = [_fit(task, mode) for mode in modes[1:]]
        results = [first(), *others]
    issued = {str(message): message for _, caught, _ in results for message in caught}
    uninformed = [
        text for text, warning in issued.items() if isinstance(warning, UninformedWarning)
    ]
    said = [sentence for _, _, sentences in results for sentence in sentences]
    for sentence in dict.fromkeys((*said, *uninformed)):
        task.say(sentence)
    for text, message in issued.items():
        if text not in uninformed:
            warn(message)
    return [fitted for fitted, *_ in results]


def _fit(task: _Task, mode: Mode) -> tuple[Fit, list[Warning], list[str]]:
    """Sample a mode's model, with more draws if they do not suffice.

    Returns the fit, its warnings, and what to tell the user.
    """
    # one thread a chain: more would wait for each other
    mode = replace(mode, problem=mode.problem.with_physics(threads=1))
    method, said = task.method, []
    for n in _DRAWS.get(method, _CHAIN_DRAWS) if task.draws is None else (task.draws,):
        tune = max(100, 5 * n // 8)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fitted = sample(
                mode.problem, method=method, seed=task.seed, draws=n, tune=tune, start=mode, cores=1
            )
        if fitted.record.interrupted:  # half a posterior gives no verdict
            raise KeyboardInterrupt
        if _converged(fitted, task.criteria):
            break
        said.append(f"{n} draws of each chain are too few")
    # of the last fit; draws from a Gaussian are no chains that converge
    unheeded: tuple[type[Warning], ...] = (ConvergenceWarning,) if method == "laplace" else ()
    kept = [warning.message for warning in caught if not issubclass(warning.category, unheeded)]
    return fitted, [message for message in kept if isinstance(message, Warning)], said


def _converged(fit: Fit, criteria: Criteria) -> bool:
    """Return whether draws are good enough for a verdict; warnings begin earlier."""
    record = fit.record
    if record.max_rhat is None or record.min_ess is None:
        return False
    if record.pareto_k is not None and not record.pareto_k <= MAX_PARETO_K:
        return False
    return record.max_rhat <= criteria.worst_rhat and record.min_ess >= criteria.least_ess


def _put_together(
    task: _Task,
    train: History,
    declared: _Model,
    revised: _Model,
    steps: list[Step],
    misfit: Misfit,
    rollout: int,
) -> Loop:
    """Return the result of the stages; errors are forecasts of ``rollout`` intervals."""
    scene, held_out, criteria = task.scene, revised.held_out, task.criteria
    test = held_out.problem.data.history
    unit = measurement_noise(revised.mode, revised.excess)
    before = declared.held_out.errors(held_out, declared.fit, rollout, task.seed, unit)
    after = before
    if revised is not declared:
        after = held_out.errors(held_out, revised.fit, rollout, task.seed, unit)
    verdict = EFFECTS_ADDED if steps else ADEQUATE
    unexplained = misfit.unexplained
    # added effects that leave an acceleration unexplained are at best near the right ones
    if unexplained is not None and not (steps and misfit.predicts(criteria)):
        verdict = UNEXPLAINED
    if steps and after.normalised_rmse > (1.0 + criteria.negligible) * before.normalised_rmse:
        verdict, unexplained = UNEXPLAINED, unexplained or _worse(before, after)
    if not all(_converged(model.fit, criteria) for model in (declared, revised)):
        verdict = NOT_CONVERGED
    added = tuple(_added(step, revised) for step in steps)
    keep_groups(revised.fit.posterior, added)
    first, last = declared.excess, revised.excess
    noise = noise_alone(revised.mode, last)
    return Loop(
        scene=scene,
        verdict=verdict,
        numerical=Numerical(
            scene.substeps, revised.mode.problem.physics.substeps, shift(revised.mode)
        ),
        candidates=(),
        added=added,
        unexplained=unexplained,
        before=before,
        after=after,
        noise_floor=held_out.noise_floor(noise, rollout),
        declared=declared.fit,
        revised=revised.fit,
        residuals_before=declared.held_out.residuals(held_out),
        residuals_after=held_out.residuals(held_out),
        rollout=example_rollout(declared.held_out, held_out),
        rollout_horizon=rollout,
        provenance={
            "seed": task.seed,
            "versions": versions(),
            "data_sha256": train.data_sha256,
            "test_sha256": test.data_sha256,
            "transitions": train.n_transitions,
            "trajectories": train.n_trajectories,
            "test_transitions": test.n_transitions,
            "rollout_horizon": rollout,
            "rollout_seconds": rollout * scene.time_step,
        },
        tests=misfit.tests,
        acceleration=Acceleration(
            first.by_name(first.size),
            last.by_name(last.size),
            first.by_name(first.relative),
            last.by_name(last.relative),
            last.by_name(last.certain),
        ),
        correlations=misfit.correlations,
        growth=misfit.growth,
        identifiability=identify(revised.fit.posterior, mode=revised.mode),
        loo=compare(declared.fit.posterior, revised.fit.posterior),
    )


def _worse(before: Errors, after: Errors) -> Unexplained:
    """Return what is unexplained where the revised model's held-out error is the larger one."""
    rise = after.normalised_rmse / before.normalised_rmse - 1.0
    sentence = (
        "the revised model forecasts the held-out trajectories worse than the declared one: its"
        f" error is {100 * rise:.2g} % larger, {after.normalised_rmse:.3g} against"
        f" {before.normalised_rmse:.3g} times the noise"
    )
    return Unexplained("", "", NOTHING_RECORDED, 0.0, float("nan"), sentence)


def _added(step: Step, revised: _Model) -> Added:
    """Return an added effect with its posterior."""
    candidate, effect = step.signature.candidate, step.signature.attached.effect
    named = {
        named_beside(law, step.signature.attached) for law in revised.mode.problem.physics.effects
    }  # an effect that was added as well is told from it
    drawn = posterior_draws(revised.fit.posterior)
    bodies = [
        attached.body
        for attached in revised.mode.problem.physics.effects
        if attached.effect.name == effect.name
    ]
    estimates = {}
    for parameter in effect.parameters:
        values = drawn[effect.variable(parameter)][:, bodies.index(candidate.body)]
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
        not_separable_from=tuple(n for n in step.not_separable_from if n not in named),
        elpd_difference=step.elpd_difference,
        elpd_difference_se=step.elpd_difference_se,
        simulated_nats=step.simulated.nats if step.simulated else None,
        simulated_share=step.simulated.share if step.simulated else None,
    )
