"""Evidence (marginal likelihood) of a problem about one mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln

from pbrl_ppl.likelihood import log_posterior
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.modes.space import Space
from pbrl_ppl.state import Floats

#: Draws a round, rounds at most, and effective draws that are enough: the log-evidence is then
#: known to within 0.07.
_DRAWS, _ROUNDS, _ENOUGH = 1000, 12, 200
#: Degrees of freedom of the proposal: tails heavier than a posterior's, at little cost.
_NU = 8.0


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


def laplace(mode: Mode) -> Evidence:
    """Return the Laplace approximation of the evidence, with a Gauss-Newton curvature.

    Parameters
    ----------
    mode : Mode
        Of a problem of continuous parameters.
    """
    space = Space.of(mode)
    centre, covariance = space.laplace(mode)
    loud = space.loud
    log_det = np.linalg.slogdet(2 * np.pi * covariance[np.ix_(loud, loud)])[1]
    return Evidence(float(space.log_density(centre[None])[0] + 0.5 * log_det))


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
    space = Space.of(mode)
    centre, covariance = space.laplace(mode)
    loud = space.loud
    centre, covariance, d = centre[loud], covariance[np.ix_(loud, loud)], len(loud)
    for _ in range(_ROUNDS):
        factor = np.asarray(np.linalg.cholesky(covariance), dtype=float)
        radius = np.sqrt(_NU / rng.chisquare(_NU, (_DRAWS, 1)))
        moved: Floats = radius * rng.standard_normal((_DRAWS, d)) @ factor.T
        z = centre + moved
        q = space.prior_draws(np.zeros((_DRAWS, space.size)), rng)
        q[:, loud] = z
        log_weight = space.log_density(q) - _log_student(moved, factor)
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


def _log_student(x: Floats, factor: Floats) -> Floats:
    """Return the log-density of the proposal about its centre, shape (n,), at (n, d)."""
    d = x.shape[1]
    square = (solve_triangular(factor, x.T, lower=True) ** 2).sum(axis=0)
    constant = gammaln((_NU + d) / 2) - gammaln(_NU / 2) - 0.5 * d * np.log(_NU * np.pi)
    log_det = np.log(np.diag(factor)).sum()
    return np.asarray(constant - log_det - 0.5 * (_NU + d) * np.log1p(square / _NU))
