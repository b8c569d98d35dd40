"""Importance sampling: proposals from Gaussians, weighted by the engine in batches."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.modes import WeightedPoints, adaptive_importance, systematic
from pbrl_ppl.posterior import MAX_PARETO_K, smoothed
from pbrl_ppl.sampling.ensemble import Reference
from pbrl_ppl.state import Floats


def draw_proposals(
    reference: Reference,
    n: int,
    seed: int | Sequence[int],
    *,
    batches: int = 4,
    effective_share: float = 0.5,
    most_batches: int = 40,
    numbers: int = 100_000_000,
    say: Callable[[str], None] = lambda said: None,
) -> tuple[WeightedPoints, Reference]:
    """Draw weighted proposals for a posterior; return them, and what the last were drawn from.

    Parameters
    ----------
    reference : Reference
        Where particles begin, in the space of the problem.
    n : int
        Proposals that are asked for: about the number of the draws, of which half are independent.
    seed : int or sequence of int
        Source of the draws.
    batches : int
        Batches of the proposals asked for.
    effective_share : float
        Effective share of the proposals asked for that suffices.
    most_batches : int
        Batches at most.
    numbers : int
        Log-likelihoods of transitions that proposals may hold.
    say : callable
        Called with how many proposals are effective.
    """
    rng, batch = np.random.default_rng(seed), -(-n // batches)
    space = reference.space
    most = int(np.clip(numbers // (batch * space.problem.segments.n), batches, most_batches))
    return adaptive_importance(
        reference, space.log_densities, len(space.informed), rng, batch=batch, say=say,
        enough=effective_share * n, smooth=smoothed, most_batches=most, max_pareto_k=MAX_PARETO_K,
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


def stream(seed: int, starts: Sequence[Mapping[str, Floats]]) -> list[int]:
    """Return a seed that also depends on where chains begin, as those of a resumed fit do."""
    begin = b"".join(
        np.asarray(start[name]).tobytes() for start in starts for name in sorted(start)
    )
    return [seed, zlib.crc32(begin)]
