"""Importance sampling: proposals from Gaussians about the modes, weighted by the engine in batches.

Where the weights are not good enough after some batches, particles are annealed from the Gaussians
to the engine's posterior by a sequential Monte Carlo sampler (Del Moral, Doucet and Jasra, 2006):
weighted, resampled and rejuvenated by Metropolis moves at temperatures of a geometric path, which
their effective sample size sets.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl.errors import FitError
from pbrl_ppl.modes import Space, adaptive_importance, systematic
from pbrl_ppl.posterior import MAX_PARETO_K, smoothed
from pbrl_ppl.sampling.ensemble import MAX_CHECKS, Ensemble, Reference, Target, groups
from pbrl_ppl.state import Floats


class Proposals(NamedTuple):
    """Proposals with the logarithm of their importance weights.

    Attributes
    ----------
    q : ndarray
        Shape (n, d).
    log_weight : ndarray
        Of the posterior over the density they are from, up to a constant, shape (n,).
    log_z : float
        Logarithm of the posterior's integral: the evidence, without what a mode's Gaussian does not
        reach.
    log_likelihood : ndarray, optional
        Of each transition, shape (n, transition), where it is known.
    tempering_steps : int
        Temperatures at which the engine moved particles.
    accepted : float
        Share of those moves that were accepted; 1 without any.
    independent_share : float
        Share of the particles that the moves left independent.
    """

    q: Floats
    log_weight: Floats
    log_z: float
    log_likelihood: Floats | None = None
    tempering_steps: int = 0
    accepted: float = 1.0
    independent_share: float = 1.0


def draw_proposals(
    reference: Reference,
    n: int,
    seed: int | Sequence[int],
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


class Tempered:
    """Geometric path from Gaussians to a density, at a share ``beta`` of the way, above 0."""

    def __init__(self, start: Reference, end: Target, beta: float) -> None:
        self.start, self.end, self.beta = start, end, beta

    def evaluate(self, q: Floats) -> Floats:
        """Evaluate the density at the end of the path; Gaussians need no engine."""
        return self.end.evaluate(q)

    def columns(self, q: Floats, values: Floats) -> Floats:
        """Return the weighted mean of both, shape (n, part + 1)."""
        end = self.end.columns(q, values)
        if self.beta == 1:
            return end
        with np.errstate(invalid="ignore"):
            both = (1.0 - self.beta) * self.start.columns(q) + self.beta * end
        return np.where(np.isneginf(end), -np.inf, both)


def anneal(
    ensemble: Ensemble, start: Reference, end: Target, *, worth: float = 0.4, most: int = 60
) -> Proposals:
    """Take particles of Gaussians to a density, in place, until weights suffice for what remains.

    A weight is for what remains of the path: 0 at its end.

    Parameters
    ----------
    ensemble : Ensemble
        Independent particles of ``start``.
    start : Reference
        The Gaussians.
    end : Target
        Log-density of the end.
    worth : float
        Effective share of the particles that weights must leave to end with them.
    most : int
        Tempering steps at most.
    """
    beta, log_z, independent_share = 0.0, 0.0, 1.0
    rates: list[float] = []
    while True:
        with np.errstate(invalid="ignore"):
            gap = _log_densities(ensemble.space, end, ensemble.q) - start.log_density(ensemble.q)
        gap = np.where(np.isnan(gap), -np.inf, gap)
        if np.isneginf(gap).all():
            raise FitError(
                f"fit: the model gives none of {len(gap)} draws about its mode a density; start"
                " from another mode, or use the method 'laplace'"
            )
        rest = (1.0 - beta) * gap if beta < 1.0 else np.zeros_like(gap)
        if beta == 1.0 or len(rates) == most or _suffices(rest, worth):
            log_z += float(logsumexp(rest) - np.log(len(rest)))
            accepted = float(np.mean(rates)) if rates else 1.0
            return Proposals(ensemble.q, rest, log_z, None, len(rates), accepted, independent_share)
        step = _step(gap, 1.0 - beta)
        total = logsumexp(step * gap)
        log_z += float(total - np.log(len(gap)))
        beta = 1.0 if step == 1.0 - beta else beta + step
        chosen = systematic(np.exp(step * gap - total), len(gap), ensemble.rng)
        ensemble.q = ensemble.q[chosen]
        ensemble.learn()
        max_checks = MAX_CHECKS if beta == 1.0 else 1  # the next step moves on
        rate, correlation = ensemble.settle(Tempered(start, end, beta), max_checks)
        rates.append(rate)
        # copies of a particle are as alike as each is to where they began, squared
        copies = np.bincount(chosen).astype(float)
        independent_share = len(gap) / float(
            (copies + copies * (copies - 1) * correlation**2).sum()
        )


def _suffices(log_weight: Floats, worth: float) -> bool:
    """Return whether weights leave an effective share ``worth``, without a heavy tail."""
    if not np.isfinite(log_weight).sum() > 2:
        return False
    weight, k = smoothed(log_weight[np.isfinite(log_weight)])
    return bool(k <= MAX_PARETO_K and 1.0 / (weight**2).sum() >= worth * len(log_weight))


def _step(gap: Floats, most: float, *, effective_share: float = 0.5) -> float:
    """Return the largest step of a path that leaves enough effective particles.

    ``effective_share``: effective share of the particles that a step leaves.
    """

    def share(step: float) -> float:
        weight = np.exp(step * gap - logsumexp(step * gap))
        return float(1.0 / (weight**2).sum() / len(gap))

    if share(most) >= effective_share:
        return most
    low, high = 0.0, most
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if share(middle) >= effective_share else (low, middle)
    return max(low, 1e-6 * most)


def _log_densities(space: Space, target: Target, q: Floats) -> Floats:
    """Return the log-density of all particles (n, d), shape (n,)."""
    parts = (q[chosen] for chosen in groups(space, len(q)))
    return np.concatenate([target.columns(x, target.evaluate(x)).sum(axis=1) for x in parts])


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
