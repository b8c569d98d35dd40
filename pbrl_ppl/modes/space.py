"""Space of a problem: unconstrained parameters and noise, in which a posterior is near normal."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from pbrl_ppl.likelihood import Problem, exponential, is_independent, log_noise_prior
from pbrl_ppl.modes.search import Mode
from pbrl_ppl.parameters import Prior, inside, nearest, symmetrised, wheels
from pbrl_ppl.state import Bools, Floats, Ints, wrapped

#: Power transform for noise near zero: such noise is this power of its coordinate.
_POWER = 3.0


def unconstrain(prior: Prior, x: Floats) -> tuple[Floats, Floats]:
    """Return the unconstraining transform of a prior's variable at x, and its derivative.

    Numbers or arrays of any shape.
    """
    if prior.family in ("log_normal", "half_normal"):
        return np.log(x), 1.0 / x
    if prior.family == "truncated_normal":
        left, right = x - prior.lower, prior.upper - x
        return np.log(left / right), 1.0 / left + 1.0 / right
    return x, np.ones_like(x)


def constrain(prior: Prior, u: Floats) -> Floats:
    """Return the inverse of :func:`unconstrain`."""
    if prior.family in ("log_normal", "half_normal"):
        return np.exp(u)
    if prior.family == "truncated_normal":
        return np.asarray(prior.lower + (prior.upper - prior.lower) * expit(u))
    return u


@dataclass(frozen=True, eq=False)
class Space:
    """Space of a problem: its transformed parameters, then the noise; a point has shape (d,).

    Parameters are as PyMC transforms them. Measurement noise is by its logarithm; unexplained
    accelerations and correlated errors, which may vanish, are by their cube root (E. B. Wilson and
    M. M. Hilferty, The distribution of chi-square, 1931) of either sign, so that nothing ends at
    zero. The equal descriptions of a wheel share
    its prior evenly; see `parameters.symmetrised`. A circle is cut opposite to the centre.

    Parameters
    ----------
    problem : Problem
        Of continuous parameters.
    centre : ndarray
        Parameters about which circles are cut, shape (p,).
    uninformed : ndarray of bool, optional
        Parameters that the data do not inform, shape (p,): their posterior is their prior, and no
        density here includes it.
    """

    problem: Problem
    centre: Floats
    uninformed: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        """Take no parameter to be uninformed by default."""
        if not len(self.uninformed):
            object.__setattr__(self, "uninformed", np.zeros(len(self.centre), dtype=bool))

    @classmethod
    def of(cls, mode: Mode) -> Space:
        """Return the space about a mode, with the parameters that the data do not inform."""
        centre = mode.phi.copy()
        for i, prior in enumerate(mode.problem.layout.priors):
            if prior.family == "von_mises":  # cut where it is farthest from every mode
                found = [other.phi[i] for other in (mode, *mode.others)]
                angles = np.sort(np.mod(found, 2 * np.pi))
                gaps = np.diff([*angles, angles[0] + 2 * np.pi])
                widest = int(np.argmax(gaps))
                middle = angles[widest] + 0.5 * gaps[widest] - np.pi
                centre[i] += wrapped(middle - centre[i])
        return cls(mode.problem, centre, uninformed(mode))

    @classmethod
    def of_draws(cls, problem: Problem, phi: Floats, sigma: Floats) -> tuple[Space, Floats]:
        """Return the space about a posterior's draws (n, p), and they in it, shape (n, d).

        All wheels are at one mode.
        """
        phi = nearest(problem.layout, phi, any_prior=True)
        space = cls(problem, phi.mean(axis=0))
        return space, space.at(phi, sigma)

    def on(self, problem: Problem) -> Space:
        """Return the same space of a problem with the same parameters and noise."""
        return replace(self, problem=problem)

    @property
    def phi_size(self) -> int:
        """Number of parameters, p."""
        return len(self.centre)

    @cached_property
    def roots(self) -> Bools:
        """Which noise parameters are by their cube root, shape (free,)."""
        free = self.problem.likelihood.free(exponential(self.problem).astype(float))
        return np.asarray(free, dtype=bool)

    @property
    def size(self) -> int:
        """Number of coordinates, d."""
        return self.phi_size + len(self.roots)

    @property
    def informed(self) -> Ints:
        """The coordinates that the data inform, shape (informed,)."""
        noise = np.arange(self.phi_size, self.size)
        return np.concatenate([np.flatnonzero(~self.uninformed), noise])

    @cached_property
    def blocks(self) -> tuple[Ints, ...]:
        """Informed coordinates of independent parts, given the noise; then those of the noise.

        One part where the likelihood mixes the bodies' residuals.
        """
        parts = [np.flatnonzero(~self.uninformed)]
        if is_independent(self.problem):
            places = [part.places for part in self.problem.physics.simulator.parts]
            parts = [place[~self.uninformed[place]] for place in places]
        noise = self.phi_size + np.arange(len(self.roots))
        blocks = (*parts, noise[~self.roots], noise[self.roots])
        return tuple(block for block in blocks if len(block))

    def at(self, phi: Floats, sigma: Floats) -> Floats:
        """Return the points of parameters (..., p) and noise (..., parameter), shape (..., d).

        Angles are within half a turn of the centre.
        """
        priors = self.problem.layout.priors
        phi = inside(priors, phi)
        columns = [unconstrain(prior, phi[..., i])[0] for i, prior in enumerate(priors)]
        u = np.stack(columns, axis=-1) if columns else phi
        for i in self._circles:
            u[..., i] = self.centre[i] + wrapped(u[..., i] - self.centre[i])
        log_sigma = np.log(self.problem.likelihood.free(sigma))
        return np.concatenate([u, self.noise(log_sigma)], axis=-1)

    def noise(self, log_sigma: Floats) -> Floats:
        """Return the coordinates of free noise parameters, given their logarithm, (..., free)."""
        return np.where(self.roots, np.exp(log_sigma / _POWER), log_sigma)

    def split(self, q: Floats) -> tuple[Floats, Floats]:
        """Return phi, shape (..., p), and sigma, shape (..., parameter), at points (..., d)."""
        problem, p = self.problem, self.phi_size
        with np.errstate(over="ignore"):
            columns = [constrain(prior, q[..., i]) for i, prior in enumerate(problem.layout.priors)]
            noise = q[..., p:]
            sigma = np.where(self.roots, np.abs(noise) ** _POWER, np.exp(noise))
        phi = np.stack(columns, axis=-1) if columns else q[..., :0]
        return phi, np.broadcast_to(sigma, (*sigma.shape[:-1], len(problem.noise_prior[0])))

    @cached_property
    def _circles(self) -> list[int]:
        priors = self.problem.layout.priors
        return [i for i, prior in enumerate(priors) if prior.family == "von_mises"]

    def log_prior(self, q: Floats) -> Floats:
        """Return the log-prior at points (..., d) without the uninformed parameters, shape (...).

        Minus infinity outside.
        """
        informed = self._of_parameters(q)[..., ~self.uninformed]
        total = informed.sum(axis=-1) + self._of_noise(q)
        return np.where(np.isfinite(total), total, -np.inf)

    def _of_parameters(self, q: Floats) -> Floats:
        """Return the log-prior of each transformed parameter, shape (..., p)."""
        problem, phi = self.problem, self.split(q)[0]
        priors = problem.layout.priors
        with np.errstate(all="ignore"):
            slopes = [unconstrain(prior, phi[..., i])[1] for i, prior in enumerate(priors)]
            density = problem.layout.log_prior(phi) + symmetrised(problem.layout, phi)
            density -= np.moveaxis(np.log(np.abs(slopes)), 0, -1) if slopes else 0.0
        for i in self._circles:
            beyond = np.abs(q[..., i] - self.centre[i]) > np.pi
            density[..., i] = np.where(beyond, -np.inf, density[..., i])
        return np.asarray(density)

    def _of_noise(self, q: Floats) -> Floats:
        """Return the log-prior of the noise's coordinates, shape (...)."""
        noise = q[..., self.phi_size :]
        with np.errstate(all="ignore"):
            size = np.abs(noise)  # a root of either sign is the same noise
            log_sigma = np.where(self.roots, _POWER * np.log(size), noise)
            # the density of a root, from that of the logarithm
            slope = np.where(self.roots, np.log(0.5 * _POWER / size), 0.0).sum(axis=-1)
            return np.asarray(log_noise_prior(self.problem, log_sigma) + slope)

    def each(self, q: Floats) -> Floats:
        """Return the log-likelihood of each transition at points (n, d), shape (n, transition)."""
        residual, (phi, sigma) = self.problem.residual(self.possible(q)), self.split(q)
        with np.errstate(all="ignore"):
            value = self.problem.log_density(residual, sigma, phi)
        return np.where(np.isnan(value), -np.inf, value)

    def possible(self, q: Floats) -> Floats:
        """Return phi (n, p), with the centre where a point is outside what numbers can hold."""
        phi = self.split(q)[0]
        there = np.isfinite(phi).all(axis=-1, keepdims=True)
        return inside(self.problem.layout.priors, np.where(there, phi, self.centre))

    def log_densities(self, q: Floats, *, numbers: int = 4_000_000) -> tuple[Floats, Floats]:
        """Return the log-posterior up to the evidence at points (n, d), and the log-likelihoods.

        Shapes (n,) and (n, transition).

        ``numbers``: numbers held at once.
        """
        width = max(1, numbers // max(self.problem.measured.size, 1))
        parts = (q[first : first + width] for first in range(0, len(q), width))
        each = np.concatenate([self.each(some) for some in parts])
        return self.log_prior(q) + each.sum(axis=1), each

    def log_density(self, q: Floats) -> Floats:
        """Return the log-posterior up to the evidence at points (n, d), shape (n,)."""
        return self.log_densities(q)[0]

    def prior_draws(self, q: Floats, rng: np.random.Generator) -> Floats:
        """Return points (n, d) with the uninformed parameters drawn from their prior."""
        q = q.copy()
        for place in np.flatnonzero(self.uninformed):
            prior = self.problem.layout.priors[place]
            drawn = inside([prior], prior.sample(rng, len(q))[:, None])[:, 0]
            q[:, place] = unconstrain(prior, drawn)[0]
        return q

    def laplace(self, mode: Mode) -> tuple[Floats, Floats]:
        """Return the Laplace approximation about a mode, shapes (d,) and (d, d).

        Its curvature is Gauss and Newton's. A density's mode moves with its coordinates: where the
        data say little, it is that of the prior here.
        """
        p, mean = self.phi_size, self.at(mode.phi, mode.sigma)
        about = self._about(mean)
        centre, of_noise = _noise_gaussian(mode)
        mean[p:] = self.noise(centre)
        stretch = np.where(self.roots, mean[p:] / _POWER, 1.0)
        covariance = np.zeros((len(mean), len(mean)))
        covariance[p:, p:] = stretch[:, None] * of_noise * stretch
        if p:
            priors = self.problem.layout.priors
            slope = [1.0 / unconstrain(*pair)[1] for pair in zip(priors, mode.phi, strict=True)]
            jacobian = mode.jacobian * np.array(slope)
            width = 1e-3  # of differences of the prior's density
            ends = mean + width * np.eye(len(mean))[:p], mean - width * np.eye(len(mean))[:p]
            here = about._of_parameters(mean)
            above, below = (np.diagonal(about._of_parameters(end)) for end in ends)
            # at least 0.05: a truncated prior's tails are flat here
            curvature = np.maximum((2 * here - above - below) / width**2, 0.05)
            precision = jacobian.T @ jacobian + np.diag(curvature)
            for place in self.problem.tails:
                precision[place, place] += slope[place] ** 2 / mode.covariance[place, place]
            scale = 1.0 / np.sqrt(np.diag(precision))
            inverse = np.linalg.inv(precision * np.outer(scale, scale) + 1e-12 * np.eye(p))
            covariance[:p, :p] = scale[:, None] * inverse * scale
            residual = np.nan_to_num(self.problem.robust(mode.phi, mode.sigma)).ravel()
            pull = (above - below) / (2 * width) - jacobian.T @ residual
            step = np.zeros_like(mean)
            step[:p] = covariance[:p, :p] @ pull
            tried = mean + np.array([0.0, 0.25, 0.5, 1.0])[:, None] * step
            mean = tried[int(np.argmax(about.log_density(tried)))]
        return mean, (covariance + covariance.T) / 2

    def _about(self, q: Floats) -> Space:
        """Return the space with circles cut opposite to a point (d,)."""
        middle = self.centre.copy()
        middle[self._circles] = q[self._circles]
        return replace(self, centre=middle)

    def widened(self, mean: Floats, covariance: Floats) -> Floats:
        """Return a covariance, widened where the posterior falls off slowly, shape (d, d).

        At a kink, or with few contacts, the curvature overstates how well a parameter is known.
        """
        informed = np.flatnonzero(~self.uninformed)
        if not len(informed):
            return covariance
        steps = np.sqrt(np.diag(covariance))[informed]
        distances = (2.0, 4.0, 8.0, 16.0)  # standard deviations
        ends = np.array([*distances, *(-far for far in distances)])
        moves = np.zeros((len(informed), len(ends), len(mean)))
        moves[np.arange(len(informed)), :, informed] = steps[:, None] * ends
        points = np.vstack([mean, mean + moves.reshape(-1, len(mean))])
        top, *log_densities = self._about(mean).log_density(points)
        fall = (top - np.array(log_densities)).reshape(len(informed), 2, -1)
        # on either side, up to the first point that has fallen by 2.5 nats; a Gaussian's first by 2
        within = np.nan_to_num(fall, nan=np.inf) < 2.5
        count = np.logical_and.accumulate(within, axis=2).sum(axis=2)
        stretch = np.array([distances[0], *distances])[count].mean(axis=1) / distances[0]
        extra = np.zeros(len(mean))
        extra[informed] = steps**2 * (stretch**2 - 1.0)
        return np.asarray(covariance + np.diag(extra))


def uninformed(mode: Mode) -> Bools:
    """Return the mask of parameters of which the data say nothing: their posterior is the prior.

    Their derivative is below 1e-3 in units of noise over their prior. A wheel's parameters are
    never among them, for its prior is not one of independent numbers.
    """
    problem = mode.problem
    # the sigma of a log-normal prior is that of the logarithm
    scale = [
        prior.sigma * (x if prior.family == "log_normal" else 1.0)
        for prior, x in zip(problem.layout.priors, mode.phi, strict=True)
    ]
    size = np.sqrt((mode.jacobian**2).sum(axis=0)) * np.nan_to_num(scale, nan=1.0)
    mask = (size < 1e-3) & bool(mode.jacobian.any())
    for wheel in wheels(problem.layout):
        mask[list(wheel.places)] = False
    mask[list(problem.tails)] = False
    return np.asarray(mask)


def _noise_gaussian(mode: Mode) -> tuple[Floats, Floats]:
    """Return the Laplace approximation of the logarithm of the free noise parameters.

    Shapes (free,) and (free, free).
    """
    problem = mode.problem
    if not is_independent(problem):
        return mode.noise_gaussian()
    # the variance of log sigma is half the inverse of the number of measurements
    counts = problem.likelihood.pooled(problem.likelihood.counts(problem.observations))
    spread = problem.noise_prior[1]
    covariance = np.diag(1.0 / (2.0 * counts + spread**-2.0))
    return problem.likelihood.free(np.log(mode.sigma)), covariance
