"""Samplers of `fit`, each with its default schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from pbrl_ppl.posterior import CELLS, LIKELIHOOD, PARETO_K, SIZE, from_groups, groups
from pbrl_ppl.sampling.emulator import FewSteps, Surrogate, Unpack, emulate
from pbrl_ppl.sampling.importance import MAX_PARETO_K, draw_pool, resample, stream, unsuited
from pbrl_ppl.sampling.metropolis import AdaptiveMetropolis, Jumps, Schedule
from pbrl_ppl.sampling.starts import blank_point, evened_logp, gaussian_blocks
from pbrl_ppl.state import Floats

#: Weighted proposals a draw, and the least share of the draws that they must be worth.
_PROPOSALS, _WORTH = 1.4, 0.3
#: Ratio of engine steps from which the engine with few of them is a surrogate.
_FEWER = 4
#: Engine steps below which a surrogate does not pay.
_LITTLE = 2000


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

    run: Callable[[Job], Any]
    draws: int
    tune: int
    thin: int
    chains: int = 4


@dataclass(frozen=True, eq=False)
class Job:
    """Arguments of a sampler's run; ``mode`` is a Mode, or None over the sets of a library."""

    model: pm.Model
    mode: Any
    seed: int
    draws: int
    tune: int
    chains: int
    thin: int
    cores: int
    progress: bool
    starts: list[dict[str, Any]]

    def sample(self, step: Any, steps_a_draw: int = 1) -> Any:
        """Run ``pm.sample`` from the starts, without its checks of convergence."""
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
        if steps_a_draw == 1:
            return trace
        data = groups(trace)
        for name in ("posterior", "sample_stats"):
            data[name] = data[name].isel(draw=slice(steps_a_draw - 1, None, steps_a_draw))
        return from_groups(data, {})


def _metropolis(job: Job) -> Any:
    """Run block-wise adaptive Metropolis with a surrogate; see `AdaptiveMetropolis`."""
    problem, model = job.mode.problem, job.model
    blocks = gaussian_blocks(model, job.mode)
    if job.mode.others and len(blocks) == 1:
        others = [gaussian_blocks(model, mode)[0] for mode in job.mode.others]
        jumps = Jumps((deepcopy(blocks[0]), *others))  # the block itself adapts
    else:
        jumps = None
    # engine steps of one exact step of a block
    engine = problem.simulator
    cost = engine.steps * problem.segments.n * problem.data.horizon / len(engine.parts)
    rough, schedule = None, Schedule(thin=job.thin)
    if cost > _LITTLE:
        unpack = Unpack(model, problem)
        if emulator := emulate(job.mode, unpack, blocks, job.seed):
            rough = Surrogate(problem, unpack, emulator)
            schedule = Schedule(inner=45, plain=0.3, thin=job.thin)
        elif engine.steps >= _FEWER * problem.rough.simulator.steps:
            rough = Surrogate(problem, unpack, FewSteps(job.mode))
            schedule = Schedule(inner=20, plain=0.1, thin=job.thin)
    return job.sample(
        AdaptiveMetropolis(
            model.free_RVs,
            blocks=blocks,
            rough=rough,
            schedule=schedule,
            jumps=jumps,
            extra=evened_logp(model, problem),
            initial_point=blank_point(model, problem),
        )
    )


class Unsuited(Exception):
    """A sampler does not suit a posterior, and why."""


def _importance(job: Job) -> Any:
    """Weight proposals from an emulator's posterior; see `importance`.

    Raises
    ------
    Unsuited
        If no emulator is close enough to the posterior.
    """
    if why := unsuited(job.mode):
        raise Unsuited(why)
    shape, seed = (job.chains, job.draws), stream(job.seed, job.starts)
    n = job.chains * job.draws
    pool, why = draw_pool(job.mode, int(_PROPOSALS * n), seed, job.cores)
    if pool is None:
        raise Unsuited(why)
    chosen, k, size = resample(pool.log_weight, n, np.random.default_rng([*seed, 1]))
    if not k <= MAX_PARETO_K:
        raise Unsuited(f"Pareto k of the proposals is {k:.2f}, above {MAX_PARETO_K}")
    if size < _WORTH * n:
        raise Unsuited(f"weights leave {size:.0f} of {n} draws")
    phi, sigma = pool.phi[chosen], pool.sigma[chosen]
    values = job.mode.problem.named(phi.reshape(*shape, -1), sigma.reshape(*shape, -1))
    trace = as_trace(job.model, values, {"log_weight": pool.log_weight[chosen].reshape(shape)})
    trace.attrs |= {PARETO_K: k, SIZE: size, LIKELIHOOD: pool.log_likelihood[chosen]}
    return trace


def _paper(job: Job) -> Any:
    """Run one random-walk Metropolis step a variable, as PyMC 2 did, and keep each n-th draw.

    The set of a library that each body has is proposed uniformly, body by body.
    """
    discrete = job.model.discrete_value_vars
    steps = [
        pm.CategoricalGibbsMetropolis([variable], model=job.model)
        if job.model.rvs_to_values[variable] in discrete
        else pm.Metropolis([variable])
        for variable in job.model.free_RVs
    ]
    return job.sample(steps, job.thin)


