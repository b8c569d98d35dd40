"""Modes of the posterior: multi-start Gauss-Newton, and a Laplace covariance at each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution, least_squares, minimize

from pbrl_ppl.differences import differentiate
from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import StartNoise, estimate_sigma, robust, whiten
from pbrl_ppl.model import COARSE, Problem
from pbrl_ppl.parameters import Prior
from pbrl_ppl.physics import PartedSimulator

Array = NDArray[np.float64]
#: Where a climb ended: phi, sigma and the log-posterior there.
Peak = tuple[Array, Array, float]

#: How far inside a bound the search stays, as a share of the interval or of one unit.
_MARGIN = 1e-6
#: A residual beyond this many noise units says no more about where the mode is.
_SCREEN_CLIP = 1e3
#: Transitions used to tell basins apart, and how many of the best are searched with all data; with
#: no more than so many transitions, all are.
_PART, _POLISHED, _FEW = 60, 2, 20
#: Population and generations that look for the hill of few data, how many of them are climbed
#: from, the most parameters that is for, and the most engine steps it may take.
_POPULATION, _GENERATIONS, _EVOLVED, _MOST_EVOLVED, _AFFORDED = 200, 120, 8, 15, 2e7
#: Gains in log-posterior: less is not worth another round; more shows that the coarse derivative
#: had not led to the top. (Friction makes the top rough: some units are within its grain.)
_STALLED, _WORTHWHILE = 0.02, 5.0
#: Predictions this close (sum of squares, in noise units) are of the same mode.
_SAME = 10.0
#: Parameters whose predictions agree are of different hills if by the derivative they should differ
#: by this (sum of squares, in noise units): ten standard deviations.
_FAR = 100.0
#: Log-posterior by which a mode is too low to hold a share of the posterior, however wide it is.
_LOWER = 20.0
#: How small the noise may seem beside its typical size while basins are compared.
_EXACT = 1e-3


@dataclass(frozen=True, eq=False)
class Mode:
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
        Log-likelihood plus log-prior of phi, up to a constant of the priors.
    others : tuple of Mode
        Lower ones, that may yet hold a share of the posterior.
    """

    problem: Problem
    phi: Array
    sigma: Array
    jacobian: Array
    covariance: Array
    log_posterior: float
    others: tuple[Mode, ...] = ()

    @property
    def values(self) -> dict[str, Array]:
        """Parameters by name, shape (body,) each."""
        return self.problem.layout.to_dict(self.phi)

    @property
    def factor(self) -> Array:
        """Cholesky factor of the covariance, shape (p, p)."""
        jitter = 1e-15 * np.eye(len(self.phi))
        return np.asarray(np.linalg.cholesky(self.covariance + jitter), dtype=float)

    def draws(self, rng: np.random.Generator, n: int) -> Array:
        """Draws of phi from the Laplace approximation, cut at the supports, shape (n, p)."""
        moved = self.phi + rng.standard_normal((n, len(self.phi))) @ self.factor.T
        return inside(self.problem.layout.priors, moved)

    @property
    def whitened(self) -> Array:
        """Residuals in units of noise, shape (transition, cell)."""
        return self.problem.whitened(self.phi, self.sigma)


def prior_residual(priors: tuple[Prior, ...], phi: Array) -> Array:
    """Each prior's least-squares residual, shape (..., p)."""
    columns = [prior.residual(phi[..., i]) for i, prior in enumerate(priors)]
    return np.stack(columns, axis=-1) if columns else np.zeros_like(phi)


def inside(priors: tuple[Prior, ...], phi: Array) -> Array:
    """Move values just inside their supports, shape (..., p)."""
    lower, upper = _box(priors)
    return np.clip(phi, lower, upper)


def _box(priors: tuple[Prior, ...]) -> tuple[Array, Array]:
    """Bounds of the search: the supports, less a margin; whole numbers may be at either end."""
    support = np.array([prior.support for prior in priors]).reshape(-1, 2)
    width = np.where(np.isfinite(np.ptp(support, axis=1)), np.ptp(support, axis=1), 1.0)
    width[[prior.discrete for prior in priors]] = 0.0
    return support[:, 0] + _MARGIN * width, support[:, 1] - _MARGIN * width


def posterior_steps(
    function: Callable[[Array], Array], phi: Array, lower: Array, upper: Array, begin: Array
) -> tuple[Array, Array]:
    """Derivative with steps of about one posterior standard deviation, and those steps.

    Friction makes kinks; a derivative over the posterior's own scale sees their average, one over a
    tiny step sees whichever side it is on.
    """
    steps = begin
    for _ in range(2):
        jacobian = differentiate(function, phi, steps, lower, upper)
        size = np.sqrt((jacobian**2).sum(axis=0))
        steps = np.clip(1.0 / np.maximum(size, 1e-300), 1e-3 * begin, 1e2 * begin)
    return jacobian, steps


