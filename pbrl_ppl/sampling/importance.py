"""Importance sampling: proposals from Gaussians, weighted by the engine in batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr
from scipy.stats import Covariance, multivariate_normal

from pbrl_ppl.modes import Mode, Space, WeightedPoints, adaptive_importance, systematic
from pbrl_ppl.parameters import covariance_factor
from pbrl_ppl.posterior import MAX_PARETO_K, smoothed
from pbrl_ppl.state import Floats, Ints


@dataclass(frozen=True, eq=False)
class Mixture:
    """Equally probable Gaussians of some coordinates.

    Parameters
    ----------
    places : ndarray of int
        The coordinates, shape (d,).
    modes : tuple
        At least one of scipy's multivariate normal distributions.
    """

    places: Ints
    modes: tuple[Any, ...]

    @property
    def normals(self) -> int:
        """How many standard normal numbers make a point: one of them chooses among modes."""
        return len(self.places) + (len(self.modes) > 1)

    def at(self, z: Floats) -> Floats:
        """Return the points (n, d) that standard normal numbers (n, normals) make."""
        several = len(self.modes)
        which = np.minimum((ndtr(z[:, -1]) * several).astype(int), several - 1)
        noise = z[:, : len(self.places)]
        of_each = [mode.mean + mode.cov_object.colorize(noise) for mode in self.modes]
        return np.asarray(np.stack(of_each)[which, np.arange(len(z))])

    def log_density(self, x: Floats) -> Floats:
        """Return the log-density at points (n, d), shape (n,)."""
        densities = [np.reshape(mode.logpdf(x), len(x)) for mode in self.modes]
        return np.asarray(logsumexp(densities, axis=0) - np.log(len(densities)))

    def learned(self, x: Floats, wider: float, retained: float) -> Mixture:
        """Return the Gaussian of points (n, d); of several modes, this one.

        The points' covariance is multiplied by ``wider``; a share ``retained`` of the covariance
        stays as it was.
        """
        if len(self.modes) > 1 or len(x) < 3:
            return self
        new = wider * np.atleast_2d(np.cov(x, rowvar=False))
        covariance = (1.0 - retained) * new + retained * self.modes[0].cov
        return replace(self, modes=(_gaussian(x.mean(axis=0), covariance),))


def _gaussian(mean: Floats, covariance: Floats) -> Any:
    """Return a Gaussian that is never singular."""
    return multivariate_normal(mean, Covariance.from_cholesky(covariance_factor(covariance)))


@dataclass(frozen=True, eq=False)
class Reference:
    """A product over independent parts, and the noise, of mixtures of Gaussians about the modes.

    Parameters
    ----------
    space : Space
        Of the points.
    origin : ndarray
        The first mode, shape (d,).
    mixtures : tuple of Mixture
        Of the space's blocks.
    wider : float
        Variance of a Gaussian that draws are proposed from over that of what it stands for.
    """

    space: Space
    origin: Floats
    mixtures: tuple[Mixture, ...]
    wider: float = 1.3

    @classmethod
    def of(cls, space: Space, gaussians: Sequence[tuple[Floats, Floats]]) -> Reference:
        """Return mixtures of Gaussians, each a mean (d,) and a covariance (d, d), made wider.

        Gaussians whose means are within each other's width are one.
        """
        mixtures = []
        for places in space.blocks:
            modes: list[Any] = []
            for mean, covariance in gaussians:
                one = _gaussian(mean[places], cls.wider * covariance[np.ix_(places, places)])
                off = [old.cov_object.whiten(one.mean - old.mean) for old in modes]
                if all((np.abs(each) > 1.0).any() for each in off):
                    modes.append(one)
            mixtures.append(Mixture(places, tuple(modes)))
        return cls(space, gaussians[0][0], tuple(mixtures))

    @classmethod
    def about(cls, space: Space, mode: Mode, cheap: Space) -> Reference:
        """Return the Laplace approximations about a mode and its others.

        ``cheap`` is the space of fewer engine steps, which tells how far off densities fall.
        """
        gaussians = [space.laplace(one) for one in (mode, *mode.others)]
        return cls.of(space, [(mean, cheap.widened(mean, spread)) for mean, spread in gaussians])

    @classmethod
    def of_draws(cls, space: Space, q: Floats) -> Reference:
        """Return the product of Gaussians of a posterior's draws (n, d)."""
        return cls.of(space, [(q.mean(axis=0), np.atleast_2d(np.cov(q, rowvar=False)))])

    @property
    def normals(self) -> int:
        """How many standard normal numbers make a point."""
        return sum(mixture.normals for mixture in self.mixtures)

    def at(self, z: Floats) -> Floats:
        """Return the points (n, d) that standard normal numbers (n, normals) make.

        Uninformed parameters are those of the origin.
        """
        q, first = np.tile(self.origin, (len(z), 1)), 0
        for mixture in self.mixtures:
            q[:, mixture.places] = mixture.at(z[:, first : first + mixture.normals])
            first += mixture.normals
        return q

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Draw n points, uninformed parameters from their prior, shape (n, d)."""
        z = [rng.standard_normal((n, mixture.normals)) for mixture in self.mixtures]
        return self.space.prior_draws(self.at(np.concatenate(z, axis=1)), rng)

    def log_density(self, q: Floats) -> Floats:
        """Return the log-density at points (n, d), shape (n,)."""
        densities = (mixture.log_density(q[:, mixture.places]) for mixture in self.mixtures)
        return sum(densities, np.zeros(len(q)))

    def log_weight(self, z: Floats) -> Floats:
        """Return the logarithm of the posterior over this density at :meth:`at`, shape (n,)."""
        q = self.at(z)
        return self.space.log_density(q) - self.log_density(q)

    def learned(self, q: Floats, retained: float = 0.0) -> Reference:
        """Return the product of Gaussians of points (n, d); of several modes, this one.

        A share ``retained`` of the covariances stays.
        """
        learned = [m.learned(q[:, m.places], self.wider, retained) for m in self.mixtures]
        return replace(self, mixtures=tuple(learned))


def draw_proposals(
    reference: Reference, n: int, seed: Sequence[int], say: Callable[[str], None]
) -> tuple[WeightedPoints, Reference]:
    """Draw weighted proposals for a posterior; return them, and what the last were drawn from.

    Parameters
    ----------
    reference : Reference
        Where particles begin, in the space of the problem.
    n : int
        Proposals that are asked for: about the number of the draws, of which half are independent.
    seed : sequence of int
        Source of the draws.
    say : callable
        Called with how many proposals are effective.
    """
    rng, batch = np.random.default_rng(seed), -(-n // 4)
    space = reference.space
    # batches: the proposals asked for at least, and what log-likelihoods fit in memory at most
    most = int(np.clip(100_000_000 // (batch * space.problem.segments.n), 4, 40))
    return adaptive_importance(
        reference, space.log_densities, len(space.informed), rng, batch=batch, say=say,
        enough=0.5 * n, smooth=smoothed, most_batches=most, max_pareto_k=MAX_PARETO_K,
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
