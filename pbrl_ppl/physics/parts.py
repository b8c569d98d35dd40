"""Independent parts of a scene, and engines that simulate each part once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass, field
from itertools import chain, combinations, compress, product
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from scipy.sparse.csgraph import connected_components

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.physics.settings import Parts, PhysicsSettings
from pbrl_ppl.physics.simulator import Simulator
from pbrl_ppl.physics.solids import to_segment
from pbrl_ppl.scene import WORLD, Scene, body_sizes
from pbrl_ppl.state import Bools, Floats, Ints

R = TypeVar("R")
#: Distance that bodies of different parts must keep: a share of their size plus the same share of
#: their relative motion in an interval, since paths are not straight.
_SHARE = 0.25


def joined_parts(parts: Parts, together: Collection[str]) -> Parts:
    """Return the parts, with those that contain any of the bodies ``together`` merged.

    Examples
    --------
    >>> joined_parts((("a", "b"), ("c",), ("d",)), ["b", "d"])
    (('a', 'b', 'd'), ('c',))
    """
    apart = [set(together).isdisjoint(part) for part in parts]
    if all(apart):
        return parts
    first = apart.index(False)
    joined = chain(*(part for part, alone in zip(parts, apart, strict=True) if not alone))
    return (*parts[:first], tuple(joined), *compress(parts[first:], apart[first:]))


def independent_parts(scene: Scene, history: History | None = None) -> Parts:
    """Return the moving bodies in parts that never come near and share no joint or parameters.

    A kinematic body counts as any other: all bodies that it meets are in its part.

    Given the noise, the likelihood factorises over the parts, so that many bodies cost the sum of
    their costs alone. Bodies that were apart in the data may meet in a prediction, for which there
    is :class:`OneWorld`.

    Parameters
    ----------
    scene : Scene
        Shapes, joints and classes. A joint of unknown bodies may join any two.
    history : History, optional
        Measured places, without which bodies come near no others; a body whose place is missing at
        some time may have been anywhere.

    Returns
    -------
    tuple of tuple of str
        Names, in the order of ``scene.moving``.

    Examples
    --------
    >>> import pandas as pd
    >>> from pbrl_ppl.scene import Body, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.1)) for name in "abc")
    >>> scene = Scene(time_step=0.1, bodies=pucks)
    >>> rows = [
    ...     {"trajectory": 0, "time": 0.1 * t, "body": name, "x": x, "vx": 0.0} for t in range(2)
    ...     for name, x in zip("abc", (0.0, 0.21, 3.0))
    ... ]
    >>> rest = dict.fromkeys(["y", "theta", "vy", "omega", "force_x", "force_y", "torque"], 0.0)
    >>> independent_parts(scene, History.from_dataframe(pd.DataFrame(rows).assign(**rest), scene))
    (('a', 'b'), ('c',))
    """
    names = [body.name for body in scene.moving]
    k = len(names)
    together = np.zeros((k, k), dtype=bool)
    for joint in scene.joints:
        if joint.bodies is None:
            return (tuple(names),)
        if all(name in names for name in joint.bodies) and WORLD not in joint.bodies:
            i, j = (names.index(name) for name in joint.bodies)
            together[i, j] = True
    for sharing in scene.owners.values():
        for name in sharing[1:]:
            together[names.index(name), names.index(sharing[0])] = True
    if history is not None:
        place = history.dataset["start"].to_numpy()[..., :2]
        intervals = history.dataset["n_rows"].to_numpy() - 1
        inside = np.arange(place.shape[1] - 1) < intervals[:, None]
        begin, end = place[:, :-1][inside], place[:, 1:][inside]  # (interval, body, 2)
        reach = [body.shape.bounding_radius for body in scene.moving]
        for i in range(k):
            for j in range(i):
                least = (1.0 + _SHARE) * (reach[i] + reach[j])
                near = come_near(begin[:, i] - begin[:, j], end[:, i] - end[:, j], least)
                together[i, j] |= near.any()
    count, part = connected_components(together, directed=False)
    kinematic = np.array([body.kinematic for body in scene.moving])
    for label in range(count):  # a kinematic body that meets none joins the first dynamic one
        if kinematic[part == label].all():
            part[part == label] = part[~kinematic][0]
    return tuple(tuple(np.array(names)[part == label].tolist()) for label in np.unique(part))


def come_near(begin: Floats, end: Floats, least: float) -> Bools:
    """Return whether two bodies come nearer than ``least`` (m), or may where places are missing.

    Parameters
    ----------
    begin, end : ndarray
        Place of one relative to the other before and after an interval, shape (..., 2), m.
    """
    path = end - begin
    nearest = to_segment(-begin, path)
    return np.asarray(~(nearest >= least + _SHARE * np.linalg.norm(path, axis=-1)))


class Memory:
    """The last few results of a function, by its arguments; they do not go into a pickle.

    Threads may share it; two that ask for the same at once both compute it.

    A Metropolis step asks for the proposed point and the current one: the latter was just computed.
    """

    def __init__(self, size: int = 4) -> None:
        self._size = size
        self._known: OrderedDict[Hashable, Any] = OrderedDict()
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[Memory], tuple[int]]:
        """Return an empty one's arguments."""
        return Memory, (self._size,)

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
        with self._lock:
            known = [self._known.pop(key)] if key in self._known else []
        result: R = known[0] if known else compute(*arguments)
        with self._lock:
            self._known[key] = result
            while len(self._known) > self._size:
                self._known.popitem(last=False)
        return result


