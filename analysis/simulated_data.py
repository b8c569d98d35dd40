"""Recordings that a problem of trajectories predicts, and the problem of such a recording."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    FilteredProblem,
    Problem,
    along_trajectories,
    in_pieces,
    is_filtered,
    is_simulated,
)
from pbrl_ppl.physics import touching
from pbrl_ppl.state import Floats


def simulated_trajectories(
    problem: FilteredProblem, phi: Floats, sigma: Floats, rng: np.random.Generator
) -> Floats:
    """Return simulated measurements from the recorded first states and commands.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories; says where each begins, what acts and what is measured.
    phi, sigma : ndarray
        Parameters and noise parameters, shapes (p,) and (parameter,).
    rng : Generator
        Of both noises.

    Returns
    -------
    ndarray
        Shape (trajectory, time, body, 6), SI units; NaN where the recording has no measurement, and
        everywhere in a trajectory in which the engine diverged.
    """
    coordinates, segments = problem.likelihood.noise.coordinates, problem.segments
    world = problem.physics.one_world
    observed = problem.data.history.dataset["observed"].to_numpy()
    states = problem.data.smoothed_states.copy()
    flat = states.reshape(*states.shape[:2], -1)
    for step in range(states.shape[1] - 1):
        now = np.flatnonzero(segments.step == step)
        trajectory = segments.trajectory[now]
        begin, inputs = states[trajectory, step], problem.inputs[now]
        lost = ~np.isfinite(begin).all(axis=(1, 2))
        ends = world(phi, np.where(lost[:, None, None], 0.0, begin), inputs)[:, 0]
        ends[lost] = np.nan
        met = touching(problem.scene, begin, np.nan_to_num(ends))
        pushes = coordinates.pushes(sigma, met, rng)
        flat[trajectory[:, None], step + 1, coordinates.places] = coordinates.of(ends) + pushes
        coordinates.completed(problem.scene, states[:, step + 1])
    drawn = rng.standard_normal((*flat.shape[:2], len(coordinates.places)))
    measured = states.copy()
    measured.reshape(flat.shape)[..., coordinates.places] += coordinates.errors(sigma) * drawn
    return np.where(np.isfinite(observed), measured, np.nan)


def with_measurements(problem: Problem, observed: Floats) -> Problem:
    """Return the problem of filtered or simulated trajectories with other measurements.

    Parameters
    ----------
    problem : Problem
        Its noise prior stays, and the coordinates of filtered trajectories.
    observed : ndarray
        Shape (trajectory, time, body, 6), SI units, NaN where missing.
    """
    dataset = problem.data.history.dataset.copy()
    start = np.where(np.isfinite(observed), observed, dataset["start"])
    for name, values in (("observed", observed), ("start", start)):
        dataset[name] = dataset[name].copy(data=values)
    history = History(dataset)
    centre = np.array([prior.centre for prior in problem.layout.priors])
    coordinates = problem.likelihood.noise.coordinates if is_filtered(problem) else None
    other = problem.with_data(history=history, states=None)
    whole = along_trajectories(other, centre, None, coordinates)
    if not is_simulated(problem):
        return whole
    pieces = in_pieces(whole, problem.data.horizon, whole.data.smoothed_states)
    return pieces.with_likelihood(prior=problem.likelihood.prior)
