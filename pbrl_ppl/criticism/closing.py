"""The closed loop as a chain: clean, fit, search, test, sample, verdict."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from pbrl_ppl.criticism import results
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.held_out import HeldOut, example_rollout, longest_rollout, rollout_horizon
from pbrl_ppl.criticism.innovations import (
    UnexplainedAcceleration,
    noise_alone,
    noise_without_unexplained,
    unexplained_acceleration,
)
from pbrl_ppl.criticism.misfit import find_misfit, forecast_test, score_test, simulation_test
from pbrl_ppl.criticism.prior_check import check_prior
from pbrl_ppl.criticism.refinement import Declared, checked_histories, outliers, shift
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.criticism.search import Search, SearchResult
from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import ConvergenceWarning, HistoryError, PriorWarning, UninformedWarning, warn
from pbrl_ppl.history import (
    MOST_TRANSITIONS,
    History,
    drawn_pieces,
    thinned,
    with_units,
    without_measurements,
)
from pbrl_ppl.likelihood import is_simulated, single_transitions
from pbrl_ppl.modes import (
    FilteredMode,
    Mode,
    filtered_mode,
    find_mode,
    is_simulated_mode,
    tempered_mode,
)
from pbrl_ppl.physics import Physics, compile_for_search, try_effect
from pbrl_ppl.posterior import (
    MAX_PARETO_K,
    Comparison,
    Fit,
    Idata,
    PosteriorRecord,
    compare,
    identify,
    interval,
    versions,
)
from pbrl_ppl.sampling import WeightsError, sample
from pbrl_ppl.scene import Scene
from pbrl_ppl.system.threads import one_blas_thread


@one_blas_thread
def close_loop(
    scene: Scene,
    train: History,
    test: History | None = None,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    draws: int | None = None,
    method: str = "importance",
    most_transitions: int = MOST_TRANSITIONS,
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> results.Loop:
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
    draws : int, optional
        Posterior draws kept of each chain; by default 180 of importance sampling and 300 of chains,
        more where these do not suffice.
    method : str
        Sampler of :func:`pbrl_ppl.fit`; with ``laplace`` the verdict relies on modes.
    most_transitions : int
        Of a history with more, pieces of so many in all are used, drawn by the seed, those with
        more motion more often; ``Loop.data.drawn`` says so. Time grows faster than they do.
    criteria : Criteria
        Thresholds of the decisions.
    progress : callable, optional
        Called with each :class:`Stage`, with sentences on what was found, and with
        ``pbrl_ppl.system.threads.Work``, what is done now and how much of it.

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
    compile_for_search(scene)
    if test is None:
        train, test = train.split(0.25, seed)
    elif scene.test_is_later:  # an effect from some trajectory on still acts
        test = test.numbered(float(train.dataset["number"].max()) + 1.0)
    scene, (train, test), thin = thinned(scene, train, test)
    task = _Task(scene, tuple(catalogue), seed, criteria, say, draws=draws, method=method)
    train, said = drawn_pieces(train, most_transitions, seed)
    test, also = drawn_pieces(test, most_transitions, seed)
    said = (*thin, *said, *(f"held out: {one}" for one in also))
    train, test, data = _cleaned(task, train, test, said)
    task = replace(task, scene=with_units(scene, train))
    prior = _prior_test(task, train)
    declared, found = _searched(task, train)
    say(results.Stage.TEST)
    fitted = _Fitted(train, test, data, declared, found, _filtered(declared, found))
    fitted = _without_outliers(task, fitted)
    judged = _tested(task, fitted, prior)
    try:
        return _sampled(task, judged)
    except KeyboardInterrupt:
        finish = partial(_sampled, replace(task, method="laplace"), judged)
        raise LoopInterrupted(finish) from None


class LoopInterrupted(KeyboardInterrupt):
    """Interrupt of :func:`close_loop` while it samples: the effects are found.

    Parameters
    ----------
    finish : callable
        Returns the loop with Gaussians at the modes in place of samples.
    """

    def __init__(self, finish: Callable[[], results.Loop]) -> None:
        super().__init__("sampling was interrupted")
        self.finish = finish


@dataclass(frozen=True, eq=False, kw_only=True)
class _Task(Declared):
    """Arguments of :func:`close_loop`."""

    draws: int | None
    method: str


@dataclass(frozen=True, eq=False)
class _Fitted:
    """The declared model, and the laws that it lacks.

    Parameters
    ----------
    train, test : History
        The histories as they are used.
    data : Recordings
        What of them is not.
    declared : FilteredMode
        The declared model.
    found : SearchResult
        The laws.
    innovations : FilteredMode
        The model with the laws, with whole trajectories filtered.
    """

    train: History
    test: History
    data: results.Recordings
    declared: FilteredMode
    found: SearchResult
    innovations: FilteredMode


@dataclass(frozen=True, eq=False)
class _Tested:
    """A model: the mode that is sampled, its innovations, and what these leave unexplained.

    Parameters
    ----------
    mode : Mode
        Of simulated pieces, or of the innovations where nothing can be simulated.
    innovations : Mode
        The same parameters, with whole trajectories filtered.
    excess : UnexplainedAcceleration
        Process noise of the innovations.
    held_out : HeldOut
        The model on the test history.
    """

    mode: Mode
    innovations: FilteredMode
    excess: UnexplainedAcceleration
    held_out: HeldOut

    @classmethod
    def of(cls, mode: Mode, innovations: FilteredMode, test: History, criteria: Criteria) -> Self:
        """Test a mode's innovations, and linearise it along the test history."""
        if not is_simulated(mode.problem):  # single transitions
            mode = innovations
        excess = unexplained_acceleration(innovations, criteria)
        return cls(mode, innovations, excess, HeldOut.of(innovations, test))


