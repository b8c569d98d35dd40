"""Importance sampling: proposals from Gaussians about the modes, weighted by the engine in batches.

Where the weights are not good enough after some batches, particles are annealed: to the posterior
of few engine steps if that is cheaper, from there to the engine's.
"""

from __future__ import annotations

import zlib
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.modes import adaptive_importance, systematic
from pbrl_ppl.posterior import MAX_PARETO_K, smoothed
from pbrl_ppl.sampling.ensemble import (
    Ensemble,
    Path,
    Posterior,
    Reference,
    anneal,
    heights,
    log_densities,
)
from pbrl_ppl.state import Floats

#: The density that was weighted, in words.
_GAUSSIANS, _FEW_STEPS = "Gaussians at the modes", "few engine steps"


class Proposals(NamedTuple):
    """Proposals with the logarithm of their importance weights, and what they predict.

    Attributes
    ----------
    phi, sigma : ndarray
        Shapes (proposal, p) and (proposal, parameter).
    log_weight : ndarray
        Of the posterior over the density they were drawn from, up to a constant, (proposal,).
    log_likelihood : ndarray
        Of each transition, shape (proposal, transition).
    log_evidence : float
        Of the model, without what a mode's Gaussian does not reach.
    rungs : int
        Rungs at which the engine moved particles.
    accepted : float
        Share of those moves that were accepted; 1 without any.
    kept : float
        Independent particles over all that the moves left.
    cheaper : str
        The density that was weighted, in words.
    """

    phi: Floats
    sigma: Floats
    log_weight: Floats
    log_likelihood: Floats
    log_evidence: float
    rungs: int
    accepted: float
    kept: float
    cheaper: str


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
        Batches of the proposals asked for; while particles are annealed, they are one batch.
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
    proposals, reference = adaptive_importance(
        reference, partial(log_densities, Posterior(space)), len(space.loud), rng, batch=batch,
        enough=effective_share * n, smooth=smoothed, most_batches=most, max_pareto_k=MAX_PARETO_K,
    )  # fmt: skip
    if not proposals.good:
        return _annealed(reference, batch, batches, rng)
    return Proposals(
        *space.split(proposals.q), proposals.log_weight, proposals.values, proposals.log_z, 0, 1.0,
        1.0, _GAUSSIANS,
    )  # fmt: skip


def _annealed(
    reference: Reference, batch: int, batches: int, rng: np.random.Generator
) -> Proposals:
    """Return proposals that were taken from Gaussians towards the engine's posterior."""
    space = reference.space
    exact, cheap = Posterior(space), Posterior.of_few_steps(space)
    # the engine is cheap beside the filter of each particle's noise
    alone = space.problem.likelihood.independent
    times = 1 if alone else batches
    particles = Ensemble(reference, reference.draw(batch * batches // times, rng), rng)
    first = None if cheap is None else anneal(particles, reference, cheap)
    start = cheap or reference
    reached = anneal(particles, start, exact, cheap=cheap, weigh=True)
    q, independent = particles.snapshots(Path(start, exact, reached.beta), cheap, times)
    q = space.prior_draws(q, rng)
    height, log_likelihood = log_densities(exact, q)
    with np.errstate(invalid="ignore"):
        left = (1.0 - reached.beta) * (height - heights(space, start, q))
    kept = independent * reached.kept * (1.0 if first is None else first.kept)
    return Proposals(
        *space.split(q), np.where(np.isnan(left), -np.inf, left), log_likelihood,
        reached.log_z + (0.0 if first is None else first.log_z), reached.rungs, reached.accepted,
        kept, _GAUSSIANS if cheap is None else _FEW_STEPS,
    )  # fmt: skip


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
        Number of independent draws of the posterior that the draws are worth if the proposals are
        independent; 0, with an infinite k, if a weight is infinite or fewer than two are positive.
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
