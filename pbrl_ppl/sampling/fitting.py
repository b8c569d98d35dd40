"""Posterior of a model by one of several samplers, with its checks before and after."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from pbrl_ppl.errors import FitError, MeetingWarning, warn
from pbrl_ppl.likelihood import Problem, is_filtered, is_independent, is_simulated
from pbrl_ppl.modes import (
    Mode,
    carried_mode,
    covariance_of,
    find_mode,
    find_simulation_mode,
    find_trajectory_mode,
    is_filtered_mode,
    weigh,
    with_state_sensitivity,
)
from pbrl_ppl.parameters import inside, prior_slopes
from pbrl_ppl.posterior import (
    LIKELIHOOD,
    PARETO_K,
    SIZE,
    Fit,
    Idata,
    ParameterPoint,
    PosteriorRecord,
    complete,
    convergence,
    from_groups,
    group,
    groups,
    linearised_as,
    parameter_draws,
    stored_mode,
)
from pbrl_ppl.sampling.methods import METHODS, SamplerRun, posterior_dataset
from pbrl_ppl.sampling.mixture import mix, most_frequent, most_probable, summed
from pbrl_ppl.state import STATE, Floats
from pbrl_ppl.system.threads import Progress, Say, one_blas_thread, silent

if TYPE_CHECKING:
    import pymc as pm

#: Searches for the mode, by the likelihood's name.
_SEARCHES: Mapping[str, Callable[..., Mode]] = {
    "transitions": find_mode,
    "trajectories": find_trajectory_mode,
    "simulation": find_simulation_mode,
}
#: The default sampler.
DEFAULT = "importance"


def fit(
    model: pm.Model,
    *,
    method: str = DEFAULT,
    seed: int = 0,
    draws: int | None = None,
    tune: int | None = None,
    chains: int | None = None,
    thin: int | None = None,
    cores: int | None = None,
    start: Mode | None = None,
    resume: Idata | None = None,
    progress: bool | Say = True,
) -> Idata:
    """Sample the posterior of a model of :func:`pbrl_ppl.physics_model`.

    Draws come from importance sampling by default. They start about the modes, which multi-start
    least squares finds if the model holds none. Where the scene does
    not say which bodies a joint joins, every choice is fitted by itself, and their draws are mixed
    by their evidences (:func:`pbrl_ppl.joint_probabilities`). A model with a ``library`` needs no
    chain: all choices are summed over, unless ``method="metropolis"`` walks among them.

    The mode is kept in ``attrs["mode"]`` as JSON: ``parameters`` and ``noise`` by label, and
    ``log_posterior``. With a library it is the most probable choice of each body (of bodies that
    meet together), which ``sets`` names; with joints of unknown bodies, the mode of the most
    probable configuration.

    Parameters
    ----------
    model : pymc.Model
        As made by ``physics_model``.
    method : str
        ``importance``: proposals from Gaussians about the modes, weighted by the engine in batches
        of which each teaches the next, and resampled; where the weights do not suffice, ``smc``
        from what was learned; ``smc``: sequential Monte Carlo by ``pm.sample_smc``, from the
        Gaussians to the posterior, a run a chain; ``metropolis``: one random walk a variable, by
        default on the schedule of the paper's Table 2 for the cart (30 chains of 20,000 iterations,
        1,000 of them burn-in, each tenth kept); with a library, on that for the apartment
        (``draws=400, tune=1000, thin=10, chains=1``), each body's set proposed uniformly;
        ``laplace``: independent draws from the Gaussian at the mode, which no chain has checked;
        ``map``: the mode alone, as one draw. For PyMC's samplers, give the model to ``pm.sample``.
    seed : int
        The same seed gives the same posterior.
    draws, tune : int, optional
        Draws kept of each chain, and tuning draws of ``metropolis``; each method has its own
        default. Draws by importance sampling are independent, and divided among chains for ArviZ.
    chains : int, optional
        Chains; 4 by default, 30 for ``metropolis``, 1 for it with a library.
    thin : int, optional
        Steps a draw of ``metropolis``.
    cores : int, optional
        Processes, at most one a chain, or the engine's threads; as many as there are processors by
        default.
    start : Mode, optional
        A mode found before, in place of the search for one.
    resume : InferenceData or DataTree, optional
        A posterior of the same model. ``metropolis`` goes on where its chains ended, and the other
        methods draw more about it; the new draws stand after the old. Whole trajectories are
        linearised as they are in it.
    progress : bool or callable
        Whether to show a progress bar; or what is called with counted work
        (``pbrl_ppl.system.threads.Work``).

    Returns
    -------
    InferenceData or DataTree
        Posterior, sample_stats, log_likelihood, posterior_predictive (of up to 200 draws, under
        their own labels), prior, log_prior, observed_data and constant_data, with units, and in
        ``attrs`` the scene, effects, method, versions, seed, the hash of the data and the
        convergence. Of importance sampling there are ``pareto_k``, the shape of the weights' tail
        (at most 0.7), ``importance_ess``, the effective sample size of the draws by their weights,
        which limits that of each parameter, ``proposals`` (what was weighted, or why ``smc``
        was run) and ``log_evidence``. Interrupted chains of ``metropolis`` keep the draws so far.

    Raises
    ------
    FitError
        If the model was not made by ``physics_model``, there is no such method, ``start`` is no
        mode, or both ``start`` and ``resume`` are given; for joints of unknown bodies, if there are
        too many choices, or with ``start`` or ``resume``.
    PosteriorError
        If ``resume`` is a posterior of other data or parameters.

    Warns
    -----
    ConvergenceWarning
        If an R-hat of chains is over 1.01, a Pareto k over 0.7 or an effective sample size under
        400, if sampling was interrupted, or if an evidence is too uncertain for the probability of
        a joint.
    LinearisationWarning
        If states smoothed again at draws give another likelihood (``attrs["linearisation"]``,
        nats).
    MeetingWarning
        If bodies that were apart in the data meet under the parameters found.
    BoundWarning
        If a parameter is at its bound.
    UninformedWarning
        If the data say nothing about a parameter.
    """
    from pbrl_ppl.model import problem_in  # PyMC takes seconds to load

    return sample(
        problem_in(model), method=method, seed=seed, draws=draws, tune=tune, chains=chains,
        thin=thin, cores=cores, start=start, resume=resume, progress=progress,
    ).posterior  # fmt: skip


def sample(
    problem: Problem,
    *,
    method: str = DEFAULT,
    seed: int = 0,
    cores: int | None = None,
    start: Mode | None = None,
    resume: Idata | None = None,
    progress: bool | Say = False,
    rescue: bool = True,
    **schedule: int | None,
) -> Fit:
    """Sample the posterior of a problem; see :func:`pbrl_ppl.fit`, which takes its pm.Model.

    Parameters
    ----------
    problem : Problem
        What is fitted. Of whole trajectories it is linearised at the mode.
    method, seed, cores, start, resume, progress
        As of :func:`pbrl_ppl.fit`.
    rescue : bool
        Whether ``smc`` runs where importance weights do not suffice: in minutes, if friction has
        kinks and transitions are few.
    **schedule : int, optional
        ``draws``, ``tune``, ``chains`` and ``thin``, as of :func:`pbrl_ppl.fit`.

    Returns
    -------
    Fit
        The problem that was sampled, and the posterior.

    Raises
    ------
    WeightsError
        If importance weights do not suffice, without ``rescue``.
    """
    _check(problem, method, start, resume)
    library = problem.library
    # with one set there is no choice to walk over
    walks = library is not None and method == "metropolis" and len(library.names) > 1
    chosen = METHODS[method]
    if walks:  # Table 2's schedule for the apartment: one chain of 5,000 iterations
        chosen = replace(chosen, draws=400, chains=1)
    if method != "map":
        asked: dict[str, Any] = {key: n for key, n in schedule.items() if n is not None}
        chosen = replace(chosen, **asked)
    # quiet without a thread, which a fork by PyMC would copy
    with Progress(False) if progress is True else nullcontext(progress or silent) as say:
        job = SamplerRun(
            problem=_as_in(problem, resume), method=chosen, mode=None, resume=resume, seed=seed,
            cores=os.cpu_count() or 1 if cores is None else cores, progress=say,
            rescue=rescue,
        )  # fmt: skip
        while True:
            job, trace, point = _drawn(job, start, walks)
            # PyMC ends an interrupted run quietly, with fewer draws or the chains that had most
            sizes = group(trace, "posterior").sizes
            cut = sizes["draw"] < chosen.draws or sizes["chain"] < job.chains
            now = job.problem
            joined = now if cut else _joined(now, *parameter_draws(now, trace))
            if joined is now:
                break
            start = start and carried_mode(job.at_mode, joined)
            job, resume = replace(job, problem=joined, resume=None), None
    if resume is not None:
        if sizes["chain"] < job.chains:
            raise KeyboardInterrupt  # some chains have nothing new, and resume= has all of them
        trace = _appended(resume, trace)
    posterior = complete(
        job.problem,
        trace,
        seed=seed,
        method=method if library is None or walks else "exact sum over the library",
        asked=(chosen.draws, job.chains) if cut else None,
        mode=point,
    )
    return Fit(job.problem, posterior)


def _drawn(
    job: SamplerRun, start: Mode | None, walks: bool
) -> tuple[SamplerRun, Idata, ParameterPoint]:
    """Return the job on the problem that was sampled, its draws, and its mode."""
    problem, method = job.problem, job.method
    if walks:
        trace = _run(job)
        return job, trace, most_frequent(problem, trace)
    if problem.library is not None:
        return job, *summed(problem, method.draws, method.chains, job.seed)
    if problem.layout.discrete.any():
        weighed = weigh(problem, seed=job.seed, progress=job.progress)

        def of_configuration(mode: Mode) -> Idata:
            return _run(replace(job, problem=mode.problem, mode=mode))

        return job, mix(job, weighed, of_configuration), most_probable(problem, weighed)
    if job.resume is not None:
        return job, _run(job), stored_mode(problem, job.resume)
    job = _at_mode(job, start)
    mode, trace = job.at_mode, _run(job)
    gaussian = (METHODS["laplace"].run, METHODS["map"].run)
    if is_simulated(problem) and problem.layout.priors and method.run not in gaussian:
        trace = _with_robust_width(mode, trace)
    return job, trace, ParameterPoint(mode.phi, mode.sigma)


def _at_mode(job: SamplerRun, start: Mode | None) -> SamplerRun:
    """Return the job with a mode, in whose problem bodies that meet at it are in one part."""
    while True:
        problem = job.problem
        mode = start or _SEARCHES[problem.likelihood.name](problem, seed=job.seed)
        if not is_independent(mode.problem):
            if is_filtered_mode(mode) and mode.problem.likelihood.sensitivity is None:
                mode = with_state_sensitivity(mode)
            problem = mode.problem  # linearised at the mode
        joined = _joined(problem, mode.phi[None], mode.sigma[None])
        if joined is problem:
            return replace(job, problem=problem, mode=replace(mode, problem=problem))
        job, start = replace(job, problem=joined), start and carried_mode(mode, joined)


def _with_robust_width(mode: Mode, trace: Idata) -> Idata:
    """Return draws about their mean with the mode's robust covariance in place of the Laplace one.

    Tempering keeps a correlated residual from counting as many measurements, and not exactly (the
    open-faced sandwich: B. A. Shaby, Journal of Computational and Graphical Statistics 23, 2014).
    """
    problem, priors = mode.problem, mode.problem.layout.priors
    precision = mode.jacobian.T @ mode.jacobian + np.diag(prior_slopes(priors, mode.phi) ** 2)
    plain = replace(mode, covariance=covariance_of(precision))
    phi, sigma = parameter_draws(problem, trace)
    centre = phi.mean(axis=0)
    wider = centre + (phi - centre) @ np.linalg.solve(plain.factor.T, mode.factor.T)
    sizes = group(trace, "posterior").sizes
    shape = (sizes["chain"], sizes["draw"], -1)
    values = problem.named(inside(priors, wider).reshape(shape), sigma.reshape(shape))
    attributes = {name: value for name, value in trace.attrs.items() if name != LIKELIHOOD}
    moved = groups(trace) | {"posterior": posterior_dataset(problem, values)}
    return from_groups(moved, attributes)


@one_blas_thread
def _run(job: SamplerRun) -> Idata:
    """Return draws by a method, without what its processes warn of."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*fork.*", category=DeprecationWarning)
        return job.method.run(job)


