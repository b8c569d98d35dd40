"""Adaptive multiple importance sampling, and the evidence by it.

Each batch is drawn by what all before taught.

The weights are over the mixture of all batches (Cornuet et al., Scandinavian Journal of Statistics
39, 2012). Pareto k (Vehtari et al., Pareto smoothed importance sampling, 2024) says whether they
suffice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import gammaln, logsumexp

from pbrl_ppl.modes.search import Mode
from pbrl_ppl.modes.space import Space
from pbrl_ppl.parameters import covariance_factor
from pbrl_ppl.state import Floats
from pbrl_ppl.system.threads import Say, Work, silent

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
    trial_batches: int = 6,
    max_pareto_k: float = 0.7,
    say: Say = silent,
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
        Effective number of points that suffices; after 16 batches it falls with their number.
    smooth : callable
        Takes log-weights, returns weights that add up to one and their Pareto k.
    most_batches : int
        Batches at most.
    trial_batches : int
        Batches after which it ends without success if, at this pace, less than 0.3 of the number
        that suffices would be reached.
    max_pareto_k : float
        Largest Pareto k that suffices.
    say : callable
        Called with the effective number of points, which may suffice before Pareto k does.

    Returns
    -------
    points : WeightedPoints
        All that were drawn.
    last : Proposal
        The last proposal.
    """
    proposals, q = [first], np.zeros((0, 0))
    log_densities, values, best = [], [], 0.0
    told = f"weighing proposals until {enough:.0f} are effective"
    for turn in range(1, most_batches + 1):
        say(Work(told, int(best), int(enough)))
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
        good = k <= max_pareto_k and size >= enough * min(1.0, 16 / turn)
        best = max(best, size)
        hopeless = best * most_batches < 0.3 * enough * turn
        if good or (turn >= trial_batches and hopeless):
            break
        chosen = q[there][systematic(weight, len(q), rng)]
        proposals.append(first.learned(chosen, retained=dimension / (dimension + size)))
    say(Work(told, int(enough), int(enough)))
    log_z = float(logsumexp(log_weight) - np.log(len(q)))
    points = WeightedPoints(q, log_weight, np.concatenate(values), log_z, size, good)
    return points, proposals[-1]


def systematic(weights: Floats, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return ``n`` indices in increasing order by systematic resampling."""
    ends = np.cumsum(weights)
    indices = np.searchsorted(ends / ends[-1], (rng.uniform() + np.arange(n)) / n)
    return np.minimum(indices, len(weights) - 1)


@dataclass(frozen=True)
class Marginal:
    """Log-evidence with its standard error.

    Parameters
    ----------
    log_z : float
        The log-evidence, in the units of the data's density.
    error : float, optional
        Its standard error by importance sampling; None for the Laplace approximation.
    ess : float, optional
        Effective draws behind it.
    """

    log_z: float
    error: float | None = None
    ess: float | None = None


def laplace(mode: Mode) -> Marginal:
    """Return the Laplace approximation of the evidence, with a Gauss-Newton curvature.

    Parameters
    ----------
    mode : Mode
        Of a problem of continuous parameters.
    """
    space = Space.of(mode)
    centre, covariance = space.laplace(mode)
    informed = space.informed
    log_det = np.linalg.slogdet(2 * np.pi * covariance[np.ix_(informed, informed)])[1]
    return Marginal(float(space.log_density(centre[None])[0] + 0.5 * log_det))


@dataclass(frozen=True, eq=False)
class _StudentT:
    """Student-t proposal of the informed coordinates; the others are drawn from their prior.

    Its tails are heavier than a posterior's, at little cost.
    """

    space: Space
    centre: Floats
    factor: Floats
    nu: float = 8.0

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Return n points, shape (n, d)."""
        radius = np.sqrt(self.nu / rng.chisquare(self.nu, (n, 1)))
        moved = radius * rng.standard_normal((n, len(self.centre))) @ self.factor.T
        q = self.space.prior_draws(np.zeros((n, self.space.size)), rng)
        q[:, self.space.informed] = self.centre + moved
        return q

    def log_density(self, q: Floats) -> Floats:
        """Return the log-density at points (n, d), shape (n,)."""
        d, nu = len(self.centre), self.nu
        off = solve_triangular(self.factor, (q[:, self.space.informed] - self.centre).T, lower=True)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - 0.5 * d * np.log(nu * np.pi)
        log_det = np.log(np.diag(self.factor)).sum()
        return np.asarray(constant - log_det - 0.5 * (nu + d) * np.log1p((off**2).sum(axis=0) / nu))

    def learned(self, q: Floats, retained: float) -> _StudentT:
        """Return the proposal of points (n, d); a share ``retained`` of the covariance stays."""
        q = q[:, self.space.informed]
        covariance = (1.0 - retained) * np.atleast_2d(np.cov(q, rowvar=False))
        covariance += retained * self.factor @ self.factor.T
        return replace(self, centre=q.mean(axis=0), factor=covariance_factor(covariance))


def importance(mode: Mode, rng: np.random.Generator) -> Marginal:
    """Return the evidence by adaptive importance sampling from a Student-t.

    It begins with the Laplace approximation. It sees what is about one mode: other modes, and a
    wheel's other equal descriptions, are left out.

    Parameters
    ----------
    mode : Mode
        Of a problem of continuous parameters.
    rng : Generator
        Source of randomness.
    """
    space = Space.of(mode)
    centre, covariance = space.laplace(mode)
    informed = space.informed
    factor = covariance_factor(covariance[np.ix_(informed, informed)])

    def density(q: Floats) -> tuple[Floats, Floats]:
        return space.log_density(q), np.zeros((len(q), 0))

    # 200 effective draws give the log-evidence to within 0.07
    proposals, _ = adaptive_importance(
        _StudentT(space, centre[informed], factor), density, len(informed), rng, batch=1000,
        enough=200, most_batches=12, trial_batches=12,
    )  # fmt: skip
    error = float(np.sqrt(max(1.0 / max(proposals.ess, 1.0) - 1.0 / len(proposals.q), 0.0)))
    return Marginal(proposals.log_z, error, proposals.ess)
