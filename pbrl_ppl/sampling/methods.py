"""Samplers of `fit`, where they begin, and their default schedules."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
import xarray as xr
from scipy.special import logsumexp

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
from pbrl_ppl.parameters import covariance_factor
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
from pbrl_ppl.sampling.importance import Reference, draw_proposals, resample
from pbrl_ppl.state import Floats, Ints
from pbrl_ppl.system.threads import Say, Work


class WeightsError(FitError):
    """Importance weights do not suffice, and no other sampler was to run."""


@dataclass(frozen=True)
class SamplingMethod:
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
    tune: int = 0
    thin: int = 1
    chains: int = 4


@dataclass(frozen=True, eq=False)
class SamplerRun:
    """What a sampler runs on.

    Parameters
    ----------
    problem : Problem
        What is sampled.
    method : SamplingMethod
        The sampler, with the schedule that was asked for.
    mode : Mode, optional
        Where draws begin, unless they go on from a posterior or walk over a library.
    resume : InferenceData or DataTree, optional
        Posterior to go on from.
    seed, cores
        As of :func:`pbrl_ppl.fit`, with defaults filled in.
    progress : callable
        Called with counted work.
    rescue : bool
        Whether `smc` runs where importance weights do not suffice.
    """

    problem: Problem
    method: SamplingMethod
    mode: Mode | None
    resume: Idata | None
    seed: int
    cores: int
    progress: Say
    rescue: bool = True

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
            each = group(self.resume, "posterior").sizes["draw"]
            last = (draws[each - 1 :: each] for draws in parameter_draws(self.problem, self.resume))
            return [self.problem.named(*draw) for draw in zip(*last, strict=True)]
        if self.mode is None:
            return prior_starts(self.problem, rng, self.method.chains)
        return dispersed(self.mode, rng, self.method.chains)

    def stream(self) -> list[int]:
        """Return a seed that also depends on where chains begin, as those of a resumed fit do."""
        begin = b"".join(
            np.asarray(start[name]).tobytes() for start in self.starts() for name in sorted(start)
        )
        return [self.seed, zlib.crc32(begin)]

    def reference(self) -> Reference:
        """Return Gaussians about the modes, or of the draws of the posterior to go on from."""
        if self.resume is None:
            problem = self.at_mode.problem.with_physics(threads=self.cores)
            space = Space.of(self.at_mode).on(problem)
            return Reference.about(space, self.at_mode, space.on(problem.medium))
        phi, sigma = parameter_draws(self.problem, self.resume)
        problem = self.problem.with_physics(threads=self.cores)
        return Reference.of_draws(*Space.of_draws(problem, phi, sigma))

    def trace(self, phi: Floats, sigma: Floats, **stats: Floats) -> Idata:
        """Return the trace of draws (n, p) and (n, parameter), a chain after another.

        With statistics of each draw, shape (n,).
        """

        def chained(values: Floats) -> Floats:
            return values.reshape(self.chains, len(values) // self.chains, *values.shape[1:])

        values = self.problem.named(chained(phi), chained(sigma))
        return as_trace(self.problem, values, {name: chained(x) for name, x in stats.items()})

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


def _importance(job: SamplerRun, *, proposals: float = 1.4) -> Idata:
    """Weight proposals from Gaussians; see `importance`. Where weights do not suffice, `_smc`.

    Or an error, if the job is not to be rescued.

    ``proposals``: weighted proposals a draw.
    """
    seed, n = job.stream(), job.chains * job.method.draws
    reference = job.reference()
    points, learned = draw_proposals(reference, int(proposals * n), seed, job.progress)
    chosen, k, size = resample(points.log_weight, n, np.random.default_rng([*seed, 1]))
    if not np.isfinite(points.log_weight).any():
        raise FitError(
            f"fit: the model gives none of {len(points.q)} draws about its mode a density; start"
            " from another mode, or use the method 'laplace'"
        )
    if not points.good:
        why = f"{points.ess:.0f} of {len(points.q)} effective, Pareto k {k:.2g}"
        if not job.rescue:
            raise WeightsError(f"fit: importance weights do not suffice ({why})")
        trace = _smc(job, learned)
        trace.attrs["proposals"] = f"none: smc, for weights do not suffice ({why})"
        return trace
    phi, sigma = reference.space.split(points.q[chosen])
    trace = job.trace(phi, sigma, log_weight=points.log_weight[chosen])
    trace.attrs |= {
        PARETO_K: k, SIZE: size, LIKELIHOOD: points.values[chosen],
        "proposals": "Gaussians at the modes", "log_evidence": points.log_z,
    }  # fmt: skip
    return trace


def _smc(job: SamplerRun, learned: Reference | None = None, *, least: int = 100) -> Idata:
    """Run PyMC's sequential Monte Carlo from Gaussians to the posterior, once a chain.

    The prior is the standard normal one of numbers that make draws of the Gaussians, ``learned`` or
    those about the modes or of the posterior to go on from; the likelihood is the posterior over
    the Gaussians' density. So no particle begins where the posterior is not, all modes have the
    same width, and what the Gaussians have wrong is corrected, as a prior is.

    ``least``: particles whose covariance can be told; of more than there are draws some are kept.
    """
    import pymc as pm  # takes seconds to load

    from pbrl_ppl.model import DensityOp

    reference, rng = learned or job.reference(), np.random.default_rng(job.stream())
    one_thread = reference.space.problem.with_physics(threads=1)  # particles come one by one
    reference = replace(reference, space=reference.space.on(one_thread))
    n = max(job.method.draws, least)
    logging.getLogger("pymc.smc").setLevel(logging.WARNING)  # it says how many jobs it has
    told = f"moving {job.chains} times {n} particles from Gaussians to the posterior"
    job.progress(Work(told, 0, 1))
    with pm.Model():
        normal = pm.Normal("z", shape=reference.normals)
        pm.Potential("weight", DensityOp(reference.log_weight)(normal))
        particles = pm.sample_smc(
            draws=n, chains=job.chains, cores=min(job.cores, job.chains), random_seed=rng,
            progressbar=False, compute_convergence_checks=False, return_inferencedata=False,
        )  # fmt: skip
    job.progress(Work(told, 1, 1))
    kept = np.arange(job.method.draws) * n // job.method.draws
    z = particles.get_values("z").reshape(job.chains, n, -1)[:, kept]
    report = particles.report  # a number a stage, in a list for each of several chains
    accept, log_z = (
        np.array([stages[-1] for stages in (of if job.chains > 1 else [of])])
        for of in (report.accept_rate, report.log_marginal_likelihood)
    )
    q = reference.space.prior_draws(reference.at(np.concatenate(z)), rng)
    phi, sigma = reference.space.split(q)
    trace = job.trace(phi, sigma, accept=np.repeat(accept, job.method.draws))
    trace.attrs["log_evidence"] = float(logsumexp(log_z) - np.log(job.chains))
    return trace


def _metropolis(job: SamplerRun) -> Idata:
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
    return job.trace(mode.phi[None], mode.sigma[None], lp=np.array([mode.log_posterior]))


def _laplace(job: SamplerRun) -> Idata:
    """Draw independently from the Gaussian at the mode; that of the noise is of its logarithm."""
    rng, mode = np.random.default_rng(job.seed), job.at_mode
    phi = mode.draws(rng, job.chains * job.method.draws)
    centre, covariance = mode.noise_gaussian()
    noise = rng.standard_normal((len(phi), len(centre))) @ covariance_factor(covariance).T
    return job.trace(phi, np.exp(centre + noise), accept=np.ones(len(phi)))


def dispersed(mode: Mode, rng: np.random.Generator, chains: int) -> list[dict[str, Floats]]:
    """Draw starts about two posterior standard deviations from the mode, one a chain."""
    space = Space.of(mode)
    mean, covariance = space.laplace(mode)
    factor = covariance_factor(covariance)
    q = mean + 2.0 * rng.standard_normal((chains, len(mean))) @ factor.T
    return [mode.problem.named(space.possible(one), space.split(one)[1]) for one in q]


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
    posterior, data = posterior_dataset(problem, draws), data_of(problem)
    per_draw = {name: (("chain", "draw"), value) for name, value in stats.items()}
    of_trace = {
        "posterior": posterior,
        "sample_stats": xr.Dataset(per_draw, {d: posterior[d] for d in ("chain", "draw")}),
        "observed_data": data[["next_state"]],
        "constant_data": data[["start", "actions"]],
    }
    return from_groups(of_trace, {})


def data_of(problem: Problem) -> xr.Dataset:
    """Return initial states, actions and measured states, with their coordinates."""
    data = {
        "start": (START_DIMS, problem.segments.start), "actions": (ACTION_DIMS, problem.inputs),
        "next_state": (NEXT_STATE_DIMS, problem.measured),
    }  # fmt: skip
    return labelled(problem, data)


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
METHODS: Mapping[str, SamplingMethod] = {
    "importance": SamplingMethod(_importance, draws=250),
    "smc": SamplingMethod(_smc, draws=300),
    "metropolis": SamplingMethod(_metropolis, draws=1900, tune=1000, thin=10, chains=30),
    "laplace": SamplingMethod(_laplace, draws=250),
    "map": SamplingMethod(_map, draws=1, chains=1),
}
