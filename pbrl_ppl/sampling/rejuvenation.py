"""Rejuvenation of a posterior's draws by Metropolis moves, all proposed in one engine call."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Space
from pbrl_ppl.sampling.ensemble import Ensemble, Posterior, Reference
from pbrl_ppl.state import Floats

#: Largest standard deviation of the log-likelihood's error with few engine steps at which several
#: moves under them make one proposal.
_CLOSE = 1.0


def rejuvenate(
    problem: Problem, phi: Floats, sigma: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats, float]:
    """Move draws of a posterior until they have decorrelated.

    A wheel's equal descriptions share their prior evenly here; `redescribed` gives each its own.

    Parameters
    ----------
    problem : Problem
        Problem whose posterior is the target.
    phi, sigma : ndarray
        Equally weighted draws, shapes (particle, p) and (particle, parameter).
    rng : Generator
        Of the moves.

    Returns
    -------
    phi, sigma : ndarray
        Shapes as given.
    accepted : float
        Share of the moves that the posterior accepted.
    """
    problem = problem.with_physics(threads=max(problem.physics.threads, 2))
    space, q = Space.of_draws(problem, phi, sigma)
    ensemble = Ensemble(Reference.of_draws(space, q), q, rng)
    exact, cheap = Posterior(space), Posterior.of_few_steps(space)
    if cheap and (ensemble.heights(cheap)[0] - ensemble.heights(exact)[0]).std() >= _CLOSE:
        cheap = None
    accepted, _ = ensemble.settle(exact, cheap)
    return (*space.split(ensemble.q), accepted)