@dataclass(eq=False)
class EnginePart:
    """One part: its engine, and where its parameters and bodies are in the whole."""

    simulator: Simulator
    places: Ints
    bodies: Ints
    memory: Memory = field(default_factory=Memory)

    @property
    def physics(self) -> PhysicsSettings:
        """Its scene, effects and parameters."""
        return self.simulator.physics


class PartedSimulator:
    """As :class:`Simulator`, for parts whose bodies neither touch each other nor share a joint.

    Proposals that agree in the parameters of a part are simulated once for it: a derivative, or a
    sampler that moves one part at a time, costs for many bodies what it costs for each alone.
    Bodies of different parts go through each other; see :class:`OneWorld`.

    Parameters
    ----------
    physics : PhysicsSettings
        Scene, effects, settings and parts.

    Raises
    ------
    SimulationError
        If the parts do not hold every moving body once.
    """

    def __init__(self, physics: PhysicsSettings) -> None:
        self.physics = physics
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
            places = [labels.index(label) for label in part_physics.layout.labels]
            bodies = [names.index(body.name) for body in part_physics.scene.moving]
            indices = np.array(places, dtype=int), np.array(bodies, dtype=int)
            self.parts.append(EnginePart(Simulator(part_physics), *indices))

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
            keys = parameters
            if start.ndim == 4:
                keys = np.hstack([parameters, begin.reshape(len(parameters), -1)])
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


def _of(part: EnginePart, start: Floats, actions: Floats) -> tuple[Floats, Floats]:
    return start[..., part.bodies, :], actions[:, :, part.bodies]


class OneWorld:
    """As :class:`PartedSimulator`, but bodies of different parts meet.

    A body that comes near none of another part, or that one world predicts as its part does, has
    the prediction of the likelihood, to the last bit; others have that of one world.

    Parameters
    ----------
    parted : PartedSimulator
        Engine of the likelihood.
    rounding : float
        Largest difference of one world's prediction from a part's that counts as none, in radii of
        the smallest body, rad and sampling intervals.
    """

    def __init__(self, parted: PartedSimulator, rounding: float = 1e-6) -> None:
        physics, self.parted = parted.physics, parted
        # contacts are not extrapolated, nor is anything else in a transition that has one
        alone = physics.changed(extrapolate=False)
        self._apart = parted if alone is physics else PartedSimulator(alone)
        self._rounding = rounding * body_sizes(physics.scene).min(axis=0)
        self._reach = [body.shape.bounding_radius for body in physics.scene.moving]
        self._whole = Simulator(alone.changed(parts=None))

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
        lost = np.isnan(whole) & np.isnan(apart)
        same = (abs(whole - apart) <= self._rounding) | lost
        differ: Bools = np.asarray((~same).any(axis=(-3, -1)))
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
            least = (1.0 + _SHARE) * (self._reach[i] + self._reach[j])
            near |= come_near(way[..., :-1, :], way[..., 1:, :], least).any(axis=-1)
        return near