@dataclass(frozen=True, eq=False)
class _Judged:
    """The declared and the revised model with the tests of the latter's residual."""

    fitted: _Fitted
    declared: _Tested
    revised: _Tested
    misfit: results.Misfit
    small: tuple[results.Law, ...]
    horizon: int
    simulated: Mapping[str, float]

    def compared(self, model: _Tested, fit: Fit, seed: int) -> results.ComparedModel:
        """Return a model with its posterior and its held-out errors in units of the revised's."""
        revised, simulated = self.revised, self.simulated
        noise = noise_without_unexplained(revised.innovations, revised.excess)
        errors = model.held_out.errors(revised.held_out, fit, self.horizon, seed, noise)
        if simulated and model is not revised:
            simulated = model.held_out.simulated()
        errors = replace(errors, simulated_rmse=simulated)
        return results.ComparedModel(fit, model.innovations, errors)


def _cleaned(
    task: _Task, train: History, test: History, drawn: tuple[str, ...]
) -> tuple[History, History, results.Recordings]:
    """Check the histories and the effects; leave out what no model should be fitted to."""
    data = results.Recordings(held_out=test, drawn=drawn)
    train, test, unused, bad_frames = checked_histories(task.scene, train, test)
    for sentence in (*drawn, *(column.sentence for column in unused), *bad_frames):
        task.say(sentence)
    for effect in task.catalogue:
        if effect not in full_catalogue:
            try_effect(effect, with_units(task.scene, train), train)
    return train, test, replace(data, velocities_not_used=unused, bad_frames=bad_frames)


def _searched(task: _Task, train: History) -> tuple[FilteredMode, SearchResult]:
    """Fit the declared model, and search for the laws that it lacks."""
    search = Search(task.missing, task.criteria, task.say)
    try:
        return search.of(train, task.mode, task.seed)
    except HistoryError:  # initial states could follow all that was measured
        mode = task.mode(train)
        return mode, search(find_mode(single_transitions(mode.problem), initial=mode.phi))


