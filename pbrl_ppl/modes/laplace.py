"""Modes of the posterior by Gauss-Newton steps, and the Laplace covariance there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Generic, NamedTuple, TypeGuard

import numpy as np
from scipy.optimize import least_squares

from pbrl_ppl.likelihood import (
    LikelihoodT,
    OutputErrorLikelihood,
    Problem,
    TrajectoryLikelihood,
    log_posterior,
)
from pbrl_ppl.modes.noise import FAR_OFF, best_tails, noise_gaussian, profile_sigma, tail_precision
from pbrl_ppl.parameters import (
    Prior,
    box,
    by_prior,
    covariance_factor,
    differentiate,
    inside,
    prior_residual,
)
from pbrl_ppl.physics import PartedSimulator
from pbrl_ppl.state import Floats

#: Gain in log-posterior below which a climb ends.
STALLED = 0.02
#: Rounds of a climb, at most.
ROUNDS = 40
#: Root of a precision up to which a parameter has no information.
_NONE = 1e-150
#: Precision of a uniform angle: 1 / variance (1/rad^2).
_CIRCLE = 3.0 / np.pi**2


class LocalMode(NamedTuple):
    """The end of a climb."""

    phi: Floats
    sigma: Floats
    log_posterior: float


@dataclass(frozen=True, eq=False)
class Mode(Generic[LikelihoodT]):
    """A mode of the posterior.

    Parameters
    ----------
    problem : Problem
        What was fitted.
    phi : ndarray
        Parameters in the layout's order, shape (p,), SI units.
    sigma : ndarray
        Noise of each state dimension, shape (state,).
    jacobian : ndarray
        Derivative of the whitened residual by phi, shape (transition * cell, p).
    covariance : ndarray
        Laplace covariance of phi, shape (p, p).
    log_posterior : float
        Value of :func:`pbrl_ppl.likelihood.log_posterior`.
    others : tuple of Mode
        Lower modes that may hold a share of the posterior.
    """

    problem: Problem[LikelihoodT]
    phi: Floats
    sigma: Floats
    jacobian: Floats
    covariance: Floats
    log_posterior: float
    others: tuple[Mode[LikelihoodT], ...] = ()

    @property
    def values(self) -> dict[str, Floats]:
        """Parameters by name, shape (body,) each."""
        return self.problem.layout.to_dict(self.phi)

    @property
    def factor(self) -> Floats:
        """Cholesky factor of the covariance, shape (p, p)."""
        return covariance_factor(self.covariance)

    def noise_gaussian(self) -> tuple[Floats, Floats]:
        """Return the Laplace approximation of log sigma: mean and covariance.

        Shapes (parameter,) and (parameter, parameter).
        """
        if isinstance(self.problem.likelihood, TrajectoryLikelihood):
            residual = self.problem.residual(self.phi)
            return noise_gaussian(self.problem, residual, self.sigma, self.phi)
        # half the inverse of the number of measurements
        counts = self.problem.likelihood.counts(self.problem.observations)
        return np.log(self.sigma), np.diag(0.5 / np.maximum(counts, 1))

    def draws(self, rng: np.random.Generator, n: int) -> Floats:
        """Draw phi from the Laplace approximation, clipped to the supports, shape (n, p)."""
        moved = self.phi + rng.standard_normal((n, len(self.phi))) @ self.factor.T
        return inside(self.problem.layout.priors, moved)

    @cached_property
    def whitened_residual(self) -> Floats:
        """Residuals in units of noise, shape (transition, coordinate); read-only."""
        residual = self.problem.whitened(self.phi, self.sigma)
        residual.setflags(write=False)
        return residual


#: Modes of filtered and of simulated trajectories.
FilteredMode = Mode[TrajectoryLikelihood]
SimulatedMode = Mode[OutputErrorLikelihood]


def is_filtered_mode(mode: Mode) -> TypeGuard[FilteredMode]:
    """Return whether the mode's trajectories are filtered, with process noise."""
    return isinstance(mode.problem.likelihood, TrajectoryLikelihood)


