"""The prior in a posterior file: draws from it, and its density at the posterior's draws."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.model import Problem
from pbrl_ppl.parameters import Prior, beside, prior_draws

Array = NDArray[np.float64]


def prior_groups(
    problem: Problem, posterior: xr.Dataset, phi: Array, sigma: Array, seed: int
) -> dict[str, xr.Dataset]:
    """The groups ``prior`` and ``log_prior``, as ArviZ looks for them.

    Both have the posterior's variables, chains and draws, so that what selects from the one selects
    from the other. Wheels are described as in the posterior, where the prior cannot tell their
    descriptions apart.

    Parameters
    ----------
    problem : Problem
        Says what the prior is.
    posterior : Dataset
        Its variables have the dims (chain, draw, ...).
    phi, sigma : ndarray
        Its draws as vectors, shapes (draw, p) and (draw, state).
    seed : int
        Of the draws from the prior.

    Returns
    -------
    dict of str to Dataset
        Empty for a library, and where which bodies a joint joins is unknown: their prior is not one
        of independent numbers.
    """
    layout = problem.layout
    if problem.library is not None or layout.discrete.any():
        return {}
    noise = _noise_priors(problem, posterior)
    # apart from the generator of the predictions
    rng = np.random.default_rng([seed, 1])
    drawn = np.empty(phi.shape)
    for i, prior in enumerate(layout.priors):
        drawn[:, i] = prior.sample(rng, len(phi))
    louder = prior_draws(noise, rng, len(phi))
    density = np.stack([prior.log_density(sigma[:, i]) for i, prior in enumerate(noise)], axis=1)
    return {
        "prior": _like(problem, posterior, beside(layout, drawn, phi), louder),
        "log_prior": _like(problem, posterior.drop_attrs(), layout.log_prior(phi), density),
    }


def _noise_priors(problem: Problem, posterior: xr.Dataset) -> list[Prior]:
    """Of each noise parameter; of a single sigma for all dimensions, one."""
    median, spread = problem.noise_prior
    mu = np.log(median)
    if sum(_width(posterior, name) for name in problem.noise_variables) == 1:
        mu = mu.mean(keepdims=True)
    return [Prior("log_normal", mu=float(each), sigma=spread) for each in mu]


def _width(posterior: xr.Dataset, name: str) -> int:
    """How many numbers a variable has in each draw."""
    return posterior[name].isel(chain=0, draw=0).size


def _like(problem: Problem, posterior: xr.Dataset, phi: Array, noise: Array) -> xr.Dataset:
    """Vectors (draw, p) and (draw, parameter) as the variables of the posterior."""
    named = problem.layout.to_dict(phi)
    begin = 0
    for name in problem.noise_variables:
        end = begin + _width(posterior, name)
        named[name] = noise[:, begin:end]
        begin = end
    return xr.Dataset(
        {
            name: posterior[name].copy(data=values.reshape(posterior[name].shape))
            for name, values in named.items()
        }
    )
