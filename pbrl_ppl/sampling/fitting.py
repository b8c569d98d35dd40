"""A model's posterior, by one of several samplers."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pymc as pm

from pbrl_ppl.model import build_model
from pbrl_ppl.modes import (
    Mode,
    choose_from_library,
    find_mode,
    find_trajectory_mode,
    following,
    weigh,
)
from pbrl_ppl.posterior import complete, group
from pbrl_ppl.sampling.emulation import emulate
from pbrl_ppl.sampling.equal_wheels import evened_logp
from pbrl_ppl.sampling.fit_checks import DEFAULT, checked_problem
from pbrl_ppl.sampling.meeting import as_in, joined_model, model_of_draws
from pbrl_ppl.sampling.metropolis import AdaptiveMetropolis, Jumps
from pbrl_ppl.sampling.mixture import mix
from pbrl_ppl.sampling.starts import blank_point, dispersed, from_posterior, gaussian_blocks
from pbrl_ppl.sampling.surrogate import Surrogate, Unpack
from pbrl_ppl.sampling.traces import appended, as_trace, thinned

#: Engine steps that cost no more than what samplers do beside them.
_LITTLE = 2000


@dataclass(frozen=True)
class Method:
    """A sampler, and how long it runs where nothing else is asked for.

    Parameters
    ----------
    run : callable
        ``run(job) -> trace``.
    draws, tune, thin : int
        Draws kept and tuning draws of each chain; steps a draw.
    chains : int
        Chains.
    """

    run: Callable[[Job], Any]
    draws: int
    tune: int
    thin: int
    chains: int = 4


@dataclass(frozen=True, eq=False)
class Job:
    """Arguments of a sampler's run."""

    model: pm.Model
    mode: Mode
    seed: int
    draws: int
    tune: int
    chains: int
    thin: int
    cores: int
    progress: bool
    starts: list[dict[str, Any]]

    def sample(self, step: Any, steps_a_draw: int = 1) -> Any:
        """``pm.sample`` from the starts; how it converged is judged elsewhere."""
        try:
            trace = pm.sample(
                draws=self.draws * steps_a_draw,
                tune=self.tune,
                chains=self.chains,
                cores=self.cores,
                step=step,
                initvals=self.starts,
                random_seed=self.seed,
                progressbar=self.progress,
                quiet=not self.progress,
                compute_convergence_checks=False,
                discard_tuned_samples=True,
            )
        except ValueError as error:
            if "Not enough samples" in str(error):  # PyMC's answer to an early interrupt
                raise KeyboardInterrupt from error
            raise
        return thinned(trace, steps_a_draw)


def _metropolis(job: Job) -> Any:
    """Block-wise adaptive Metropolis with a surrogate; see AdaptiveMetropolis."""
    problem, model = job.mode.problem, job.model
    blocks = gaussian_blocks(model, job.mode)
    options: dict[str, Any] = {"inner": 10, "initial_point": blank_point(model, problem)}
    options["extra"] = evened_logp(model, problem)
    if job.mode.others and len(blocks) == 1:
        hills = [gaussian_blocks(model, peak)[0] for peak in job.mode.others]
        jumps = Jumps((deepcopy(blocks[0]), *hills))  # the block itself adapts
    else:
        jumps = None
    # an exact step of one block, in engine steps; where that is little, looking ahead is no use
    engine = problem.simulator
    cost = engine.steps * problem.segments.n * problem.data.horizon / len(engine.parts)
    if cost > _LITTLE:
        unpack = Unpack(model, problem)
        if emulator := emulate(job.mode, unpack, blocks, job.seed):
            options |= {"rough": Surrogate(problem, unpack, emulator), "inner": 45, "plain": 0.3}
    return job.sample(
        AdaptiveMetropolis(model.free_RVs, blocks=blocks, thin=job.thin, jumps=jumps, **options)
    )


def _paper(job: Job) -> Any:
    """One random-walk Metropolis step a variable, as PyMC 2 did: burn in, then keep each n-th."""
    steps = [pm.Metropolis([variable]) for variable in job.model.free_RVs]
    return job.sample(steps, job.thin)


def _demetropolisz(job: Job) -> Any:
    """Differential evolution from each chain's past (ter Braak and Vrugt, 2008)."""
    return job.sample(pm.DEMetropolisZ(job.model.free_RVs), job.thin)


def _nuts(job: Job) -> Any:
    """NUTS on the finite-difference gradient: where nothing slides to a stop or collides."""
    return job.sample(pm.NUTS(job.model.free_RVs), job.thin)


