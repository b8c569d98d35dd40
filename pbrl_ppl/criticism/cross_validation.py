"""Cross-validation over whole training trajectories, by one Newton step a fold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import inside, prior_residual, prior_slopes

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

#: With fewer trajectories than this, folds are runs of transitions within them.
LEAST_FOLDS = 8
#: A step that a bound shortens by more than this (standard deviations) is stopped by it.
_ROUNDING = 1e-6


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
    problem, p = mode.problem, len(mode.phi)
    residual = mode.whitened_residual()
    n, cells = residual.shape
    scale = np.sqrt(np.maximum(np.diag(mode.covariance), 1e-300))
    jacobian = mode.jacobian.reshape(n, cells, p) * scale
    density = problem.log_density(problem.residual(mode.phi), mode.sigma, mode.phi)
    grams = np.array([_gram(jacobian[fold == f]) for f in range(fold.max() + 1)])
    slopes = prior_slopes(problem.layout.priors, mode.phi) * scale
    whole = np.linalg.inv(mode.covariance / np.outer(scale, scale)) if p else np.eye(0)
    prior = np.diag(np.maximum(slopes**2, np.diag(whole - grams.sum(axis=0))))
    # a climb ends near the top, and what one fold alone knows of would be pulled far from there
    gradient = np.einsum("kcp,kc->p", jacobian, residual)
    gradient += slopes * prior_residual(problem.layout.priors, mode.phi)
    precision = grams.sum(axis=0) + prior
    move, free = _to_top(mode, precision, gradient, scale)
    at_top = residual + jacobian @ move
    density = density + 0.5 * (residual**2 - at_top**2).sum(axis=1)
    jacobian, grams = jacobian[..., free], grams[:, free][:, :, free]
    prior, log_whole = prior[free][:, free], np.linalg.slogdet(precision[free][:, free])[1]
    result = np.empty(fold.max() + 1)
    for f in range(len(result)):
        own = fold == f
        pull = np.einsum("kcp,kc->p", jacobian[own], at_top[own])
        values, vectors = np.linalg.eigh(np.delete(grams, f, axis=0).sum(axis=0) + prior)
        values = np.maximum(values, 1e-300)
        square = float(((vectors.T @ pull) ** 2 / values).sum())
        result[f] = density[own].sum() - 0.5 * (square + log_whole - np.log(values).sum())
    return result


def _to_top(
    mode: Mode, precision: Array, gradient: Array, scale: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Step from a mode to the top of its Gaussian, and which parameters no bound stops there.

    Precision, gradient and step are in units of ``scale``, shape (p,).
    """
    move, free = np.zeros(len(gradient)), np.ones(len(gradient), dtype=bool)
    while free.any():
        slope = (gradient + precision @ move)[free]
        wanted = move.copy()
        wanted[free] -= np.linalg.solve(precision[free][:, free], slope)
        top = inside(mode.problem.layout.priors, mode.phi + scale * wanted)
        move = (top - mode.phi) / scale
        stopped = free & (np.abs(move - wanted) > _ROUNDING)
        if not stopped.any():
            break
        free &= ~stopped
    return move, free


def _gram(rows: Array) -> Array:
    """Precision that rows of a Jacobian (transition, cell, p) give, shape (p, p)."""
    return np.asarray(np.einsum("kcp,kcq->pq", rows, rows))


def standard_error(gains: Array) -> float:
    """Standard error of a sum of independent gains."""
    return float(np.sqrt(len(gains)) * gains.std(ddof=1)) if len(gains) > 1 else np.inf
