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
from pbrl_ppl.history import History, UnusedVelocity, with_units, without_measurements
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

    @property
    def effects(self) -> tuple[Attached, ...]:
        """Effects that the scene declares."""
        return attach(self.scene, (), self.catalogue)


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


@dataclass(frozen=True, eq=False)
class _Recordings:
    """Training and test history as they are used, and what of them is not."""

    train: History
    test: History
    unused: tuple[UnusedVelocity, ...]
    bad_frames: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Judged:
    """The declared and the revised model with the tests of the latter's residual."""

    search: _Search
    recordings: _Recordings
    held_out: HeldOut
    before: UnexplainedAcceleration
    after: UnexplainedAcceleration
    misfit: Misfit
    rollout: int


def _closed(task: _Task, train: History, test: History, recorded: History) -> Loop:
    """Go through the stages of :func:`close_loop`; ``recorded`` is ``test`` as it was given."""
    if task.substeps is not None:
        task.scene.replace(substeps=task.substeps)  # it is checked there
    recordings = _Recordings(*checked_histories(task.scene, train, test))
    task = replace(task, scene=with_units(task.scene, recordings.train))
    for sentence in (*(column.sentence for column in recordings.unused), *recordings.bad_frames):
        task.say(sentence)
    for effect in task.catalogue:
        if effect not in full_catalogue:
            try_effect(effect, task.scene, recordings.train)
    selection = Selection(task.scene, task.catalogue, task.criteria, task.say)
    prior, declared = _declared(task, recordings.train)
    search, recordings = _settled(task, _searched(declared, selection), recordings, selection)
    judged = _judged(task, search, recordings, prior)

    def sampled(task: _Task) -> Loop:
        return replace(
            _sampled(task, judged),
            candidates=selection.explained(search.first),
            small=tuple(selection.small),
            held_out=recorded,
        )

    try:
        return sampled(task)
    except KeyboardInterrupt:
        raise LoopInterrupted(partial(sampled, replace(task, method="laplace"))) from None


def _declared(task: _Task, train: History) -> tuple[ResidualTest, Mode]:
    """Return the test of the declared prior, and the mode of the declared model."""
    task.say(Stage.CHECK_PRIOR)
    with background(partial(_compile, task.scene, train, task.effects)) as compiled:
        prior = _prior_test(task, train, task.effects)
        if not prior.passed:  # before the long fit: units may be wrong
            hint = "the declared prior does not explain this recording"
            hint = f"{hint}, unless a missing effect is why"
            warn(f"{hint}: {prior.sentence}", PriorWarning)
        task.say(Stage.FIT)
        mode = _fitted(task, train)
        compiled()
    return prior, mode


def _fitted(task: _Task, train: History) -> Mode:
    """Return the mode of the declared model."""
    return declared_mode(
        task.scene, train, task.effects, task.seed, task.substeps, task.say, task.criteria
    )


def _settled(
    task: _Task, search: _Search, recordings: _Recordings, selection: Selection
) -> tuple[_Search, _Recordings]:
    """Return the search and the recordings without outliers, and with the noise that they show.

    With the right noise model effects may show that were hidden before.
    """
    for _ in range(task.criteria.noise_rounds):
        train, frames = without_measurements(recordings.train, outliers(search.mode, task.criteria))
        if frames:
            said = tuple(map(str, frames))
            for sentence in said:
                task.say(sentence)
            recordings = replace(
                recordings, train=train, bad_frames=(*recordings.bad_frames, *said)
            )
            search = _searched(_fitted(task, train), selection)
            continue
        correlated = with_correlated_errors(search.mode, task.criteria)
        if correlated is None:
            break
        task.say(Stage.REPEAT)
        declared = same_noise(search.declared, correlated)
        search = _grown(replace(search, declared=declared, mode=correlated), selection)
    return search, recordings


def _judged(task: _Task, search: _Search, recordings: _Recordings, prior: ResidualTest) -> _Judged:
    """Test the residual of the revised model, on the training and on the test history."""
    criteria, revised = task.criteria, search.mode
    held_out = HeldOut.of(revised, recordings.test)
    tested = replace(revised, problem=held_out.problem)
    test, frames = without_measurements(recordings.test, outliers(tested, criteria))
    if frames:
        said = tuple(f"held out: {frame}" for frame in frames)
        recordings = replace(recordings, test=test, bad_frames=(*recordings.bad_frames, *said))
        held_out = HeldOut.of(revised, test)
        tested = replace(revised, problem=held_out.problem)
    task.say(Stage.TEST)
    before, after = (
        unexplained_acceleration(mode, criteria) for mode in (search.declared, revised)
    )
    horizon = rollout_horizon(recordings.train, task.scene)
    if search.steps and not prior.passed:  # the missing effect may be why
        values = dict(zip(revised.problem.layout.labels, revised.phi.tolist(), strict=True))
        labels = (label for step in search.steps for label in step.signature.attached.labels)
        added = {label: values[label] for label in labels}
        prior = _prior_test(task, recordings.train, revised.problem.physics.effects, added)
    misfit = find_misfit(revised, after, horizon=horizon, seed=task.seed).with_test(prior)
    if search.steps:
        misfit = with_negligible_acceleration(misfit, revised, after)
    rollout = longest_rollout(test, horizon)
    forecasts = held_out_forecasts(tested, noise_alone(revised, after), rollout, criteria)
    return _Judged(
        search, recordings, held_out, before, after, misfit.with_test(forecasts), rollout
    )


def _sampled(task: _Task, judged: _Judged) -> Loop:
    """Sample the posteriors, and compare the models on the test history."""
    search, recordings = judged.search, judged.recordings
    declared, revised = search.declared, search.mode
    task.say(Stage.SAMPLE)
    fits = _fits(task, [declared, revised] if search.steps else [declared])
    first = last = _Model(revised, judged.after, fits[-1], judged.held_out)
    if revised is not declared:
        held_out = HeldOut.of(declared, recordings.test)
        first = _Model(declared, judged.before, fits[0], held_out)
    task.say(Stage.COMPARE)
    return _put_together(task, judged, first, last)


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


def _put_together(task: _Task, judged: _Judged, declared: _Model, revised: _Model) -> Loop:
    """Return the result of the stages; errors are forecasts of ``judged.rollout`` intervals."""
    recordings, steps = judged.recordings, judged.search.steps
    train, misfit, rollout = recordings.train, judged.misfit, judged.rollout
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
        velocities_not_used=recordings.unused,
        bad_frames=recordings.bad_frames,
        criteria=criteria,
        catalogue=task.catalogue,
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
