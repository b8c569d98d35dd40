"""Maximum a posteriori tails of the noise, apart from the rest of phi: they move no prediction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes.noise import FAR_OFF
from pbrl_ppl.parameters import box

Array = NDArray[np.float64]

#: Step of a second difference in the tails, and the least curvature.
_STEP, _LEAST = 0.02, 1.0


def _tail_cost(problem: Problem, phi: Array, sigma: Array) -> Callable[[Array], float]:
    """Negative log-posterior as a function of the noise's tails alone."""
    residual, tails = np.nan_to_num(problem.residual(phi), nan=FAR_OFF), list(problem.tails)

    def cost(values: Array) -> float:
        point = phi.copy()
        point[tails] = values
        likelihood = problem.log_density(residual, sigma, point).sum()
        return -float(likelihood + problem.layout.log_prior(point)[tails].sum())

    return cost


def best_tails(problem: Problem, phi: Array, sigma: Array) -> Array:
    """Phi with the maximum a posteriori tails, all else fixed."""
    if not problem.tails:
        return phi
    tails = list(problem.tails)
    lower, upper = (end[tails] for end in box(problem.layout.priors))
    bounds = list(zip(lower, upper, strict=True))
    found = minimize(_tail_cost(problem, phi, sigma), phi[tails], method="L-BFGS-B", bounds=bounds)
    result = phi.copy()
    result[tails] = found.x
    return result


def tail_precision(problem: Problem, phi: Array, sigma: Array) -> Array:
    """Curvature of the negative log-posterior in each of the noise's tails."""
    tails = list(problem.tails)
    lower, upper = (end[tails] for end in box(problem.layout.priors))
    cost = _tail_cost(problem, phi, sigma)
    curvature = np.empty(len(tails))
    for i, step in enumerate(np.minimum(_STEP, 0.25 * (upper - lower))):
        middle = phi[tails].copy()
        middle[i] = np.clip(middle[i], lower[i] + step, upper[i] - step)
        ends = [middle.copy(), middle, middle.copy()]
        ends[0][i] -= step
        ends[2][i] += step
        below, at, above = (cost(end) for end in ends)
        curvature[i] = max((below - 2 * at + above) / step**2, _LEAST)
    return curvature
