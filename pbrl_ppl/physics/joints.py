"""Joints in the engine: a table of their kinds, their numbers from phi, and states on rods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pymunk

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import JOINT_ANCHORS, JOINT_INDICES
from pbrl_ppl.scene import WORLD, Scene, smallest_radius
from pbrl_ppl.state import Bools, Floats, Ints

#: Columns of a joint's numbers: its anchors and its length; of a slider, the ends of its line in
#: the first body's frame (m).
JOINT_COLUMNS = (*JOINT_ANCHORS, "length", "low_x", "low_y", "high_x", "high_y")
A_X, A_Y, B_X, B_Y, LENGTH, LOW_X, LOW_Y, HIGH_X, HIGH_Y = range(len(JOINT_COLUMNS))


class Setting(NamedTuple):
    """A property of a pymunk constraint, the C function that sets it, and the columns it takes.

    The columns are those of a joint's numbers, or of a body's for a constraint of a body. With
    ``weighted`` the number is multiplied by the body's weight.
    """

    attribute: str
    function: str
    columns: tuple[int, ...]
    weighted: bool = False


@dataclass(frozen=True)
class EngineJoint:
    """What a kind of joint is in the engine.

    A new kind is one more entry of :data:`JOINT_KINDS`, and a kind of link in `tree_of`.

    Attributes
    ----------
    constraint : callable
        Makes the pymunk constraint of two bodies, with both anchors at their origins.
    settings : tuple of Setting
        Properties of the constraint, in the order in which they are set.
    gap : callable
        Distance of the anchors from that in the reference poses (m).
    friction : str
        The body's constraints by which friction and damping act in it: see `world`. None without.
    """

    constraint: Callable[[pymunk.Body, pymunk.Body], pymunk.Constraint]
    settings: tuple[Setting, ...]
    gap: Callable[[float], float]
    friction: str = ""


HINGE = EngineJoint(
    constraint=lambda a, b: pymunk.PivotJoint(a, b, (0, 0), (0, 0)),
    settings=(
        Setting("anchor_a", "cpPivotJointSetAnchorA", (A_X, A_Y)),
        Setting("anchor_b", "cpPivotJointSetAnchorB", (B_X, B_Y)),
    ),
    gap=lambda distance: 0.0,
    friction="pivot",
)
ROD = EngineJoint(
    constraint=lambda a, b: pymunk.PinJoint(a, b, (0, 0), (0, 0)),
    settings=(
        Setting("anchor_a", "cpPinJointSetAnchorA", (A_X, A_Y)),
        Setting("anchor_b", "cpPinJointSetAnchorB", (B_X, B_Y)),
        Setting("distance", "cpPinJointSetDist", (LENGTH,)),
    ),
    gap=lambda distance: distance,
)
#: Right for bodies that never turn alone: see `never_turning`.
SLIDER = EngineJoint(
    constraint=lambda a, b: pymunk.GrooveJoint(a, b, (-1, 0), (1, 0), (0, 0)),
    settings=(
        Setting("groove_a", "cpGrooveJointSetGrooveA", (LOW_X, LOW_Y)),
        Setting("groove_b", "cpGrooveJointSetGrooveB", (HIGH_X, HIGH_Y)),
        Setting("anchor_b", "cpGrooveJointSetAnchorB", (B_X, B_Y)),
    ),
    gap=lambda distance: 0.0,
    friction="rail",
)
#: Every kind that a scene can declare.
JOINT_KINDS = {"hinge": HINGE, "slider": SLIDER, "distance": ROD}


def never_turning(scene: Scene) -> Bools:
    """Return the moving bodies that sliders alone tie to what is fixed, shape (body,).

    They keep their reference angles: their moments of inertia do not matter.
    """
    reached = {WORLD, *(body.name for body in scene.bodies if body.static)}
    pairs = [set(joint.bodies or ()) for joint in scene.joints if joint.traits.slides]
    for _ in pairs:
        for pair in pairs:
            reached |= pair if pair & reached else set()
    return np.array([body.name in reached and not body.kinematic for body in scene.moving])


class SceneJoints:
    """Translates parameter vectors into the numbers of the joints that a scene declares.

    Parameters
    ----------
    scene : Scene
        Its joints, and the poses that their lengths follow from.
    places : dict of str to int
        Place of each label in phi.
    """

    def __init__(self, scene: Scene, places: dict[str, int]) -> None:
        self._scene = scene
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
        #: Ends of the sliders' lines from the first body's anchor, zero of other joints; no body
        #: reaches one.
        half = 1e6 * smallest_radius(scene)
        self._ends = np.zeros((len(scene.joints), 4))
        for j, joint in enumerate(scene.joints):
            if joint.traits.slides and joint.bodies:
                turn = scene.direction(joint) - scene.reference_angle(joint.bodies[0])
                along = half * np.array([np.cos(turn), np.sin(turn)])
                self._ends[j] = *-along, *along
        lengths = self._lengths(self._anchors, self._held)
        #: Kind of each joint in the engine.
        self.kinds = tuple(
            HINGE
            if joint.kind == "distance" and joint.known and length < 1e-9 * smallest_radius(scene)
            else JOINT_KINDS[joint.kind]
            for joint, length in zip(scene.joints, lengths, strict=True)
        )

    def _lengths(self, anchors: Floats, holders: Ints) -> Floats:
        """Return the distances of anchors (..., 4) in the reference poses, shape (...,)."""
        poses = self._poses[holders]
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        x, y = anchors[..., 0::2], anchors[..., 1::2]
        at_x = poses[..., 0] + c * x - s * y
        at_y = poses[..., 1] + s * x + c * y
        return np.asarray(np.hypot(at_x[..., 0] - at_x[..., 1], at_y[..., 0] - at_y[..., 1]))

    def __call__(self, phi: Floats) -> tuple[Floats, Ints]:
        """Return anchors and lengths, and the bodies that joints of unknown bodies hold.

        Parameters
        ----------
        phi : ndarray
            Proposals, shape (proposal, p), SI units.

        Returns
        -------
        joints : ndarray
            Shape (proposal, joint, 9), columns as in :data:`JOINT_COLUMNS`, m.
        indices : ndarray
            Indices into ``scene.joinable`` of an inferred joint's bodies, shape (proposal, free
            joint, 2).

        Raises
        ------
        ParameterError
            If an index names nothing.
        """
        n, count = len(phi), len(self._anchors)
        joints = np.empty((n, count, len(JOINT_COLUMNS)))
        if not count:
            return joints, np.empty((n, 0, 2), dtype=np.int64)
        joints[..., :4] = self._anchors
        place, joint, column = self._moved_anchors
        joints[:, joint, column] = phi[:, place]
        joints[..., LOW_X:] = self._ends + np.tile(joints[..., :B_X], 2)
        indices = phi[:, self._free[:, 1:]]
        choices = len(self._scene.joinable)
        wrong = (indices != np.floor(indices)) | (indices < 0) | (indices >= choices)
        if wrong.any():
            raise ParameterError(
                f"joint index is {indices[wrong][0]:g}, expected a whole number from 0 to"
                f" {choices - 1}: {', '.join(self._scene.joinable)}"
            )
        holders = np.repeat(self._held[None], n, axis=0)
        holders[:, self._free[:, 0]] = indices
        joints[..., LENGTH] = self._lengths(joints[..., :4], holders)
        return joints, indices.astype(np.int64)


def on_rod(states: Floats, rod: Floats, unit_moment: float) -> Floats:
    """Return initial states that satisfy the rod of an effect, with the least correction.

    Measured states violate the rod by the noise. The engine would correct the whole drift in one
    substep: the shorter the substep, the faster the body. The velocity along the rod is removed.

    Parameters
    ----------
    states : ndarray
        States of one body, shape (proposal, transition, 6).
    rod : ndarray
        Ends on the body and in the world, and length, shape (proposal, 5), m. A length of 0 is no
        rod.
    unit_moment : float
        The body's moment of inertia for each unit of mass (m^2).

    Returns
    -------
    ndarray
        Same shape as ``states``.

    Examples
    --------
    >>> on_rod(np.array([[[1.1, 0.0, 0.0, 0.3, 1.0, 0.0]]]), np.array([[0, 0, 0, 0, 1.0]]), 0.1)
    array([[[1., 0., 0., 0., 1., 0.]]])
    """
    exists = rod[:, LENGTH] > 0
    if not exists.any():
        return states
    moved, (a_x, a_y, b_x, b_y, length) = states[exists], rod[exists].T[..., None]

    def geometry() -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Return length, direction (x, y), lever arm, and the inverse mass along the rod."""
        c, s = np.cos(moved[..., 2]), np.sin(moved[..., 2])
        arm_x, arm_y = c * a_x - s * a_y, s * a_x + c * a_y
        x, y = moved[..., 0] + arm_x - b_x, moved[..., 1] + arm_y - b_y
        distance = np.maximum(np.hypot(x, y), np.finfo(float).tiny)
        n_x, n_y = x / distance, y / distance
        lever = arm_x * n_y - arm_y * n_x
        return distance, n_x, n_y, lever, 1.0 + lever**2 / unit_moment

    def push(impulse: Floats, first: int, n_x: Floats, n_y: Floats, lever: Floats) -> None:
        """Apply an impulse per unit of mass along the rod to poses (0) or velocities (3)."""
        moved[..., first] += impulse * n_x
        moved[..., first + 1] += impulse * n_y
        moved[..., first + 2] += impulse * lever / unit_moment

    for _ in range(3):  # Newton steps: each squares the remaining relative error
        distance, n_x, n_y, lever, inverse_mass = geometry()
        push((length - distance) / inverse_mass, 0, n_x, n_y, lever)
    _, n_x, n_y, lever, inverse_mass = geometry()
    speed = moved[..., 3] * n_x + moved[..., 4] * n_y + moved[..., 5] * lever
    push(-speed / inverse_mass, 3, n_x, n_y, lever)
    result = states.copy()
    result[exists] = moved
    return result