def _check(problem: Problem, method: str, start: object, resume: Idata | None) -> None:
    """Refuse arguments of `fit` that do not go with a problem."""
    if method not in METHODS:
        raise FitError(f"fit: method is {method!r}, expected one of {', '.join(METHODS)}")
    given = [name for name, one in (("start", start), ("resume", resume)) if one is not None]
    if len(given) > 1:
        raise FitError("fit: start and resume are given, but chains begin at one: leave one out")
    if start is not None and not isinstance(start, Mode):
        raise FitError(
            f"fit: start is a {type(start).__name__}, expected a Mode; pass a posterior to go on"
            " with as resume"
        )
    kind, of_start = problem.likelihood.name, (start.problem if start else problem).likelihood.name
    if kind != of_start and "simulation" in (kind, of_start):
        raise FitError(
            f"fit: start is a mode of the likelihood {of_start}, the model's is {kind}; leave"
            " out start"
        )
    if problem.library is not None and (method not in (DEFAULT, "metropolis") or given):
        raise FitError(
            "fit: a model with a library is summed over exactly, or walked over by the method"
            " 'metropolis'; leave out method or use that, and leave out start and resume"
        )
    if given and problem.layout.discrete.any():
        raise FitError(
            f"fit: {given[0]} was given and which bodies a joint joins is unknown; a fit cannot"
            f" go on from one choice of bodies to all of them; leave {given[0]} out and raise draws"
        )


