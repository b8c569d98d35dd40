"""Engines of scenes in parts: bodies that never meet are simulated apart, each part once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.physics.coupling import SHARE, come_near
from pbrl_ppl.physics.simulator import Simulator
from pbrl_ppl.scene import body_sizes
from pbrl_ppl.state import Bools, Floats, Ints

if TYPE_CHECKING:
    from pbrl_ppl.physics.physics import Physics

R = TypeVar("R")


class Memory:
    """The last few results of a function, by its arguments; they do not go into a pickle.

    A Metropolis step asks for the proposed point and the current one: the latter was just computed.
    """

    def __init__(self, size: int = 4) -> None:
        self._size = size
        self._known: OrderedDict[Hashable, Any] = OrderedDict()

    def __getstate__(self) -> dict[str, object]:
        """Nothing."""
        return {"_size": self._size, "_known": OrderedDict()}

    def recall(self, arguments: tuple[Floats, ...], compute: Callable[..., R]) -> R:
        """Return ``compute(*arguments)``, from memory for equal arguments.

        The first argument is compared as a whole, others by a hash.

        Examples
        --------
        >>> memory, one = Memory(), np.ones(2)
        >>> memory.recall((one,), np.exp) is memory.recall((np.ones(2),), np.exp)
        True
        """
        parameters, *data = arguments  # of what is large, a hash will do
        key = (parameters.tobytes(), *((array.shape, hash(array.tobytes())) for array in data))
        if key in self._known:
            self._known.move_to_end(key)
        else:
            self._known[key] = compute(*arguments)
            if len(self._known) > self._size:
                self._known.popitem(last=False)
        result: R = self._known[key]
        return result


@dataclass(eq=False)
class Part:
    """One part: its engine, and where its parameters and bodies are in the whole."""

    simulator: Simulator
    places: NDArray[np.intp]
    bodies: NDArray[np.intp]
    memory: Memory = field(default_factory=Memory)

    @property
    def physics(self) -> Physics:
        """Its scene, effects and parameters."""
        return self.simulator.physics


class PartedSimulator:
    """As :class:`Simulator`, for parts whose bodies neither touch each other nor share a joint.

    Proposals that agree in the parameters of a part are simulated once for it: a derivative, or a
    sampler that moves one part at a time, costs for many bodies what it costs for each alone.
    Bodies of different parts go through each other; see :class:`OneWorld`.

    Parameters
    ----------
    physics : Physics
        Scene, effects, settings and parts.

    Raises
    ------
    SimulationError
        If the parts do not hold every moving body once.
    """

    def __init__(self, physics: Physics) -> None:
        names = tuple(body.name for body in physics.scene.moving)
        parts = (names,) if physics.parts is None else physics.parts
        listed = [name for part in parts for name in part]
        if sorted(listed) != sorted(names):
            raise SimulationError(
                f"parts hold {', '.join(listed)}, expected each moving body once:"
                f" {', '.join(names)}"
            )
        labels = self._labels = physics.layout.labels
        self.parts = []
        for part in parts:
            part_physics = physics if len(parts) == 1 else physics.part(part)
            places = np.array(
                [labels.index(label) for label in part_physics.layout.labels], dtype=int
            )
            bodies = np.array(
                [names.index(body.name) for body in part_physics.scene.moving], dtype=int
            )
            self.parts.append(Part(Simulator(part_physics), places, bodies))

    @property
    def steps(self) -> int:
        """Engine steps an interval, of all parts and all runs that are combined."""
        return int(sum(part.simulator.levels[0].sum() for part in self.parts))

    def __call__(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Predict as :class:`Simulator` does: (transition, H, body, 6), or with proposals first."""
        if len(self.parts) == 1:
            return self.parts[0].simulator(phi, start, actions)
        phi = np.asarray(phi, dtype=float)
        proposals = np.atleast_2d(phi)
        out = np.empty((len(proposals), *actions.shape[:-1], 6))
        for part in self.parts:
            parameters = proposals[:, part.places]
            begin, acted = _of(part, start, actions)
            keys = (
                parameters
                if start.ndim == 3
                else np.hstack([parameters, begin.reshape(len(parameters), -1)])
            )
            _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
            begin = begin if start.ndim == 3 else begin[first]
            states = part.simulator(parameters[first], begin, acted)
            out[..., part.bodies, :] = states[which.ravel()]
        return out if phi.ndim == 2 else out[0]

    def recall(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Return the prediction for one phi, from memory if it was just computed."""
        if phi.shape != (len(self._labels),):
            raise SimulationError(
                f"phi has shape {phi.shape}, expected ({len(self._labels)},):"
                f" {', '.join(self._labels)}"
            )
        out = np.empty((*actions.shape[:-1], 6))
        for part in self.parts:
            inputs = phi[part.places], *_of(part, start, actions)
            out[..., part.bodies, :] = part.memory.recall(inputs, part.simulator)
        return out

    def jacobian(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Derivative by phi, shape (transition, H, body, 6, p); see :meth:`Simulator.jacobian`."""
        out = np.zeros((*actions.shape[:-1], 6, len(phi)))
        for part in self.parts:
            derivative = part.simulator.jacobian(phi[part.places], *_of(part, start, actions))
            out[:, :, part.bodies[:, None, None], np.arange(6)[:, None], part.places] = derivative
        return out


def _of(part: Part, start: Floats, actions: Floats) -> tuple[Floats, Floats]:
    return start[..., part.bodies, :], actions[:, :, part.bodies]


class OneWorld:
    """As :class:`PartedSimulator`, but bodies of different parts meet.

    A body that comes near none of another part, or that one world predicts as its part does, has
    the prediction of the likelihood, to the last bit; others have that of one world.

    Parameters
    ----------
    physics : Physics
        Scene, effects, settings and parts.
    rounding : float
        Largest difference of one world's prediction from a part's that counts as none, in radii of
        the smallest body, rad and sampling intervals.
    """

    def __init__(self, physics: Physics, rounding: float = 1e-6) -> None:
        self.parted = physics.simulator
        # contacts are not extrapolated, nor is anything else in a transition that has one
        self._apart = physics.changed(extrapolate=False).simulator
        self._rounding = rounding * body_sizes(physics.scene).min(axis=0)
        self._reach = [body.shape.bounding_radius for body in physics.scene.moving]
        self._whole = Simulator(physics.changed(extrapolate=False, parts=None))

    def __call__(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Predict as :class:`Simulator` does: (transition, H, body, 6), or with proposals first."""
        return self.meetings(phi, start, actions)[0]

    def meetings(self, phi: Floats, start: Floats, actions: Floats) -> tuple[Floats, Bools]:
        """Predict, and return which bodies touch another part, shape (..., transition, body)."""
        states = self.parted(phi, start, actions)
        met = np.zeros((*states.shape[:-3], states.shape[-2]), dtype=bool)
        if len(self.parted.parts) == 1:
            return states, met
        whole, apart = self._whole(phi, start, actions), self._apart(phi, start, actions)
        # in a contact within a part too, for the solver's iterations depend on the others
        differ: Bools = np.asarray((~_same(whole, apart, self._rounding)).any(axis=(-3, -1)))
        if not differ.any():
            return states, met
        for bodies_a, bodies_b in combinations((part.bodies for part in self.parted.parts), 2):
            both = np.concatenate([bodies_a, bodies_b])
            moved = differ[..., both].any(axis=-1)
            if not moved.any():
                continue
            near: Bools = self._near(whole, start, bodies_a, bodies_b)
            near |= self._near(apart, start, bodies_a, bodies_b)
            met[..., both] |= np.expand_dims(moved & near, -1)
        return np.where((met & differ)[..., None, :, None], whole, states), met

    def _near(self, states: Floats, start: Floats, bodies_a: Ints, bodies_b: Ints) -> Bools:
        """Whether a body of one part comes near one of another, shape (..., transition)."""
        begin = start[..., :, None, :, :2]
        first = np.broadcast_to(begin, (*states.shape[:-4], *begin.shape[-4:]))
        places = np.concatenate([first, states[..., :2]], axis=-3)
        near = np.zeros(states.shape[:-3], dtype=bool)
        for i, j in product(bodies_a, bodies_b):
            way = places[..., i, :] - places[..., j, :]
            least = (1.0 + SHARE) * (self._reach[i] + self._reach[j])
            near |= come_near(way[..., :-1, :], way[..., 1:, :], least).any(axis=-1)
        return near


def _same(a: Floats, b: Floats, rounding: Floats) -> Bools:
    """Whether numbers are the same to rounding, or both are lost."""
    return np.asarray((abs(a - b) <= rounding) | (np.isnan(a) & np.isnan(b)))
