"""Modes of the posterior by climbs from many starts, and the Laplace covariance there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Generic, NamedTuple, TypeGuard

import numpy as np
from scipy.optimize import differential_evolution, least_squares

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import (
    LikelihoodT,
    OutputErrorLikelihood,
    Problem,
    TrajectoryLikelihood,
    estimate_sigma,
    is_filtered,
    is_simulated,
    log_posterior,
)
from pbrl_ppl.modes.noise import (
    FAR_OFF,
    best_tails,
    finite,
    gaussian_profile,
    noise_gaussian,
    profile_sigma,
    tail_precision,
)
from pbrl_ppl.parameters import (
    box,
    by_prior,
    covariance_factor,
    differentiate,
    inside,
    prior_draws,
    prior_residual,
)
from pbrl_ppl.physics import PartedSimulator
from pbrl_ppl.state import Floats
from pbrl_ppl.system.threads import one_blas_thread

#: Gain in log-posterior (nats) below which a climb ends.
_STALLED = 0.02


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
    def factor(self) -> Floats:
        """Cholesky factor of the covariance, shape (p, p)."""
        return covariance_factor(self.covariance)

    def noise_gaussian(self) -> tuple[Floats, Floats]:
        """Return the Laplace approximation of log sigma: mean and covariance.

        Shapes (parameter,) and (parameter, parameter).
        """
        if is_filtered(self.problem):
            return noise_gaussian(self.problem, self.phi, self.sigma)
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
    return is_filtered(mode.problem)


def is_simulated_mode(mode: Mode) -> TypeGuard[SimulatedMode]:
    """Return whether the mode's trajectories are simulated from latent initial states."""
    return is_simulated(mode.problem)


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
    problem: Problem, phi: Floats, slope: PartedSimulator, rounds: int = 40, tries: int = 4
) -> LocalMode:
    """Return a mode by alternating least squares for phi with the most probable sigma.

    Derivatives are taken through the engine ``slope``, in ``rounds`` rounds at most.
    """
    priors = problem.layout.priors
    lower, upper = box(priors)
    sigma, value = profiled(problem, phi)
    if not priors:
        return LocalMode(phi, sigma, value)
    # least squares over multiples of each parameter's scale, whatever its unit
    origin = problem.layout.origin
    scale = problem.layout.scale(phi)
    ends = (lower - origin) / scale, (upper - origin) / scale
    steps = np.full(len(phi), 1e-3)

    def residual(moved: Floats, engine: PartedSimulator | None = None) -> Floats:
        points = np.clip(origin + scale * moved, lower, upper)  # rounding leaves no support
        z = _least_squares(problem, points, sigma, phi, engine)
        return np.nan_to_num(z, nan=FAR_OFF, posinf=FAR_OFF, neginf=-FAR_OFF)

    def jacobian(moved: Floats) -> Floats:
        size = np.minimum(steps, 0.1 * np.maximum(np.abs(moved), steps))
        return differentiate(partial(residual, engine=slope), moved, size, *ends)

    for _ in range(rounds):
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
        if gain < _STALLED:
            break
        size = np.sqrt((result.jac**2).sum(axis=0))
        steps = np.clip(1.0 / np.maximum(size, 1e-300), 1e-6, 0.1)
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
    angles = [prior.family == "von_mises" for prior in priors]
    precision[angles, angles] += 3.0 / np.pi**2  # of a uniform angle: none is wider (1/rad^2)
    n_cells = len(jacobian) - len(phi)
    return Mode(problem, phi, sigma, jacobian[:n_cells], covariance_of(precision), log_posterior)


def covariance_of(precision: Floats) -> Floats:
    """Return the inverse of a precision, shape (p, p), whatever the parameters' units.

    Zero for parameters of no precision; a direction's precision is at least what rounding leaves.
    """
    unit, values, vectors = _spectrum(precision)
    sd = np.where(np.diag(precision) > np.finfo(float).tiny, 1.0 / unit, 0.0)[:, None]
    root = sd * vectors / np.sqrt(np.maximum(values, len(sd) * np.finfo(float).eps))
    return np.asarray(root @ root.T, dtype=float)