def find_modes(
    problem: Problem,
    *,
    seed: int | np.random.Generator = 0,
    starts: int | None = None,
    screened: int | None = None,
    initial: Array | None = None,
    rounds: int | None = None,
) -> list[Mode]:
    """Search for modes from several starts, best first.

    Parameters
    ----------
    problem : Problem
        What to fit.
    seed : int or Generator
        Of the draws from the prior.
    starts, screened : int, optional
        Local searches, and draws from the prior among which their starts are chosen. With few data
        there are more by default: they cost little there, and friction makes more hills. So it
        does that differential evolution looks for the highest too.
    initial : ndarray, optional
        Where to begin, shape (p,); then there is one local search.
    rounds : int, optional
        With ``initial``, at most so many rounds, and no polish: a first look at where it leads.

    Returns
    -------
    list of Mode
        At least one.

    Raises
    ------
    FitError
        If a joint's bodies are unknown: modes are sought over continuous parameters.
    """
    priors = problem.layout.priors
    if problem.layout.discrete.any():
        raise FitError(
            "which bodies a joint of the scene joins is unknown, and a mode is one of continuous"
            " parameters; name the bodies in the scene: pbrl_ppl.fit finds them, and"
            " joint_probabilities says which they are"
        )
    if initial is not None:
        if rounds is not None:
            first = _climb(problem, inside(priors, initial), problem.coarse, rounds)
            return [_finish(problem, *first)]
        near = _climb(problem, inside(priors, initial), problem.coarse)
        return [_finish(problem, *_polish(problem, near))]
    if not priors:  # everything is known but the noise
        return [_finish(problem, *_climb(problem, np.zeros(0), problem.coarse))]
    few = problem.segments.n <= _FEW
    starts = (16 if few else 4) if starts is None else starts
    screened = (1000 if few else 48) if screened is None else screened
    rng = np.random.default_rng(seed)
    draws = np.stack([prior.sample(rng, screened) for prior in priors], axis=1)
    draws = np.vstack([[prior.centre for prior in priors], draws])
    draws = inside(priors, draws)
    # the basins show in a part of the data already, and with few engine steps
    part = problem if few else _part(problem, _PART)
    residual = part.residual(draws)
    sigma = estimate_sigma(np.nanmedian(residual, axis=0), part.observations.measured, None)
    z = np.nan_to_num(residual / sigma, nan=_SCREEN_CLIP).reshape(len(draws), -1)
    # log(1 + z^2): a good start fits most transitions, not the worst one
    order = np.argsort(np.log1p(np.minimum(z, _SCREEN_CLIP) ** 2).sum(axis=1))
    begin = draws[order[:starts]]
    steps = problem.simulator.steps * problem.segments.n * problem.horizon
    if few and len(priors) <= _MOST_EVOLVED and steps * _POPULATION * _GENERATIONS < _AFFORDED:
        begin = np.vstack([begin, _evolve(problem, rng)])
    rough = [_climb(part, phi, part.simulator) for phi in begin]
    rough.sort(key=lambda result: -result[2])
    found = _distinct(part, rough)
    if not few:
        found = [_climb(problem, phi, problem.coarse) for phi, _, _ in found[:_POLISHED]]
    found.sort(key=lambda result: -result[2])
    best = _polish(problem, found[0])
    return [_finish(problem, *result) for result in (best, *found[1:])]


def _evolve(problem: Problem, rng: np.random.Generator) -> Array:
    """The best that differential evolution finds, best first, shape (evolved, p).

    Where few transitions slide, the top may be so narrow that no draw from the prior leads there.
    It shows with the exact engine alone: one with fewer steps has its kinks elsewhere.
    """
    priors = problem.layout.priors
    draws = np.stack([prior.sample(rng, _POPULATION) for prior in priors], axis=1)
    measured = problem.observations.measured
    counts = measured.sum((0, 1, 2))
    # without a floor, an exact fit of one dimension would outweigh all others
    floor = (_EXACT * problem.noise_prior[0]) ** 2

    def cost(points: Array) -> Array:
        phi = inside(priors, points.T)
        residual = np.where(measured, np.nan_to_num(problem.residual(phi), nan=_SCREEN_CLIP), 0.0)
        variance = np.maximum((residual**2).sum((1, 2, 3)) / counts, floor)
        fit = (counts * np.log(variance)).sum(axis=-1)
        return np.asarray(0.5 * (fit + (prior_residual(priors, phi) ** 2).sum(axis=-1)))

    lower, upper = _box(priors)
    lower = np.where(np.isfinite(lower), lower, draws.min(axis=0))
    upper = np.where(np.isfinite(upper), upper, draws.max(axis=0))
    found = differential_evolution(
        cost, list(zip(lower, upper, strict=True)), init=draws, rng=rng,
        strategy="rand1bin", recombination=0.9, maxiter=_GENERATIONS, polish=False,
        vectorized=True, updating="deferred", tol=0.0, atol=_STALLED,
    )  # fmt: skip
    best = np.argsort(found.population_energies)[:_EVOLVED]
    return inside(priors, found.population[best])


