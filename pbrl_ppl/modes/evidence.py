"""Evidence (marginal likelihood) of a problem about one mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln, ndtr, ndtri
from scipy.stats import truncnorm

from pbrl_ppl.likelihood import log_posterior, noise_law
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.parameters import Prior, evened
from pbrl_ppl.state import Floats

#: Draws a round, rounds at most, and effective draws that are enough: the log-evidence is then
#: known to within 0.07.
_DRAWS, _ROUNDS, _ENOUGH = 1000, 12, 200
#: Degrees of freedom of the proposal: tails heavier than a posterior's, at little cost.
_NU = 8.0
#: Points of the table of a von Mises distribution.
_POINTS = 100_001
_CHUNK = 128


@dataclass(frozen=True)
class Evidence:
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


class Coordinates:
    """Parameters and noise in coordinates in which their prior is a standard normal.

    The evidence is then the mean of the likelihood over a standard normal distribution.

    Parameters
    ----------
    mode : Mode
        An angle's circle is cut opposite to it.
    """

    def __init__(self, mode: Mode) -> None:
        self.problem = mode.problem
        priors = self.problem.layout.priors
        self._laws = [_Law(prior, x) for prior, x in zip(priors, mode.phi, strict=True)]
        self._centre, self._spread = noise_law(self.problem)
        likelihood = self.problem.likelihood
        sigma = likelihood.free(np.log(mode.sigma))
        self._counts = likelihood.pooled(self.problem.observations.measured.sum((0, 1, 2)))
        z = [float(law.standard(x)) for law, x in zip(self._laws, mode.phi, strict=True)]
        #: The mode, shape (d,).
        self.origin = np.concatenate([z, (sigma - self._centre) / self._spread])

    def values(self, z: Floats) -> tuple[Floats, Floats]:
        """Return phi (n, p) and sigma (n, parameter) at z (n, d)."""
        p = len(self._laws)
        columns = [law.value(z[:, i]) for i, law in enumerate(self._laws)]
        phi = np.stack(columns, axis=1) if columns else np.zeros((len(z), 0))
        sigma = np.exp(self._centre + self._spread * z[:, p:])
        states = len(self.problem.observations.columns)
        return phi, np.broadcast_to(sigma, (len(z), states))

    def log_density(self, z: Floats) -> Floats:
        """Return the log-posterior density of z, normalised by the prior, shape (n,)."""
        phi, sigma = self.values(z)
        problem = self.problem
        parts = [
            problem.log_density(problem.residual(phi[i:j]), sigma[i:j], phi[i:j])
            for i, j in ((i, i + _CHUNK) for i in range(0, len(z), _CHUNK))
        ]
        even = evened(problem.layout, phi).sum(axis=-1)  # it sees one description of a wheel
        return np.asarray(np.concatenate(parts).sum(axis=-1) + _log_normal(z) + even)

    def gauss_newton(self, mode: Mode) -> tuple[Floats, Floats]:
        """Return the mode (d,) and the Laplace covariance (d, d) in these coordinates."""
        p, step = len(self._laws), 1e-4
        slope = np.array(
            [
                float(np.diff(law.value(z + np.array([-step, step])))[0]) / (2 * step)
                for law, z in zip(self._laws, self.origin, strict=False)
            ]
        )
        jacobian = mode.jacobian * slope
        precision = np.eye(len(self.origin))
        precision[:p, :p] += jacobian.T @ jacobian
        own = np.arange(p, len(precision))
        precision[own, own] += 2.0 * self._counts * self._spread**2
        covariance = np.linalg.inv(precision)
        # a density's mode moves with its coordinates: where the data are silent, to the origin
        residual = np.nan_to_num(self.problem.robust(mode.phi, mode.sigma)).ravel()
        pull = np.concatenate([-jacobian.T @ residual, np.zeros(len(own))])
        whole = covariance @ (pull - self.origin)
        tried = self.origin + np.array([0.0, 0.25, 0.5, 1.0])[:, None] * whole
        best = int(np.argmax(self.log_density(tried)))
        return tried[best], np.asarray((covariance + covariance.T) / 2)


class _Law:
    """Map between a prior's values and a standard normal coordinate."""

    def __init__(self, prior: Prior, near: float) -> None:
        self._prior = prior
        if prior.family == "von_mises":
            grid = near + np.linspace(-np.pi, np.pi, _POINTS)
            density = np.exp(prior.kappa * (np.cos(grid - prior.mu) - 1.0))
            below = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
            self._grid, self._below = grid, below / below[-1]
        elif prior.family not in ("log_normal", "normal"):
            ends = (np.array(prior.support) - prior.mu) / prior.sigma
            self._law = truncnorm(*ends, prior.mu, prior.sigma)

    def standard(self, x: float) -> Floats:
        """Return the coordinate of a value."""
        prior = self._prior
        if prior.family in ("log_normal", "normal"):
            natural = np.log(x) if prior.family == "log_normal" else x
            return np.asarray((natural - prior.mu) / prior.sigma)
        if prior.family == "von_mises":
            return np.asarray(ndtri(np.interp(x, self._grid, self._below)))
        below, above = self._law.cdf(x), self._law.sf(x)
        return np.asarray(np.where(below < above, ndtri(below), -ndtri(above)))

    def value(self, z: Floats) -> Floats:
        """Return the values at coordinates, same shape."""
        prior = self._prior
        if prior.family == "log_normal":
            return np.asarray(np.exp(prior.mu + prior.sigma * z))
        if prior.family == "normal":
            return np.asarray(prior.mu + prior.sigma * z)
        if prior.family == "von_mises":
            return np.asarray(np.interp(ndtr(z), self._below, self._grid))
        ends = self._law.ppf(ndtr(np.minimum(z, 0.0))), self._law.isf(ndtr(-np.maximum(z, 0.0)))
        return np.asarray(np.where(z < 0, *ends))