def _filtered(declared: FilteredMode, found: SearchResult) -> FilteredMode:
    """Return the model found, with whole trajectories filtered."""
    return filtered_mode(declared, found.after) if found.laws else declared


def _without_outliers(task: _Task, fitted: _Fitted) -> _Fitted:
    """Leave out measurements that the model found contradicts; refit it, with the same laws."""
    test, data, criteria = fitted.test, fitted.data, task.criteria
    train, frames = without_measurements(fitted.train, outliers(fitted.innovations, criteria))
    if frames:
        task.say("; ".join(map(str, frames)))
        declared = task.mode(train, fitted.declared)
        found = fitted.found.on(declared)
        fitted = _Fitted(train, test, data, declared, found, _filtered(declared, found))
    innovations = fitted.innovations
    held_out = replace(innovations, problem=HeldOut.of(innovations, test).problem)
    test, more = without_measurements(test, outliers(held_out, criteria))
    said = (*map(str, frames), *(f"held out: {frame}" for frame in more))
    data = replace(data, bad_frames=(*data.bad_frames, *said))
    return replace(fitted, test=test, data=data)


def _tested(task: _Task, fitted: _Fitted, prior: results.ResidualTest) -> _Judged:
    """Test the innovations of the model found, on the training and on the test history."""
    criteria, found, test = task.criteria, fitted.found, fitted.test
    innovations = fitted.innovations
    before = revised = _Tested.of(found.after, innovations, test, criteria)
    if found.laws:
        before = _Tested.of(found.declared, fitted.declared, test, criteria)
    horizon = rollout_horizon(fitted.train, task.scene)
    rollout = longest_rollout(test, horizon)
    noise, held_out = noise_alone(innovations, revised.excess), revised.held_out
    collides = revised.mode.problem.data.breaks is not None
    simulated = {} if collides else held_out.simulated()
    seconds = (int(test.dataset["n_rows"].max()) - 1) * task.scene.time_step
    # unusual laws that no climb tried are not compiled for a test
    tried = [one for one in task.missing(innovations) if one in found.candidates]
    ranked = rank_candidates(innovations, tried, criteria, task.say)
    ahead = replace(innovations, problem=held_out.problem)
    misfit = find_misfit(innovations, revised.excess, horizon=horizon, seed=task.seed)
    tests = (
        *misfit.tests,
        # a missing effect may be why the prior does not explain the data
        *(() if found.laws else (prior,)),
        forecast_test(ahead, noise, rollout, criteria, held_out=True),
        simulation_test(
            simulated, held_out.measurement_errors(noise), held_out.motion(), seconds, criteria
        ),
        score_test(innovations, ranked, criteria),
    )
    small = tuple(one.candidate for one in ranked[:1] if one.candidate.p_value < criteria.try_p)
    misfit = replace(misfit, tests=tests)
    return _Judged(fitted, before, revised, misfit, small, rollout, simulated)


def _prior_test(task: _Task, train: History) -> results.ResidualTest:
    """Test whether the declared prior could have made the data, and warn before the long fit."""
    task.say(results.Stage.CHECK_PRIOR)
    physics = Physics(task.scene, task.effects, threads=2)
    checked = check_prior(physics, train, seed=task.seed, criteria=task.criteria.prior)
    share = float(checked.dataset["share_beyond"].max())
    sentence, *more = checked.summary
    if more:
        sentence = f"{sentence}; {len(more)} more likewise"
    passed = not checked.sentences
    if not passed:  # units may be wrong
        hint = "the declared prior does not explain this recording"
        warn(f"{hint}, unless a missing effect is why: {sentence}", PriorWarning)
    return results.ResidualTest(results.KindOfTest.PRIOR, float("nan"), share, passed, sentence)