def _smc(job: Job) -> Any:
    """Sequential Monte Carlo from the prior: for several modes and few parameters."""
    return pm.sample_smc(
        draws=job.draws,
        chains=job.chains,
        cores=job.cores,
        random_seed=job.seed,
        progressbar=job.progress,
        compute_convergence_checks=False,
    )


def _map(job: Job) -> Any:
    """The mode alone, as a posterior of one draw."""
    values = job.mode.problem.named(job.mode.phi, job.mode.sigma)
    draws = {name: np.asarray(value)[None, None] for name, value in values.items()}
    return as_trace(job.model, draws, {"lp": np.array([[job.mode.log_posterior]])})


def _laplace(job: Job) -> Any:
    """Independent draws from the Gaussian at the mode; of the noise, of its logarithm."""
    rng, mode = np.random.default_rng(job.seed), job.mode
    shape = job.chains, job.draws
    phi = mode.draws(rng, job.chains * job.draws)
    centre, covariance = mode.noise_gaussian()
    louder = rng.standard_normal((len(phi), len(centre))) @ np.linalg.cholesky(covariance).T
    sigma = np.exp(centre + louder)
    values = mode.problem.named(phi.reshape(*shape, -1), sigma.reshape(*shape, -1))
    return as_trace(job.model, values, {"accept": np.ones(shape)})


