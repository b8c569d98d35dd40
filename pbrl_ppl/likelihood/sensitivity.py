"""Sensitivity of the linearisation point of trajectories to the parameters.

A parameter and the states are often known together far better than each alone, such as a wheel's
angle and a heading. With the states held fast, another angle would be judged by motions that no
body made: by slips and stops that are not there. Predictions start from the states that go with the
parameters, to first order, and are taken back along the slope by as much: where the motion is
linear, nothing changes. See E. L. Haseltine and J. B. Rawlings, Critical evaluation of extended
Kalman filtering and moving-horizon estimation (2005), on the point of linearisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood.coordinates import Coordinates
from pbrl_ppl.parameters import Layout, change_from
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Bools, Floats

#: Larger changes of a state count as divergence, in typical sizes of its coordinates.
_FAR = 1e6
#: Predicts next states from phi, initial states and inputs, as a simulator does.
Engine = Callable[[Floats, Floats, Floats], Floats]


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity:
    """Derivative of the initial states of transitions by the parameters.

    Parameters
    ----------
    scene : Scene
        Its hinges hold hung bodies.
    layout : Layout
        Order of phi.
    coordinates : Coordinates
        Coordinates of the state.
    slope : ndarray
        Derivative of the next state by the state, shape (transition, coordinate, coordinate).
    phi : ndarray
        Parameters that the states were smoothed with, one set a transition, shape (transition, p).
    before : ndarray
        Derivative of the state before each transition, shape (transition, coordinate, p).
    """

    scene: Scene
    layout: Layout
    coordinates: Coordinates
    slope: Floats
    phi: Floats
    before: Floats

    @cached_property
    def _sets(self) -> list[tuple[Floats, Bools, Floats]]:
        """Parameter sets of phi, the transitions of each, and their derivatives.

        The latter have the shape (transition * coordinate, p).
        """
        sets, which = np.unique(self.phi, axis=0, return_inverse=True)
        rows = [which.ravel() == i for i in range(len(sets))]
        parts = [self.before[row].reshape(-1, self.phi.shape[1]) for row in rows]
        return list(zip(sets, rows, parts, strict=True))

    @cached_property
    def _far(self) -> Floats:
        """Changes of the coordinates that count as divergence, shape (coordinate,)."""
        return _FAR * self.coordinates.sizes(self.scene)

    def at(self, rows: NDArray[np.intp]) -> Sensitivity:
        """Return the sensitivity of these transitions alone."""
        return replace(self, slope=self.slope[rows], phi=self.phi[rows], before=self.before[rows])

    def moved(self, phi: Floats) -> Floats:
        """Return the change of the states with phi, shape (..., transition, coordinate)."""
        result = np.empty((*phi.shape[:-1], *self.before.shape[:2]))
        for before, rows, by_phi in self._sets:
            change = change_from(self.layout, phi, before) @ by_phi.T
            result[..., rows, :] = change.reshape(*phi.shape[:-1], -1, result.shape[-1])
        return result

    def begun(self, moved: Floats, start: Floats) -> Floats:
        """Return moved initial states, shape (..., transition, body, 6)."""
        states = np.broadcast_to(start, (*moved.shape[:-2], *start.shape))
        return self.coordinates.completed(self.scene, self._added(states, moved))

    def predicted(self, engine: Engine, phi: Floats, start: Floats, inputs: Floats) -> Floats:
        """Return next states from smoothed initial states, shape (..., transition, 1, body, 6).

        Parameters
        ----------
        engine : callable
            As :class:`pbrl_ppl.physics.PartedSimulator`.
        phi : ndarray
            Parameters, shape (..., p).
        start : ndarray
            Smoothed states before the transitions, shape (transition, body, 6), SI units.
        inputs : ndarray
            What acts, shape (transition, 1, body, 3 or 9).
        """
        moved = self.moved(phi)
        moved = np.where(
            np.abs(moved) < self._far, moved, np.nan
        )  # nothing is predicted from there
        states = engine(phi, self.begun(np.nan_to_num(moved), start), inputs)
        back = np.matmul(self.slope, moved[..., None])[..., 0]
        return self._added(states, -back[..., None, :])

    def _added(self, states: Floats, change: Floats) -> Floats:
        """Return states (..., body, 6) with changed coordinates (..., coordinate)."""
        states = np.array(states, order="C")  # so that what is reshaped is a view of it
        flat = states.reshape(*states.shape[:-2], -1)
        flat[..., self.coordinates.places] += change
        return states