def _distinct(problem: Problem, found: list[Peak]) -> list[Peak]:
    """Leave out what predicts the same as one before it, and is on the same hill.

    A wheel's other description is, and so is what differs where the data are silent. A mirror image
    is not: it predicts the same, but what is linear in between would not.
    """
    folded = fold_wheels(problem, np.array([phi for phi, _, _ in found]))
    z = problem.whitened(folded, found[0][1])
    z = np.nan_to_num(z, nan=_SCREEN_CLIP)
    kept: dict[int, Array] = {}
    for i in range(len(found)):
        same = [j for j in kept if ((z[i] - z[j]) ** 2).sum() < _SAME]
        if not any(((kept[j] @ (folded[i] - folded[j])) ** 2).sum() < _FAR for j in same):
            kept[i] = _finish(problem, *found[i]).jacobian
    return [found[i] for i in kept]


def _part(problem: Problem, transitions: int) -> Problem:
    """The problem, roughly, on evenly chosen trajectories of about so many transitions."""
    history = problem.history
    rough = replace(problem, substeps=min(COARSE, problem.substeps), extrapolate=False)
    share = transitions / max(problem.segments.n, 1)
    count = max(2, math.ceil(share * history.n_trajectories))
    if problem.noise is not None or count >= history.n_trajectories:
        return rough
    chosen = np.linspace(0, history.n_trajectories - 1, count).astype(int)
    part = replace(rough, history=history.select(chosen))
    return part if part.observations.columns == problem.observations.columns else rough


def find_mode(
    problem: Problem,
    *,
    seed: int | np.random.Generator = 0,
    initial: Array | None = None,
    rounds: int | None = None,
) -> Mode:
    """Best mode, and those others that are not far below it; see :func:`find_modes`."""
    best, *others = find_modes(problem, seed=seed, initial=initial, rounds=rounds)
    near = (mode for mode in others if mode.log_posterior > best.log_posterior - _LOWER)
    return replace(best, others=tuple(near))


def _polish(problem: Problem, found: Peak) -> Peak:
    """Go on by the exact engine's derivative, as far as that leads."""
    if not problem.layout.size:
        return found
    exact = _climb(problem, found[0], problem.simulator, rounds=1, tries=2)
    if exact[2] < found[2] + _WORTHWHILE:
        return max(found, exact, key=lambda result: result[2])
    return _climb(problem, exact[0], problem.simulator)


def _climb(
    problem: Problem, phi: Array, slope: PartedSimulator, rounds: int = 40, tries: int = 4
) -> Peak:
    """Alternate between phi by least squares and sigma by maximum likelihood.

    Derivatives are taken through the engine ``slope``.
    """
    priors = problem.layout.priors
    lower, upper = _box(priors)
    sigma, value = _at(problem, phi)
    if not priors:
        return phi, sigma, value
    steps = 1e-3 * problem.layout.scale(phi)

    def whole(points: Array, sigma: Array, engine: PartedSimulator | None = None) -> Array:
        z = problem.whitened(points, sigma, engine).reshape(*points.shape[:-1], -1)
        z = robust(z, problem.nu)
        z = np.nan_to_num(z, nan=_SCREEN_CLIP, posinf=_SCREEN_CLIP, neginf=-_SCREEN_CLIP)
        return np.concatenate([z, prior_residual(priors, points)], axis=-1)

    for _ in range(rounds):

        def residual(point: Array, sigma: Array = sigma) -> Array:
            return whole(point, sigma)

        def jacobian(point: Array, sigma: Array = sigma, steps: Array = steps) -> Array:
            size = np.minimum(steps, 0.1 * np.maximum(np.abs(point), steps))
            return differentiate(
                lambda points: whole(points, sigma, slope), point, size, lower, upper
            )

        result = least_squares(
            residual, phi, jac=jacobian, bounds=(lower, upper), x_scale="jac", max_nfev=tries,
            ftol=1e-6, xtol=1e-6, gtol=1e-6,
        )  # fmt: skip
        better, improved = _at(problem, result.x)
        if improved < value:
            break
        phi, sigma, gain, value = result.x, better, improved - value, improved
        if gain < _STALLED:
            break
        size = np.sqrt((result.jac**2).sum(axis=0))
        steps = np.clip(1.0 / np.maximum(size, 1e-12), 1e-6, 0.1)
    return phi, sigma, value


