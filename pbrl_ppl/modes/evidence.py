"""Evidence (marginal likelihood) of a problem about one mode."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln

from pbrl_ppl.likelihood import log_posterior
from pbrl_ppl.modes.importance import adaptive_importance
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.modes.space import Space
from pbrl_ppl.state import Floats


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


def trajectory_evidence(mode: Mode) -> float:
    """Return the Laplace approximation of the log-evidence of whole trajectories.

    States are integrated out by the filter; of the noise parameters the logarithm is normal, as an
    unexplained acceleration may well be nothing.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    """
    centre, of_noise = mode.noise_gaussian()
    value = float(log_posterior(mode.problem, mode.phi, np.exp(centre)) + centre.sum())
    log_dets = (
        np.linalg.slogdet(2 * np.pi * covariance)[1] for covariance in (of_noise, mode.covariance)
    )
    return value + 0.5 * float(sum(log_dets))


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
        factor = np.asarray(np.linalg.cholesky(covariance), dtype=float)
        return replace(self, centre=q.mean(axis=0), factor=factor)


def importance(
    mode: Mode, rng: np.random.Generator, *, draws: int = 1000, rounds: int = 12, enough: int = 200
) -> Marginal:
    """Return the evidence by adaptive importance sampling from a Student-t.

    It begins with the Laplace approximation. It sees what is about one mode: other modes, and a
    wheel's other equal descriptions, are left out.

    Parameters
    ----------
    mode : Mode
        Of a problem of continuous parameters.
    rng : Generator
        Source of randomness.
    draws, rounds : int
        Draws a round, and rounds at most.
    enough : int
        Effective draws at which it ends: 200 give the log-evidence to within 0.07.
    """
    space = Space.of(mode)
    centre, covariance = space.laplace(mode)
    informed = space.informed
    factor = np.asarray(np.linalg.cholesky(covariance[np.ix_(informed, informed)]), dtype=float)

    def density(q: Floats) -> tuple[Floats, Floats]:
        return space.log_density(q), np.zeros((len(q), 0))

    proposals, _ = adaptive_importance(
        _StudentT(space, centre[informed], factor), density, len(informed), rng, batch=draws,
        enough=enough,
        most_batches=rounds, trial_batches=rounds,
    )  # fmt: skip
    error = float(np.sqrt(max(1.0 / max(proposals.ess, 1.0) - 1.0 / len(proposals.q), 0.0)))
    return Marginal(proposals.log_z, error, proposals.ess)
