"""Cross-validation over whole training trajectories, by one Newton step a fold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.modes import Mode

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

#: With fewer trajectories than this, folds are runs of transitions within them.
LEAST_FOLDS = 8


def folds(mode: Mode) -> Ints:
    """Fold of each transition, shape (transition,): its trajectory, or a run of it.

    Given what was measured before, a run's innovations do not depend on those of another.
    """
    segments = mode.problem.segments
    trajectory, step = segments.trajectory, segments.step
    count = len(np.unique(trajectory))
    if count >= LEAST_FOLDS:
        return np.unique(trajectory, return_inverse=True)[1].astype(np.intp)
    runs = -(-LEAST_FOLDS // count)
    length = np.array([(trajectory == t).sum() for t in trajectory])
    run = np.minimum(step * runs // np.maximum(length, 1), runs - 1)
    return np.unique(trajectory * runs + run, return_inverse=True)[1].astype(np.intp)


def cross_validated(mode: Mode, fold: Ints) -> Array:
    """Log predictive density of each fold under the posterior of all others, shape (fold,).

    The whitened residual z is linear in the parameters about the mode, with Jacobian J and
    posterior precision A of all data; without the rows of a fold the precision is
    ``B = A - J_f' J_f``, and the fold's density is that of a Gaussian whose square is
    ``z_f' z_f + z_f' J_f B^-1 J_f' z_f`` and whose log-determinant is ``log |A| - log |B|``
    (leave-out formulas of linear regression). The noise parameters stay.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    fold : ndarray of int
        Fold of each transition.
    """
    problem = mode.problem
    residual = mode.whitened_residual()
    n, cells = residual.shape
    jacobian = mode.jacobian.reshape(n, cells, -1)
    density = problem.log_density(problem.residual(mode.phi), mode.sigma, mode.phi)
    p = jacobian.shape[-1]
    scale = np.sqrt(np.maximum(np.diag(mode.covariance), 1e-300)) if p else np.ones(0)
    precision = np.linalg.inv(mode.covariance / np.outer(scale, scale)) if p else np.eye(0)
    whole = np.linalg.slogdet(precision)[1]
    result = np.empty(fold.max() + 1)
    for f in range(len(result)):
        own = fold == f
        rows = jacobian[own].reshape(own.sum() * cells, p) * scale
        pull = rows.T @ residual[own].ravel()
        rest = precision - rows.T @ rows
        # what is known of one direction is known from this fold alone: the prior is not much
        values, vectors = np.linalg.eigh(rest)
        values = np.maximum(values, 1e-9 * max(values.max(initial=0.0), 1e-300))
        turned = vectors.T @ pull
        square = float((turned**2 / values).sum())
        result[f] = density[own].sum() - 0.5 * (square + whole - np.log(values).sum())
    return result


def standard_error(gains: Array) -> float:
    """Standard error of a sum of independent gains."""
    return float(np.sqrt(len(gains)) * gains.std(ddof=1)) if len(gains) > 1 else np.inf
