"""Coordinates of the bodies' states that trajectories are filtered over, with their noises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, estimate_rates, fill_joints, joint_coordinates
from pbrl_ppl.physics import touching
from pbrl_ppl.scene import Scene, state_sizes
from pbrl_ppl.state import STATE, THETA, VELOCITY, Bools, Floats, Ints, wrapped

#: Variable of the process noise: the unexplained acceleration.
ACCELERATION = "unexplained_acceleration"
#: Variable of the process noise that contacts add.
CONTACT = "contact_acceleration"


@dataclass(frozen=True, eq=False, repr=False)
class Coordinates:
    """Unknown coordinates of the bodies' states, with the noise parameters of each.

    Parameters
    ----------
    places : ndarray of int
        Where an array of shape (body * 6,) holds them, shape (coordinate,).
    columns : tuple of int
        State dimensions that occur.
    sensor : ndarray of int
        Place of the noise parameter of each coordinate's measurement noise; -1 where ``fixed`` is
        it.
    fixed : ndarray
        Standard deviation of measuring a coordinate where it is no parameter, shape (coordinate,).
    push : ndarray
        Change of the coordinates in a step by a unit unexplained acceleration, one row a body and
        velocity, shape (push, coordinate).
    pushed : ndarray of int
        Place of the noise parameter that scales each row, shape (push,).
    sensors, rates, contacts : tuple of int
        State dimensions of the noise parameters: measurement noise, unexplained accelerations,
        accelerations that contacts add.
    """

    places: Ints
    columns: tuple[int, ...]
    sensor: Ints
    fixed: Floats
    push: Floats
    pushed: Ints
    sensors: tuple[int, ...]
    rates: tuple[int, ...]
    contacts: tuple[int, ...] = ()

    @property
    def variables(self) -> dict[str, tuple[str, ...]]:
        """Noise variables with their state dimensions, in the order of sigma."""
        dimensions = {"sigma": self.sensors, ACCELERATION: self.rates, CONTACT: self.contacts}
        return {
            name: tuple(STATE[d] for d in places) for name, places in dimensions.items() if places
        }

    @property
    def accelerations(self) -> range:
        """Places of the noise parameters that are unexplained accelerations."""
        return range(len(self.sensors), len(self.sensors) + len(self.rates))

    @cached_property
    def always(self) -> Bools:
        """Mask of the rows that act in every step, not only in contact, shape (push,)."""
        return self.pushed < self.accelerations.stop

    def steps(self, sigma: Floats) -> Floats:
        """Return the process noise of a step without and with contact, at sigma (..., parameter).

        Shape (..., 2, coordinate, coordinate).
        """
        square = sigma[..., self.pushed] ** 2
        both = np.stack([np.where(self.always, square, 0.0), square], axis=-2)
        return np.asarray((self.push.T * both[..., None, :]) @ self.push)

    def pushes(self, sigma: Floats, touching: Bools, rng: np.random.Generator) -> Floats:
        """Draw process noise of the coordinates, shape (*touching.shape, coordinate).

        The leading axes of ``sigma``, shape (..., parameter), go with those.
        """
        drawn = sigma[..., self.pushed] * rng.standard_normal((*touching.shape, len(self.pushed)))
        return np.where(self.always | touching[..., None], drawn, 0.0) @ self.push

    def sizes(self, scene: Scene) -> Floats:
        """Return typical sizes of the coordinates, shape (coordinate,); see :func:`state_sizes`."""
        return state_sizes(scene)[self.places % len(STATE)]

    def errors(self, sigma: Floats) -> Floats:
        """Return the measurement noise of each coordinate, shape (..., coordinate)."""
        return np.where(self.sensor >= 0, sigma[..., self.sensor], self.fixed)

    def of(self, values: Floats) -> Floats:
        """Return the coordinates of values (..., body, 6), shape (..., coordinate)."""
        return np.asarray(values.reshape(*values.shape[:-2], -1)[..., self.places])

    def completed(self, scene: Scene, states: Floats) -> Floats:
        """Place bodies of states (..., body, 6) by their hinges and sliders, in place."""
        if len(self.places) == 6 * len(scene.moving):  # none is hung
            return states
        free = np.zeros((len(scene.moving), 6), dtype=bool)
        free.reshape(-1)[self.places] = True
        tied = joint_coordinates(scene)
        hung = np.array([body.name in tied for body in scene.moving])[:, None] & ~free
        if hung.any():
            states[..., hung] = np.nan
            fill_joints(states.reshape(-1, 1, *states.shape[-2:]), scene)
        return states

    def displaced(self, scene: Scene, states: Floats, steps: Floats) -> Floats:
        """Return states with each coordinate a step ahead, then with each a step behind.

        Shape (2 coordinate, transition, body, 6), from ``states`` (transition, body, 6) and
        ``steps`` (coordinate,).
        """
        d = len(steps)
        moved = np.tile(states, (2 * d, 1, 1, 1))
        flat = moved.reshape(2 * d, len(states), -1)
        for i, place in enumerate(self.places):
            flat[i, :, place] += steps[i]
            flat[d + i, :, place] -= steps[i]
        return self.completed(scene, moved)

    def slopes(
        self, scene: Scene, states: Floats, steps: Floats, predict: Callable[[Floats], Floats]
    ) -> Floats:
        """Return the derivative of the next state by the state, by central differences.

        Parameters
        ----------
        scene : Scene
            Bodies; those in hinges and sliders follow the others.
        states : ndarray
            States before transitions, shape (transition, body, 6), SI units.
        steps : ndarray
            Steps of the differences, shape (coordinate,).
        predict : callable
            Returns the states after an interval, shape (point, transition, body, 6), for such
            states before it.

        Returns
        -------
        ndarray
            Shape (transition, coordinate, coordinate); 0 where the engine diverged.
        """
        d, after = len(steps), self.of(predict(self.displaced(scene, states, steps)))
        with np.errstate(invalid="ignore"):  # a coordinate that never moves has no step
            slopes = (after[:d] - after[d:]) / (2 * steps[:, None, None])
        return np.nan_to_num(slopes).transpose(1, 2, 0)

    def wrapped(self, difference: Floats) -> Floats:
        """Return differences (..., coordinate) with angles wrapped to (-pi, pi]."""
        angle = self.places % 6 == THETA
        return np.where(angle, wrapped(difference), difference)

    def of_residual(self, residual: Floats) -> Floats:
        """Return the coordinates of a residual (..., transition, 1, body, state)."""
        body, place = self.in_residual
        return np.ascontiguousarray(residual[..., 0, body, place])

    @cached_property
    def in_residual(self) -> tuple[Ints, Ints]:
        """Body and place among the columns of each coordinate."""
        body, dimension = np.divmod(self.places, 6)
        return body, np.searchsorted(self.columns, dimension)


def observed_coordinates(scene: Scene, history: History, *, exactness: float = 1e-6) -> Coordinates:
    """Return the unknown coordinates of a scene's bodies with the noise of a recording.

    ``exactness``: error of measuring what does not move at all, as a share of the coordinate's
    typical size.

    Raises
    ------
    HistoryError
        If nothing moves: no number that was measured ever changes.
    """
    observed = history.dataset["observed"].to_numpy()
    # what was measured of first states alone is given with them
    measured = np.isfinite(observed[:, 1:]).any(axis=(0, 1))
    with np.errstate(invalid="ignore"):
        low, high = (of.reduce(observed, axis=(0, 1)) for of in (np.fmin, np.fmax))
    still = measured & (high == low)
    still[:, VELOCITY:] |= still[:, :VELOCITY]
    free = np.array([[not body.kinematic] * len(STATE) for body in scene.moving])
    tied = joint_coordinates(scene)
    for i, moving in enumerate(scene.moving):
        column = tied.get(moving.name)
        if column in (0, 1) and not measured[i, column]:
            column = 1 - column  # a slider's other position
        if column is not None and measured[i, column]:
            free[i] = [d % VELOCITY == column for d in range(len(STATE))]
    if not (scene.walls or scene.joints or len(scene.bodies) > 1 or scene.bodies[0].wheel):
        # nothing couples coordinates of a body: what was not measured moves nothing that was
        seen = measured[:, :VELOCITY] | measured[:, VELOCITY:]
        free &= np.hstack([seen, seen])
    places = np.flatnonzero(free)
    body, dimension = np.divmod(places, len(STATE))
    stated = dict(scene.noise)
    exact = exactness * state_sizes(scene)
    sensed = free & measured & ~still & np.array([name not in stated for name in STATE])
    sensors = np.flatnonzero(sensed.any(axis=0))
    if not (free & ~still)[:, VELOCITY:].any():  # all logged as constant, while places change
        still = np.hstack([still[:, :VELOCITY]] * 2)
    rates = np.flatnonzero((free & ~still).any(axis=0)[VELOCITY:]) + VELOCITY
    if not (sensors.size or rates.size):
        names = ", ".join(body.name for body in scene.dynamic)
        raise HistoryError(
            f"history: nothing moves: every number that was measured of {names} stays exactly the"
            " same, which tells nothing; record a motion, or check the columns"
        )
    sensor = np.where(sensed[body, dimension], np.searchsorted(sensors, dimension), -1)
    push, pushed, dt = [], [], scene.time_step
    ways = first_states(history)
    begin, end = (s.reshape(-1, *s.shape[2:]) for s in (ways[:, :-1], ways[:, 1:]))
    touched = bool(touching(scene, begin, end).any())
    for kind, b in product(range(1 + touched), range(len(scene.moving))):
        for j, d in enumerate(rates):
            if free[b, d] and not still[b, d]:
                row = np.where((body == b) & (dimension == d), dt, 0.0)
                place = np.where((body == b) & (dimension == d - VELOCITY), dt**2, 0.0)
                push.append(row + place / 2)
                if kind:  # a blow falls at any moment of the interval
                    push.append(place / np.sqrt(12))
                pushed += [len(sensors) + kind * len(rates) + j] * (1 + kind)
    return Coordinates(
        places,
        tuple(np.unique(dimension).tolist()),
        sensor,
        np.array([stated.get(STATE[d], exact[d]) for d in dimension]),
        np.array(push).reshape(-1, len(places)),
        np.array(pushed, dtype=np.intp),
        tuple(sensors.tolist()),
        tuple(rates.tolist()),
        tuple(rates.tolist()) if touched else (),
    )


def first_states(history: History) -> Floats:
    """Return measured states, gaps interpolated, shape (trajectory, time, body, 6).

    Velocities that do not count as measured are estimated from measured positions.
    """
    dataset = history.dataset
    states: Floats = dataset["start"].to_numpy().copy()
    seen = np.isfinite(dataset["observed"].to_numpy()).any(axis=(0, 1))
    free = ~dataset["kinematic"].to_numpy()[:, None]
    states[..., VELOCITY:][:, :, free & seen[:, :VELOCITY] & ~seen[:, VELOCITY:]] = np.nan
    estimate_rates(states, float(dataset.attrs["time_step"]))
    rows = dataset["n_rows"].to_numpy()
    for trajectory, body, d in np.ndindex(len(states), *states.shape[2:]):
        values = states[trajectory, : rows[trajectory], body, d]
        known = np.flatnonzero(np.isfinite(values))
        if len(known):
            level = np.unwrap(values[known]) if d == THETA else values[known]
            values[:] = np.interp(np.arange(len(values)), known, level)
    return np.asarray(np.nan_to_num(states))
