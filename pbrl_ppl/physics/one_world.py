"""Predictions in one world: bodies that were apart in the data may meet there."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics.coupling import SHARE, Parts, come_near
from pbrl_ppl.physics.parts import PartedSimulator
from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.simulator import Simulator
from pbrl_ppl.scene import Scene

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
#: How far one world and a part may be from each other and be the same (SI units).
_ROUNDING = 1e-6


class OneWorld:
    """As :class:`PartedSimulator`, but bodies of different parts meet.

    A body that comes near none of another part, or of which one world says the same as its part,
    is predicted as the likelihood has it, to the last bit; others as one world does.

    Parameters
    ----------
    scene, layout, effects, parts, substeps, threads, extrapolate
        As for :class:`PartedSimulator`.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        effects: tuple[Attached, ...] = (),
        parts: Parts | None = None,
        *,
        substeps: int | None = None,
        threads: int = 1,
        extrapolate: bool = True,
    ) -> None:
        self.parted = PartedSimulator(
            scene, layout, effects, parts, substeps=substeps, threads=threads,
            extrapolate=extrapolate,
        )  # fmt: skip
        # contacts are not extrapolated, nor is anything else in a transition that has one
        self._apart = PartedSimulator(
            scene, layout, effects, parts, substeps=substeps, threads=threads, extrapolate=False
        )
        self._reach = [body.shape.bounding_radius for body in scene.moving]
        self._whole = Simulator(
            scene, layout, effects, substeps=substeps, threads=threads, extrapolate=False
        )

    def __call__(self, phi: Array, start: Array, actions: Array) -> Array:
        """Predict as :class:`Simulator` does: (transition, H, body, 6), or with proposals first."""
        return self.told(phi, start, actions)[0]

    def told(self, phi: Array, start: Array, actions: Array) -> tuple[Array, Bools]:
        """Predict, and say which bodies are of parts that meet, shape (..., transition, body)."""
        states = self.parted(phi, start, actions)
        met = np.zeros((*states.shape[:-3], states.shape[-2]), dtype=bool)
        if len(self.parted.parts) == 1:
            return states, met
        whole, apart = self._whole(phi, start, actions), self._apart(phi, start, actions)
        # in a contact within a part too, for the solver's iterations depend on the others
        differ: Bools = np.asarray((~_same(whole, apart)).any(axis=(-3, -1)))
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

    def _near(self, states: Array, start: Array, bodies_a: Ints, bodies_b: Ints) -> Bools:
        """Whether a body of one part comes near one of another, shape (..., transition)."""
        begin = start[..., :, None, :, :2]
        first = np.broadcast_to(begin, (*states.shape[:-4], *begin.shape[-4:]))
        places = np.concatenate([first, states[..., :2]], axis=-3)
        found = np.zeros(states.shape[:-3], dtype=bool)
        for i, j in product(bodies_a, bodies_b):
            way = places[..., i, :] - places[..., j, :]
            least = (1.0 + SHARE) * (self._reach[i] + self._reach[j])
            found |= come_near(way[..., :-1, :], way[..., 1:, :], least).any(axis=-1)
        return found


def _same(a: Array, b: Array) -> Bools:
    """Whether numbers are the same to rounding, or both are lost."""
    return np.asarray((abs(a - b) <= _ROUNDING) | (np.isnan(a) & np.isnan(b)))
