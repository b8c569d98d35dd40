"""Modes of trajectories: filtered, parameters and smoothed states in turn, or simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbrl_ppl.likelihood import (
    FilteredProblem,
    NoisePrior,
    Problem,
    along_trajectories,
    corrected,
    is_filtered,
    is_independent,
    is_simulated,
    log_posterior,
    single_transitions,
    smoothed,
    with_sensitivity,
)
from pbrl_ppl.modes.ladder import fit_pieces, ladder, with_robust_covariance
from pbrl_ppl.modes.search import (
    FilteredMode,
    LocalMode,
    Mode,
    SimulatedMode,
    find_mode,
    finish,
    near_mode,
    profiled,
)
from pbrl_ppl.parameters import change_from, inside
from pbrl_ppl.state import Floats
from pbrl_ppl.system.threads import one_blas_thread

#: Most linearisations, and change of phi (standard deviations) below which one is the last.
_ROUNDS, _CONVERGED = 6, 0.2


@one_blas_thread
def find_trajectory_mode(problem: Problem, seed: int) -> FilteredMode:
    """Return the best mode of whole trajectories, from five starts about one of Eq. 11.

    A climb's end depends on the side of a kink that the states are smoothed on.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    seed : int
        Of the starts, which are twice as far apart as draws from single transitions.

    Returns
    -------
    Mode
        Result of :func:`with_state_sensitivity`.
    """
    near = find_mode(single_transitions(problem), seed=seed)
    off = near.draws(np.random.default_rng(seed), 4) - near.phi
    far = inside(problem.layout.priors, near.phi + 2.0 * off)
    there = np.isfinite(near.problem.residual(far)).all(axis=(1, 2, 3, 4))
    starts = (near.phi, *far[there])
    modes = [with_state_sensitivity(trajectory_mode(problem, phi)) for phi in starts]
    return max(modes, key=lambda mode: mode.log_posterior)


def trajectory_mode(problem: Problem, phi: Floats, sigma: Floats | None = None) -> FilteredMode:
    """Return the mode of whole trajectories, linearised at smoothed states.

    The better of two, which start with the given noise and with near-zero process noise: errors of
    measuring and unexplained accelerations trade places, and have a mode each.

    Parameters
    ----------
    problem : Problem
        Of single transitions, or of trajectories already.
    phi : ndarray
        Where to begin, shape (p,).
    sigma : ndarray, optional
        Noise parameters to begin with where the problem is one of trajectories, smoothed nearby.

    Returns
    -------
    Mode
        Its problem has a :class:`pbrl_ppl.likelihood.TrajectoryLikelihood`.
    """
    if sigma is not None and is_filtered(problem):
        mode = nearby_mode(problem, phi, sigma)
    else:
        whole = _smoothed_cheaply(problem, phi)
        mode = nearby_mode(whole, phi, whole.likelihood.noise.sigma)
    small = _with_small_process_noise(mode.problem, mode.sigma)
    if np.array_equal(small, mode.sigma):
        return mode
    other = nearby_mode(smoothed(mode.problem, mode.phi, small), mode.phi, small)
    return max(mode, other, key=lambda candidate: candidate.log_posterior)


def mode_of_more(problem: Problem, mode: FilteredMode) -> FilteredMode:
    """Return the mode of whole trajectories, begun at that of a part of them."""
    return nearby_mode(_smoothed_cheaply(problem, mode.phi), mode.phi, mode.sigma)


def _with_small_process_noise(problem: FilteredProblem, sigma: Floats) -> Floats:
    """Return sigma with unexplained accelerations of at most a tenth of their prior median."""
    steps, sigma = problem.likelihood.noise.coordinates.accelerations, sigma.copy()
    sigma[steps] = np.minimum(sigma[steps], 0.1 * problem.noise_prior[0][steps])
    return sigma


def _smoothed_cheaply(problem: Problem, phi: Floats) -> FilteredProblem:
    """Return the problem of whole trajectories, smoothed at phi with fewer engine steps."""
    coordinates = problem.likelihood.noise.coordinates if is_filtered(problem) else None
    medium = along_trajectories(problem.medium, phi, coordinates=coordinates)
    return replace(medium, physics=problem.physics)


@one_blas_thread
def filtered_mode(mode: FilteredMode, other: Mode) -> FilteredMode:
    """Return the mode of whole trajectories at another mode's parameters.

    Noise and smoothed states are fitted in turn three times, from two sizes of the unexplained
    acceleration as in :func:`trajectory_mode`; the parameters stay.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    other : Mode
        Of a model of the same recording, under any likelihood.
    """
    physics, phi = other.problem.physics, other.phi
    problem = mode.problem.with_physics(effects=physics.effects, substeps=physics.substeps)
    problem = _smoothed_cheaply(problem, phi)
    sigma = problem.likelihood.noise.sigma
    ends: list[tuple[FilteredProblem, LocalMode]] = []
    for begin in (sigma, _with_small_process_noise(problem, sigma)):
        sigma, there = begin, problem
        for _ in range(3):
            there = smoothed(there, phi, sigma)
            sigma, value = profiled(there, phi)
        ends.append((there, LocalMode(phi, sigma, value)))
    return finish(*max(ends, key=lambda end: end[1].log_posterior))


def nearby_mode(problem: FilteredProblem, phi: Floats, sigma: Floats) -> FilteredMode:
    """Return the mode by alternating climbs with smoothing.

    It climbs with few engine steps, whose error at the start is corrected, and corrects it again
    where that ends, three times at most.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    phi, sigma : ndarray
        Where to begin, shapes (p,) and (parameter,).
    """
    modes: list[FilteredMode] = []
    for _ in range(3):
        cheap = corrected(problem, phi)
        mode = _alternate_smoothing(cheap, phi, sigma)
        if cheap is problem:
            return mode
        problem = replace(mode.problem, physics=problem.physics, defect=None)
        moved, phi = _change(mode, phi), mode.phi
        sigma, value = profiled(problem, phi)
        modes.append(replace(mode, problem=problem, sigma=sigma, log_posterior=value, others=()))
        if moved < _CONVERGED or abs(value - mode.log_posterior) < 0.5:  # nats, as with many steps
            break
    return max(modes, key=lambda candidate: candidate.log_posterior)


def _alternate_smoothing(problem: FilteredProblem, phi: Floats, sigma: Floats) -> FilteredMode:
    """Return the mode of a problem by alternating climbs with smoothing."""
    for i in range(_ROUNDS):
        if i:
            problem = smoothed(problem, phi, sigma)
        mode = near_mode(problem, phi)
        change = _change(mode, phi)
        phi, sigma = mode.phi, mode.sigma
        if i and change < _CONVERGED:
            break
    return mode


def with_state_sensitivity(mode: FilteredMode) -> FilteredMode:
    """Return a mode of whole trajectories whose smoothed states follow the parameters.

    Parameters
    ----------
    mode : Mode
        Result of :func:`trajectory_mode`.

    Returns
    -------
    Mode
        Its problem's noise has a :class:`pbrl_ppl.model.Sensitivity`.
    """
    modes: list[tuple[float, FilteredMode]] = []
    problem, phi, sigma = mode.problem, mode.phi, mode.sigma
    for i in range(_ROUNDS):
        if i:
            problem = smoothed(problem, phi, sigma)
        problem = with_sensitivity(problem, phi, sigma)
        mode = near_mode(problem, phi)
        # far from where it is linearised a climb may end anywhere: judged by where it began
        modes.append((float(log_posterior(problem, phi, sigma)), mode))
        change = _change(mode, phi)
        phi, sigma = mode.phi, mode.sigma
        if change < _CONVERGED:
            break
    return max(modes, key=lambda pair: pair[0])[1]


def _change(mode: FilteredMode, phi: Floats) -> float:
    """Return the distance of a mode from the start of its search, in standard deviations."""
    spread = np.sqrt(np.maximum(np.diag(mode.covariance), 1e-300))
    moved = change_from(mode.problem.layout, mode.phi, phi)
    return float((np.abs(moved) / spread).max(initial=0.0))


@one_blas_thread
def find_simulation_mode(problem: Problem, seed: int) -> SimulatedMode:
    """Return the best mode of simulated trajectories, from one of whole trajectories.

    Parameters
    ----------
    problem : Problem
        Of any likelihood; the prior of sigma is kept, if it is of simulated trajectories.
    seed : int
        Of the search for the mode of whole trajectories.

    Returns
    -------
    Mode
        Result of :func:`tempered_mode` of the longest simulated pieces.
    """
    prior = problem.likelihood.prior if is_simulated(problem) else None
    return tempered_mode(ladder(find_trajectory_mode(problem, seed))[-1], prior)


def tempered_mode(mode: SimulatedMode, prior: NoisePrior | None = None) -> SimulatedMode:
    """Return a mode of simulated pieces as the mode of their posterior.

    The density of each dimension is divided by its autocorrelation time.

    Parameters
    ----------
    mode : Mode
        Of simulated pieces, with any number of engine steps.
    prior : tuple, optional
        Of sigma; by default it is taken from the pieces. The last climb has it, and all engine
        steps.

    Returns
    -------
    Mode
        Its problem has an :class:`pbrl_ppl.likelihood.OutputErrorLikelihood`, linearised at its
        initial states, and the prior of sigma fixed.
    """
    median, spread = mode.problem.noise_prior
    problem = mode.problem.with_likelihood(prior=prior or (tuple(median.tolist()), spread))
    return with_robust_covariance(near_mode(problem, mode.phi))


def carried_mode(mode: Mode, problem: Problem) -> Mode:
    """Return the mode of a problem near that of another one of the same parameters and data."""
    if is_independent(problem):
        return find_mode(problem, initial=mode.phi)
    if is_simulated(problem):
        return tempered_mode(fit_pieces(problem, mode.phi), problem.likelihood.prior)
    return with_state_sensitivity(trajectory_mode(problem, mode.phi, mode.sigma))
