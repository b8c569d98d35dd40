"""Medians of the noise priors along trajectories, from the bodies' motion."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.history import History, unseen
from pbrl_ppl.likelihood.coordinates import Coordinates
from pbrl_ppl.likelihood.data import least_noise
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA, VELOCITY, Floats

#: Log-scale of the log-normal priors of errors of measuring and of contact accelerations.
SPREAD = 2.0
#: Median of an exponential law, as a share of what it exceeds with a probability of 1 %.
_MEDIAN = np.log(2.0) / -np.log(0.01)


def noise_medians(
    coordinates: Coordinates,
    scene: Scene,
    history: History,
    states: Floats,
    *,
    sensor_share: float = 0.1,
    contact_share: float = 0.1,
    acceleration_share: float = 0.1,
) -> Floats:
    """Return the medians of the noise priors, shape (parameter,), from changes of the states.

    ``sensor_share``: median of the prior of errors of measuring, as a share of what states do in a
    step.

    ``contact_share``: the same share for contact accelerations.
    ``acceleration_share``: an unexplained acceleration is larger than this share of the bodies'
    with a probability of 1 %: physics is nearly deterministic, and a random force follows whatever
    is smooth.
    """
    real = np.isfinite(history.dataset["clock"].to_numpy())
    shown = real & ~unseen(history).any(axis=-1)
    typical, seen = (
        _typical(
            coordinates,
            [np.diff(path[row], axis=0) for path, row in zip(states, rows, strict=True)],
        )
        for rows in (real, shown)
    )
    dt = float(history.dataset.attrs["time_step"])
    sensors, contacts = list(coordinates.sensors), list(coordinates.contacts)
    steps = acceleration_share * _MEDIAN * _vectors(typical, coordinates.rates) / dt
    medians = sensor_share * seen[sensors], steps, contact_share * typical[contacts] / dt
    rates = least_noise(scene, (*coordinates.rates, *contacts)) / dt
    floors = least_noise(scene, sensors), rates
    return np.asarray(np.maximum(np.concatenate(medians), np.concatenate(floors)))


def _typical(coordinates: Coordinates, changes: list[Floats]) -> Floats:
    """Return the root mean square change of each state dimension, shape (6,)."""
    square = np.concatenate([change.reshape(len(change), -1) for change in changes]) ** 2
    mean_square = square.mean(axis=0)[coordinates.places]
    of = coordinates.places % len(STATE)
    return np.array(
        [np.sqrt(mean_square[of == d].mean()) if (of == d).any() else 0.0 for d in range(6)]
    )


def _vectors(typical: Floats, rates: tuple[int, ...]) -> Floats:
    """Return sizes of velocity changes, x and y as one vector, shape (rate,)."""
    plane = [d for d in rates if d % VELOCITY != THETA]
    size = float(np.sqrt((typical[plane] ** 2).sum()))
    return np.array([typical[d] if d % VELOCITY == THETA else size for d in rates])


def bodies_acceleration(problem: Problem) -> Floats:
    """Return the root mean square acceleration along smoothed trajectories, shape (velocity,).

    Of x and y it is that of the vector, whatever the axes' directions (m/s^2); of omega in rad/s^2.
    """
    coordinates, segments = problem.trajectory_noise.coordinates, problem.segments
    change = segments.observed[:, 0] - segments.start
    return _vectors(_typical(coordinates, [change]), coordinates.rates) / problem.scene.time_step
