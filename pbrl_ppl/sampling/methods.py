"""Samplers of `fit`, where they begin, and their default schedules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
import xarray as xr

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import (
    ACTION_DIMS,
    NEXT_STATE_DIMS,
    START_DIMS,
    Problem,
    variable_coords,
    variable_dims,
)
from pbrl_ppl.modes import Mode, Space, library_of
from pbrl_ppl.parameters import covariance_factor, nearest
from pbrl_ppl.posterior import (
    LIKELIHOOD,
    PARETO_K,
    SIZE,
    Idata,
    from_groups,
    group,
    groups,
    parameter_draws,
)
from pbrl_ppl.sampling.ensemble import Ensemble, Reference
from pbrl_ppl.sampling.importance import draw_proposals, resample, stream
from pbrl_ppl.state import Floats, Ints
from pbrl_ppl.threads import Say, Work


@dataclass(frozen=True)
class Method:
    """A sampler and its default schedule.

    Parameters
    ----------
    run : callable
        ``run(job) -> trace``.
    draws, tune, thin : int
        Draws kept and tuning draws of each chain; steps a draw.
    chains : int
        Chains.
    """

    run: Callable[[SamplerRun], Idata]
    draws: int
    tune: int
    thin: int
    chains: int = 4


@dataclass(frozen=True, eq=False)
class SamplerRun:
    """What a sampler runs on.

    Parameters
    ----------
    problem : Problem
        What is sampled.
    method : Method
        The sampler, with the schedule that was asked for.
    mode : Mode, optional
        Where draws begin, unless they go on from a posterior or walk over a library.
    resume : InferenceData or DataTree, optional
        Posterior to go on from.
    seed, cores
        As of :func:`pbrl_ppl.fit`, with defaults filled in.
    progress : callable
        Called with counted work.
    """

    problem: Problem
    method: Method
    mode: Mode | None
    resume: Idata | None
    seed: int
    cores: int
    progress: Say

    @property
    def chains(self) -> int:
        """Chains that are asked for, or those of the posterior to go on from."""
        if self.resume is None:
            return self.method.chains
        return int(group(self.resume, "posterior").sizes["chain"])

    def starts(self) -> list[dict[str, Floats]]:
        """Return starts of PyMC's chains, and of the stream of random numbers."""
        rng = np.random.default_rng(self.seed)
        if self.resume is not None:
            draws = zip(*last_draws(self.problem, self.resume), strict=True)
            return [self.problem.named(*draw) for draw in draws]
        if self.mode is None:
            return prior_starts(self.problem, rng, self.method.chains)
        return dispersed(self.mode, rng, self.method.chains)

    def reference(self) -> Reference:
        """Return Gaussians about the modes, or of the draws of the posterior to go on from."""
        if self.resume is None:
            problem = self.at_mode.problem.with_physics(threads=self.cores)
            space = Space.of(self.at_mode).on(problem)
            return Reference.about(space, self.at_mode, space.on(problem.medium))
        phi, sigma = parameter_draws(self.problem, self.resume)
        problem = self.problem.with_physics(threads=self.cores)
        return Reference.of_draws(*Space.of_draws(problem, phi, sigma))

    @property
    def at_mode(self) -> Mode:
        """The mode.

        Raises
        ------
        FitError
            If there is none.
        """
        if self.mode is None:
            raise FitError("fit: this method begins at a mode, and there is none")
        return self.mode


def _importance(
    job: SamplerRun, *, proposals: float = 1.4, tune: int = 125, thin: int = 16
) -> Idata:
    """Weight proposals from Gaussians; see `importance`. Chains, where weights do not suffice.

    ``proposals``: weighted proposals a draw; ``tune``, ``thin``: of the chains.
    """
    shape, seed = (job.chains, job.method.draws), stream(job.seed, job.starts())
    n = job.chains * job.method.draws
    reference = job.reference()
    points, learned = draw_proposals(reference, int(proposals * n), seed, say=job.progress)
    chosen, k, size = resample(points.log_weight, n, np.random.default_rng([*seed, 1]))
    if not np.isfinite(points.log_weight).any():
        raise FitError(
            f"fit: the model gives none of {len(points.q)} draws about its mode a density; start"
            " from another mode, or use the method 'laplace'"
        )
    if not points.good:
        chains = replace(job, method=replace(job.method, tune=tune, thin=thin))
        trace = _metropolis(chains, learned)
        why = f"{points.ess:.0f} of {len(points.q)} effective, Pareto k {k:.2g}"
        trace.attrs["proposals"] = f"none: chains, for weights do not suffice ({why})"
        return trace
    phi, sigma = reference.space.split(points.q[chosen])
    values = job.problem.named(phi.reshape(*shape, -1), sigma.reshape(*shape, -1))
    log_weight = points.log_weight[chosen].reshape(shape)
    trace = as_trace(job.problem, values, {"log_weight": log_weight})
    trace.attrs |= {
        PARETO_K: k, SIZE: size, LIKELIHOOD: points.values[chosen],
        "proposals": "Gaussians at the modes", "log_evidence": points.log_z,
    }  # fmt: skip
    return trace