def joined_at(problem: Problem, phi: Floats, sigma: Floats) -> Problem:
    """Return the problem with bodies that meet at these draws in one part; itself if none do.

    Parameters
    ----------
    problem : Problem
        Bodies that were apart in its data are simulated apart.
    phi, sigma : ndarray
        Draws, shapes (n, p) and (n, parameter).
    """
    physics = problem.physics
    if len(physics.simulator.parts) == 1:
        return problem
    rows = np.linspace(0, len(phi) - 1, min(50, len(phi))).astype(int)  # enough, evenly spread
    phi, sigma = phi[rows], sigma[rows]
    start, columns = problem.segments.start, list(problem.observations.columns)
    states, met = physics.one_world.meetings(phi, start, problem.inputs)
    if not met.any():
        return problem
    apart = physics.simulator(phi, start, problem.inputs)
    off = abs(problem.observations.wrapped((states - apart)[..., columns]))
    if is_filtered(problem):  # errors of measurement alone
        sensors = problem.likelihood.noise.coordinates.sensors
        stated = dict(problem.scene.noise)
        known = np.tile([stated.get(name, np.inf) for name in STATE], (len(phi), 1))
        known[:, list(sensors)] = sigma[:, : len(sensors)]
        sigma = known[:, columns]
    # a hundredth of the noise is the same to the likelihood
    matters = np.any(~(off <= 0.01 * sigma[:, None, None, None]), axis=(2, 3, 4))
    meet = (met & matters[..., None]).any(axis=(0, 1))
    meeting = [body.name for body, one in zip(problem.scene.moving, meet, strict=True) if one]
    if not meeting:
        return problem
    return problem.with_physics(together=tuple(dict.fromkeys((*physics.together, *meeting))))


