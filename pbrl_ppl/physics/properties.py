"""Phi and effects -> the numbers that the engine is given for each body, joint and force law."""

from __future__ import annotations

from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects.base import Attached
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS, JOINT_INDICES, Layout
from pbrl_ppl.scene import WORLD, Scene

Array = NDArray[np.float64]

#: Columns of a body's properties. ``moment`` is about the centroid (kg m^2); ``pivot_torque`` (N m)
#: and ``pivot_damping`` (N m s) act in the body's hinge, ``patch_mu`` (1) and ``patch_radius`` (m)
#: are of the friction under it.
COLUMNS = (
    *BODY_PARAMETERS,
    "moment",
    "pivot_torque",
    "pivot_damping",
    "patch_mu",
    "patch_radius",
)
COLUMN = {name: i for i, name in enumerate(COLUMNS)}
#: Columns of a joint's properties: its anchors and its length (m).
JOINT_COLUMNS = (*JOINT_ANCHORS, "length")
#: A joint shorter than this (m) is a hinge.
_NO_LENGTH = 1e-9
_MAX = np.finfo(float).max
_POSITIVE = ("mass", "moment")
_ANYTHING = ("w_x", "w_y", "w_theta")
#: Least value of each column.
_LEAST = np.array(
    [
        np.nextafter(0, 1) if name in _POSITIVE else -_MAX if name in _ANYTHING else 0.0
        for name in COLUMNS
    ]
)


class EngineInput(NamedTuple):
    """What the engine is given, for each proposal.

    Attributes
    ----------
    bodies : ndarray
        Shape (proposal, body, column), columns as in :data:`COLUMNS`, SI units.
    joints : ndarray
        Shape (proposal, joint, 5), columns as in :data:`JOINT_COLUMNS`, m.
    laws : ndarray
        Parameters of the effects that have a force law, one after the other, shape (proposal, q).
    indices : ndarray
        Which of ``scene.joinable`` an inferred joint holds; shape (proposal, free joint, 2).
    """

    bodies: Array
    joints: Array
    laws: Array
    indices: NDArray[np.int64]


def _is_patch(one: Attached) -> bool:
    """Whether an effect puts friction under its body: it is tried."""
    if one.effect.modify is None:
        return False
    row = {name: np.ones(1) for name in COLUMNS}
    one.effect.modify(row, {p.name: np.array([p.prior.centre]) for p in one.effect.parameters})
    return bool((row["patch_mu"] != 1.0).any())


