"""Correlated errors of measuring: tried where a random force would be unexplained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism.correlation import correlation_tests
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.likelihood import Problem, noise_medians, ranges
from pbrl_ppl.modes import Mode, profile_sigma, trajectory_evidence, trajectory_mode

Array = NDArray[np.float64]

#: Correlations from row to row that are tried: errors that last two, five and twenty rows.
_MEMORIES = (0.5, 0.8, 0.95)


def with_correlated_errors(mode: Mode, criteria: Criteria = DEFAULT) -> Mode | None:
    """A mode with correlated errors of measuring, if those explain the data better.

    A tracker's errors last from frame to frame, which an unexplained acceleration follows as well.
    They are accepted by the evidence, and only if negligible beside the motion: of a larger one
    nobody can say whether the sensor or the physics is off.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories, without correlated errors.
    criteria : Criteria
        How much evidence is needed, and what is negligible.

    Returns
    -------
    Mode or None
        None where they do not explain the data better, or are too large.
    """
    if mode.problem.trajectory_noise.cells.drifts or not _asked_for(mode, criteria):
        return None
    residual = mode.problem.residual(mode.phi)
    tried = []
    for memory in _MEMORIES:
        problem = _drifting(mode, memory)
        sigma = profile_sigma(problem, residual, mode.phi)
        density = problem.log_density(residual, sigma, mode.phi).sum()
        tried.append((float(density), problem, sigma))
    _, problem, sigma = max(tried, key=lambda each: each[0])
    found = trajectory_mode(problem, mode.phi, sigma)
    cells = found.problem.trajectory_noise.cells
    data = found.problem.data
    extent = ranges(cells, data.history, data.smoothed_states)
    white = mode.sigma[: len(cells.drifts)]  # as large as what passed for a row's own errors
    most = np.maximum(criteria.negligible * extent, white)
    if (found.sigma[cells.drift_parameters] > most).any():
        return None
    gained = trajectory_evidence(found) - trajectory_evidence(mode)
    return found if gained >= criteria.min_evidence else None


def _asked_for(mode: Mode, criteria: Criteria) -> bool:
    """Whether an acceleration is unexplained, or an innovation says something of the next."""
    if unexplained_acceleration(mode, criteria).matters.any():
        return True
    whiteness, _ = correlation_tests(mode, criteria)[0]
    return not whiteness.passed


def same_noise(mode: Mode, other: Mode) -> Mode:
    """Refit a mode with the correlated errors of another one's model."""
    memory = other.problem.trajectory_noise.cells.memory
    problem = _drifting(mode, memory)
    sigma = profile_sigma(problem, mode.problem.residual(mode.phi), mode.phi)
    return trajectory_mode(problem, mode.phi, sigma)


def _drifting(mode: Mode, memory: float) -> Problem:
    """A mode's problem with correlated errors, whose prior stands beside those of the noise."""
    problem = mode.problem
    noise = problem.trajectory_noise
    cells = noise.cells.drifting(memory)
    every = noise_medians(cells, problem.data.history, problem.data.smoothed_states)
    medians = every[cells.drift_parameters]
    sigma = np.concatenate([mode.sigma, mode.sigma[: len(medians)]])
    prior = (*problem.noise_prior[0].tolist(), *medians.tolist()), problem.noise_prior[1]
    return problem.along(replace(noise, cells=cells, sigma=sigma), prior=prior)
