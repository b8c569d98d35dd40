"""Importance sampling: proposals from Gaussians about the modes, weighted by the engine in batches.

Each batch of proposals is drawn from Gaussians that all before it taught. Where the weights are not
good enough after some of them, particles are annealed: to the posterior of few engine steps if that
is cheaper, from there to the engine's. Pareto k (Vehtari et al., Pareto smoothed importance
sampling, 2024) says whether weights suffice.
"""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl.posterior import MAX_PARETO_K, smoothed
from pbrl_ppl.sampling.ensemble import Ensemble, Path, Posterior, Reference, anneal, systematic
from pbrl_ppl.state import Floats

#: Batches of the proposals asked for; while particles are annealed, they are one batch.
_BATCHES = 4
#: Effective share of the proposals asked for that suffices; after so many batches it falls with
#: their number, and they end.
_ENOUGH, _PATIENT, _MOST = 0.5, 16, 40
#: Share of that which must be in sight after so many batches; otherwise annealing is faster.
_IN_SIGHT, _TRIAL = 0.3, 6
#: Log-likelihoods of transitions that proposals may hold.
_NUMBERS = 100_000_000
_GAUSSIANS, _FEW_STEPS = "Gaussians at the modes", "few engine steps"


class Pool(NamedTuple):
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


def draw_pool(reference: Reference, n: int, seed: Any) -> Pool:
    """Draw weighted proposals for a posterior.

    Parameters
    ----------
    reference : Reference
        Where particles begin, in the space of the problem.
    n : int
        Proposals that are asked for: about the number of the draws, of which half are independent.
    seed : int or sequence of int
        Source of the draws.
    """
    rng, batch = np.random.default_rng(seed), -(-n // _BATCHES)
    pool, reference = _adaptive(reference, _ENOUGH * n, batch, rng)
    return _annealed(reference, batch, rng) if pool is None else pool


def _adaptive(
    first: Reference, enough: float, batch: int, rng: np.random.Generator
) -> tuple[Pool | None, Reference]:
    """Return proposals from Gaussians, if enough are independent, and what they taught.

    The weights are over the mixture of all batches (adaptive multiple importance sampling: Cornuet
    et al., Scandinavian Journal of Statistics 39, 2012). A share of the first covariance stays, as
    large as a prior worth a draw a coordinate has it.
    """
    space, references, q = first.space, [first], np.zeros((0, len(first.origin)))
    exact, heights, likelihoods = Posterior(space), [], []
    best = 0.0
    most = int(np.clip(_NUMBERS // (batch * space.problem.segments.n), _BATCHES, _MOST))
    for turn in range(1, most + 1):
        particles = Ensemble(first, references[-1].draw(batch, rng), rng)
        height, each = particles.heights(exact, each=True)
        heights.append(height)
        likelihoods.append(each)
        q = np.concatenate([q, particles.q])
        mixture = logsumexp([one.columns(q, None).sum(axis=1) for one in references], axis=0)
        log_weight = np.concatenate(heights) - mixture + np.log(turn)
        there = np.isfinite(log_weight)
        if there.sum() < 3:
            break
        weight, k = smoothed(log_weight[there])
        size = 1.0 / float((weight**2).sum())
        if k <= MAX_PARETO_K and size >= enough * min(1.0, _PATIENT / turn):
            evidence = float(logsumexp(log_weight) - np.log(len(q)))
            pool = Pool(
                *space.split(q), log_weight, np.concatenate(likelihoods), evidence, 0, 1.0, 1.0,
                _GAUSSIANS,
            )  # fmt: skip
            return pool, references[-1]
        best = max(best, size)
        if turn >= _TRIAL and best * most < _IN_SIGHT * enough * turn:
            break
        chosen = q[there][systematic(weight, len(q), rng)]
        references.append(first.learned(chosen, kept=len(space.loud) / (len(space.loud) + size)))
    return None, references[-1]


def _annealed(reference: Reference, batch: int, rng: np.random.Generator) -> Pool:
    """Return proposals that were taken from Gaussians towards the engine's posterior."""
    space = reference.space
    exact, cheap = Posterior(space), Posterior.of_few_steps(space)
    # the engine is cheap beside the filter of each particle's noise
    alone = space.problem.likelihood.independent
    times = 1 if alone else _BATCHES
    particles = Ensemble(reference, reference.draw(batch * _BATCHES // times, rng), rng)
    first = None if cheap is None else anneal(particles, reference, cheap)
    start = cheap or reference
    reached = anneal(particles, start, exact, cheap=cheap, weigh=True)
    q, independent = particles.snapshots(Path(start, exact, reached.beta), cheap, times)
    proposals = Ensemble(reference, space.prior_draws(q, rng), rng)
    height, each = proposals.heights(exact, each=True)
    with np.errstate(invalid="ignore"):
        left = (1.0 - reached.beta) * (height - proposals.heights(start)[0])
    kept = independent * reached.kept * (1.0 if first is None else first.kept)
    return Pool(
        *space.split(proposals.q), np.where(np.isnan(left), -np.inf, left), each,
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