def laplace(mode: Mode) -> Evidence:
    """Return the Laplace approximation of the evidence, with a Gauss-Newton curvature.

    Parameters
    ----------
    mode : Mode
        Of a problem of continuous parameters.
    """
    coordinates = Coordinates(mode)
    centre, covariance = coordinates.gauss_newton(mode)
    log_det = np.linalg.slogdet(2 * np.pi * covariance)[1]
    return Evidence(float(coordinates.log_density(centre[None])[0] + 0.5 * log_det))


def trajectory_evidence(mode: Mode, unit: Sequence[int] = ()) -> float:
    """Return the Laplace approximation of the log-evidence of whole trajectories.

    States are integrated out by the filter; of the noise parameters the logarithm is normal, as an
    unexplained acceleration may well be nothing.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    unit : sequence of int, optional
        Places of parameters whose prior counts as worth one measured row, whatever its scale (R. E.
        Kass and L. Wasserman, Journal of the American Statistical Association 90, 1995): effects
        are of bodies of any size.
    """
    centre, of_noise = mode.noise_gaussian()
    value = float(log_posterior(mode.problem, mode.phi, np.exp(centre)) + centre.sum())
    log_dets = (np.linalg.slogdet(2 * np.pi * own)[1] for own in (of_noise, mode.covariance))
    value += 0.5 * float(sum(log_dets))
    if not len(unit):
        return value
    places, shown = list(unit), mode.problem.trajectory_noise.seen.any(axis=1).sum()
    own = np.linalg.slogdet(2 * np.pi * mode.covariance[np.ix_(places, places)])[1]
    prior = mode.problem.layout.log_prior(mode.phi)[places].sum()
    return value - float(prior) - 0.5 * float(own + len(places) * np.log(shown))


def importance(mode: Mode, rng: np.random.Generator) -> Evidence:
    """Return the evidence by adaptive importance sampling from a Student-t.

    It begins with the Laplace approximation; each round's proposal is made from the rounds before
    (Cappé et al., 2008), so that each round's estimate is unbiased by itself. It sees what is about
    one mode: other modes, and a wheel's other equal descriptions, are left out.

    Parameters
    ----------
    mode : Mode
        Of a problem of continuous parameters.
    rng : Generator
        Source of randomness.
    """
    coordinates = Coordinates(mode)
    centre, covariance = coordinates.gauss_newton(mode)
    d = len(centre)
    for _ in range(_ROUNDS):
        factor = np.asarray(np.linalg.cholesky(covariance), dtype=float)
        radius = np.sqrt(_NU / rng.chisquare(_NU, (_DRAWS, 1)))
        moved: Floats = radius * rng.standard_normal((_DRAWS, d)) @ factor.T
        z = centre + moved
        log_weight = coordinates.log_density(z) - _log_student(moved, factor)
        top = log_weight.max()
        weight = np.exp(log_weight - top)
        ess = float(weight.sum() ** 2 / (weight**2).sum())
        error = float(np.sqrt(max(1.0 / ess - 1.0 / _DRAWS, 0.0)))
        found = Evidence(float(top + np.log(weight.mean())), error, ess)
        if ess >= _ENOUGH:
            break
        # a few large weights must not decide alone (Ionides, 2008)
        weight = np.minimum(weight, weight.mean() * np.sqrt(_DRAWS))
        weight /= weight.sum()
        kept = 1.0 / (weight**2).sum()
        share = kept / (kept + 2.0 * d)
        mean = weight @ z
        spread = (z - mean).T @ (weight[:, None] * (z - mean))
        centre = centre + share * (mean - centre)
        covariance = covariance + share * (spread - covariance)
    return found


def _log_normal(z: Floats) -> Floats:
    """Return the log-density of a standard normal, shape (n,), at (n, d)."""
    return np.asarray(-0.5 * (z**2).sum(axis=1) - 0.5 * z.shape[1] * np.log(2 * np.pi))


def _log_student(x: Floats, factor: Floats) -> Floats:
    """Return the log-density of the proposal about its centre, shape (n,), at (n, d)."""
    d = x.shape[1]
    square = (solve_triangular(factor, x.T, lower=True) ** 2).sum(axis=0)
    constant = gammaln((_NU + d) / 2) - gammaln(_NU / 2) - 0.5 * d * np.log(_NU * np.pi)
    log_det = np.log(np.diag(factor)).sum()
    return np.asarray(constant - log_det - 0.5 * (_NU + d) * np.log1p(square / _NU))