def _demetropolisz(job: Job) -> Any:
    """Run differential evolution from each chain's past (ter Braak and Vrugt, 2008)."""
    return job.sample(pm.DEMetropolisZ(job.model.free_RVs), job.thin)


def _nuts(job: Job) -> Any:
    """Run NUTS on the finite-difference gradient: where nothing slides to a stop or collides."""
    return job.sample(pm.NUTS(job.model.free_RVs), job.thin)


def _smc(job: Job) -> Any:
    """Run sequential Monte Carlo from the prior: for several modes and few parameters."""
    return pm.sample_smc(
        draws=job.draws,
        chains=job.chains,
        cores=job.cores,
        random_seed=job.seed,
        progressbar=job.progress,
        compute_convergence_checks=False,
    )


def _map(job: Job) -> Any:
    """Return the mode alone, as a posterior of one draw."""
    values = job.mode.problem.named(job.mode.phi, job.mode.sigma)
    draws = {name: np.asarray(value)[None, None] for name, value in values.items()}
    return as_trace(job.model, draws, {"lp": np.array([[job.mode.log_posterior]])})


def _laplace(job: Job) -> Any:
    """Draw independently from the Gaussian at the mode; that of the noise is of its logarithm."""
    rng, mode = np.random.default_rng(job.seed), job.mode
    shape = job.chains, job.draws
    phi = mode.draws(rng, job.chains * job.draws)
    centre, covariance = mode.noise_gaussian()
    noise = rng.standard_normal((len(phi), len(centre))) @ np.linalg.cholesky(covariance).T
    sigma = np.exp(centre + noise)
    values = mode.problem.named(phi.reshape(*shape, -1), sigma.reshape(*shape, -1))
    return as_trace(job.model, values, {"accept": np.ones(shape)})


def as_trace(model: pm.Model, draws: Mapping[str, Any], stats: Mapping[str, Any]) -> Any:
    """Return a trace in PyMC's form, of draws made without PyMC.

    Parameters
    ----------
    model : pymc.Model
        As made by ``physics_model``; has the dimensions of each variable.
    draws : mapping of str to ndarray
        By the variables' names, shape (chain, draw, ...).
    stats : mapping of str to ndarray
        The sampler's statistics of each draw, shape (chain, draw).
    """
    problem, posterior = model.problem, posterior_dataset(model, draws)
    per_draw = {name: (("chain", "draw"), value) for name, value in stats.items()}
    given = {
        "start": (("transition", "body", "full_state"), problem.segments.start),
        "actions": (("transition", "step", "body", "wrench"), problem.inputs),
    }
    observed = {"next_state": (CELLS, problem.observations.values)}
    return from_groups(
        {
            "posterior": posterior,
            "sample_stats": xr.Dataset(per_draw, {d: posterior[d] for d in ("chain", "draw")}),
            "observed_data": labelled(model, observed),
            "constant_data": labelled(model, given),
        },
        {},
    )


def posterior_dataset(model: pm.Model, values: Mapping[str, Floats]) -> xr.Dataset:
    """Return draws, shape (chain, draw, ...), with the model's dimensions and coordinates."""
    data = {
        name: (("chain", "draw", *(model.named_vars_to_dims.get(name) or ())), value)
        for name, value in values.items()
    }
    chains, draws = next(iter(values.values())).shape[:2]
    return labelled(model, data).assign_coords(chain=np.arange(chains), draw=np.arange(draws))


def labelled(model: pm.Model, variables: Mapping[str, Any]) -> xr.Dataset:
    """Return variables (dims, values) with the model's coordinates of their dimensions."""
    used = {dim for dims, _ in variables.values() for dim in dims if dim in model.coords}
    return xr.Dataset(variables, {dim: list(model.coords[dim]) for dim in used})


#: The samplers by name. The paper's schedule is that of Table 2 for the cart: 30 chains of 20,000
#: iterations, of which the first 1,000 are burnt in and each tenth of the others is kept. (PyMC 2
#: counted the burn-in among the iterations.)
METHODS: Mapping[str, Method] = {
    "importance": Method(_importance, draws=250, tune=0, thin=1),
    "metropolis": Method(_metropolis, draws=800, tune=500, thin=1),
    "paper": Method(_paper, draws=1900, tune=1000, thin=10, chains=30),
    "demetropolisz": Method(_demetropolisz, draws=1000, tune=2000, thin=10),
    "smc": Method(_smc, draws=1000, tune=0, thin=1),
    "nuts": Method(_nuts, draws=500, tune=500, thin=1),
    "laplace": Method(_laplace, draws=250, tune=0, thin=1),
    "map": Method(_map, draws=1, tune=0, thin=1),
}

#: Table 2's schedule for the apartment, whose prior is a library: one chain of 5,000 iterations.
OVER_LIBRARY: Mapping[str, Method] = {
    "paper": Method(_paper, draws=400, tune=1000, thin=10, chains=1),
}
