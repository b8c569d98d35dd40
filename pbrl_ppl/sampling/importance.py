"""Importance sampling: proposals from an emulator's posterior, weighted by the engine in one batch.

A chain spends its time between engine calls. Here many walkers move together under the posterior of
an emulator, the engine evaluates all their ends at once, and they are resampled by their
Pareto-smoothed weights (Vehtari et al., Pareto smoothed importance sampling, 2024). The weights
correct every error of the emulator; Pareto k says whether its tails are wide enough for that.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood, exponential, log_noise_prior
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import evened, inside, wheels
from pbrl_ppl.posterior import smoothed
from pbrl_ppl.sampling.emulator import FLATTER, Emulator, Pieces, errors, monomials, spread
from pbrl_ppl.sampling.metropolis import TARGET_ACCEPTANCE, Gaussian
from pbrl_ppl.sampling.starts import constrain, laplace, noise_block, unconstrain
from pbrl_ppl.state import Bools, Floats

#: Pareto k of the weights above which proposals miss a part of the posterior.
MAX_PARETO_K = 0.7
#: Standard deviation of the emulator's error in the log-likelihood at which a fit ends, and the
#: largest of a usable emulator.
_CLOSE, _ENOUGH = 0.7, 2.0
#: Engine runs a coefficient of the emulator, at least; rounds of them.
_A_COEFFICIENT, _LEAST, _ROUNDS = 4, 160, 6
#: Largest number of coefficients of an emulator that is not linear.
_MOST = 250
#: Sweeps of the walkers between two fits and between two looks at whether they drift, and looks. In
#: so many sweeps a walker of a cart's posterior forgets four fifths of where it was.
_SWEEPS, _LOOKS = 3, 8
#: Walkers' means may differ by this many standard errors between two looks.
_DRIFT = 3.5
#: Noise that may vanish is a power of its coordinate.
_ROOT = 3.0
#: Half of an emulator's runs are this many times as far from the walkers' mean.
_FARTHER = 1.4
#: Variance of proposals over that of the walkers: a walker in a tail moves on.
_WIDER = 1.3
#: A parameter whose derivative is below this in units of noise over its prior is not informed.
_SILENT = 1e-3
#: Measured numbers from which a recording is long: the posterior is near its Laplace approximation.
_LONG = 300_000
#: Numbers of the filter's gains that are kept at once, and of residuals.
_NUMBERS = 8_000_000


@dataclass(frozen=True, eq=False)
class Space:
    """Space of a problem: its transformed parameters, then the noise, in which it is near normal.

    Measurement noise is by its logarithm. Unexplained accelerations and correlated errors, which
    may vanish, are by their cube root (E. B. Wilson and M. M. Hilferty, The distribution of
    chi-square, 1931).

    Parameters
    ----------
    problem : Problem
        Without joints of unknown bodies and without a library.
    """

    problem: Problem

    @cached_property
    def roots(self) -> Bools:
        """Which noise parameters are by their cube root, shape (free,)."""
        free = self.problem.likelihood.free(exponential(self.problem).astype(float))
        return np.asarray(free, dtype=bool)

    def noise(self, log_sigma: Floats) -> Floats:
        """Return the coordinates of free noise parameters, given their logarithm, (..., free)."""
        return np.where(self.roots, np.exp(log_sigma / _ROOT), log_sigma)

    def split(self, q: Floats) -> tuple[Floats, Floats]:
        """Return phi, shape (..., p), and sigma, shape (..., parameter), at points (..., d)."""
        problem = self.problem
        priors, p = problem.layout.priors, problem.layout.size
        with np.errstate(over="ignore"):
            columns = [constrain(prior, q[..., i]) for i, prior in enumerate(priors)]
            noise = q[..., p:]
            sigma = np.where(self.roots, np.abs(noise) ** _ROOT, np.exp(noise))
        phi = np.stack(columns, axis=-1) if columns else q[..., :0]
        return phi, np.broadcast_to(sigma, (*sigma.shape[:-1], len(problem.noise_prior[0])))

    def log_prior(self, q: Floats, but: Bools | None = None) -> Floats:
        """Return the log-density of the prior in this space, shape (...).

        A wheel's equal descriptions share their prior evenly; see `parameters.evened`. ``but`` are
        parameters that do not count, shape (p,).
        """
        problem = self.problem
        priors, p = problem.layout.priors, problem.layout.size
        phi = self.split(q)[0]
        with np.errstate(all="ignore"):
            slopes = [unconstrain(prior, phi[..., i])[1] for i, prior in enumerate(priors)]
            density = problem.layout.log_prior(phi) + evened(problem.layout, phi)
            density -= np.moveaxis(np.log(np.abs(slopes)), 0, -1) if slopes else 0.0
            density = density.sum(axis=-1, where=True if but is None else ~but)
            noise = q[..., p:]
            log_sigma = np.where(self.roots, _ROOT * np.log(noise), noise)
            # the density of a root, from that of the logarithm
            slope = np.where(self.roots, np.log(_ROOT / noise), 0.0).sum(axis=-1)
            total = density + log_noise_prior(problem, log_sigma) + slope
        return np.where(np.isfinite(total), total, -np.inf)


class Pool(NamedTuple):
    """Independent proposals with the logarithm of their importance weights, and what they predict.

    Parameters
    ----------
    phi, sigma : ndarray
        Shapes (proposal, p) and (proposal, parameter).
    log_weight : ndarray
        Of the posterior over the density they were drawn from, up to a constant, (proposal,).
    log_likelihood : ndarray
        Of each transition, shape (proposal, transition).
    """

    phi: Floats
    sigma: Floats
    log_weight: Floats
    log_likelihood: Floats


def _not_keeping(n: int) -> AbstractContextManager[None]:
    """Return a context without effect."""
    return nullcontext()


class Walkers:
    """Points that move together under the posterior of an emulator.

    Parameters
    ----------
    space : Space
        Where they move.
    emulator : Emulator
        Predicts the residuals.
    blocks : list of Gaussian
        Entries that move together: of the parameters, and of the noise.
    q : ndarray
        The points, shape (walker, d).
    rng : Generator
        Source of randomness.
    """

    def __init__(
        self,
        space: Space,
        emulator: Emulator,
        blocks: list[Gaussian],
        q: Floats,
        rng: np.random.Generator,
    ) -> None:
        self.space, self.emulator, self.blocks, self.rng = space, emulator, blocks, rng
        self.q = q.copy()

    def likelihood(self, q: Floats) -> Floats:
        """Return the emulated log-likelihood at points (walker, d), shape (walker,)."""
        phi, sigma = self.space.split(q)
        problem = self.space.problem
        value = problem.log_density(self.emulator.batch(phi), sigma, phi).sum(axis=-1)
        return np.where(np.isnan(value), -np.inf, value)

    def density(self, q: Floats) -> Floats:
        """Return the log-density that the walkers move under, shape (walker,)."""
        prior = self.space.log_prior(q)
        value, there = np.full(len(q), -np.inf), np.isfinite(prior)
        if there.any():
            value[there] = prior[there] + FLATTER * self.likelihood(q[there])
        return value

    def sweep(self, rounds: int) -> None:
        """Move every block this many times; chunks of walkers keep their filters' gains."""
        problem = self.space.problem
        size = problem.measured.size
        keeping: Callable[[int], AbstractContextManager[None]] = _not_keeping
        if isinstance(problem.likelihood, TrajectoryLikelihood):
            noise = problem.trajectory_noise
            size, keeping = size * len(noise.cells.places), noise.memory.keeping
        width = max(8, _NUMBERS // max(size, 1))
        with keeping(2 * width):
            for first in range(0, len(self.q), width):
                chosen = slice(first, first + width)
                self.q[chosen] = self._moved(self.q[chosen], rounds)

    def _moved(self, q: Floats, rounds: int) -> Floats:
        """Return points after some sweeps."""
        here = self.density(q)
        for i in range(rounds):
            for block in self.blocks:
                if not len(block.places):
                    continue
                there, correction = q.copy(), 0.0
                walk = i % 3 == 2
                there[:, block.places], correction = block.propose(
                    q[:, block.places], walk, self.rng
                )
                new = self.density(there)
                with np.errstate(invalid="ignore"):
                    ratio = np.nan_to_num(new - here + correction, nan=-np.inf)
                rate = np.exp(np.minimum(ratio, 0.0))
                taken = self.rng.uniform(size=len(q)) < rate
                q = np.where(taken[:, None], there, q)
                here = np.where(taken, new, here)
                change = float(rate.mean()) - TARGET_ACCEPTANCE
                if walk:
                    block.lengthen(change, walk)
                else:  # up to draws that forget where they were
                    block.log_beta = min(block.log_beta + change, 0.0)
        return q

    def settle(self) -> bool:
        """Move until the walkers' means no longer drift; return whether they came to rest."""
        for _ in range(_LOOKS):
            before = self.q.copy()
            self.sweep(_SWEEPS)
            change = self.q - before
            error = change.std(axis=0) / np.sqrt(len(change)) + 1e-300
            if (np.abs(change.mean(axis=0)) < _DRIFT * error).all():
                return True
        return False


def silent(mode: Mode) -> Bools:
    """Return the mask of parameters of which the data say nothing: their posterior is the prior.

    A wheel's parameters are never among them, for its prior is not one of independent numbers.
    """
    problem = mode.problem
    # the sigma of a log-normal prior is that of the logarithm
    scale = np.array(
        [
            prior.sigma * (x if prior.family == "log_normal" else 1.0)
            for prior, x in zip(problem.layout.priors, mode.phi, strict=True)
        ]
    )
    size = np.sqrt((mode.jacobian**2).sum(axis=0)) * np.nan_to_num(scale, nan=1.0)
    mask = (size < _SILENT) & bool(mode.jacobian.any())
    for wheel in wheels(problem.layout):
        mask[list(wheel.places)] = False
    mask[list(problem.tails)] = False
    return np.asarray(mask)


def unsuited(mode: Mode) -> str:
    """Return why no emulator's posterior can stand for a mode's; empty if one can."""
    problem = mode.problem
    if mode.others:
        return "the posterior has several modes"
    if len(problem.simulator.parts) > 1:
        return "the scene has several independent parts"
    if len(Pieces.of(problem).rows):
        return "bodies touch"
    return ""


def draw_pool(mode: Mode, n: int, seed: Any, threads: int) -> tuple[Pool | None, str]:
    """Draw independent proposals for a posterior, and evaluate them by the engine.

    Parameters
    ----------
    mode : Mode
        The first engine runs are drawn from its Laplace approximation.
    n : int
        Proposals.
    seed : int or sequence of int
        Source of the draws.
    threads : int
        Of the engine.

    Returns
    -------
    pool : Pool or None
        None where no emulator is close enough.
    why : str
        Why there is none.
    """
    rng = np.random.default_rng(seed)
    problem = mode.problem.with_physics(threads=threads)
    space, quiet = Space(problem), silent(mode)
    if problem.measured.size > _LONG:
        return _from_gaussians(mode, space, quiet, n, rng), ""
    fitted = _emulate(mode, space, quiet, rng)
    if isinstance(fitted, str):
        return None, fitted
    walkers, prior = fitted, _PriorDraws(space, quiet)
    walkers.q = walkers.q[np.arange(n) % len(walkers.q)]
    walkers.sweep(2 * _SWEEPS)
    if not walkers.settle():
        return None, "the proposals still drift"
    q = prior.filled(walkers.q, rng)
    phi, sigma, exact = _evaluated(space, q)
    likelihood = np.concatenate([walkers.likelihood(part) for part in np.array_split(q, 8)])
    return Pool(phi, sigma, exact.sum(axis=1) - FLATTER * likelihood, exact), ""


def _from_gaussians(
    mode: Mode, space: Space, quiet: Bools, n: int, rng: np.random.Generator
) -> Pool:
    """Return proposals from the widened Laplace approximations, to which long recordings come."""
    loud, sensors, _, steps = _blocks(mode, space.problem.rough, np.flatnonzero(~quiet))
    q = np.zeros((n, len(quiet) + len(space.roots)))
    log_density = np.zeros(n)
    for block in (loud, sensors, steps):
        noise = rng.standard_normal((n, len(block.places)))
        q[:, block.places] = block.mean + np.sqrt(_WIDER) * noise @ block.factor.T
        log_density -= 0.5 * (noise**2).sum(axis=1)
    q = _PriorDraws(space, quiet).filled(q, rng)
    phi, sigma, exact = _evaluated(space, q)
    height = exact.sum(axis=1) + space.log_prior(q, but=quiet)
    return Pool(phi, sigma, height - log_density, exact)


def _emulate(mode: Mode, space: Space, quiet: Bools, rng: np.random.Generator) -> Walkers | str:
    """Return walkers under the posterior of an emulator, or why there is none.

    Each round adds engine runs, with few substeps, where the walkers of the round before are.
    """
    problem, rough = space.problem, space.problem.rough
    blocks = _blocks(mode, rough, np.flatnonzero(~quiet))
    pieces = Pieces.of(rough).without(np.flatnonzero(quiet))
    widest = max((len(piece.places) for piece in pieces.emulated), default=0)
    degree = 2 if _terms(widest, 2) <= _MOST else 1
    half = max(_LEAST, _A_COEFFICIENT * _terms(widest, degree)) // 2
    prior, entries = _PriorDraws(space, quiet), len(space.roots)
    q = prior.filled(np.zeros((half, len(quiet) + entries)), rng)
    for block in blocks:
        noise = rng.standard_normal((half, len(block.places)))
        q[:, block.places] = block.mean + noise @ block.factor.T
    runs: list[tuple[Floats, Floats]] = []
    walkers: Walkers | None = None

    def fit() -> Emulator:
        phi, residual = (np.concatenate(each) for each in zip(*runs[-2:], strict=True))
        return Emulator(pieces, phi, residual, degree)

    off = np.inf
    for _ in range(_ROUNDS + 1):
        drawn, sigma = space.split(q)
        phi = spread(problem, inside(problem.layout.priors, drawn), _FARTHER)
        residual = rough.residual(phi)
        if walkers:  # judge the emulator of the round before, where its walkers are
            both = np.concatenate([sigma, sigma])
            exact = problem.log_density(residual, both, phi).sum(axis=-1)
            emulated = problem.log_density(walkers.emulator.batch(phi), both, phi).sum(axis=-1)
            off = float(errors(emulated, exact, half).std())
        good = np.asarray(np.isfinite(residual).all(axis=(1, 2, 3, 4)))
        if good.sum() < 0.5 * len(phi):
            return "the engine diverges about the mode"
        runs.append((phi[good], residual[good]))
        walkers = Walkers(space, fit(), blocks, q, rng)
        if off < _CLOSE:
            break
        walkers.sweep(_SWEEPS)
        q = prior.filled(walkers.q, rng)
        blocks = [_learned(block, q) for block in blocks]
    if walkers is None or not off < _ENOUGH:
        return f"the emulator's log-likelihood is off by {off:.2g} nats"
    if rough.physics != problem.physics:
        few = np.flatnonzero(good[:half])[: 3 * (widest + 1)]
        walkers.emulator.correct(phi[few], problem.residual(phi[few]) - residual[few])
    return walkers


def _terms(parameters: int, degree: int) -> int:
    """Return the number of terms of a polynomial."""
    return monomials(np.zeros(parameters), degree).size


class _PriorDraws:
    """Draws of the parameters that the data do not inform."""

    def __init__(self, space: Space, quiet: Bools) -> None:
        self.priors = space.problem.layout.priors
        self.places = np.flatnonzero(quiet)

    def filled(self, q: Floats, rng: np.random.Generator) -> Floats:
        """Return points with these parameters drawn from their prior."""
        q = q.copy()
        for place in self.places:
            prior = self.priors[place]
            drawn = inside([prior], prior.sample(rng, len(q))[:, None])[:, 0]
            q[:, place] = unconstrain(prior, drawn)[0]
        return q


def _blocks(mode: Mode, rough: Problem, loud: Any) -> list[Gaussian]:
    """Return the Laplace approximations of informed parameters and of the noise."""
    mean, covariance = laplace(rough, mode)
    noise_mean, noise_covariance = noise_block(mode)
    entries = len(mean) + np.arange(len(noise_mean))
    sensors, steps = entries, entries[:0]
    if isinstance(mode.problem.likelihood, TrajectoryLikelihood):
        n = len(mode.problem.trajectory_noise.cells.sensors)
        sensors, steps = entries[:n], entries[n:]
    mean = np.concatenate([mean, noise_mean])
    covariance = block_diag(covariance, noise_covariance)
    space = Space(mode.problem)
    mean[entries] = space.noise(noise_mean)
    slope = np.ones(len(mean))
    slope[entries] = np.where(space.roots, mean[entries] / _ROOT, 1.0)
    covariance = slope[:, None] * covariance * slope
    blocks = (loud, sensors, loud, steps)  # a move of the parameters costs no run of the filter
    return [Gaussian(own, mean[own], covariance[np.ix_(own, own)]) for own in blocks]


def _learned(block: Gaussian, q: Floats) -> Gaussian:
    """Return a block with mean and covariance of the walkers, and the step sizes it had."""
    if not len(block.places):
        return block
    x = q[:, block.places]
    covariance = np.atleast_2d(np.cov(x, rowvar=False))
    ridge = 1e-9 * np.diag(np.diag(covariance))
    learned = Gaussian(block.places, x.mean(axis=0), _WIDER * covariance + ridge)
    learned.log_scale, learned.log_beta = block.log_scale, block.log_beta
    return learned


def _evaluated(space: Space, q: Floats) -> tuple[Floats, Floats, Floats]:
    """Return parameters, noise, and the engine's log-likelihoods (proposal, transition)."""
    problem = space.problem
    phi, sigma = space.split(q)
    exact = np.empty((len(q), problem.segments.n))
    width = max(16, _NUMBERS // max(problem.measured.size, 1))
    for first in range(0, len(q), width):
        chosen = slice(first, first + width)
        residual = problem.residual(phi[chosen])
        exact[chosen] = problem.log_density(residual, sigma[chosen], phi[chosen])
    return phi, sigma, exact


def systematic(weights: Floats, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return ``n`` indices in increasing order by systematic resampling."""
    ends = np.cumsum(weights)
    indices = np.searchsorted(ends / ends[-1], (rng.uniform() + np.arange(n)) / n)
    return np.minimum(indices, len(weights) - 1)


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
        Pareto k.
    size : float
        Number of independent draws of the posterior that the draws are worth if the proposals are
        independent; 0, with an infinite k, if a weight is infinite or fewer than two are positive.
    """
    weight = np.zeros(len(log_weight))
    there = np.isfinite(log_weight)
    if there.sum() < 2 or np.isposinf(log_weight).any():
        return np.zeros(n, dtype=int), np.inf, 0.0
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
