"""Cross-validation over whole training trajectories, from the model linearised at its mode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm, t, wilcoxon

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.forecast import forecast
from pbrl_ppl.likelihood import robust
from pbrl_ppl.modes import Mode, profile_sigma
from pbrl_ppl.parameters import box, differentiate, inside, prior_residual, prior_slopes
from pbrl_ppl.state import Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Predictions of each fold from a fit to all others.

    Parameters
    ----------
    density : ndarray
        Log predictive density of each fold, shape (fold,).
    phi, sigma : ndarray
        Parameters and noise parameters fitted without it, shapes (fold, p) and (fold, parameter).
    """

    density: Floats
    phi: Floats
    sigma: Floats


@dataclass(frozen=True, eq=False)
class Change:
    """Sum over folds of one model's gain over another.

    Parameters
    ----------
    total : float
        The sum.
    error : float
        Its standard error; infinite for a single fold.
    folds : int
        Number of folds.
    signed_rank : float
        One-sided p-value of Wilcoxon's signed-rank test that folds gain: one fold that gains far
        more than others makes the standard error large, but the gain no less certain.
    """

    total: float
    error: float
    folds: int
    signed_rank: float = 1.0

    @classmethod
    def of(cls, gains: Floats) -> Change:
        """Sum the gains of independent folds, shape (fold,)."""
        n = len(gains)
        error = float(np.sqrt(n) * gains.std(ddof=1)) if n > 1 else np.inf
        ranked = float(wilcoxon(gains, alternative="greater").pvalue) if gains.any() else 1.0
        return cls(float(gains.sum()), error, n, ranked)

    def needed(self, errors: float) -> float:
        """Return the smallest sum that is as certain as so many standard errors of many folds."""
        if self.folds < 2:
            return np.inf
        return float(t.isf(norm.sf(errors), self.folds - 1)) * self.error

    def certain(self, errors: float) -> bool:
        """Return whether the gain is as certain as so many standard errors of many folds."""
        if self.total <= 0:
            return False
        return self.total >= self.needed(errors) or self.signed_rank < norm.sf(errors)


