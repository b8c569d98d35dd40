"""Importance sampling: particles of a cheaper posterior, weighted by the engine in a batch.

Particles begin at Gaussians about the modes and are taken to the posterior of an emulator, or of
few engine steps. The engine evaluates them all at once, and they are resampled by their
Pareto-smoothed weights (Vehtari et al., Pareto smoothed importance sampling, 2024). The weights
correct every error of the cheaper posterior; where Pareto k says that they cannot, particles are
moved on by the engine.
"""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood import TransitionLikelihood
from pbrl_ppl.posterior import smoothed
from pbrl_ppl.sampling.emulator import emulate
from pbrl_ppl.sampling.ensemble import Ensemble, Posterior, Reference, anneal, systematic
from pbrl_ppl.state import Floats

#: Times at which particles of a cheaper posterior are taken as proposals.
_TIMES = 4
#: Measured numbers from which a recording is long: the posterior is near its Laplace approximation.
_LONG = 300_000


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


class Cheaper(NamedTuple):
    """A posterior that costs less than the engine's, a reference for it, and what it is."""

    posterior: Posterior | None
    reference: Reference
    name: str


def cheaper(reference: Reference, rng: np.random.Generator) -> Cheaper:
    """Return an emulator's posterior, or that of few engine steps, corrected at the mode, or none.

    The first that is close, and has fewer engine steps.
    """
    space = reference.space
    problem = space.problem
    corrected = problem.corrected(space.centre)
    if problem.measured.size <= _LONG:
        found = emulate(space, reference, rng)
        if not isinstance(found, str):
            return Cheaper(*found, "an emulator")
    if corrected is not problem:
        return Cheaper(Posterior(space.on(corrected)), reference, "few engine steps")
    return Cheaper(None, reference, "Gaussians at the modes")


def draw_pool(first: Reference, n: int, seed: Any) -> Pool:
    """Draw weighted proposals for a posterior.

    Parameters
    ----------
    first : Reference
        Where particles begin, in the space of the problem.
    n : int
        Proposals.
    seed : int or sequence of int
        Source of the draws.
    """
    rng, space = np.random.default_rng(seed), first.space
    cheap, reference, name = cheaper(first, rng)
    log_z, kept = 0.0, 1.0
    if cheap is None:
        q = reference.draw(n, rng)
    else:
        # along trajectories each particle's noise costs runs of the filter
        whole = isinstance(space.problem.likelihood, TransitionLikelihood)
        times = 1 if whole else _TIMES
        few = Ensemble(reference, reference.draw(-(-n // times), rng), rng)
        reached = anneal(few, reference, cheap)
        taken, alike = [few.q.copy()], []
        for _ in range(times - 1):
            alike.append(few.settle(cheap, looks=2)[1])
            taken.append(few.q.copy())
        # as of chains of so many draws, whose correlation falls geometrically
        lags = np.arange(1, times)
        shared = (np.mean(alike) if alike else 0.0) ** lags @ (1.0 - lags / times)
        kept = reached.kept / float(1.0 + 2.0 * shared)
        log_z, q = reached.log_z, space.prior_draws(np.concatenate(taken)[:n], rng)
    ensemble = Ensemble(reference, q, rng)
    weighed = anneal(ensemble, cheap or reference, Posterior(space), cheap=cheap, weigh=True)
    phi, sigma = space.split(ensemble.q)
    return Pool(
        phi, sigma, weighed.log_weight, weighed.each, log_z + weighed.log_z, weighed.rungs,
        weighed.accepted, weighed.kept if weighed.rungs else kept, name,
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
