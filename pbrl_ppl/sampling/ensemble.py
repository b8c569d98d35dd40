"""Ensemble of particles: Gaussians about the modes, and Metropolis moves of many at once.

All particles move together: one engine batch a sweep, accepted for each independent part by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from pbrl_ppl.likelihood import is_independent
from pbrl_ppl.modes import Mode, Space
from pbrl_ppl.parameters import covariance_factor
from pbrl_ppl.state import Bools, Floats, Ints

#: Best acceptance rate of a random walk in many dimensions (Roberts, Gelman and Gilks, 1997).
TARGET_ACCEPTANCE = 0.234
#: Variance of a Gaussian that draws are proposed from over that of what it stands for.
_WIDER = 1.3


class Target(Protocol):
    """A log-density of particles, in columns: one a part of the scene, the last of the noise.

    A space is one, of its problem's posterior.
    """

    def evaluate(self, q: Floats) -> Floats:
        """Return what is expensive at particles (n, d), and does not depend on the noise."""

    def columns(self, q: Floats, values: Floats) -> Floats:
        """Return the log-density of each part and of the noise, shape (n, part + 1)."""


class _Gaussian(NamedTuple):
    """A Gaussian by its mean (d,), Cholesky factor (d, d) and the inverse of that."""

    mean: Floats
    factor: Floats
    inverse: Floats

    def standardised(self, x: Floats) -> Floats:
        """Return points (n, d) in units of this Gaussian, same shape."""
        return np.asarray((x - self.mean) @ self.inverse.T)

    def log_density(self, x: Floats) -> Floats:
        """Return the log-density at points (n, d), shape (n,)."""
        z = self.standardised(x)
        constant = np.log(np.diag(self.factor)).sum() + 0.5 * z.shape[1] * np.log(2 * np.pi)
        return np.asarray(-0.5 * (z**2).sum(axis=1) - constant)


@dataclass(eq=False)
class Block:
    """Coordinates that move together: a mixture of Gaussians about the modes, and its moves.

    Three proposals take turns: a random walk, which finds its way anywhere; a Crank-Nicolson step
    that is reversible for the Gaussian (Rudolf and Sprungk, 2018), which makes large moves where
    the posterior is close to one; and between modes a jump that keeps the point's place in units of
    the mode's Gaussian (Tjelmeland and Hegstad, 2001, without their local search).

    Parameters
    ----------
    places : ndarray of int
        The coordinates, shape (d,).
    modes : sequence of _Gaussian
        At least one.
    """

    places: Ints
    modes: Sequence[_Gaussian]
    step: Floats = field(init=False)
    log_scale: float = field(init=False)
    log_beta: float = float(np.log(0.6))

    def __post_init__(self) -> None:
        """Start from the best scale for a Gaussian."""
        self.step = self.modes[0].factor
        self.log_scale = float(np.log(2.38 / np.sqrt(max(len(self.places), 1))))

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Draw n points from the mixture, shape (n, d)."""
        which = rng.integers(len(self.modes), size=n)
        noise = rng.standard_normal((n, len(self.places)))
        drawn = np.empty_like(noise)
        for i, mode in enumerate(self.modes):
            drawn[which == i] = mode.mean + noise[which == i] @ mode.factor.T
        return drawn

    def log_density(self, x: Floats) -> Floats:
        """Return the log-density of the mixture at points (n, d), shape (n,)."""
        densities = [mode.log_density(x) for mode in self.modes]
        return np.asarray(logsumexp(densities, axis=0) - np.log(len(densities)))

    def kind(self, rng: np.random.Generator) -> str:
        """Return which move is made next: a quarter are jumps where there are several modes."""
        if len(self.modes) > 1:
            return "jump" if rng.uniform() < 0.25 else "walk"
        return "walk" if rng.uniform() < 0.5 else "draw"

    def propose(self, x: Floats, kind: str, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return a proposal from each point (n, d), and the logarithm of the Hastings ratio."""
        if kind == "jump":
            first = rng.integers(len(self.modes), size=len(x))  # each point's way by itself
            second = (first + rng.integers(1, len(self.modes), size=len(x))) % len(self.modes)
            moved, gain = np.empty_like(x), np.empty(len(x))
            for i, j in permutations(range(len(self.modes)), 2):
                between, (a, b) = (first == i) & (second == j), (self.modes[i], self.modes[j])
                moved[between] = b.mean + a.standardised(x[between]) @ b.factor.T
                gain[between] = np.log(np.diag(b.factor) / np.diag(a.factor)).sum()
            return moved, gain
        noise = rng.standard_normal(x.shape)
        if kind == "walk":
            return x + np.exp(self.log_scale) * noise @ self.step.T, np.zeros(len(x))
        mode, beta = self.modes[0], np.exp(self.log_beta)
        remaining = np.sqrt(1 - beta**2) * (x - mode.mean)
        moved = mode.mean + remaining + beta * noise @ mode.factor.T
        return moved, mode.log_density(x) - mode.log_density(moved)

    def adapt(self, kind: str, rate: float) -> None:
        """Change the step size of a kind of move towards the best acceptance rate."""
        if kind == "walk":
            self.log_scale += rate - TARGET_ACCEPTANCE
        elif kind == "draw":  # up to draws that forget where they were
            self.log_beta = min(self.log_beta + rate - TARGET_ACCEPTANCE, 0.0)

    def learn(self, x: Floats, wider: float = 1.0, retained: float = 0.0) -> None:
        """Take the particles' mean and covariance; the covariance about modes if several.

        A share ``retained`` of the covariance stays as it was.
        """
        if not len(self.places) or len(x) < 3:
            return
        if len(self.modes) == 1:
            old = self.modes[0].factor @ self.modes[0].factor.T
            new = np.atleast_2d(wider * np.cov(x, rowvar=False))
            self.modes = (_gaussian(x.mean(axis=0), (1.0 - retained) * new + retained * old),)
            self.step = self.modes[0].factor
            return
        nearest = np.argmax([mode.log_density(x) for mode in self.modes], axis=0)
        about = x - np.array([mode.mean for mode in self.modes])[nearest]
        self.step = _gaussian(about.mean(axis=0), about.T @ about / len(x)).factor


def _gaussian(mean: Floats, covariance: Floats) -> _Gaussian:
    """Return a Gaussian that is never singular."""
    factor = covariance_factor(np.reshape(covariance, 2 * (len(mean),)))
    return _Gaussian(mean, factor, solve_triangular(factor, np.eye(len(mean)), lower=True))


@dataclass(frozen=True, eq=False)
class Reference:
    """A product over independent parts, and the noise, of mixtures of Gaussians about the modes.

    Parameters
    ----------
    space : Space
        Of the particles.
    origin : ndarray
        The first mode, shape (d,).
    parts, noise : list of Block
        In the order of the space's parts; blocks of the noise.
    """

    space: Space
    origin: Floats
    parts: list[Block]
    noise: list[Block]

    @classmethod
    def of(cls, space: Space, gaussians: Sequence[tuple[Floats, Floats]]) -> Reference:
        """Return mixtures of Gaussians, each a mean (d,) and a covariance (d, d), made wider.

        Gaussians whose means are within each other's width are one.
        """

        def block(places: Ints) -> Block:
            modes: list[_Gaussian] = []
            for mean, covariance in gaussians:
                one = _gaussian(mean[places], _WIDER * covariance[np.ix_(places, places)])
                if all((np.abs(old.standardised(one.mean[None])) > 1.0).any() for old in modes):
                    modes.append(one)
            return Block(places, tuple(modes))

        parts = [block(part.places) for part in space.parts]
        return cls(space, gaussians[0][0], parts, [block(places) for places in space.noise_blocks])

    @classmethod
    def about(cls, space: Space, mode: Mode, cheap: Space | None = None) -> Reference:
        """Return the Laplace approximations about a mode and its others.

        ``cheap`` is the space of fewer engine steps, which tells how far off densities fall.
        """
        gaussians = [space.laplace(one) for one in (mode, *mode.others)]
        near = cheap or space
        return cls.of(space, [(mean, near.widened(mean, spread)) for mean, spread in gaussians])

    @classmethod
    def of_draws(cls, space: Space, q: Floats) -> Reference:
        """Return the product of Gaussians of a posterior's draws (n, d)."""
        return cls.of(space, [(q.mean(axis=0), np.atleast_2d(np.cov(q, rowvar=False)))])

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Draw n particles, uninformed parameters from their prior, shape (n, d)."""
        q = np.tile(self.origin, (n, 1))
        for block in (*self.parts, *self.noise):
            q[:, block.places] = block.draw(n, rng)
        return self.space.prior_draws(q, rng)

    def log_density(self, q: Floats) -> Floats:
        """Return the log-density of particles (n, d), shape (n,)."""
        parts = [block.log_density(q[:, block.places]) for block in self.parts]
        noise = sum(block.log_density(q[:, block.places]) for block in self.noise)
        return np.asarray(np.stack([*parts, noise + np.zeros(len(q))], axis=1).sum(axis=1))

    def learned(self, q: Floats, retained: float = 0.0) -> Reference:
        """Return the product of Gaussians of particles; of several modes, this one.

        A share ``retained`` of the covariances stays.
        """
        parts, noise = (
            [Block(b.places, b.modes) for b in some] for some in (self.parts, self.noise)
        )
        for block in (*parts, *noise):
            block.learn(q[:, block.places], _WIDER, retained)
        return replace(self, parts=parts, noise=noise)


class Ensemble:
    """Particles with their proposals.

    Parameters
    ----------
    reference : Reference
        First guess of the proposals, which are learned.
    q : ndarray
        The particles, shape (n, d).
    rng : Generator
        Source of randomness.
    """

    def __init__(self, reference: Reference, q: Floats, rng: np.random.Generator) -> None:
        self.space, self.q, self.rng = reference.space, q.copy(), rng
        learned = reference.learned(q[:0])
        self.parts, self.noise = learned.parts, learned.noise

    @property
    def blocks(self) -> list[Block]:
        """All blocks."""
        return [*self.parts, *self.noise]

    def learn(self) -> None:
        """Take the proposals' Gaussians from the particles."""
        for block in self.blocks:
            block.learn(self.q[:, block.places])

    def move(self, target: Target, sweeps: int, *, adapt: bool = True) -> float:
        """Move all particles by Metropolis sweeps; return the share of accepted moves.

        After each sweep the noise moves several times, fewer along trajectories, where each move
        runs the filter.

        Parameters
        ----------
        target : Target
            Density that the moves leave invariant.
        sweeps : int
            Engine batches of each group.
        adapt : bool
            Whether step sizes follow acceptance rates.
        """
        rates = []
        noise = self.noise * (5 if is_independent(self.space.problem) else 1)
        for chosen in groups(self.space, len(self.q)):
            q, of_sweeps = self.q[chosen], []
            values = target.evaluate(q)
            here = target.columns(q, values)
            for _ in range(sweeps):
                y, gain, kinds = self._proposed(q)
                seen = target.evaluate(y)
                there = target.columns(y, seen)
                accepted, rate = self._accepted(there[:, :-1], here[:, :-1], gain)
                if adapt:
                    for block, kind, one in zip(self.parts, kinds, rate, strict=True):
                        block.adapt(kind, float(one))
                q, values = self._chosen(accepted, y, q), self._merged(accepted, seen, values)
                here[:, :-1] = np.where(accepted, there[:, :-1], here[:, :-1])
                of_sweeps.append(rate.mean() if len(rate) else 1.0)
                for block in noise:
                    q, here = self._of_noise(block, q, here, target, values, adapt)
            self.q[chosen] = q
            rates.append(np.mean(of_sweeps))
        return float(np.mean(rates))

    def _proposed(self, q: Floats) -> tuple[Floats, Floats, list[str]]:
        """Return a proposal, the log Hastings ratio of each part, and the kinds of move."""
        y, gain, kinds = q.copy(), np.zeros((len(q), len(self.parts))), []
        for j, block in enumerate(self.parts):
            kinds.append(block.kind(self.rng))
            if len(block.places):
                y[:, block.places], gain[:, j] = block.propose(
                    q[:, block.places], kinds[-1], self.rng
                )
        return y, gain, kinds

    def _accepted(self, there: Floats, here: Floats, gain: Floats) -> tuple[Bools, Floats]:
        """Return which proposals are accepted, same shape, and the mean rates over particles.

        A proposal of no density is not; from a point of none every other is.
        """
        with np.errstate(invalid="ignore"):
            log_ratio = np.where(np.isneginf(there), -np.inf, there - here + gain)
        rate = np.exp(np.minimum(np.nan_to_num(log_ratio, nan=-np.inf, posinf=0.0), 0.0))
        return self.rng.uniform(size=rate.shape) < rate, rate.mean(axis=0)

    def _chosen(self, accepted: Bools, y: Floats, q: Floats) -> Floats:
        """Return the particles with the proposal for the parts (n, part) that accept it."""
        result = q.copy()
        for j, block in enumerate(self.parts):
            chosen = np.ix_(accepted[:, j], block.places)
            result[chosen] = y[chosen]
        return result

    def _merged(self, accepted: Bools, new: Floats, old: Floats) -> Floats:
        """Return what is known of particles, from the proposals for the parts that accept them."""
        for j, part in enumerate(self.space.parts):
            which = accepted[:, j]
            if len(self.parts) == 1:
                old[which] = new[which]
            else:
                chosen = np.flatnonzero(which)[:, None]
                old[chosen, ..., part.bodies, :] = new[chosen, ..., part.bodies, :]
        return old

    def _of_noise(
        self, block: Block, q: Floats, here: Floats, target: Target, values: Floats, adapt: bool
    ) -> tuple[Floats, Floats]:
        """Return particles and columns after a move of the noise, for which no engine is needed."""
        y, kind = q.copy(), block.kind(self.rng)
        y[:, block.places], gain = block.propose(q[:, block.places], kind, self.rng)
        there = target.columns(y, values)
        accepted, rate = self._accepted(there.sum(axis=1), here.sum(axis=1), gain)
        if adapt:
            block.adapt(kind, float(rate))
        return np.where(accepted[:, None], y, q), np.where(accepted[:, None], there, here)


def groups(space: Space, n: int, numbers: int = 8_000_000) -> Iterator[slice]:
    """Yield groups of n particles whose predictions have at most so many numbers."""
    width = max(8, numbers // max(space.problem.measured.size, 1))
    for first in range(0, n, width):
        yield slice(first, first + width)