def is_simulated_mode(mode: Mode) -> TypeGuard[SimulatedMode]:
    """Return whether the mode's trajectories are simulated from latent initial states."""
    return isinstance(mode.problem.likelihood, OutputErrorLikelihood)


def posterior_slopes(
    function: Callable[[Floats], Floats],
    phi: Floats,
    lower: Floats,
    upper: Floats,
    begin: Floats,
    coarse: Callable[[Floats], Floats] | None = None,
    *,
    least: float = 1e-3,
) -> Floats:
    """Return the derivative with steps of one posterior standard deviation.

    Friction makes kinks; a derivative over the posterior's own scale sees their average, one over a
    tiny step sees whichever side it is on. The posterior's scale comes from the derivative over the
    steps ``begin``, shape (p,), of the function or a cheaper one, ``coarse``.

    ``least``: the shortest steps, as a share of ``begin``.
    """
    size = np.sqrt((differentiate(coarse or function, phi, begin, lower, upper) ** 2).sum(axis=0))
    steps = np.clip(1.0 / np.maximum(size, 1e-300), least * begin, 1e2 * begin)
    return differentiate(function, phi, steps, lower, upper)


def climb(
    problem: Problem, phi: Floats, slope: PartedSimulator, rounds: int = ROUNDS, tries: int = 4
) -> LocalMode:
    """Return a mode by alternating least squares for phi with the most probable sigma.

    Derivatives are taken through the engine ``slope``.
    """
    priors = problem.layout.priors
    lower, upper = box(priors)
    sigma, value = profiled(problem, phi)
    if not priors:
        return LocalMode(phi, sigma, value)
    # least squares over multiples of each parameter's scale, whatever its unit
    origin = problem.layout.origin
    scale = np.where(problem.layout.discrete, 1.0, problem.layout.scale(phi))
    ends = (lower - origin) / scale, (upper - origin) / scale
    steps = np.where(problem.layout.discrete, 0.0, 1e-3)

    def whole(moved: Floats, sigma: Floats, engine: PartedSimulator | None = None) -> Floats:
        points = np.clip(origin + scale * moved, lower, upper)  # rounding leaves no support
        z = _least_squares(problem, points, sigma, phi, engine)
        return np.nan_to_num(z, nan=FAR_OFF, posinf=FAR_OFF, neginf=-FAR_OFF)

    for _ in range(rounds):

        def residual(moved: Floats, sigma: Floats = sigma) -> Floats:
            return whole(moved, sigma)

        def jacobian(moved: Floats, sigma: Floats = sigma, steps: Floats = steps) -> Floats:
            size = np.minimum(steps, 0.1 * np.maximum(np.abs(moved), steps))
            return differentiate(lambda points: whole(points, sigma, slope), moved, size, *ends)

        result = least_squares(
            residual, (phi - origin) / scale, jac=jacobian, bounds=ends, x_scale="jac",
            max_nfev=tries, ftol=1e-6, xtol=1e-6, gtol=1e-6,
        )  # fmt: skip
        reached = np.clip(origin + scale * result.x, lower, upper)
        reached = best_tails(problem, reached, sigma)
        better, improved = profiled(problem, reached)
        if improved < value:
            break
        phi, sigma, gain, value = reached, better, improved - value, improved
        if gain < STALLED:
            break
        size = np.sqrt((result.jac**2).sum(axis=0))
        steps = np.where(steps > 0, np.clip(1.0 / np.maximum(size, 1e-300), 1e-6, 0.1), 0.0)
    return LocalMode(phi, sigma, value)