def _at(problem: Problem, phi: Array) -> tuple[Array, float]:
    """The most likely sigma at phi, and the log-posterior there."""
    residual = problem.residual(phi)
    sigma = profile_sigma(problem, residual)
    likelihood = problem.log_density(residual, sigma).sum()
    return sigma, float(likelihood - 0.5 * (prior_residual(problem.layout.priors, phi) ** 2).sum())


def profile_sigma(problem: Problem, residual: Array) -> Array:
    """Maximum-likelihood sigma at given residuals, shape (state,).

    Parameters
    ----------
    problem : Problem
        Says which cells were measured, and how the start state's noise spreads.
    residual : ndarray
        Shape (transition, H, body, state).
    """
    measured, noise = problem.observations.measured, problem.noise
    residual = np.nan_to_num(residual, nan=_SCREEN_CLIP)
    sigma = estimate_sigma(residual, measured, None)
    gaussian = problem.nu is None
    if problem.scalar_sigma and gaussian:
        z = whiten(residual, np.ones_like(sigma), noise)
        return np.full_like(sigma, max(np.sqrt((z**2).sum() / measured.sum()), 1e-9))
    if noise is None and gaussian:
        return sigma
    begin = np.log(sigma if noise is None else sigma / np.median(noise.gain))
    every = np.ones_like(sigma)
    if problem.scalar_sigma:
        begin = begin.mean(keepdims=True)

    def cost(log_sigma: Array) -> float:
        return -float(problem.log_density(residual, np.exp(log_sigma) * every).sum())

    bounds = [(b - 6, b + 6) for b in begin]
    found = minimize(cost, begin, method="L-BFGS-B", bounds=bounds).x
    return np.asarray(np.exp(found) * every)


def _finish(problem: Problem, phi: Array, sigma: Array, log_posterior: float) -> Mode:
    """Fold the wheel's symmetry, and take the Jacobian at the posterior's own scale."""
    phi = fold_wheels(problem, phi)
    priors = problem.layout.priors
    if not priors:
        cells = problem.observations.values.size
        return Mode(problem, phi, sigma, np.zeros((cells, 0)), np.zeros((0, 0)), log_posterior)
    lower, upper = _box(priors)

    def residual(points: Array, engine: PartedSimulator | None = None) -> Array:
        z = robust(problem.whitened(points, sigma, engine), problem.nu).reshape(len(points), -1)
        return np.concatenate([np.nan_to_num(z), prior_residual(priors, points)], axis=-1)

    begin = 1e-3 * problem.layout.scale(phi)
    _, steps = posterior_steps(partial(residual, engine=problem.coarse), phi, lower, upper, begin)
    jacobian = differentiate(residual, phi, steps, lower, upper)
    precision = jacobian.T @ jacobian
    covariance = np.linalg.pinv(precision, hermitian=True)
    n_cells = len(jacobian) - len(phi)
    return Mode(
        problem, phi, sigma, jacobian[:n_cells], np.asarray(covariance, dtype=float), log_posterior
    )


def fold_wheels(problem: Problem, phi: Array) -> Array:
    """Choose one of a wheel's four equal descriptions, for phi of shape (..., p).

    Namely mu_x <= mu_y and w_theta in (-pi/2, pi/2].
    """
    phi = phi.copy()
    layout = problem.layout
    for body in problem.scene.dynamic:
        names = [f"{name}[{body.name}]" for name in ("w_theta", "mu_x", "mu_y")]
        if not all(name in layout.labels for name in names):
            continue
        angle, x, y = (layout.labels.index(name) for name in names)
        phi[..., angle] += np.where(phi[..., x] > phi[..., y], np.pi / 2, 0.0)
        phi[..., [x, y]] = np.sort(phi[..., [x, y]], axis=-1)
        phi[..., angle] = np.pi / 2 - np.mod(np.pi / 2 - phi[..., angle], np.pi)
    return phi


def with_start_noise(problem: Problem, mode: Mode) -> Problem:
    """Account for the noise of measured start states, linearised at a mode."""
    measured = problem.observations.measured.reshape(problem.segments.n, -1)
    sensitivity = problem.sensitivity(mode.phi, mode.sigma)
    sigma = estimate_sigma(problem.residual(mode.phi), problem.observations.measured, sensitivity)
    return replace(problem, noise=StartNoise.of(sensitivity, measured, sigma))
