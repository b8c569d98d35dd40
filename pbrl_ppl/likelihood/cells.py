"""Cells: unknown coordinates of the bodies' states, and which noise each is subject to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import fill_hinges, hung_bodies
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA, wrapped

#: The variable of what a step adds: an acceleration that nothing in the model explains.
ACCELERATION = "unexplained_acceleration"
#: And the one of what comes on top of it where bodies touch.
JOLT = "contact_acceleration"
#: Errors of measuring that last: those of a tracker, say, beside errors of single rows.
DRIFT = "correlated_error"

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class Cells:
    """Unknown coordinates of the bodies' states, and which noise parameter each is subject to.

    Parameters
    ----------
    places : ndarray of int
        Where an array of shape (body * 6,) holds them, shape (cell,).
    columns : tuple of int
        State dimensions that occur.
    sensor : ndarray of int
        Which noise parameter is the error of measuring a cell; -1 where ``fixed`` is.
    fixed : ndarray
        Standard deviation of measuring a cell where it is no parameter, shape (cell,).
    push : ndarray
        What a unit of an unexplained acceleration adds to the cells in a step, one row a body and
        velocity, shape (push, cell).
    pushed : ndarray of int
        Which noise parameter is the acceleration of each row, shape (push,).
    sensors, rates, jolts, drifts : tuple of int
        State dimensions that the noise parameters are about: of measurements, of accelerations, of
        what bodies that touch add to those, of errors of measuring that are correlated.
    memory : float
        Correlation of the latter from one row to the next.
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
        """Variables of the noise, and the state dimensions of each, in the order of sigma."""
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
        """Places of the noise parameters that are correlated errors of measuring."""
        first = len(self.sensors) + len(self.rates) + len(self.jolts)
        return range(first, first + len(self.drifts))

    def drifting(self, memory: float) -> Cells:
        """The same with correlated errors of measuring positions."""
        return replace(self, drifts=tuple(d for d in self.sensors if d <= THETA), memory=memory)

    @cached_property
    def drifted(self) -> tuple[Ints, Ints]:
        """Cells with correlated errors, and which noise parameter each one's is."""
        dimension = self.places % len(STATE)
        cells = np.flatnonzero(np.isin(dimension, self.drifts) & (self.sensor >= 0))
        order = np.searchsorted(self.drifts, dimension[cells])
        return cells, self.drift_parameters.start + order

    @cached_property
    def always(self) -> Bools:
        """Which rows act in every step, and not only where bodies touch, shape (push,)."""
        return self.pushed < self.accelerations.stop

    def steps(self, sigma: Array) -> Array:
        """Covariance of what a step adds where no bodies touch, and where some do.

        Shape (2, cell, cell).
        """
        return step_covariances(self.push, sigma[self.pushed], self.always)

    def pushes(self, sigma: Array, touching: Bools, rng: np.random.Generator) -> Array:
        """Draw what steps add to the cells, shape (..., cell), as ``touching`` has its axes.

        The leading axes of ``sigma``, shape (..., parameter), go with those.
        """
        drawn = sigma[..., self.pushed] * rng.standard_normal((*touching.shape, len(self.pushed)))
        return np.where(self.always | touching[..., None], drawn, 0.0) @ self.push

    def white(self, sigma: Array) -> Array:
        """Standard deviation of a row's own error of measuring each cell, shape (cell,)."""
        return np.where(self.sensor >= 0, sigma[self.sensor], self.fixed)

    def errors(self, sigma: Array) -> Array:
        """Standard deviation of measuring each cell, correlated or not, shape (cell,)."""
        square = self.white(sigma) ** 2
        cells, parameters = self.drifted
        square[cells] += sigma[parameters] ** 2
        return np.sqrt(square)

    def of(self, values: Array) -> Array:
        """The cells of values of shape (..., body, 6), shape (..., cell)."""
        return np.asarray(values.reshape(*values.shape[:-2], -1)[..., self.places])

    def completed(self, scene: Scene, states: Array) -> Array:
        """Put hung bodies of states (..., body, 6) where their hinges hold them, in place."""
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
        """Differences of cells, shape (..., cell), angles wrapped to (-pi, pi]."""
        angle = self.places % 6 == THETA
        return np.where(angle, wrapped(difference), difference)

    def of_residual(self, residual: Array) -> Array:
        """The cells of a residual (..., transition, 1, body, state): (..., transition, cell)."""
        body, place = self.in_residual
        return np.ascontiguousarray(residual[..., 0, body, place])

    @cached_property
    def in_residual(self) -> tuple[Ints, Ints]:
        """Body and place among the columns of each cell."""
        body, dimension = np.divmod(self.places, 6)
        return body, np.searchsorted(self.columns, dimension)


def step_covariances(push: Array, size: Array, always: Bools) -> Array:
    """Covariance of what a step adds where no bodies touch, and where some do.

    Parameters
    ----------
    push : ndarray
        What a unit of each row adds, shape (push, coordinate).
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
    """Refuse a recording in which nothing moves, which has no noise to infer either.

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