def _least_squares(
    problem: Problem, points: Floats, sigma: Floats, phi: Floats, engine: PartedSimulator | None
) -> Floats:
    """Return residuals of the data and the prior at points (..., p), shape (..., residual).

    The tails are those of phi: least squares do not find them, see :func:`best_tails`.
    """
    points, tails = points.copy(), list(problem.tails)
    points[..., tails] = phi[tails]
    z = problem.robust(points, sigma, engine).reshape(*points.shape[:-1], -1)
    return np.concatenate([z, prior_residual(problem.layout.priors, points)], axis=-1)


def profiled(problem: Problem, phi: Floats) -> tuple[Floats, float]:
    """Return the most probable sigma at phi, and the log-posterior there."""
    residual = problem.residual(phi)
    sigma = profile_sigma(problem, residual, phi)
    likelihood = problem.log_density(residual, sigma, phi).sum()
    return sigma, float(log_posterior(problem, phi, sigma, log_likelihood=likelihood))


def canonical_wheels(problem: Problem, peak: LocalMode) -> LocalMode:
    """Return a peak with each wheel in its most probable description; it predicts the same."""
    better = by_prior(problem.layout, peak.phi)
    gain = problem.layout.log_prior(better) - problem.layout.log_prior(peak.phi)
    return LocalMode(better, peak.sigma, peak.log_posterior + float(gain.sum()))


def finish(problem: Problem[LikelihoodT], peak: LocalMode) -> Mode[LikelihoodT]:
    """Return the mode at a peak, with the Jacobian taken at the posterior's scale."""
    phi, sigma, log_posterior = canonical_wheels(problem, peak)
    priors = problem.layout.priors
    if not priors:
        cells = problem.observations.values.size
        return Mode(problem, phi, sigma, np.zeros((cells, 0)), np.zeros((0, 0)), log_posterior)
    lower, upper = box(priors)

    def residual(points: Floats, engine: PartedSimulator | None = None) -> Floats:
        return np.nan_to_num(_least_squares(problem, points, sigma, phi, engine))

    begin = 1e-3 * problem.layout.scale(phi)
    coarse = partial(residual, engine=problem.coarse.physics.simulator)
    jacobian = posterior_slopes(residual, phi, lower, upper, begin, coarse)
    precision = jacobian.T @ jacobian
    if problem.tails:
        tails = list(problem.tails)
        precision[tails, tails] = tail_precision(problem, phi, sigma)
    covariance = laplace_covariance(priors, precision)
    n_cells = len(jacobian) - len(phi)
    return Mode(problem, phi, sigma, jacobian[:n_cells], covariance, log_posterior)


def laplace_covariance(priors: Sequence[Prior], precision: Floats) -> Floats:
    """Return the covariance of parameters, shape (p, p); no angle is wider than its circle."""
    angles = [i for i, prior in enumerate(priors) if prior.family == "von_mises"]
    precision = precision.copy()
    precision[angles, angles] += _CIRCLE
    return covariance_of(precision)


def covariance_of(precision: Floats) -> Floats:
    """Return the inverse of a precision, shape (p, p), whatever the parameters' units.

    Zero for parameters of no precision; a direction's precision is at least what rounding leaves.
    """
    unit, values, vectors = _spectrum(precision)
    sd = np.where(unit > _NONE, 1.0 / unit, 0.0)[:, None]
    root = sd * vectors / np.sqrt(np.maximum(values, len(sd) * np.finfo(float).eps))
    return np.asarray(root @ root.T, dtype=float)


def sandwich(inverse: Floats, score: Floats) -> Floats:
    """Return the covariance ``inverse @ score @ inverse``, which rounding leaves positive."""
    unit, values, vectors = _spectrum(score)
    root = inverse @ (unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
    return np.asarray(root @ root.T, dtype=float)


def _spectrum(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the roots of a matrix's diagonal, and the spectrum in units of them."""
    unit = np.sqrt(np.maximum(np.diag(matrix), _NONE**2))
    return unit, *np.linalg.eigh(matrix / unit / unit[:, None])
