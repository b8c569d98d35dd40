"""Importance sampling: proposals from Gaussians about the modes, weighted by the engine in batches.

Where the weights are not good enough after some batches, particles are annealed: weighted,
resampled and moved from the Gaussians to the engine's posterior.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.modes import adaptive_importance, systematic
from pbrl_ppl.posterior import MAX_PARETO_K, smoothed
from pbrl_ppl.sampling.ensemble import Ensemble, Proposals, Reference, anneal
from pbrl_ppl.state import Floats


def draw_proposals(
    reference: Reference,
    n: int,
    seed: Any,
    *,
    batches: int = 4,
    effective_share: float = 0.5,
    most_batches: int = 40,
    numbers: int = 100_000_000,
) -> Proposals:
    """Draw weighted proposals for a posterior.

    Parameters
    ----------
    reference : Reference
        Where particles begin, in the space of the problem.
    n : int
        Proposals that are asked for: about the number of the draws, of which half are independent.
    seed : int or sequence of int
        Source of the draws.
    batches : int
        Batches of the proposals asked for; annealed particles are one batch.
    effective_share : float
        Effective share of the proposals asked for that suffices.
    most_batches : int
        Batches at most.
    numbers : int
        Log-likelihoods of transitions that proposals may hold.
    """
    rng, batch = np.random.default_rng(seed), -(-n // batches)
    space = reference.space
    most = int(np.clip(numbers // (batch * space.problem.segments.n), batches, most_batches))
    points, learned = adaptive_importance(
        reference, space.log_densities, len(space.informed), rng, batch=batch,
        enough=effective_share * n, smooth=smoothed, most_batches=most, max_pareto_k=MAX_PARETO_K,
    )  # fmt: skip
    if points.good:
        return Proposals(points.q, points.log_weight, points.log_z, points.values)
    particles = Ensemble(learned, learned.draw(batch * batches, rng), rng)
    reached = anneal(particles, learned, space)
    return reached._replace(q=space.prior_draws(reached.q, rng))


def resample(
    log_weight: Floats, n: int, rng: np.random.Generator
) -> tuple[NDArray[np.intp], float, float]:
    """Return proposals drawn by their smoothed weights, in random order.

    Parameters
    ----------
    log_weight : ndarray
        Of the proposals, shape (proposal,).
    n : int
        Draws.
    rng : Generator
        Source of randomness.

    Returns
    -------
    chosen : ndarray of int
        Which proposal each draw is, shape (n,).
    k : float
        Pareto k; 0 for equal weights.
    size : float
        Effective sample size of the draws if the proposals are independent; 0, with an infinite k,
        if a weight is infinite or fewer than two are positive.
    """
    weight = np.zeros(len(log_weight))
    there = np.isfinite(log_weight)
    if there.sum() < 2 or np.isposinf(log_weight).any():
        return np.zeros(n, dtype=int), np.inf, 0.0
    if np.ptp(log_weight[there]) == 0.0:
        weight[there], k = 1.0 / there.sum(), 0.0
    else:
        weight[there], k = smoothed(log_weight[there])
    counts = np.bincount(systematic(weight, n, rng), minlength=len(weight))
    # the variance of a mean is that of weighted proposals, and what resampling adds
    added = ((counts / n - weight) ** 2).sum()
    size = min(1.0 / float((weight**2).sum() + added), float(n))
    return rng.permutation(np.repeat(np.arange(len(weight)), counts)), k, size


def stream(seed: int, starts: list[dict[str, Any]]) -> list[int]:
    """Return a seed that also depends on where chains begin, as those of a resumed fit do."""
    begin = b"".join(
        np.asarray(start[name]).tobytes() for start in starts for name in sorted(start)
    )
    return [seed, zlib.crc32(begin)]
