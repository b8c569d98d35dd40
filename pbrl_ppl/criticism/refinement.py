"""Refinement of a fitted mode: enough engine substeps, and correlated measurement errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from pbrl_ppl.criticism.correlation import correlation_tests
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.effects import Attached
from pbrl_ppl.likelihood import Problem, noise_medians, ranges
from pbrl_ppl.modes import Mode, nearby_mode, profile_sigma, trajectory_evidence, trajectory_mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.state import Floats

#: Correlations from row to row that are tried: errors that last two, five and twenty rows.
_MEMORIES = (0.5, 0.8, 0.95)


def with_effects(
    mode: Mode,
    effects: tuple[Attached, ...],
    values: Mapping[Attached, Floats | float] | None = None,
) -> tuple[Problem, Floats]:
    """Return a mode's problem with other effects, and where a search for its mode begins.

    Parameters
    ----------
    mode : Mode
        A mode of the model with the effects so far.
    effects : tuple of Attached
        All effects of the new model.
    values : mapping, optional
        Where the parameters of an effect begin; by default at the mode, or the prior's centre.
    """
    problem = mode.problem.with_physics(effects=effects)
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    for attached, sizes in (values or {}).items():
        phi[[layout.labels.index(label) for label in attached.labels]] = sizes
    return problem, inside(layout.priors, phi)


def with_enough_substeps(
    mode: Mode, say: Callable[[str], None], criteria: Criteria = DEFAULT
) -> Mode:
    """Double the substeps until neither predictions nor the acceleration test move, and refit.

    The engine's error hardly depends on the parameters, so it is measured at the mode found with
    fewer substeps. At the end smoothing begins anew: an optimum with too large a noise confirms
    itself through the states that were smoothed with that noise.
    """
    limits = criteria.engine
    confirmed = 0  # substeps with which smoothing began anew
    while True:  # a better engine leaves less noise, against which its error shows again
        begin = substeps = mode.problem.physics.substeps
        while shift(mode, substeps) > limits.small_shift and substeps < limits.most_substeps:
            substeps *= 2
        if substeps > begin:
            mode = _refined(mode, substeps, say)
            continue
        if confirmed < substeps:
            fresh, confirmed = trajectory_mode(mode.problem, mode.phi), substeps
            if fresh.log_posterior > mode.log_posterior + limits.better_mode:
                mode = fresh
                continue
        excess = unexplained_acceleration(mode, criteria)
        if (
            not excess.matters.any()
            or excess.worst > limits.large
            or substeps >= limits.most_substeps
        ):
            return mode
        finer = _refined(mode, 2 * substeps, say)
        moved = np.abs(excess.relative - unexplained_acceleration(finer, criteria).relative)
        if (moved < limits.still * excess.relative)[excess.matters].all():
            return mode
        mode = finer


def _refined(mode: Mode, substeps: int, say: Callable[[str], None]) -> Mode:
    """Return the mode refitted with more substeps."""
    say(f"using {substeps} engine steps an interval")
    return nearby_mode(mode.problem.with_physics(substeps=substeps), mode.phi, mode.sigma)


def shift(mode: Mode, substeps: int | None = None) -> float:
    """Return the rms change of the innovations, over the noise, if substeps are doubled.

    Parameters
    ----------
    mode : Mode
        Fitted to whole trajectories.
    substeps : int, optional
        The number to double; the mode's by default.
    """
    problem = mode.problem
    substeps = problem.physics.substeps if substeps is None else substeps
    coarse, fine = (problem.with_physics(substeps=n) for n in (substeps, 2 * substeps))
    change = coarse.whitened(mode.phi, mode.sigma) - fine.whitened(mode.phi, mode.sigma)
    return float(np.sqrt(np.nanmean(change**2, axis=0).max()))


def with_correlated_errors(mode: Mode, criteria: Criteria = DEFAULT) -> Mode | None:
    """Return a mode with correlated measurement errors, if those explain the data better.

    A tracker's errors last from frame to frame, which an unexplained acceleration fits as well.
    They are accepted by the evidence, and only if negligible beside the motion: a larger one may
    be an error of the sensor or of the physics.

    Parameters
    ----------
    mode : Mode
        Fitted to whole trajectories, without correlated errors.
    criteria : Criteria
        How much evidence is needed, and what is negligible.

    Returns
    -------
    Mode or None
        None where they do not explain the data better, or are too large.
    """
    if mode.problem.trajectory_noise.coordinates.drifts:
        return None
    if not unexplained_acceleration(mode, criteria).matters.any():
        whiteness, _ = correlation_tests(mode, criteria)[0]
        if whiteness.passed:
            return None
    residual = mode.problem.residual(mode.phi)
    tried = []
    for memory in _MEMORIES:
        problem = _with_correlation(mode, memory)
        sigma = profile_sigma(problem, residual, mode.phi)
        density = problem.log_density(residual, sigma, mode.phi).sum()
        tried.append((float(density), problem, sigma))
    _, problem, sigma = max(tried, key=lambda each: each[0])
    found = trajectory_mode(problem, mode.phi, sigma)
    coordinates = found.problem.trajectory_noise.coordinates
    data = found.problem.data
    extent = ranges(coordinates, data.history, data.smoothed_states)
    # as large as the measurement noise of single rows was
    white = mode.sigma[: len(coordinates.drifts)]
    most = np.maximum(criteria.negligible * extent, white)
    if (found.sigma[coordinates.drift_parameters] > most).any():
        return None
    gained = trajectory_evidence(found) - trajectory_evidence(mode)
    return found if gained >= criteria.min_evidence else None


def same_noise(mode: Mode, other: Mode) -> Mode:
    """Refit a mode with the correlated measurement errors of another mode's model."""
    memory = other.problem.trajectory_noise.coordinates.memory
    problem = _with_correlation(mode, memory)
    sigma = profile_sigma(problem, mode.problem.residual(mode.phi), mode.phi)
    return trajectory_mode(problem, mode.phi, sigma)


def _with_correlation(mode: Mode, memory: float) -> Problem:
    """Return a mode's problem with correlated measurement errors, and a prior of their sizes."""
    problem = mode.problem
    noise = problem.trajectory_noise
    coordinates = noise.coordinates.drifting(memory)
    every = noise_medians(
        coordinates, problem.scene, problem.data.history, problem.data.smoothed_states
    )
    medians = every[coordinates.drift_parameters]
    sigma = np.concatenate([mode.sigma, mode.sigma[: len(medians)]])
    prior = (*problem.noise_prior[0].tolist(), *medians.tolist()), problem.noise_prior[1]
    return problem.along(replace(noise, coordinates=coordinates, sigma=sigma), prior=prior)
