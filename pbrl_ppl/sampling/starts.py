"""Where chains begin: about a mode, at a posterior's last draws, or anywhere in the prior."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode, Space, library_of
from pbrl_ppl.posterior import Idata, group, parameter_draws
from pbrl_ppl.state import Floats


def dispersed(
    mode: Mode, rng: np.random.Generator, chains: int, *, away: float = 2.0
) -> list[dict[str, Floats]]:
    """Draw starts about two posterior standard deviations from the mode, one a chain.

    ``away``: distance from the mode in posterior standard deviations.
    """
    space = Space.of(mode)
    mean, covariance = space.laplace(mode)
    factor = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
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


def prior_starts(problem: Problem, rng: np.random.Generator, chains: int) -> list[dict[str, Any]]:
    """Draw starts of chains over a library: each owner's set from the prior, the median sigma."""
    library = library_of(problem)
    median = problem.noise_prior[0]
    sigma = np.exp(np.log(median).mean()) if problem.likelihood.scalar else median
    laws = [library.prior(owner) for owner in problem.scene.owners]
    return [
        {"library_index": np.array([rng.choice(len(p), p=p) for p in laws]), "sigma": sigma}
        for _ in range(chains)
    ]
