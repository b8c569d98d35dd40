"""Most probable noise parameters and tails at given residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from scipy.optimize import minimize
from scipy.special import wrightomega

from pbrl_ppl.likelihood import (
    FilteredProblem,
    Problem,
    exponential,
    is_filtered,
    is_simulated,
    log_noise_prior,
    noise_law,
    noise_prior_slope,
)
from pbrl_ppl.parameters import box
from pbrl_ppl.scene import state_sizes
from pbrl_ppl.state import Floats

#: Largest residual, in noise units: larger ones are clipped.
FAR_OFF = 1e3
#: Largest change of a log noise parameter from where its optimisation begins.
_FAR = 6.0
#: Unexplained acceleration that counts as zero, as a share of its prior's median.
NOTHING = 1e-3


def finite(problem: Problem, residual: Floats) -> Floats:
    """Return residuals in SI units with large ones where a prediction diverged, same shape."""
    far = FAR_OFF * state_sizes(problem.scene)[list(problem.observations.columns)]
    return np.where(np.isfinite(residual), residual, far)


def profile_sigma(
    problem: Problem,
    residual: Floats,
    phi: Floats | None = None,
    fixed: Mapping[int, float] | None = None,
) -> Floats:
    """Return sigma of highest posterior density at given residuals, shape (parameter,).

    Parameters
    ----------
    problem : Problem
        Has the measurements, the likelihood and the prior of sigma.
    residual : ndarray
        Shape (transition, H, body, state).
    phi : ndarray, optional
        Parameters, shape (p,); needed where the noise's tails are inferred.
    fixed : dict of int to float, optional
        Noise parameters of whole trajectories that are given.
    """
    residual, medians = finite(problem, residual), problem.noise_prior[0]
    filtered, gaussian = is_filtered(problem), problem.nu(phi) is None
    if is_filtered(problem):
        begin = np.log(problem.likelihood.noise.sigma)
    elif is_simulated(problem):
        begin = np.log(problem.likelihood.profile(residual, problem.least_noise))
    else:
        begin = gaussian_log_sigma(problem, (residual**2).sum((0, 1, 2)))
        if gaussian:
            return np.asarray(np.exp(begin) * np.ones(len(medians)))
    lower, upper = begin - _FAR, begin + _FAR
    for place in np.flatnonzero(exponential(problem)).tolist():
        lower[place] = np.log(NOTHING * medians[place])
        begin[place] = max(begin[place], lower[place])
        upper[place] = max(upper[place], lower[place] + _FAR)
    for place, value in (fixed or {}).items():
        begin[place] = lower[place] = upper[place] = np.log(value)
    sloped, bounds = filtered and gaussian, np.transpose([lower, upper])
    cost = _cost_and_slope if sloped else partial(_cost, phi=phi)
    best = minimize(cost, begin, (problem, residual), jac=sloped, method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(best.x) * np.ones(len(medians)))


def _cost(log_sigma: Floats, problem: Problem, residual: Floats, phi: Floats | None) -> float:
    """Return the negative log-density of data and log noise parameters."""
    sigma = np.exp(log_sigma) * np.ones(len(problem.noise_prior[0]))
    likelihood = problem.log_density(residual, sigma, phi).sum()
    return float(log_sigma.sum() - log_noise_prior(problem, log_sigma) - likelihood)


def _cost_and_slope(
    log_sigma: Floats, problem: FilteredProblem, residual: Floats
) -> tuple[float, Floats]:
    """Return the negative log-density for Gaussian noise, and its derivative by log sigma."""
    likelihood, slope = problem.likelihood.noise.score(residual, np.exp(log_sigma))
    cost = float(log_sigma.sum() - log_noise_prior(problem, log_sigma) - likelihood)
    return cost, 1.0 - noise_prior_slope(problem, log_sigma) - slope


def gaussian_log_sigma(problem: Problem, square: Floats) -> Floats:
    """Return the most probable log sigma of independent Gaussian residuals, in closed form.

    The density ``-(n + 1) t - S exp(-2 t) / 2 - (t - m)^2 / 2 s^2`` of t = log sigma has its only
    maximum where ``y exp(2 y) = s^2 S exp(2 (a - m))``, with ``a = s^2 (n + 1)`` and
    ``t = y - a + m``: Wright's omega function.

    Parameters
    ----------
    problem : Problem
        Has the number of measurements and the prior of sigma.
    square : ndarray
        Sum of squared residuals of each state dimension, shape (..., state).

    Returns
    -------
    ndarray
        Log sigma, shape (..., state), or (..., 1) for a scalar sigma.
    """
    centre, spread = noise_law(problem)
    count = problem.likelihood.pooled(problem.observations.measured.sum((0, 1, 2)))
    square = problem.likelihood.pooled(square)
    a = spread**2 * (count + 1)
    with np.errstate(divide="ignore"):  # an exact fit
        y = 0.5 * wrightomega(np.log(2 * spread**2 * square) + 2 * (a - centre))
    least = np.log(problem.least_noise)
    return np.asarray(np.maximum(y - a + centre, least if y.shape[-1] > 1 else least.min()))


def gaussian_profile(problem: Problem, square: Floats) -> Floats:
    """Return the log-density of data and sigma at that maximum, up to a constant."""
    t = gaussian_log_sigma(problem, square)
    count = problem.observations.measured.sum((0, 1, 2))
    likelihood = -(count * t + 0.5 * square * np.exp(-2 * t)).sum(axis=-1)
    return np.asarray(likelihood + log_noise_prior(problem, t) - t.sum(axis=-1))


def noise_gaussian(problem: Problem, phi: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Return the Laplace approximation of log noise parameters by second differences.

    It is taken at the mode of the density of the logarithm: at that of the parameters themselves,
    unexplained accelerations may vanish, and their logarithm is not normal.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    phi : ndarray
        Parameters, shape (p,).
    sigma : ndarray
        Most probable noise parameters, shape (parameter,).

    Returns
    -------
    mean, covariance : ndarray
        Shapes (parameter,) and (parameter, parameter); no direction is wider than the prior.
    """
    residual, spread = problem.residual(phi), noise_law(problem)[1]
    begin, n = np.log(sigma), len(sigma)
    floor = np.log(0.1 * problem.noise_prior[0])
    begin = np.where(exponential(problem), np.maximum(begin, floor), begin)

    def cost(at: Floats) -> float:
        return _cost(at, problem, residual, phi) - float(at.sum())

    at = minimize(cost, begin, method="L-BFGS-B", bounds=[(b - _FAR, b + _FAR) for b in begin]).x

    width = 0.05  # of second differences
    middle, hessian, steps = cost(at), np.empty((n, n)), width * np.eye(n)
    for i, one in enumerate(steps):
        hessian[i, i] = (cost(at + one) - 2 * middle + cost(at - one)) / width**2
        for j, other in enumerate(steps[:i]):
            mixed = cost(at + one + other) - cost(at + one - other)
            mixed += cost(at - one - other) - cost(at - one + other)
            hessian[i, j] = hessian[j, i] = mixed / (4 * width**2)
    values, vectors = np.linalg.eigh(hessian)
    return at, np.asarray((vectors / np.maximum(values, spread**-2)) @ vectors.T)


