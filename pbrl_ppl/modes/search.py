"""Search for modes of the posterior from many starts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import differential_evolution

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import LikelihoodT, Problem, estimate_sigma, is_filtered
from pbrl_ppl.modes.laplace import ROUNDS, STALLED, LocalMode, Mode, canonical_wheels, climb, finish
from pbrl_ppl.modes.noise import FAR_OFF, finite, gaussian_profile
from pbrl_ppl.parameters import box, by_prior, inside, prior_draws
from pbrl_ppl.state import Floats
from pbrl_ppl.threads import one_blas_thread

#: Population and generations of the evolution that looks for the mode of few data.
_POPULATION, _GENERATIONS = 200, 120


@one_blas_thread
def find_modes(
    problem: Problem[LikelihoodT],
    *,
    seed: int | np.random.Generator = 0,
    initial: Floats | None = None,
    rounds: int | None = None,
    n_part: int = 40,
    polished: int = 2,
    n_few: int = 20,
    most_parameters: int = 15,
    afforded: float = 2e7,
) -> list[Mode[LikelihoodT]]:
    """Return modes found from several starts, best first.

    Parameters
    ----------
    problem : Problem
        What to fit.
    seed : int or Generator
        Of the draws from the prior.
    initial : ndarray, optional
        Where to begin, shape (p,); then there is one local search.
    rounds : int, optional
        With ``initial``, the most rounds, without polish: a first look at where it leads.
    n_part : int
        Transitions used to tell basins apart.
    polished : int
        How many of the best are searched with all data.
    n_few : int
        With at most so many transitions, all are used.
    most_parameters : int
        Of an evolution, which few data allow.
    afforded : float
        Engine steps that it may take.

    Returns
    -------
    list of Mode
        At least one.

    Raises
    ------
    FitError
        If a joint's bodies are unknown: modes are sought over continuous parameters.
    """
    priors, coarse = problem.layout.priors, problem.coarse.physics.simulator
    if problem.layout.discrete.any():
        raise FitError(
            "which bodies a joint of the scene joins is unknown, and a mode is one of continuous"
            " parameters; name the bodies in the scene: pbrl_ppl.fit finds them, and"
            " joint_probabilities says which they are"
        )
    if initial is not None:
        near = climb(problem, inside(priors, initial), coarse, rounds or ROUNDS)
        return [finish(problem, near if rounds else _polish(problem, near))]
    if not priors:  # everything is known but the noise
        return [finish(problem, climb(problem, np.zeros(0), coarse))]
    few = problem.segments.n <= n_few
    # more starts with few data: they cost little, and friction makes more modes
    starts, screened = (16, 1000) if few else (4, 48)
    rng = np.random.default_rng(seed)
    draws = np.vstack([[prior.centre for prior in priors], prior_draws(priors, rng, screened)])
    draws = inside(priors, draws)
    # the basins show in a part of the data already, and with few engine steps
    part = problem if few else _part(problem, n_part)
    residual = part.residual(draws)
    sigma = estimate_sigma(np.nanmedian(residual, axis=0), part.observations, part.scene)
    z = np.nan_to_num(residual / sigma, nan=FAR_OFF).reshape(len(draws), -1)
    # log(1 + z^2): a good start fits most transitions, not the worst one
    order = np.argsort(np.log1p(np.minimum(z, FAR_OFF) ** 2).sum(axis=1))
    begin = draws[order[:starts]]
    steps = problem.physics.simulator.steps * problem.segments.n * problem.data.horizon
    if few and len(priors) <= most_parameters and steps * _POPULATION * _GENERATIONS < afforded:
        begin = np.vstack([begin, _evolve(problem, rng)])
    peaks = _distinct(
        part, [canonical_wheels(part, climb(part, phi, part.physics.simulator)) for phi in begin]
    )
    if not few:  # all data may join what a part of them told apart
        peaks = [climb(problem, phi, coarse) for phi, *_ in peaks[:polished]]
        peaks = _distinct(problem.coarse, peaks)
    best = _polish(problem, peaks[0])
    return [finish(problem, peak) for peak in (best, *peaks[1:])]


def _evolve(problem: Problem, rng: np.random.Generator, *, climbed: int = 8) -> Floats:
    """Return the best points of differential evolution, best first, shape (evolved, p).

    Where few transitions slide, the mode may be too narrow for draws from the prior to find. The
    exact engine is needed: with fewer steps, friction's kinks are elsewhere.

    ``climbed``: how many of the population are climbed from.
    """
    priors = problem.layout.priors
    draws = prior_draws(priors, rng, _POPULATION)
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
        strategy="rand1bin", recombination=0.9, maxiter=_GENERATIONS, polish=False,
        vectorized=True, updating="deferred", tol=0.0, atol=STALLED,
    )  # fmt: skip
    best = np.argsort(result.population_energies)[:climbed]
    return inside(priors, result.population[best])


def _distinct(
    problem: Problem, peaks: list[LocalMode], *, same_below: float = 10.0, far: float = 100.0
) -> list[LocalMode]:
    """Return peaks, best first, without those that predict as a better one and are connected to it.

    Equivalent wheels and uninformed directions are connected; mirror images are not: they predict
    the same, but points between them do not.

    ``same_below``: predictions this close (sum of squares, in noise units) are of the same mode.
    ``far``: parameters whose predictions agree are of different modes if by the derivative they
    should differ by this (sum of squares, in noise units): ten standard deviations.
    """
    if len(peaks) == 1:
        return peaks
    peaks = sorted(peaks, key=lambda peak: -peak.log_posterior)
    folded = by_prior(problem.layout, np.array([peak.phi for peak in peaks]))
    z = np.nan_to_num(problem.whitened(folded, peaks[0].sigma), nan=FAR_OFF)
    kept: dict[int, Floats] = {}
    for i in range(len(peaks)):
        same = [j for j in kept if ((z[i] - z[j]) ** 2).sum() < same_below]
        if not any(((kept[j] @ (folded[i] - folded[j])) ** 2).sum() < far for j in same):
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


def find_mode(
    problem: Problem[LikelihoodT],
    *,
    seed: int | np.random.Generator = 0,
    initial: Floats | None = None,
    rounds: int | None = None,
    lower: float = 20.0,
) -> Mode[LikelihoodT]:
    """Return the best mode with others that are not far below it; see :func:`find_modes`.

    ``lower``: log-posterior by which a mode is too low to hold a share of the posterior, however
    wide it is.
    """
    best, *others = find_modes(problem, seed=seed, initial=initial, rounds=rounds)
    near = (mode for mode in others if mode.log_posterior > best.log_posterior - lower)
    return replace(best, others=tuple(near))


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
