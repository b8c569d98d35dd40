"""Coordinates of the bodies' states that trajectories are filtered over, with their noises."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import fill_hinges, hung_bodies
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA, wrapped

#: Variable of the process noise: the unexplained acceleration.
ACCELERATION = "unexplained_acceleration"
#: Variable of the process noise that contacts add.
JOLT = "contact_acceleration"
#: Variable of measurement noise that is correlated from row to row, as of a tracker.
DRIFT = "correlated_error"

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class Cells:
    """Unknown coordinates of the bodies' states, with the noise parameters of each.

    Parameters
    ----------
    places : ndarray of int
        Where an array of shape (body * 6,) holds them, shape (cell,).
    columns : tuple of int
        State dimensions that occur.
    sensor : ndarray of int
        Place of the noise parameter that is a cell's measurement noise; -1 where ``fixed`` is it.
    fixed : ndarray
        Standard deviation of measuring a cell where it is no parameter, shape (cell,).
    push : ndarray
        Change of the cells in a step by a unit unexplained acceleration, one row a body and
        velocity, shape (push, cell).
    pushed : ndarray of int
        Place of the noise parameter that scales each row, shape (push,).
    sensors, rates, jolts, drifts : tuple of int
        State dimensions of the noise parameters: measurement noise, unexplained accelerations,
        accelerations that contacts add, correlated measurement noise.
    memory : float
        Correlation of the last from one row to the next.
    """

    places: Ints
    columns: tuple[int, ...]
    sensor: Ints
    fixed: Array
    push: Array
    pushed: Ints
    sensors: tuple[int, ...]
    rates: tuple[int, ...]
    jolts: tuple[int, ...] = ()
    drifts: tuple[int, ...] = ()
    memory: float = 0.0

    @property
    def variables(self) -> dict[str, tuple[str, ...]]:
        """Noise variables with their state dimensions, in the order of sigma."""
        own = {
            "sigma": self.sensors, ACCELERATION: self.rates, JOLT: self.jolts, DRIFT: self.drifts,
        }  # fmt: skip
        return {name: tuple(STATE[d] for d in about) for name, about in own.items() if about}

    @property
    def accelerations(self) -> range:
        """Places of the noise parameters that are unexplained accelerations."""
        return range(len(self.sensors), len(self.sensors) + len(self.rates))

    @property
    def drift_parameters(self) -> range:
        """Places of the noise parameters of correlated measurement noise."""
        first = len(self.sensors) + len(self.rates) + len(self.jolts)
        return range(first, first + len(self.drifts))

    def drifting(self, memory: float) -> Cells:
        """Return the same with correlated measurement noise of positions."""
        return replace(self, drifts=tuple(d for d in self.sensors if d <= THETA), memory=memory)

    @cached_property
    def drifted(self) -> tuple[Ints, Ints]:
        """Cells with correlated measurement noise, and the place of its noise parameter."""
        dimension = self.places % len(STATE)
        cells = np.flatnonzero(np.isin(dimension, self.drifts) & (self.sensor >= 0))
        order = np.searchsorted(self.drifts, dimension[cells])
        return cells, self.drift_parameters.start + order

    @cached_property
    def always(self) -> Bools:
        """Mask of the rows that act in every step, not only in contact, shape (push,)."""
        return self.pushed < self.accelerations.stop

    def steps(self, sigma: Array) -> Array:
        """Return the process noise of a step without and with contact.

        Shape (2, cell, cell).
        """
        return step_covariances(self.push, sigma[self.pushed], self.always)

    def pushes(self, sigma: Array, touching: Bools, rng: np.random.Generator) -> Array:
        """Draw process noise of the cells, shape (*touching.shape, cell).

        The leading axes of ``sigma``, shape (..., parameter), go with those.
        """
        drawn = sigma[..., self.pushed] * rng.standard_normal((*touching.shape, len(self.pushed)))
        return np.where(self.always | touching[..., None], drawn, 0.0) @ self.push

    def white(self, sigma: Array) -> Array:
        """Return the uncorrelated measurement noise of each cell, shape (cell,)."""
        return np.where(self.sensor >= 0, sigma[self.sensor], self.fixed)

    def errors(self, sigma: Array) -> Array:
        """Return the measurement noise of each cell, correlated and not, shape (cell,)."""
        square = self.white(sigma) ** 2
        cells, parameters = self.drifted
        square[cells] += sigma[parameters] ** 2
        return np.sqrt(square)

    def of(self, values: Array) -> Array:
        """Return the cells of values (..., body, 6), shape (..., cell)."""
        return np.asarray(values.reshape(*values.shape[:-2], -1)[..., self.places])

    def completed(self, scene: Scene, states: Array) -> Array:
        """Place hinged bodies of states (..., body, 6) by their hinges, in place."""
        if len(self.places) == 6 * len(scene.moving):  # none is hung
            return states
        free = np.zeros((len(scene.moving), 6), dtype=bool)
        free.reshape(-1)[self.places] = True
        tied = hung_bodies(scene)
        hung = np.array([body.name in tied for body in scene.moving])[:, None] & ~free
        if hung.any():
            states[..., hung] = np.nan
            fill_hinges(states.reshape(-1, 1, *states.shape[-2:]), scene)
        return states

    def wrapped(self, difference: Array) -> Array:
        """Return differences of cells, shape (..., cell), angles wrapped to (-pi, pi]."""
        angle = self.places % 6 == THETA
        return np.where(angle, wrapped(difference), difference)

    def of_residual(self, residual: Array) -> Array:
        """Return the cells of a residual (..., transition, 1, body, state)."""
        body, place = self.in_residual
        return np.ascontiguousarray(residual[..., 0, body, place])

    @cached_property
    def in_residual(self) -> tuple[Ints, Ints]:
        """Body and place among the columns of each cell."""
        body, dimension = np.divmod(self.places, 6)
        return body, np.searchsorted(self.columns, dimension)


def step_covariances(push: Array, size: Array, always: Bools) -> Array:
    """Return the process noise of a step without and with contact.

    Parameters
    ----------
    push : ndarray
        Change by a unit of each row, shape (push, coordinate).
    size : ndarray
        Standard deviation of each row, shape (push,).
    always : ndarray of bool
        Which rows act in every step, shape (push,).

    Returns
    -------
    ndarray
        Shape (2, coordinate, coordinate).
    """
    square = size**2
    free = np.where(always, square, 0.0)
    return np.stack([(push.T * own) @ push for own in (free, square)])


def check_moves(cells: Cells, scene: Scene) -> None:
    """Refuse a recording in which nothing moves.

    Raises
    ------
    HistoryError
        If no number that was measured ever changes.
    """
    if not cells.sensors and not cells.rates:
        names = ", ".join(body.name for body in scene.dynamic)
        raise HistoryError(
            f"history: nothing moves: every number that was measured of {names} stays exactly the"
            " same, which tells nothing; record a motion, or check the columns"
        )