def _tail_cost(problem: Problem, phi: Floats, sigma: Floats) -> Callable[[Floats], float]:
    """Return the negative log-posterior as a function of the tails alone."""
    residual, tails = finite(problem, problem.residual(phi)), list(problem.tails)

    def cost(values: Floats) -> float:
        point = phi.copy()
        point[tails] = values
        likelihood = problem.log_density(residual, sigma, point).sum()
        return -float(likelihood + problem.layout.log_prior(point)[tails].sum())

    return cost


def best_tails(problem: Problem, phi: Floats, sigma: Floats) -> Floats:
    """Return phi with the most probable tails, all else fixed."""
    if not problem.tails:
        return phi
    result, tails = phi.copy(), list(problem.tails)
    bounds = np.transpose([end[tails] for end in box(problem.layout.priors)])
    cost = _tail_cost(problem, phi, sigma)
    result[tails] = minimize(cost, phi[tails], method="L-BFGS-B", bounds=bounds).x
    return result


def tail_precision(problem: Problem, phi: Floats, sigma: Floats) -> Floats:
    """Return the curvature of the negative log-posterior in each tail parameter, at least 1."""
    tails = list(problem.tails)
    lower, upper = (end[tails] for end in box(problem.layout.priors))
    cost = _tail_cost(problem, phi, sigma)
    curvature = np.empty(len(tails))
    for i, step in enumerate(np.minimum(0.02, 0.25 * (upper - lower))):
        middle, move = phi[tails], step * np.eye(len(tails))[i]
        middle[i] = np.clip(middle[i], lower[i] + step, upper[i] - step)
        fall = cost(middle - move) - 2 * cost(middle) + cost(middle + move)
        curvature[i] = max(fall / step**2, 1.0)
    return curvature