def sandwich(inverse: Floats, score: Floats) -> Floats:
    """Return the covariance ``inverse @ score @ inverse``, which rounding leaves positive."""
    unit, values, vectors = _spectrum(score)
    root = inverse @ (unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
    return np.asarray(root @ root.T, dtype=float)


def _spectrum(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the roots of a matrix's diagonal, and the spectrum in units of them."""
    unit = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    return unit, *np.linalg.eigh(matrix / unit / unit[:, None])


@one_blas_thread
def find_modes(problem: Problem[LikelihoodT], *, seed: int = 0) -> list[Mode[LikelihoodT]]:
    """Return modes found from several starts, best first.

    Parameters
    ----------
    problem : Problem
        What to fit.
    seed : int
        Of the draws from the prior.

    Returns
    -------
    list of Mode
        At least one.

    Raises
    ------
    FitError
        If a joint's bodies are unknown: modes are sought over continuous parameters.
    """
    _refuse_discrete(problem)
    priors, coarse = problem.layout.priors, problem.coarse.physics.simulator
    if not priors:  # everything is known but the noise
        return [finish(problem, climb(problem, np.zeros(0), coarse))]
    few = problem.segments.n <= 20
    # more starts with few data: they cost little, and friction makes more modes
    starts, screened = (16, 1000) if few else (4, 48)
    rng = np.random.default_rng(seed)
    draws = np.vstack([[prior.centre for prior in priors], prior_draws(priors, rng, screened)])
    draws = inside(priors, draws)
    # the basins show in a part of the data already, and with few engine steps
    part = problem if few else _part(problem, 40)
    residual = part.residual(draws)
    sigma = estimate_sigma(np.nanmedian(residual, axis=0), part.observations, part.scene)
    z = np.nan_to_num(residual / sigma, nan=FAR_OFF).reshape(len(draws), -1)
    # log(1 + z^2): a good start fits most transitions, not the worst one
    order = np.argsort(np.log1p(np.minimum(z, FAR_OFF) ** 2).sum(axis=1))
    begin = draws[order[:starts]]
    if few:
        begin = np.vstack([begin, _evolve(problem, rng)])
    peaks = [climb(part, phi, part.physics.simulator) for phi in begin]
    peaks = _distinct(part, [canonical_wheels(part, peak) for peak in peaks])
    if not few:  # all data may join what a part of them told apart
        peaks = [climb(problem, phi, coarse) for phi, *_ in peaks[:2]]
        peaks = _distinct(problem.coarse, peaks)
    best = _polish(problem, peaks[0])
    return [finish(problem, peak) for peak in (best, *peaks[1:])]


def _refuse_discrete(problem: Problem) -> None:
    """Raise a FitError if a joint's bodies are unknown."""
    if problem.layout.discrete.any():
        raise FitError(
            "which bodies a joint of the scene joins is unknown, and a mode is one of continuous"
            " parameters; name the bodies in the scene: pbrl_ppl.fit finds them, and"
            " joint_probabilities says which they are"
        )


def _evolve(problem: Problem, rng: np.random.Generator) -> Floats:
    """Return the best eight points of differential evolution, best first, shape (8, p).

    Where few transitions slide, the mode may be too narrow for draws from the prior to find. The
    exact engine is needed: with fewer steps, friction's kinks are elsewhere. There are none with
    more than 15 parameters, or where it would take more than 2e7 engine steps.
    """
    priors, population, generations = problem.layout.priors, 200, 120
    steps = problem.physics.simulator.steps * problem.segments.n * problem.data.horizon
    if len(priors) > 15 or steps * population * generations >= 2e7:
        return np.zeros((0, len(priors)))
    draws = prior_draws(priors, rng, population)
    measured = problem.observations.measured

    def cost(points: Floats) -> Floats:
        phi = inside(priors, points.T)
        residual = np.where(measured, finite(problem, problem.residual(phi)), 0.0)
        fit = gaussian_profile(problem, (residual**2).sum((1, 2, 3)))
        return np.asarray(-fit - problem.layout.log_prior(phi).sum(axis=-1))

    lower, upper = box(priors)
    lower = np.where(np.isfinite(lower), lower, draws.min(axis=0))
    upper = np.where(np.isfinite(upper), upper, draws.max(axis=0))
    result = differential_evolution(
        cost, list(zip(lower, upper, strict=True)), init=draws, rng=rng,
        strategy="rand1bin", recombination=0.9, maxiter=generations, polish=False,
        vectorized=True, updating="deferred", tol=0.0, atol=_STALLED,
    )  # fmt: skip
    best = np.argsort(result.population_energies)[:8]
    return inside(priors, result.population[best])


def _distinct(problem: Problem, peaks: list[LocalMode]) -> list[LocalMode]:
    """Return peaks, best first, without those that predict as a better one and are connected to it.

    Equivalent wheels and uninformed directions are connected; mirror images are not: they predict
    the same, but points between them do not.
    """
    if len(peaks) == 1:
        return peaks
    peaks = sorted(peaks, key=lambda peak: -peak.log_posterior)
    folded = by_prior(problem.layout, np.array([peak.phi for peak in peaks]))
    z = np.nan_to_num(problem.whitened(folded, peaks[0].sigma), nan=FAR_OFF)
    kept: dict[int, Floats] = {}
    for i in range(len(peaks)):
        # sums of squares in noise units: predictions within 10 agree; they are of different modes
        # if by the derivative they should differ by 100, ten standard deviations
        same = [j for j in kept if ((z[i] - z[j]) ** 2).sum() < 10.0]
        if not any(((kept[j] @ (folded[i] - folded[j])) ** 2).sum() < 100.0 for j in same):
            kept[i] = finish(problem, peaks[i]).jacobian
    return [peaks[i] for i in kept]


def _part(problem: Problem, transitions: int) -> Problem:
    """Return the coarse problem on evenly chosen trajectories of about this many transitions."""
    history = problem.data.history
    share = transitions / max(problem.segments.n, 1)
    count = max(2, math.ceil(share * history.n_trajectories))
    if is_filtered(problem) or count >= history.n_trajectories:
        return problem.coarse
    chosen = np.linspace(0, history.n_trajectories - 1, count).astype(int)
    part = problem.coarse.with_data(history=history.select(chosen))
    same = part.observations.columns == problem.observations.columns
    return part if same else problem.coarse


@one_blas_thread
def find_mode(
    problem: Problem[LikelihoodT], *, seed: int = 0, initial: Floats | None = None, rounds: int = 0
) -> Mode[LikelihoodT]:
    """Return the best mode with others that are not far below it; see :func:`find_modes`.

    From ``initial``, shape (p,), there is one local search; with ``rounds`` it has so many at most,
    and no polish: a first look at where it leads.
    """
    if initial is not None:
        _refuse_discrete(problem)
        begin, coarse = inside(problem.layout.priors, initial), problem.coarse.physics.simulator
        if rounds:
            return finish(problem, climb(problem, begin, coarse, rounds))
        return finish(problem, _polish(problem, climb(problem, begin, coarse)))
    best, *others = find_modes(problem, seed=seed)
    # a mode lower by 20 nats holds no share of the posterior, however wide it is
    near = (mode for mode in others if mode.log_posterior > best.log_posterior - 20.0)
    return replace(best, others=tuple(near))


def near_mode(problem: Problem[LikelihoodT], phi: Floats) -> Mode[LikelihoodT]:
    """Return the mode near parameters, shape (p,), by a few rounds of a climb."""
    return find_mode(problem, initial=phi, rounds=5)


def _polish(problem: Problem, start: LocalMode, *, worthwhile: float = 5.0) -> LocalMode:
    """Return a peak refined with the exact engine, if that raises the log-posterior.

    ``worthwhile``: gain in log-posterior which shows that the coarse derivative had not led to the
    top. (Friction makes the top rough: some units are within its grain.)
    """
    if not problem.layout.size:
        return start
    start = canonical_wheels(problem, start)
    exact = climb(problem, start.phi, problem.physics.simulator, rounds=1, tries=2)
    if exact.log_posterior < start.log_posterior + worthwhile:
        return max(start, exact, key=lambda peak: peak.log_posterior)
    return climb(problem, exact.phi, problem.physics.simulator)
