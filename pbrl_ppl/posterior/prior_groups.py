"""The prior in a posterior file: draws from it, and its density at the posterior's draws."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.likelihood import Problem, exponential, noise_law
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
    centre, spread = noise_law(problem)
    noise = [Prior("log_normal", mu=float(mu), sigma=spread) for mu in centre]
    steps = exponential(problem)[: len(centre)]
    scale = np.exp(centre) / np.log(2.0)
    # apart from the generator of the predictions
    rng = np.random.default_rng([seed, 1])
    drawn = np.empty(phi.shape)
    for i, prior in enumerate(layout.priors):
        drawn[:, i] = prior.sample(rng, len(phi))
    louder = prior_draws(noise, rng, len(phi))
    louder = np.where(steps, rng.exponential(scale, louder.shape), louder)
    density = np.stack([prior.log_density(sigma[:, i]) for i, prior in enumerate(noise)], axis=1)
    density = np.where(steps, -np.log(scale) - sigma[:, : len(scale)] / scale, density)
    return {
        "prior": _like(problem, posterior, beside(layout, drawn, phi), louder),
        "log_prior": _like(problem, posterior.drop_attrs(), layout.log_prior(phi), density),
    }


def _like(problem: Problem, posterior: xr.Dataset, phi: Array, noise: Array) -> xr.Dataset:
    """Vectors (draw, p) and (draw, parameter) as the variables of the posterior."""
    return xr.Dataset(
        {
            name: posterior[name].copy(data=values.reshape(posterior[name].shape))
            for name, values in problem.named(phi, noise).items()
        }
    )