class EngineProperties:
    """Translates parameter vectors for the engine.

    Parameters
    ----------
    scene : Scene
        Gives the known parameters and the geometry.
    effects : tuple of Attached
        All effects of the model.
    layout : Layout
        Order of phi.
    """

    def __init__(self, scene: Scene, effects: tuple[Attached, ...], layout: Layout) -> None:
        self._scene, self._effects, self._layout = scene, effects, layout
        places = {label: i for i, label in enumerate(layout.labels)}
        bodies = [body.name for body in scene.moving]
        self._known = np.zeros((len(bodies), len(COLUMNS)))
        moved = []  # (place in phi, body, column)
        for i, body in enumerate(scene.moving):
            known = dict(body.known) | (
                {"mass": 1.0} if body.kinematic else {}
            )  # of no consequence
            for name in BODY_PARAMETERS:
                self._known[i, COLUMN[name]] = known.get(name, 0.0)
                place = places.get(f"{name}[{body.name}]")
                if place is not None:
                    moved.append((place, i, COLUMN[name]))
        self._moved = np.array(moved, dtype=int).reshape(-1, 3).T
        self._unit_moment = np.array([body.shape.unit_moment for body in scene.moving])
        self._modified = [
            (bodies.index(one.body), one.effect.modify, self._values(one, places))
            for one in effects
            if one.effect.modify is not None
        ]
        #: Which bodies have friction under them.
        self.patches = tuple(sorted({bodies.index(one.body) for one in effects if _is_patch(one)}))
        self._laws = [
            value
            for one in effects
            if one.effect.force is not None
            for value in self._values(one, places).values()
        ]
        self._bind_joints(scene, places)

    @staticmethod
    def _values(one: Attached, places: dict[str, int]) -> dict[str, tuple[int | None, float]]:
        """Where phi holds each parameter of an effect, and its null value where it does not."""
        return {
            each.name: (places.get(f"{one.effect.variable(each)}[{one.body}]"), each.null)
            for each in one.effect.parameters
        }

    def _bind_joints(self, scene: Scene, places: dict[str, int]) -> None:
        self._anchors = np.zeros((len(scene.joints), 4))
        self._held = np.zeros((len(scene.joints), 2), dtype=int)
        fixed = (body.name for body in scene.bodies if body.static or body.kinematic)
        holders = [*scene.joinable, *fixed]
        poses = {body.name: body.pose for body in scene.bodies} | {WORLD: None}
        self._poses = np.array([poses[name] or (0.0, 0.0, 0.0) for name in holders])
        moved, free = [], []
        for j, (owner, joint) in enumerate(zip(scene.joint_names, scene.joints, strict=True)):
            self._anchors[j] = (*(joint.anchor_a or (0, 0)), *(joint.anchor_b or (0, 0)))
            for column, name in enumerate(JOINT_ANCHORS):
                place = places.get(f"{name}[{owner}]")
                if place is not None:
                    moved.append((place, j, column))
            if joint.bodies is not None:
                self._held[j] = [holders.index(name) for name in joint.bodies]
            else:
                free.append((j, *(places[f"{name}[{owner}]"] for name in JOINT_INDICES)))
        self._moved_anchors = np.array(moved, dtype=int).reshape(-1, 3).T
        self._free = np.array(free, dtype=int).reshape(-1, 3)
        length = self._lengths(self._anchors, self._held)
        #: Which joints have no length, one a joint.
        self.hinges = tuple(
            joint.kind == "hinge" or bool(joint.known and each < _NO_LENGTH)
            for joint, each in zip(scene.joints, length, strict=True)
        )

    def _lengths(self, anchors: Array, held: NDArray[np.int64]) -> Array:
        """Distance of the anchors in the reference poses, shape (...,)."""
        poses = self._poses[held]
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        x, y = anchors[..., 0::2], anchors[..., 1::2]
        at_x = poses[..., 0] + c * x - s * y
        at_y = poses[..., 1] + s * x + c * y
        return np.asarray(np.hypot(at_x[..., 0] - at_x[..., 1], at_y[..., 0] - at_y[..., 1]))

    def __call__(self, phi: Array) -> EngineInput:
        """Translate.

        Parameters
        ----------
        phi : ndarray
            Proposals, shape (proposal, p), in SI units.

        Raises
        ------
        ParameterError
            If a value is not finite, a mass or moment is not positive, a friction is negative or
            an index names nothing; the message names the body or joint.
        """
        if not np.isfinite(phi).all():
            self._refuse_phi(phi)
        n = len(phi)
        bodies = np.repeat(self._known[None], n, axis=0)
        place, body, column = self._moved
        bodies[:, body, column] = phi[:, place]
        bodies[..., COLUMN["moment"]] = bodies[..., COLUMN["mass"]] * self._unit_moment

        def value(place: int | None, null: float) -> Array:
            return np.full(n, null) if place is None else phi[:, place]

        for i, modify, values in self._modified:
            row = {name: bodies[:, i, column] for name, column in COLUMN.items()}
            modify(row, {name: value(*each) for name, each in values.items()})
            bodies[:, i] = np.stack([row[name] for name in COLUMNS], axis=1)
        self._check(bodies)
        laws = [value(*each) for each in self._laws]
        joints, indices = self._joints(phi)
        return EngineInput(
            bodies, joints, np.stack(laws, axis=1) if laws else np.zeros((n, 0)), indices
        )

    def _joints(self, phi: Array) -> tuple[Array, NDArray[np.int64]]:
        """Anchors and lengths, and what the joints of unknown bodies hold."""
        n, count = len(phi), len(self._anchors)
        if not count:
            return np.empty((n, 0, len(JOINT_COLUMNS))), np.empty((n, 0, 2), dtype=np.int64)
        joints = np.empty((n, count, len(JOINT_COLUMNS)))
        joints[..., :4] = self._anchors
        place, joint, column = self._moved_anchors
        joints[:, joint, column] = phi[:, place]
        indices = phi[:, self._free[:, 1:]]
        choices = len(self._scene.joinable)
        wrong = (indices != np.floor(indices)) | (indices < 0) | (indices >= choices)
        if wrong.any():
            raise ParameterError(
                f"joint index is {indices[wrong][0]:g}, expected a whole number from 0 to"
                f" {choices - 1}: {', '.join(self._scene.joinable)}"
            )
        held = np.repeat(self._held[None], n, axis=0)
        held[:, self._free[:, 0]] = indices
        joints[..., 4] = self._lengths(joints[..., :4], held)
        return joints, indices.astype(np.int64)

    def _refuse_phi(self, phi: Array) -> NoReturn:
        """Name the first value that is not finite."""
        place = int(np.argwhere(~np.isfinite(phi))[0, 1])
        label = self._layout.labels[place]
        name, owner = label[:-1].split("[")
        raise ParameterError(
            f"{self._layout.owner_kind(place)} {owner!r}: {name} is not finite; give a finite"
            " number"
        )

    def _check(self, bodies: Array) -> None:
        """Refuse numbers that no body can have."""
        possible = (bodies >= _LEAST) & (bodies < np.inf)
        if possible.all():
            return
        proposal, body, column = np.argwhere(~possible)[0]
        found, name = bodies[proposal, body, column], COLUMNS[column]
        where = f"body {self._scene.moving[body].name!r}: {name}"
        if not np.isfinite(found):
            raise ParameterError(f"{where} is not finite; give a finite number")
        expected = "a positive number" if name in _POSITIVE else "zero or more"
        raise ParameterError(f"{where} is {found:g}, expected {expected}")
