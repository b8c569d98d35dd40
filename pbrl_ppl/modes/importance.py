"""Adaptive multiple importance sampling: each batch is drawn by what all before taught.

The weights are over the mixture of all batches (Cornuet et al., Scandinavian Journal of Statistics
39, 2012). Pareto k (Vehtari et al., Pareto smoothed importance sampling, 2024) says whether they
suffice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl.state import Floats

ProposalT = TypeVar("ProposalT", bound="Proposal")


class Proposal(Protocol):
    """A density that is drawn from, and learned from the points before."""

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Return n points, shape (n, d)."""

    def log_density(self, q: Floats) -> Floats:
        """Return the log-density at points (n, d), shape (n,)."""

    def learned(self: ProposalT, q: Floats, retained: float) -> ProposalT:
        """Return the proposal of points (n, d); a share ``retained`` of the covariance stays."""


class WeightedPoints(NamedTuple):
    """Points with the logarithm of their importance weights.

    Attributes
    ----------
    q : ndarray
        Shape (n, d).
    log_weight : ndarray
        Of the target over the mixture of all proposals, shape (n,).
    values : ndarray
        What else the target's density gave at each point, shape (n, ...).
    log_z : float
        Logarithm of the target's integral.
    ess : float
        Effective number of points; 0 where fewer than three have any density.
    good : bool
        Whether Pareto k and the effective number suffice.
    """

    q: Floats
    log_weight: Floats
    values: Floats
    log_z: float
    ess: float
    good: bool


def normalised(log_weight: Floats) -> tuple[Floats, float]:
    """Return weights that add up to one, and a Pareto k of zero: it is not estimated."""
    return np.exp(log_weight - logsumexp(log_weight)), 0.0


def adaptive_importance(
    first: ProposalT,
    density: Callable[[Floats], tuple[Floats, Floats]],
    dimension: int,
    rng: np.random.Generator,
    *,
    batch: int,
    enough: float,
    smooth: Callable[[Floats], tuple[Floats, float]] = normalised,
    most_batches: int = 40,
    patient_batches: int = 16,
    trial_batches: int = 6,
    hopeless_share: float = 0.3,
    max_pareto_k: float = 0.7,
) -> tuple[WeightedPoints, ProposalT]:
    """Draw batches until their weights suffice, each from what all before it taught.

    Parameters
    ----------
    first : Proposal
        Of the first batch. A share of its covariance stays, as large as a prior worth a point a
        coordinate has it.
    density : callable
        Takes points (n, d), returns the target's log-density, shape (n,), and what else is kept of
        each point, shape (n, ...).
    dimension : int
        Number of coordinates that are learned.
    rng : Generator
        Source of randomness.
    batch : int
        Points of a batch.
    enough : float
        Effective number of points that suffices.
    smooth : callable
        Takes log-weights, returns weights that add up to one and their Pareto k.
    most_batches : int
        Batches at most.
    patient_batches : int
        Batches after which the number that suffices falls with their number.
    trial_batches : int
        Batches after which it ends without success if, at this pace, less than `hopeless_share` of
        the number that suffices would be reached.
    hopeless_share : float
        See `trial_batches`.
    max_pareto_k : float
        Largest Pareto k that suffices.

    Returns
    -------
    points : WeightedPoints
        All that were drawn.
    last : Proposal
        The last proposal.
    """
    proposals, q = [first], np.zeros((0, 0))
    log_densities, values, best = [], [], 0.0
    for turn in range(1, most_batches + 1):
        drawn = proposals[-1].draw(batch, rng)
        log_density, others = density(drawn)
        log_densities.append(log_density)
        values.append(others)
        q = drawn if turn == 1 else np.concatenate([q, drawn])
        mixture = logsumexp([proposal.log_density(q) for proposal in proposals], axis=0)
        log_weight = np.concatenate(log_densities) - mixture + np.log(turn)
        size, good, there = 0.0, False, np.isfinite(log_weight)
        if there.sum() < 3:
            break
        weight, k = smooth(log_weight[there])
        size = 1.0 / float((weight**2).sum())
        good = k <= max_pareto_k and size >= enough * min(1.0, patient_batches / turn)
        best = max(best, size)
        hopeless = best * most_batches < hopeless_share * enough * turn
        if good or (turn >= trial_batches and hopeless):
            break
        chosen = q[there][systematic(weight, len(q), rng)]
        proposals.append(first.learned(chosen, retained=dimension / (dimension + size)))
    log_z = float(logsumexp(log_weight) - np.log(len(q)))
    points = WeightedPoints(q, log_weight, np.concatenate(values), log_z, size, good)
    return points, proposals[-1]


def systematic(weights: Floats, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return ``n`` indices in increasing order by systematic resampling."""
    ends = np.cumsum(weights)
    indices = np.searchsorted(ends / ends[-1], (rng.uniform() + np.arange(n)) / n)
    return np.minimum(indices, len(weights) - 1)
