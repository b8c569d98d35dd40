"""Rejuvenation of particles by Metropolis steps, all proposed in one engine call."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood, log_noise_prior
from pbrl_ppl.parameters import evened, gathered, inside
from pbrl_ppl.sampling.metropolis import TARGET_ACCEPTANCE, Gaussian
from pbrl_ppl.sampling.starts import constrain, unconstrain
from pbrl_ppl.state import Bools, Floats, Ints

#: Steps under the coarse posterior for each exact decision, and of the noise.
_INNER, _NOISE_STEPS = 15, 10
#: Steps a round without the coarse posterior.
_PLAIN_STEPS = 5
#: Largest standard deviation of the coarse log-likelihood's error at which it is used.
_CLOSE = 1.0
#: Rounds end when no parameter correlates more than this with its start, or after so many: then
#: copies of one particle are nearly independent.
_FORGOTTEN, _ROUNDS = 0.5, 20
#: Numbers held at once: particles are moved in groups whose predictions are fewer.
_NUMBERS = 4_000_000


def rejuvenate(
    problem: Problem,
    phi: Floats,
    sigma: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, Floats, float]:
    """Rejuvenate particles of a posterior by Metropolis steps, until they have decorrelated.

    Independent parts of the scene are moved and accepted separately, given the noise; then the
    noise, for which the engine is not needed.
    A wheel's equal descriptions share their prior evenly here; `redescribed` gives each its own.

    Where a coarse engine follows the posterior, several steps under it make one proposal, as in
    :class:`pbrl_ppl.sampling.metropolis.AdaptiveMetropolis`.

    Parameters
    ----------
    problem : Problem
        Problem whose posterior is the target.
    phi, sigma : ndarray
        Equally weighted draws, shapes (particle, p) and (particle, state).
    rng : Generator
        Of the moves.

    Returns
    -------
    phi, sigma : ndarray
        Shapes as given.
    accepted : float
        Share of the moves that the exact posterior accepted.
    """
    wide = problem.with_physics(threads=max(problem.physics.threads, 2))
    mover = _Mover(wide, phi, sigma)
    begin, rates = mover.u.copy(), []
    for _ in range(_ROUNDS):
        rates.append(np.mean([mover.move(group, rng) for group in mover.groups()]))
        if _correlation(begin, mover.u) < _FORGOTTEN:
            break
    return mover.phi(mover.u), mover.sigma(mover.noise), float(np.mean(rates))


def _correlation(before: Floats, after: Floats) -> float:
    """Return the largest correlation over the columns between the particles before and after."""
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    size = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return float(((a * b).sum(axis=0) / np.maximum(size, 1e-300)).max(initial=0.0))


class _Mover:
    """Particles in the unconstrained space, with their proposals and densities."""

    def __init__(self, problem: Problem, phi: Floats, sigma: Floats) -> None:
        self.problem, self.priors = problem, problem.layout.priors
        phi = inside(self.priors, gathered(problem.layout, phi))
        pairs = [unconstrain(prior, x) for prior, x in zip(self.priors, phi.T, strict=True)]
        self.u = np.array([u for u, _ in pairs]).reshape(-1, len(phi)).T.copy()
        self.noise = problem.likelihood.free(np.log(sigma)).copy()
        self.parts = problem.simulator.parts
        if isinstance(problem.likelihood, TrajectoryLikelihood):  # it mixes the bodies' residuals
            self.parts = problem.physics.changed(parts=None).simulator.parts
        self.blocks = [
            Gaussian(part.places, self.u[:, part.places].mean(axis=0), _spread(self.u, part.places))
            for part in self.parts
        ]
        columns = np.arange(self.noise.shape[1])
        self.of_noise = Gaussian(columns, self.noise.mean(axis=0), _spread(self.noise, columns))
        # the coarse engine is corrected by its error at the particles' mean
        centre = self.phi(self.u.mean(axis=0))
        self.coarse = problem.coarse.simulator
        self.correction = problem.predict(centre) - problem.predict(centre, self.coarse)
        self.look_ahead: bool | None = None

    def groups(self) -> list[slice]:
        """Return groups of particles whose predictions fit into memory."""
        size = max(1, _NUMBERS // max(self.problem.observations.values.size, 1))
        return [slice(i, i + size) for i in range(0, len(self.u), size)]

    def phi(self, u: Floats) -> Floats:
        """Return the parameters at unconstrained ones, shape (..., p)."""
        columns = [constrain(prior, u[..., i]) for i, prior in enumerate(self.priors)]
        return np.asarray(inside(self.priors, np.stack(columns, axis=-1)) if columns else u)

    def sigma(self, noise: Floats) -> Floats:
        """Return all noise parameters at the logarithms of the inferred ones."""
        return np.asarray(np.exp(noise) * np.ones(len(self.problem.noise_prior[0])))

    def prior(self, u: Floats) -> Floats:
        """Return the log-density of each part's parameters, transformed, shape (particle, part)."""
        phi = self.phi(u)
        layout = self.problem.layout
        terms = layout.log_prior(phi) + evened(layout, phi)
        for i, prior in enumerate(self.priors):
            terms[:, i] -= np.log(unconstrain(prior, phi[:, i])[1])
        return np.stack([terms[:, part.places].sum(axis=1) for part in self.parts], axis=1)

    def likelihood(self, residual: Floats, noise: Floats, u: Floats) -> Floats:
        """Return the log-likelihood of each part at log sigma (particle, state)."""
        problem, sigma = self.problem, self.sigma(noise)
        measured, phi = problem.observations.measured, self.phi(u)
        nu = problem.nu(phi)
        if len(self.parts) == 1:
            return np.asarray(problem.log_density(residual, sigma, phi).sum(axis=-1)[:, None])
        result = np.empty((len(residual), len(self.parts)))
        for j, part in enumerate(self.parts):
            nu_of = nu[..., part.bodies, :] if isinstance(nu, np.ndarray) else nu
            some, seen = residual[..., part.bodies, :], measured[..., part.bodies, :]
            each = problem.likelihood.log_density(some, sigma, seen, nu_of)
            result[:, j] = each.sum(axis=-1)
        return result

    def exact(self, u: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """Return the log-density of each part, and the residuals."""
        residual = self.problem.residual(self.phi(u))
        return self.prior(u) + self.likelihood(residual, noise, u), residual

    def rough(self, u: Floats, noise: Floats) -> Floats:
        """Return the log-density of each part with the coarse engine."""
        states = self.problem.predict(self.phi(u), self.coarse) + self.correction
        residual = self.problem.observations.residual(states)
        return self.prior(u) + self.likelihood(residual, noise, u)

    def move(self, group: slice, rng: np.random.Generator) -> float:
        """Move a group of particles by one round; return the share of accepted moves."""
        u, noise, rates = self.u[group], self.noise[group], []
        here, residual = self.exact(u, noise)
        if self.look_ahead is None:
            self.look_ahead = bool(((self.rough(u, noise) - here).std(axis=0) < _CLOSE).all())
        for _ in range(1 if self.look_ahead else _PLAIN_STEPS):
            walk = bool(rng.uniform() < 0.5)
            ahead = self.look_ahead
            y, gain = self._ahead(u, noise, rng) if ahead else self._propose(u, walk, rng)
            there, moved = self.exact(y, noise)
            accepted = _accepted(there - here + gain, rng)
            if not ahead:
                self._learn(accepted.mean(axis=0), walk)
            rates.append(accepted.mean())
            u, here = self._chosen(accepted, y, u), np.where(accepted, there, here)
            for j, part in enumerate(self.parts):
                which = np.flatnonzero(accepted[:, j])[:, None]
                residual[which, ..., part.bodies] = moved[which, ..., part.bodies]
        self.u[group], self.noise[group] = u, self._noisy(residual, noise, u, rng)
        return float(np.mean(rates))

    def _chosen(self, accepted: Bools, y: Floats, u: Floats) -> Floats:
        """Return the particles with the proposal for the parts (particle, part) that accept it."""
        result = u.copy()
        for j, part in enumerate(self.parts):
            result[:, part.places] = np.where(
                accepted[:, j, None], y[:, part.places], u[:, part.places]
            )
        return result

    def _propose(self, u: Floats, walk: bool, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return a proposal, and the logarithm of each part's Hastings ratio."""
        y, gain = u.copy(), np.zeros((len(u), len(self.parts)))
        for j, block in enumerate(self.blocks):
            y[:, block.places], gain[:, j] = block.propose(u[:, block.places], walk, rng)
        return y, gain

    def _learn(self, rates: Floats, walk: bool) -> None:
        """Adapt the parts' step sizes to acceptance rates over all particles."""
        for block, rate in zip(self.blocks, rates, strict=True):
            block.lengthen(rate - TARGET_ACCEPTANCE, walk)

    def _ahead(self, u: Floats, noise: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return a proposal of steps under the coarse posterior, and its log Hastings ratio.

        The steps must be as likely in the reverse order: step sizes adapt only at the end.
        """
        begin = here = self.rough(u, noise)
        rates: dict[bool, list[Floats]] = {True: [], False: []}
        for _ in range(_INNER):
            walk = bool(rng.uniform() < 0.5)
            y, gain = self._propose(u, walk, rng)
            there = self.rough(y, noise)
            accepted = _accepted(there - here + gain, rng)
            rates[walk].append(accepted.mean(axis=0))
            u, here = self._chosen(accepted, y, u), np.where(accepted, there, here)
        for walk, measured in rates.items():
            if measured:
                self._learn(np.mean(measured, axis=0), walk)
        return u, begin - here

    def _noisy(
        self, residual: Floats, noise: Floats, u: Floats, rng: np.random.Generator
    ) -> Floats:
        """Return the noise, shape (particle, state), after steps at given residuals."""

        def density(at: Floats) -> Floats:
            likelihood = self.likelihood(residual, at, u).sum(axis=1)
            return np.asarray(log_noise_prior(self.problem, at) + likelihood)

        here = density(noise)
        for _ in range(_NOISE_STEPS):
            walk = bool(rng.uniform() < 0.5)
            y, gain = self.of_noise.propose(noise, walk, rng)
            there = density(y)
            accepted = _accepted(there - here + gain, rng)
            self.of_noise.lengthen(accepted.mean() - TARGET_ACCEPTANCE, walk)
            noise = np.where(accepted[:, None], y, noise)
            here = np.where(accepted, there, here)
        return noise


def _accepted(log_ratio: Floats, rng: np.random.Generator) -> Bools:
    """Return whether each proposal is accepted; not where a density is not a number."""
    with np.errstate(invalid="ignore"):
        passes = np.log(rng.uniform(size=log_ratio.shape)) < log_ratio
    return np.asarray(passes)


def _spread(points: Floats, columns: Ints) -> Floats:
    """Return the covariance of some columns, never singular."""
    if not len(columns):  # of a part whose parameters are known
        return np.zeros((0, 0))
    covariance = np.cov(points[:, columns], rowvar=False).reshape(2 * (len(columns),))
    return np.asarray(covariance + np.diag(np.maximum(1e-9 * np.diag(covariance), 1e-300)))