def _joined(problem: Problem, phi: Floats, sigma: Floats) -> Problem:
    """Return the problem with bodies that meet at draws (n, p) and (n, state) in one part.

    The likelihood simulates bodies apart that were apart in the data. The problem itself if they do
    not meet under these parameters either.

    Warns
    -----
    MeetingWarning
        If bodies meet.
    """
    joined = joined_at(problem, phi, sigma)
    if joined is problem:
        return problem
    warn(
        f"fit: {', '.join(joined.physics.together)} meet under the parameters that were found, and"
        " were thought apart by where they are in the data; all is fitted again with them in one"
        " world",
        MeetingWarning,
    )
    return joined


def _as_in(problem: Problem, idata: Idata | None) -> Problem:
    """Return the problem with the parts and the linearisation that a posterior was sampled with."""
    if idata is None:
        return problem
    known = PosteriorRecord.of(idata).together
    if not set(known) <= set(problem.physics.together):
        problem = problem.with_physics(together=known)
    return linearised_as(problem, idata)


def _appended(earlier: Idata, trace: Idata) -> Idata:
    """Return the draws of two runs, the earlier ones first."""
    data = groups(trace)
    for name in ("posterior", "sample_stats"):
        old, new = group(earlier, name), data[name]
        shared = [str(variable) for variable in new.data_vars if variable in old]
        if shared:  # two samplers have no statistics in common: then NaN stands for missing ones
            old, new = old[shared], new[shared]
        both = xr.concat([old, new], dim="draw")
        data[name] = both.assign_coords(draw=np.arange(both.sizes["draw"]))
    runs = (earlier, trace)
    if not any(SIZE in run.attrs for run in runs):
        return from_groups(data, {})
    least = (min(convergence(run)[1].values()) for run in runs)
    size = sum(run.attrs.get(SIZE, ess) for run, ess in zip(runs, least, strict=True))
    k = max(run.attrs.get(PARETO_K, -np.inf) for run in runs)
    return from_groups(data, {PARETO_K: k, SIZE: float(size)})
