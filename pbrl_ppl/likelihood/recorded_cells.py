"""Coordinates that a recording observes, and first estimates of its states."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.history import History, estimate_rates, hung_bodies
from pbrl_ppl.likelihood.cells import Cells
from pbrl_ppl.physics import touching
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA

Array = NDArray[np.float64]

#: Error of measuring what does not move at all (m, rad, m/s, rad/s).
_EXACT = 1e-6
#: A position's velocity is so many places on.
_RATE = 3


def cells_of(scene: Scene, history: History) -> Cells:
    """Return the unknown coordinates of a scene's bodies with the noise of a recording."""
    observed = history.dataset["observed"].to_numpy()
    # what was measured of first states alone is given with them
    measured = np.isfinite(observed[:, 1:]).any(axis=(0, 1))
    with np.errstate(invalid="ignore"):
        low = np.where(measured, np.fmin.reduce(observed, axis=(0, 1)), 0.0)
        high = np.where(measured, np.fmax.reduce(observed, axis=(0, 1)), 0.0)
    still = measured & (high == low)
    still[:, _RATE:] |= still[:, :_RATE]
    free = np.array([[not body.kinematic] * len(STATE) for body in scene.moving])
    for i, moving in enumerate(scene.moving):
        if moving.name in hung_bodies(scene) and measured[i, THETA]:
            free[i] = [d % _RATE == THETA for d in range(len(STATE))]
    if _uncoupled(scene):  # what was not measured moves nothing that was
        seen = measured[:, :_RATE] | measured[:, _RATE:]
        free &= np.hstack([seen, seen])
    places = np.flatnonzero(free)
    body, dimension = np.divmod(places, len(STATE))
    stated = dict(scene.noise)
    given = np.array([name in stated for name in STATE])
    sensed = free & measured & ~still & ~given
    sensors = np.flatnonzero(sensed.any(axis=0))
    rates = np.flatnonzero((free & ~still).any(axis=0)[_RATE:]) + _RATE
    sensor = np.full(len(places), -1)
    for i, (b, d) in enumerate(zip(body, dimension, strict=True)):
        if sensed[b, d]:
            sensor[i] = np.searchsorted(sensors, d)
    push, pushed = [], []
    dt = scene.time_step
    ways = first_states(history)
    begin, end = (s.reshape(-1, *s.shape[2:]) for s in (ways[:, :-1], ways[:, 1:]))
    jolted = bool(touching(scene, begin, end).any())
    kinds = product(range(1 + jolted), range(len(scene.moving)))
    for kind, b in kinds:
        for j, d in enumerate(rates):
            if free[b, d] and not still[b, d]:
                row = np.where((body == b) & (dimension == d), dt, 0.0)
                place = np.where((body == b) & (dimension == d - _RATE), dt**2, 0.0)
                push.append(row + place / 2)
                if kind:  # a blow falls at any moment of the interval
                    push.append(place / np.sqrt(12))
                pushed += [len(sensors) + kind * len(rates) + j] * (1 + kind)
    return Cells(
        places,
        tuple(int(d) for d in np.unique(dimension)),
        sensor,
        np.array([stated.get(STATE[d], _EXACT) for d in dimension]),
        np.array(push).reshape(-1, len(places)),
        np.array(pushed, dtype=np.intp),
        tuple(int(d) for d in sensors),
        tuple(int(d) for d in rates),
        tuple(int(d) for d in rates) if jolted else (),
    )


def _uncoupled(scene: Scene) -> bool:
    """Return whether the scene couples no coordinate of a body with another."""
    return not (scene.walls or scene.joints or len(scene.bodies) > 1 or scene.bodies[0].wheel)


def first_states(history: History) -> Array:
    """Return measured states, gaps interpolated, shape (trajectory, time, body, 6).

    Velocities that do not count as measured are estimated from measured positions.
    """
    dataset = history.dataset
    states: Array = dataset["start"].to_numpy().copy()
    seen = np.isfinite(dataset["observed"].to_numpy()).any(axis=(0, 1))
    free = ~dataset["kinematic"].to_numpy()[:, None]
    rates = np.hstack([np.zeros_like(seen[:, :_RATE]), free & seen[:, :_RATE] & ~seen[:, _RATE:]])
    states[:, :, rates] = np.nan
    estimate_rates(states, float(dataset.attrs["time_step"]))
    rows = dataset["n_rows"].to_numpy()
    for trajectory, n in enumerate(rows):
        for body in range(states.shape[2]):
            for d in range(len(STATE)):
                values = states[trajectory, :n, body, d]
                known = np.flatnonzero(np.isfinite(values))
                if len(known):
                    level = np.unwrap(values[known]) if d == THETA else values[known]
                    values[:] = np.interp(np.arange(n), known, level)
    return np.asarray(np.nan_to_num(states))
