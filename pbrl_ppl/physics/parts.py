"""A scene whose bodies fall into parts that never touch: one engine a part, each with a memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics.coupling import Parts
from pbrl_ppl.physics.memory import Memory
from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.simulator import Simulator
from pbrl_ppl.scene import Scene


@dataclass(eq=False)
class Part:
    """One part: its engine, and where its parameters and bodies are in the whole."""

    simulator: Simulator
    places: NDArray[np.intp]
    bodies: NDArray[np.intp]
    memory: Memory = field(default_factory=Memory)


class PartedSimulator:
    """As :class:`Simulator`, for parts whose bodies neither touch each other nor share a joint.

    Proposals that agree in a part's parameters are simulated once for it: a derivative, or a
    sampler that moves one part at a time, costs for many bodies what it costs for each alone.
    Bodies of different parts go through each other; predictions are :class:`OneWorld`'s.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    layout : Layout
        Order of the unknown parameters in phi.
    effects : tuple of Attached
        All effects of the model.
    parts : tuple of tuple of str
        Every moving body's name once; see :func:`independent_parts`. None for a scene in one
        part.
    substeps, threads, extrapolate
        As for :class:`Simulator`.

    Raises
    ------
    SimulationError
        If ``parts`` does not hold every moving body once.
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
        names = [body.name for body in scene.moving]
        parts = (tuple(names),) if parts is None else parts
        given = [name for part in parts for name in part]
        if sorted(given) != sorted(names):
            raise SimulationError(
                f"parts hold {', '.join(given)}, expected each moving body once: {', '.join(names)}"
            )
        labels = self._labels = layout.labels
        self.parts = []
        for part in parts:
            own = scene if len(parts) == 1 else scene.subset(part)
            kept = (*part, *own.owners, *own.joint_names)
            chosen = layout if len(parts) == 1 else layout.subset(kept)
            simulator = Simulator(
                own,
                chosen,
                tuple(attached for attached in effects if attached.body in part),
                substeps=substeps,
                threads=threads,
                extrapolate=extrapolate,
            )
            places = np.array([labels.index(label) for label in chosen.labels], dtype=int)
            bodies = np.array([names.index(body.name) for body in own.moving], dtype=int)
            self.parts.append(Part(simulator, places, bodies))

    @property
    def steps(self) -> int:
        """Engine steps an interval, of all parts and all runs that are combined."""
        return int(sum(part.simulator.levels[0].sum() for part in self.parts))

    def __call__(self, phi: Array, start: Array, actions: Array) -> Array:
        """Predict as :class:`Simulator` does: (transition, H, body, 6), or with proposals first."""
        if len(self.parts) == 1:
            return self.parts[0].simulator(phi, start, actions)
        phi = np.asarray(phi, dtype=float)
        proposals = np.atleast_2d(phi)
        out = np.empty((len(proposals), *actions.shape[:-1], 6))
        for part in self.parts:
            own = proposals[:, part.places]
            begin, acted = _of(part, start, actions)
            keys = own if start.ndim == 3 else np.hstack([own, begin.reshape(len(own), -1)])
            _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
            begin = begin if start.ndim == 3 else begin[first]
            states = part.simulator(own[first], begin, acted)
            out[..., part.bodies, :] = states[which.ravel()]
        return out if phi.ndim == 2 else out[0]

    def recall(self, phi: Array, start: Array, actions: Array) -> Array:
        """Predict for one phi, or recall what was said of these very inputs a moment ago."""
        if phi.shape != (len(self._labels),):
            raise SimulationError(
                f"phi has shape {phi.shape}, expected ({len(self._labels)},):"
                f" {', '.join(self._labels)}"
            )
        out = np.empty((*actions.shape[:-1], 6))
        for part in self.parts:
            asked = phi[part.places], *_of(part, start, actions)
            out[..., part.bodies, :] = part.memory.recall(asked, part.simulator)
        return out

    def jacobian(self, phi: Array, start: Array, actions: Array) -> Array:
        """Derivative by phi, shape (transition, H, body, 6, p); see :meth:`Simulator.jacobian`."""
        out = np.zeros((*actions.shape[:-1], 6, len(phi)))
        for part in self.parts:
            own = part.simulator.jacobian(phi[part.places], *_of(part, start, actions))
            out[:, :, part.bodies[:, None, None], np.arange(6)[:, None], part.places] = own
        return out


def _of(part: Part, start: Array, actions: Array) -> tuple[Array, Array]:
    return start[..., part.bodies, :], actions[:, :, part.bodies]