def _metropolis(
    job: SamplerRun, learned: Reference | None = None, *, most_walkers: int = 20
) -> Idata:
    """Run the ensemble as chains; see `ensemble`. A chain is its walkers, one after another.

    They begin at draws of ``learned``, or where it is not given at the modes' Gaussians or where
    the posterior to go on from ends.

    ``most_walkers``: walkers of a chain of the ensemble.
    """
    reference = learned or job.reference()
    rng = np.random.default_rng(stream(job.seed, job.starts()))
    method, chains = job.method, job.chains
    walkers = min(most_walkers, method.draws)
    per_walker = -(-method.draws // walkers)
    if job.resume is None or learned:
        q = reference.draw(chains * walkers, rng)
    else:
        phi, sigma = last_draws(job.problem, job.resume, walkers)
        q = reference.space.at(nearest(job.problem.layout, phi, any_prior=True), sigma)
    ensemble = Ensemble(reference, q, rng)
    tune = -(-method.tune // walkers) * method.thin
    retained, rates = [], []
    done, total = 0, tune + per_walker * method.thin
    try:
        for i in range(tune + per_walker):
            sweeps = 1 if i < tune else method.thin
            rate = ensemble.move(reference.space, sweeps, adapt=i < tune)
            done += sweeps
            job.progress(Work(f"sampling chains of {total} sweeps", done, total))
            ensemble.q = reference.space.prior_draws(ensemble.q, rng)
            if i < tune:
                ensemble.learn()
                continue
            retained.append(ensemble.q.copy())
            rates.append(rate)
    except KeyboardInterrupt:
        if len(retained) < 2:
            raise
    phi, sigma = reference.space.split(np.array(retained))  # (draw, walker of all chains, ...)

    def chained(values: Floats) -> Floats:
        values = np.moveaxis(values, 0, 1).reshape(chains, walkers * len(retained), -1)
        return values[:, -method.draws :]

    values = job.problem.named(chained(phi), chained(sigma))
    accept = np.repeat(np.array(rates)[:, None], chains * walkers, axis=1)
    return as_trace(job.problem, values, {"accept": chained(accept[..., None])[..., 0]})


def _paper(job: SamplerRun) -> Idata:
    """Run one random-walk Metropolis step a variable, as PyMC 2 did, and keep each n-th draw.

    The set of a library that each body has is proposed uniformly, body by body. PyMC's checks of
    convergence are left out.
    """
    import pymc as pm  # takes seconds to load

    from pbrl_ppl.model import build_model

    model, starts, thin = build_model(job.problem), job.starts(), job.method.thin
    total, done = len(starts) * (job.method.tune + job.method.draws * thin), count(1)
    steps = [
        pm.CategoricalGibbsMetropolis([variable], model=model)
        if model.rvs_to_values[variable] in model.discrete_value_vars
        else pm.Metropolis([variable], model=model)
        for variable in model.free_RVs
    ]
    try:
        trace: Idata = pm.sample(
            draws=job.method.draws * thin, tune=job.method.tune, chains=len(starts),
            cores=min(job.cores, len(starts)), step=steps, initvals=starts,
            random_seed=job.seed, progressbar=False, quiet=True,
            callback=lambda **_: job.progress(Work("sampling chains", next(done), total)),
            compute_convergence_checks=False, discard_tuned_samples=True, model=model,
        )  # fmt: skip
    except ValueError as error:
        if "Not enough samples" in str(error):  # PyMC's answer to an early interrupt
            raise KeyboardInterrupt from error
        raise
    data = groups(trace)
    for name in ("posterior", "sample_stats"):
        data[name] = data[name].isel(draw=slice(thin - 1, None, thin))
    return from_groups(data, {})


def _map(job: SamplerRun) -> Idata:
    """Return the mode alone, as a posterior of one draw."""
    mode = job.at_mode
    values = mode.problem.named(mode.phi[None, None], mode.sigma[None, None])
    return as_trace(job.problem, values, {"lp": np.array([[mode.log_posterior]])})


def _laplace(job: SamplerRun) -> Idata:
    """Draw independently from the Gaussian at the mode; that of the noise is of its logarithm."""
    rng, mode = np.random.default_rng(job.seed), job.at_mode
    shape = job.chains, job.method.draws
    phi = mode.draws(rng, shape[0] * shape[1])
    centre, covariance = mode.noise_gaussian()
    noise = rng.standard_normal((len(phi), len(centre))) @ covariance_factor(covariance).T
    sigma = np.exp(centre + noise)
    values = mode.problem.named(phi.reshape(*shape, -1), sigma.reshape(*shape, -1))
    return as_trace(job.problem, values, {"accept": np.ones(shape)})


def dispersed(
    mode: Mode, rng: np.random.Generator, chains: int, *, away: float = 2.0
) -> list[dict[str, Floats]]:
    """Draw starts about two posterior standard deviations from the mode, one a chain.

    ``away``: distance from the mode in posterior standard deviations.
    """
    space = Space.of(mode)
    mean, covariance = space.laplace(mode)
    factor = covariance_factor(covariance)
    q = mean + away * rng.standard_normal((chains, len(mean))) @ factor.T
    return [mode.problem.named(space.possible(one), space.split(one)[1]) for one in q]


def last_draws(problem: Problem, idata: Idata, walkers: int = 1) -> tuple[Floats, Floats]:
    """Return the last draws of each chain's walkers, which stand one after another in it.

    Shapes (chain * walker, p) and (chain * walker, parameter).
    """
    sizes = group(idata, "posterior").sizes
    last = np.arange(1, walkers + 1) * sizes["draw"] // walkers - 1
    chosen = (np.arange(sizes["chain"])[:, None] * sizes["draw"] + last).ravel()
    phi, sigma = parameter_draws(problem, idata)
    return phi[chosen], sigma[chosen]


def prior_starts(
    problem: Problem, rng: np.random.Generator, chains: int
) -> list[dict[str, Floats]]:
    """Draw starts of chains over a library: each owner's set from the prior, the median sigma."""
    library = library_of(problem)
    median = problem.noise_prior[0]
    sigma = np.exp(np.log(median).mean()) if problem.likelihood.scalar else median
    laws = [library.prior(owner) for owner in problem.scene.owners]
    return [
        {"library_index": np.array([rng.choice(len(p), p=p) for p in laws]), "sigma": sigma}
        for _ in range(chains)
    ]


def as_trace(
    problem: Problem, draws: Mapping[str, Floats | Ints], stats: Mapping[str, Floats]
) -> Idata:
    """Return a trace in PyMC's form, of draws made without PyMC.

    Parameters
    ----------
    problem : Problem
        Has the dimensions of each variable.
    draws : mapping of str to ndarray
        By the variables' names, shape (chain, draw, ...).
    stats : mapping of str to ndarray
        The sampler's statistics of each draw, shape (chain, draw).
    """
    posterior = posterior_dataset(problem, draws)
    per_draw = {name: (("chain", "draw"), value) for name, value in stats.items()}
    data = {
        "start": (START_DIMS, problem.segments.start),
        "actions": (ACTION_DIMS, problem.inputs),
    }
    observed = {"next_state": (NEXT_STATE_DIMS, problem.observations.values)}
    return from_groups(
        {
            "posterior": posterior,
            "sample_stats": xr.Dataset(per_draw, {d: posterior[d] for d in ("chain", "draw")}),
            "observed_data": labelled(problem, observed),
            "constant_data": labelled(problem, data),
        },
        {},
    )


def posterior_dataset(problem: Problem, values: Mapping[str, Floats | Ints]) -> xr.Dataset:
    """Return draws, shape (chain, draw, ...), with the problem's dimensions and coordinates."""
    dims = variable_dims(problem)
    data = {name: (("chain", "draw", *dims[name]), value) for name, value in values.items()}
    chains, draws = next(iter(values.values())).shape[:2]
    return labelled(problem, data).assign_coords(chain=np.arange(chains), draw=np.arange(draws))


def labelled(
    problem: Problem, variables: Mapping[str, tuple[tuple[str, ...], Floats | Ints]]
) -> xr.Dataset:
    """Return variables (dims, values) with the coordinates of their dimensions."""
    coords = variable_coords(problem)
    used = {dim for dims, _ in variables.values() for dim in dims if dim in coords}
    return xr.Dataset(variables, {dim: coords[dim] for dim in used})


#: The samplers by name. The paper's schedule is that of Table 2 for the cart: 30 chains of 20,000
#: iterations, of which the first 1,000 are burnt in and each tenth of the others is kept. (PyMC 2
#: counted the burn-in among the iterations.)
METHODS: Mapping[str, Method] = {
    "importance": Method(_importance, draws=250, tune=0, thin=1),
    "metropolis": Method(_metropolis, draws=800, tune=500, thin=4),
    "paper": Method(_paper, draws=1900, tune=1000, thin=10, chains=30),
    "laplace": Method(_laplace, draws=250, tune=0, thin=1),
    "map": Method(_map, draws=1, tune=0, thin=1, chains=1),
}

#: Table 2's schedule for the apartment, whose prior is a library: one chain of 5,000 iterations.
OVER_LIBRARY: Mapping[str, Method] = {
    "paper": Method(_paper, draws=400, tune=1000, thin=10, chains=1),
}