def _fits(task: _Task, modes: list[Mode]) -> list[Fit]:
    """Sample the models of modes; issue their warnings, each once.

    What the data do not inform is said, and in the report: no conclusion depends on it.
    """
    fits = [_fit(task, mode) for mode in modes]
    issued = {str(message): message for _, caught in fits for message in caught}
    for text, message in issued.items():
        if isinstance(message, UninformedWarning):
            task.say(text)
        else:
            warn(message)
    return [fitted for fitted, _ in fits]


def _fit(task: _Task, mode: Mode) -> tuple[Fit, list[Warning]]:
    """Sample a mode's model, with more draws if they do not suffice; return its warnings too."""
    if is_simulated_mode(mode):
        mode = tempered_mode(mode)
    method = task.method
    # draws of each chain, then those where that is not enough
    enough = {"importance": (180, 600), "laplace": (60,)}.get(method, (300, 1000))
    for n in enough if task.draws is None else (task.draws,):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            draw = partial(
                sample, mode.problem, seed=task.seed, draws=n, tune=max(100, 5 * n // 8),
                start=mode, progress=task.say, rescue=False,
            )  # fmt: skip
            try:
                fitted = draw(method=method)
            except WeightsError as error:  # particles may take minutes
                fitted = draw(method="laplace")
                instead = "the draws are from the Gaussian at the mode instead"
                warn(f"{error}; {instead}", ConvergenceWarning)
        if fitted.record.interrupted:  # half a posterior gives no verdict
            raise KeyboardInterrupt
        if _converged(fitted, task.criteria):
            break
        task.say(f"{n} draws of each chain are too few")
    # of the last fit; draws from a Gaussian are no chains that converge
    unheeded: tuple[type[Warning], ...] = (ConvergenceWarning,) if method == "laplace" else ()
    messages = [one.message for one in caught if not issubclass(one.category, unheeded)]
    return fitted, [message for message in messages if isinstance(message, Warning)]


def _converged(fit: Fit, criteria: Criteria) -> bool:
    """Return whether draws are good enough for a verdict; warnings begin earlier."""
    record = fit.record
    if record.max_rhat is None or record.min_ess is None:
        return False
    if record.pareto_k is not None and not record.pareto_k <= MAX_PARETO_K:
        return False
    if record.method == "laplace":  # independent draws
        return True
    return record.max_rhat <= criteria.worst_rhat and record.min_ess >= criteria.least_ess


def _sampled(task: _Task, judged: _Judged) -> results.Loop:
    """Sample the posteriors, compare the models on the test history, and return the result."""
    task.say(results.Stage.SAMPLE)
    declared, revised, found = judged.declared, judged.revised, judged.fitted.found
    models = [revised] if revised is declared else [declared, revised]
    fits = _fits(task, [model.mode for model in models])
    before, after = fits[0], fits[-1]
    task.say(results.Stage.COMPARE)
    last = judged.compared(revised, after, task.seed)
    first = last if declared is revised else judged.compared(declared, before, task.seed)
    converged = all(_converged(fit, task.criteria) for fit in (before, after))
    verdict, unexplained = _verdict(
        judged, first.errors.normalised_rmse, last.errors.normalised_rmse, converged, task.criteria
    )
    added = tuple(_with_posterior(law, one, after) for one, law in found.laws.items())
    keep_groups(after.posterior, added)
    old, new = declared.excess, revised.excess
    alone = noise_alone(revised.innovations, new)
    substeps = task.scene.substeps, revised.innovations.problem.physics.substeps
    return results.Loop(
        scene=task.scene,
        verdict=verdict,
        unexplained=unexplained,
        numerical=results.Numerical(*substeps, shift(revised.innovations)),
        data=replace(judged.fitted.data, provenance=_provenance(task, judged)),
        found=results.Found(
            tuple(found.candidates.values()), added, judged.small,
            found.lesser, found.hypotheses, found.lengths,
        ),
        declared=first,
        revised=last,
        misfit=judged.misfit,
        acceleration=results.Acceleration(
            old.by_name(old.size), new.by_name(new.size),
            old.by_name(old.relative), new.by_name(new.relative),
            dict(zip(new.names, new.certain.tolist(), strict=True)),
        ),
        forecasts=results.Forecasts(
            revised.held_out.noise_floor(alone, judged.horizon),
            example_rollout(declared.held_out, revised.held_out),
            judged.horizon,
        ),
        identifiability=identify(after.posterior, mode=revised.mode),
        loo=_compared(declared.mode, revised.mode, before, after),
        criteria=task.criteria,
        catalogue=task.catalogue,
    )  # fmt: skip


def _provenance(task: _Task, judged: _Judged) -> dict[str, object]:
    """Return what the result was made with and of."""
    train, test = judged.fitted.train, judged.fitted.test
    return {
        "seed": task.seed,
        "versions": versions(),
        "data_sha256": train.data_sha256,
        "test_sha256": test.data_sha256,
        "transitions": train.n_transitions,
        "trajectories": train.n_trajectories,
        "test_transitions": test.n_transitions,
        "rollout_horizon": judged.horizon,
        "rollout_seconds": judged.horizon * task.scene.time_step,
    }


def _compared(declared: Mode, revised: Mode, before: Fit, after: Fit) -> Comparison | None:
    """Compare the posteriors by cross-validation, where both temper their densities alike."""
    times = [
        np.array(mode.problem.likelihood.tau) if is_simulated_mode(mode) else np.ones(1)
        for mode in (declared, revised)
    ]
    alike = times[0].shape == times[1].shape and np.allclose(times[0], times[1], rtol=0.1)
    return compare(before.posterior, after.posterior) if alike else None


def _verdict(
    judged: _Judged, before: float, after: float, converged: bool, criteria: Criteria
) -> tuple[str, results.Unexplained | None]:
    """Return the verdict and what is unexplained, from tests and held-out errors alone.

    What remains beside named laws and is small, so that forecasts are at the noise floor, changes
    no verdict; nor does an error below the noise, which says nothing of either model.
    """
    misfit, found = judged.misfit, judged.fitted.found
    unexplained, laws = misfit.unexplained, found.laws
    if found.doubt:
        return results.UNEXPLAINED, results.Unexplained.somewhere(found.doubt)
    worse = bool(laws) and after > (1.0 + criteria.negligible) * max(before, 1.0)
    if worse:
        unexplained = results.Unexplained.somewhere(
            "the revised model forecasts the held-out trajectories worse than the declared one:"
            f" its error is {100 * (after / before - 1.0):.2g} % larger, {after:.3g} against"
            f" {before:.3g} times the noise"
        )
    if not converged:
        return results.NOT_CONVERGED, unexplained
    if worse or (unexplained is not None and not (laws and misfit.predicts(criteria))):
        return results.UNEXPLAINED, unexplained
    return (results.EFFECTS_ADDED if laws else results.ADEQUATE), unexplained


def keep_groups(posterior: Idata, added: Iterable[results.Law]) -> None:
    """Record in a posterior's attributes which effects its recording cannot separate."""
    groups = tuple(
        tuple(
            name if " on " in name else f"{name} on {one.body}"
            for name in (one.effect, *one.not_separable_from)
        )
        for one in added
        if one.not_separable_from
    )
    replace(PosteriorRecord.of(posterior), not_separable=groups).write(posterior)


def _with_posterior(law: results.Law, attached: Attached, revised: Fit) -> results.Law:
    """Return a law with the posterior of its parameters in the revised model."""
    phi, places = revised.draws[0], revised.problem.layout.places(attached.labels)
    parameters = {
        parameter.name: results.Estimate(
            float(values.mean()), float(values.std()), interval(values), parameter.unit
        )
        for parameter, values in zip(attached.effect.parameters, phi.T[places], strict=True)
    }
    return replace(law, parameters=parameters)
