"""Refits of a mode: with other effects, substeps or noise, or a structure that bodies hit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from pbrl_ppl.criticism.correlation import correlation_tests
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.effects import Attached
from pbrl_ppl.likelihood import Problem, noise_medians, ranges
from pbrl_ppl.modes import Mode, nearby_mode, profile_sigma, trajectory_evidence, trajectory_mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.state import Floats


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
        phi[layout.places(attached.labels)] = sizes
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


def with_correlated_errors(
    mode: Mode,
    criteria: Criteria = DEFAULT,
    *,
    memories: tuple[float, ...] = (0.5, 0.8, 0.95),
) -> Mode | None:
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
    memories : tuple of float
        Correlations from row to row that are tried: errors that last two, five and twenty rows.

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
    for memory in memories:
        problem = _with_correlation(mode, memory)
        sigma = profile_sigma(problem, residual, mode.phi)
        density = problem.log_density(residual, sigma, mode.phi).sum()
        tried.append((float(density), problem, sigma))
    _, problem, sigma = max(tried, key=lambda trial: trial[0])
    revised = trajectory_mode(problem, mode.phi, sigma)
    coordinates = revised.problem.trajectory_noise.coordinates
    data = revised.problem.data
    extent = ranges(coordinates, data.history, data.smoothed_states)
    # as large as the measurement noise of single rows was
    white = mode.sigma[: len(coordinates.drifts)]
    most = np.maximum(criteria.negligible * extent, white)
    if (revised.sigma[coordinates.drift_parameters] > most).any():
        return None
    gained = trajectory_evidence(revised) - trajectory_evidence(mode)
    return revised if gained >= criteria.min_evidence else None


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


def structure_mode(
    mode: Mode,
    candidate: Attached,
    estimate: Floats,
    *,
    least_substeps: int = 40,
    noise_share: float = 0.3,
    most_places: int = 4,
    rounds: int = 3,
    least_gain: float = 2.0,
) -> Mode:
    """Fit a model with a structure that bodies collide with.

    Derivatives across a collision mislead an optimiser, and the noise that fits without the
    structure hides which collisions a place explains. So guesses of the place are improved first,
    by Nelder and Mead's simplex under Student's loss with little noise; the best are fitted with
    all parameters, place and fit in turn.

    Parameters
    ----------
    mode : Mode
        Of the model that lacks the structure, fitted to whole trajectories.
    candidate : Attached
        The effect; its scan makes the guesses.
    estimate : ndarray
        A further guess, shape (q,).
    least_substeps : int
        A body stops within a step of where it touches: with fewer steps places come out far off.
    noise_share : float
        Process noise as a share of its prior's median: more than the engine's error at contact.
    most_places : int
        Places from which the other parameters and the noise are fitted.
    rounds : int
        Further rounds of place and fit, at most.
    least_gain : float
        A round that gains less (nats) is the last.

    Returns
    -------
    Mode
        With at least ``least_substeps`` an interval.
    """
    physics = mode.problem.physics
    substeps = max(least_substeps, physics.substeps)
    # where bodies touch, extrapolation gains nothing
    problem = mode.problem.with_physics(
        effects=(*physics.effects, candidate), substeps=least_substeps, extrapolate=False
    )
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    columns = layout.places(candidate.labels)
    guesses = estimate[None]
    if candidate.effect.scan is not None:
        body = problem.scene.body(candidate.body)
        points = candidate.effect.scan(problem.scene, problem.data.history, body)
        guesses = np.vstack([guesses, points[np.isfinite(points).all(axis=1)]])

    def fitted(problem: Problem, phi: Floats, place: Floats, sigma: Floats) -> Mode:
        start = phi.copy()
        start[columns] = place
        return trajectory_mode(problem, inside(layout.priors, start), sigma)

    places = _places(problem, phi, problem.quiet(mode.sigma, noise_share), columns, guesses)
    fits = [fitted(problem, phi, place, mode.sigma) for place in places[:most_places]]
    best = max(fits, key=lambda fit: fit.log_posterior)
    for _ in range(rounds):
        quiet = best.problem.quiet(best.sigma, noise_share)
        place, *_ = _places(best.problem, best.phi, quiet, columns, best.phi[columns][None])
        again = fitted(best.problem, best.phi, place, best.sigma)
        if again.log_posterior < best.log_posterior + least_gain:
            break
        best = again
    exact = best.problem.with_physics(substeps=substeps, extrapolate=physics.extrapolate)
    return nearby_mode(exact, best.phi, best.sigma)


def _places(
    problem: Problem,
    phi: Floats,
    sigma: Floats,
    columns: list[int],
    guesses: Floats,
    *,
    nu: float = 4.0,
    most_guesses: int = 6,
    most_runs: int = 200,
    first_side: float = 0.05,
    last_side: float = 4e-3,
    least_difference: float = 1.0,
) -> list[Floats]:
    """Improve guesses of some parameters, the others held; return distinct ones, best first.

    ``nu`` are the degrees of freedom of the loss, under which a transition that a guess does not
    explain pulls little. ``most_guesses`` are improved, by ``most_runs`` of the engine each. The
    first simplex has sides of ``first_side`` of the prior's scale, the last ``last_side`` of those.
    Places whose losses differ by less than ``least_difference`` are the same.
    """
    lower, upper = (bound[columns] for bound in problem.layout.bounds)

    def loss(values: Floats) -> float:
        if np.any(values <= lower) or np.any(values >= upper):
            return np.inf
        here = phi.copy()
        here[columns] = values
        whitened = np.nan_to_num(problem.whitened(here, sigma)).reshape(problem.segments.n, -1)
        square = (whitened**2).sum(axis=1)
        return float(0.5 * (nu + whitened.shape[1]) * np.log1p(square / nu).sum())

    losses = [loss(guess) for guess in guesses]
    side = first_side * min(problem.layout.priors[place].scale for place in columns)
    scored: list[tuple[float, Floats]] = []
    for i in np.argsort(losses)[:most_guesses]:
        best = minimize(
            lambda values: loss(side * values),
            guesses[i] / side,
            method="Nelder-Mead",
            options={
                "maxfev": most_runs,
                "initial_simplex": guesses[i] / side + np.eye(len(columns) + 1, len(columns), -1),
                "xatol": last_side,
                "fatol": 0.1,
            },
        )
        if all(abs(best.fun - value) > least_difference for value, _ in scored):
            scored.append((float(best.fun), side * best.x))
    return [place for _, place in sorted(scored, key=lambda entry: entry[0])]