#: The samplers by name. The paper's schedule is that of Table 2 for the cart: 30 chains of 20,000
#: iterations, of which the first 1,000 are burnt in and each tenth of the others is kept. (PyMC 2
#: counted the burn-in among the iterations.)
METHODS: Mapping[str, Method] = {
    "metropolis": Method(_metropolis, draws=800, tune=500, thin=1),
    "paper": Method(_paper, draws=1900, tune=1000, thin=10, chains=30),
    "demetropolisz": Method(_demetropolisz, draws=1000, tune=2000, thin=10),
    "smc": Method(_smc, draws=1000, tune=0, thin=1),
    "nuts": Method(_nuts, draws=500, tune=500, thin=1),
    "laplace": Method(_laplace, draws=250, tune=0, thin=1),
    "map": Method(_map, draws=1, tune=0, thin=1),
}


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
    resume: Any = None,
    progress: bool = True,
) -> Any:
    """Sample the posterior of a model of :func:`pbrl_ppl.physics_model`.

    Multi-start least squares finds the mode, from about which the chains start, if the model holds
    none. Where the scene does not say which bodies a joint joins, every choice is fitted by itself,
    and their draws are mixed by their evidences (:func:`pbrl_ppl.joint_probabilities`). A model
    with a ``library`` needs no chain: all choices are summed over.

    Parameters
    ----------
    model : pymc.Model
        As made by ``physics_model``.
    method : str
        ``metropolis``: adaptive blocks that follow the scene's independent parts and look ahead
        with polynomials where engine runs are dear; ``paper``: one random walk a variable, by
        default on the schedule of the paper's Table 2 for the cart (30 chains of 20,000 iterations,
        1,000 of them burn-in, each tenth kept), that for the apartment being ``draws=400,
        tune=1000, thin=10, chains=1``; ``demetropolisz``; ``smc``; ``nuts``, on the
        finite-difference gradient; ``laplace``: independent draws from the Gaussian at the mode,
        which no chain has checked; ``map``: the mode alone, as one draw.
    seed : int
        The same seed gives the same posterior.
    draws, tune : int, optional
        Draws kept and tuning draws of each chain; each method has its own default.
    chains : int, optional
        Chains; 4 by default, 30 for ``paper``.
    thin : int, optional
        Steps a draw; rounds over the blocks for ``metropolis``.
    cores : int, optional
        Processes; as many as there are processors by default, at most one a chain.
    start : Mode, optional
        A mode found before, in place of the search for one.
    resume : InferenceData or DataTree, optional
        A posterior of the same model, whose chains go on where they ended, with the new draws after
        the old. Whole trajectories are linearised as they are in it.
    progress : bool
        Whether to show PyMC's progress bar.

    Returns
    -------
    InferenceData or DataTree
        Posterior, sample_stats, log_likelihood, posterior_predictive (of up to 200 draws, under
        their own labels), prior, log_prior, observed_data and constant_data, with units, and in
        ``attrs`` the scene, effects, method, versions, seed, the hash of the data and the
        convergence. An interrupted run keeps the draws so far.

    Raises
    ------
    FitError
        If the model was not made by ``physics_model``, there is no such method, ``start`` is no
        mode, or both ``start`` and ``resume`` are given; for joints of unknown bodies, if there are
        too many choices, or with ``smc``, ``start`` or ``resume``.
    PosteriorError
        If ``resume`` is a posterior of other data or parameters.

    Warns
    -----
    ConvergenceWarning
        If an R-hat is over 1.01 or an effective sample size under 400, if sampling was
        interrupted, or if an evidence is too rough for the probability of a joint.
    LinearisationWarning
        If states smoothed anew at draws give another likelihood (``attrs["linearisation"]``, nats).
    MeetingWarning
        If bodies that were apart in the data meet under the parameters found.
    BoundWarning
        If a parameter is pressed against the end of its support.
    UninformedWarning
        If the data say nothing about a parameter.
    """
    problem = checked_problem(model, method, METHODS, start, resume)
    again = partial(
        fit, method=method, seed=seed, draws=draws, tune=tune, chains=chains, thin=thin,
        cores=cores, progress=progress,
    )  # fmt: skip
    if problem.library is not None:
        default = METHODS[method]
        trace = _summed(
            model,
            default.draws if draws is None else draws,
            default.chains if chains is None else chains,
            seed,
        )
        if joined := model_of_draws(problem, trace):
            return again(joined)
        return complete(problem, trace, seed=seed, method="exact sum over the library")
    chosen = METHODS[method]
    draws = chosen.draws if draws is None else draws
    chains = chosen.chains if chains is None else chains
    if method == "map":
        draws = chains = 1

    def sampled(model: pm.Model, mode: Mode, starts: list[dict[str, Any]] | None = None) -> Any:
        if starts is None:
            starts = dispersed(mode, np.random.default_rng(seed), chains)
        job = Job(
            model=model,
            mode=mode,
            seed=seed,
            draws=draws,
            tune=chosen.tune if tune is None else tune,
            chains=len(starts),
            thin=chosen.thin if thin is None else thin,
            cores=min(len(starts), os.cpu_count() or 1) if cores is None else cores,
            progress=progress,
            starts=starts,
        )
        with model, warnings.catch_warnings():
            # convergence is checked and reported in this package's own words
            warnings.filterwarnings("ignore", message=".*fork.*", category=DeprecationWarning)
            # draws from the prior, of which SMC needs some, are not compiled on the newer stack
            warnings.filterwarnings("ignore", message="Numba will use object mode")
            return chosen.run(job)

    model = as_in(model, resume)
    problem = model.problem
    if problem.layout.discrete.any():
        found = weigh(problem, seed=seed, progress=progress)
        trace = mix(model, problem, found, sampled, draws=draws, chains=chains, seed=seed)
    elif resume is not None:
        trace = sampled(model, *from_posterior(problem, resume))
    else:
        held: Mode | None = getattr(model, "mode", None)  # of physics_model
        search = find_mode if problem.trajectories is None else find_trajectory_mode
        mode = start or held or search(problem, seed=seed)
        if mode.problem.trajectories is not None and mode is not held:  # linearised at it by now
            mode = mode if start is None else following(start)
            problem = mode.problem
            model = build_model(problem)
        if joined := joined_model(problem, mode.phi[None], mode.sigma[None]):
            return again(joined)
        trace = sampled(model, mode)
    # PyMC ends an interrupted run quietly, with fewer draws or with the chains that had most
    sizes = group(trace, "posterior").sizes
    all_chains = chains if resume is None else group(resume, "posterior").sizes["chain"]
    cut = sizes["draw"] < draws or sizes["chain"] < all_chains
    if not cut and (joined := model_of_draws(problem, trace)):
        return again(joined)
    if resume is not None:
        if sizes["chain"] < all_chains:
            raise KeyboardInterrupt  # some chains have nothing new, and resume= has all of them
        trace = appended(resume, trace)
    asked = (draws, all_chains) if cut else None
    return complete(problem, trace, seed=seed, method=method, asked=asked)


def _summed(model: pm.Model, draws: int, chains: int, seed: int) -> Any:
    """Draws of a model with a library, by summing over its choices."""
    problem = model.problem
    phi, sigma, index, accepted = choose_from_library(problem, draws, chains, seed)
    values: dict[str, Any] = problem.layout.to_dict(phi)
    values |= {"library_index": index, "sigma": sigma[..., 0] if problem.noise.scalar else sigma}
    return as_trace(model, values, {"accept": accepted})