def folds(mode: Mode, criteria: Criteria = DEFAULT) -> Ints:
    """Return the fold of each transition, shape (transition,): its trajectory, or a run of it.

    Given the measurements before, innovations of different runs are independent.
    """
    segments = mode.problem.segments
    trajectory, step = segments.trajectory, segments.step
    count, least = trajectory_count(mode), criteria.selection.least_trajectories
    if count >= least:
        return np.unique(trajectory, return_inverse=True)[1].astype(np.intp)
    runs = -(-least // count)
    length = np.array([(trajectory == t).sum() for t in trajectory])
    run = np.minimum(step * runs // np.maximum(length, 1), runs - 1)
    return np.unique(trajectory * runs + run, return_inverse=True)[1].astype(np.intp)


def trajectory_count(mode: Mode) -> int:
    """Return the number of trajectories that a mode was fitted to."""
    return len(np.unique(mode.problem.segments.trajectory))


def leave_out(mode: Mode, fold: Ints) -> LeftOut:
    """Return the predictions of each fold from a fit to all others.

    The noise is estimated anew without the fold, whose measurements count as missing. The whitened
    residual z under that noise is linear in the parameters about the mode, with Jacobian J and
    posterior precision A of all data; without the rows of a fold the precision is
    ``B = A - J_f' J_f``, and the fold's density is that of a Gaussian whose square is
    ``z_f' z_f + z_f' J_f B^-1 J_f' z_f`` and whose log-determinant is ``log |A| - log |B|``
    (leave-out formulas of linear regression).

    Parameters
    ----------
    mode : Mode
        Fitted to whole trajectories.
    fold : ndarray of int
        Fold of each transition, from 0 on.
    """
    problem, phi = mode.problem, mode.phi
    priors, count = problem.layout.priors, int(fold.max()) + 1
    scale = np.sqrt(np.maximum(np.diag(mode.covariance), 1e-300))
    slopes = prior_slopes(priors, phi) * scale
    # beside the data: the prior, and what a circle or a tail's curvature adds
    rows = mode.jacobian * scale
    least = slopes**2
    if len(phi):
        inverse = np.linalg.pinv(mode.covariance / np.outer(scale, scale), hermitian=True)
        least = np.maximum(least, np.diag(inverse) - (rows**2).sum(axis=0))
    prior = np.diag(least)
    pull = slopes * prior_residual(priors, phi)
    residual = problem.residual(phi)
    without = _linearised(mode, residual, scale)
    density, sigmas = np.empty(count), np.empty((count, len(mode.sigma)))
    phis = np.empty((count, len(phi)))
    for f in range(count):
        members = fold == f
        sigma, z, jacobian = without(members)
        out, inner = (
            jacobian[rows].reshape(z[rows].size, len(phi)) for rows in (members, ~members)
        )
        rest = inner.T @ inner + prior
        whole = rest + out.T @ out
        # the optimiser stops near the top; the rest of the step must not count for this fold
        gradient = out.T @ z[members].ravel() + inner.T @ z[~members].ravel() + pull
        move, free = _to_top(mode, whole, gradient, scale)
        at_top = z[members].ravel() + out @ move
        gained = 0.5 * float((z[members] ** 2).sum() - (at_top**2).sum())
        slope = out[:, free].T @ at_top
        values, vectors = np.linalg.eigh(rest[free][:, free])
        values = np.maximum(values, 1e-300)
        part = vectors.T @ slope
        spread = np.linalg.slogdet(whole[free][:, free])[1] - np.log(values).sum()
        gained -= 0.5 * float((part**2 / values).sum() + spread)
        move[free] += vectors @ (part / values)
        density[f] = problem.log_density(residual, sigma, phi)[members].sum() + gained
        phis[f], sigmas[f] = inside(priors, phi + scale * move), sigma
    return LeftOut(density, phis, sigmas)


def gain(before: Mode, after: Mode, criteria: Criteria = DEFAULT) -> Change:
    """Return the gain in cross-validated log predictive density of one model over another."""
    fold = folds(after, criteria)
    return Change.of(leave_out(after, fold).density - leave_out(before, fold).density)


def forecast_squares(mode: Mode, fold: Ints, left_out: LeftOut, intervals: int) -> Floats:
    """Return sums of squared forecast errors of each fold, from the fit without it.

    Parameters
    ----------
    mode : Mode
        Fitted to whole trajectories.
    fold : ndarray of int
        Fold of each transition.
    left_out : LeftOut
        Fits without these folds.
    intervals : int
        Length of the forecasts.

    Returns
    -------
    ndarray
        Shape (fold, cell), SI units squared; NaN where no forecast begins, nothing was measured or
        one diverges.
    """
    cells = len(mode.problem.trajectory_noise.coordinates.places)
    squares = np.full((len(left_out.phi), cells), np.nan)
    for f, (phi, sigma) in enumerate(zip(left_out.phi, left_out.sigma, strict=True)):
        error = forecast(mode.problem, phi, sigma, intervals, within=fold == f).error
        total = np.nansum(error**2, axis=0)
        some = np.isfinite(total) & ~np.isnan(error).all(axis=0)
        squares[f] = np.where(some, total, np.nan)
    return squares


def relative_fall(before: Floats, after: Floats) -> Change:
    """Return the share by which errors fall, from sums of squares, shape (fold, coordinate).

    A fold or coordinate without forecasts is NaN. To first order, half of the fall of squares.
    """
    some = np.isfinite(before).any(axis=1)
    before, after = before[some], after[some]
    if not len(before):
        return Change(0.0, np.inf, 0)
    unit = np.nansum(before, axis=0)
    cells = unit > 0
    falls = np.nan_to_num((before - after)[:, cells] / unit[cells]).mean(axis=1) / 2
    return Change.of(falls)


def _linearised(
    mode: Mode, residual: Floats, scale: Floats
) -> Callable[[Bools], tuple[Floats, Floats, Floats]]:
    """Return a function that fits noise, whitened residual and Jacobian without some rows.

    The last two have the shapes (transition, cell) and (transition, cell, p), the Jacobian by the
    parameters in units of ``scale``. Under Eq. 11 the noise stays.
    """
    problem, phi, p = mode.problem, mode.phi, len(mode.phi)
    if problem.likelihood.independent:
        z = problem.robust(phi, mode.sigma)
        jacobian = mode.jacobian.reshape(*z.shape, p) * scale
        return lambda fold: (mode.sigma, z, jacobian)
    noise = problem.trajectory_noise
    nu = noise.of_coordinates(problem.nu(phi), residual.shape)
    slopes = _residual_slopes(mode, scale)
    nothing = np.zeros_like(noise.begin)
    still = replace(noise, begin=nothing, measured=nothing)
    step = 1e-4  # of a whitened residual

    def without(fold: Bools) -> tuple[Floats, Floats, Floats]:
        hidden = replace(noise, seen=noise.seen & ~fold[:, None], sigma=mode.sigma)
        sigma = profile_sigma(problem.along(hidden), residual, phi)
        z = noise.whiten(residual, sigma)
        white = still.filtered(slopes, sigma)[0]
        weight = (robust(z + step, nu) - robust(z - step, nu)) / (2 * step)
        return sigma, robust(z, nu), np.moveaxis(white * weight, 0, -1)

    return without


def _residual_slopes(mode: Mode, scale: Floats, informed_share: float = 0.7) -> Floats:
    """Return the derivative of residuals by parameters in units of ``scale``.

    Shape (p, transition, coordinate). Steps are a posterior standard deviation where that is less
    than ``informed_share`` of the prior's.
    """
    problem, priors = mode.problem, mode.problem.layout.priors
    coordinates = problem.trajectory_noise.coordinates
    if not priors:
        return np.zeros((0, problem.segments.n, len(coordinates.places)))
    lower, upper = box(priors)
    informed = scale * np.abs(prior_slopes(priors, mode.phi)) < informed_share

    def residual(points: Floats) -> Floats:
        return np.nan_to_num(coordinates.of_residual(problem.residual(points)))

    # a long step of a parameter that the data do not inform would cross thresholds
    steps = np.where(informed, scale, 1e-3 * np.minimum(scale, problem.layout.scale(mode.phi)))
    steps[list(problem.tails)] = 0.0  # they change the density, not the residual
    slopes = differentiate(residual, mode.phi, steps, lower, upper) * scale
    return np.ascontiguousarray(np.moveaxis(slopes, -1, 0))


def _to_top(mode: Mode, precision: Floats, gradient: Floats, scale: Floats) -> tuple[Floats, Bools]:
    """Return the step from a mode to the top of its Gaussian, and which parameters are free there.

    Precision, gradient and step are in units of ``scale``, shape (p,).
    """
    move, free = np.zeros(len(gradient)), np.ones(len(gradient), dtype=bool)
    while free.any():
        slope = (gradient + precision @ move)[free]
        wanted = move.copy()
        wanted[free] -= np.linalg.solve(precision[free][:, free], slope)
        top = inside(mode.problem.layout.priors, mode.phi + scale * wanted)
        move = (top - mode.phi) / scale
        stopped = free & (np.abs(move - wanted) > 1e-6)  # by a bound, and not by rounding
        if not stopped.any():
            break
        free &= ~stopped
    return move, free
