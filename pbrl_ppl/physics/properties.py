"""Translation of phi and effects into the engine's numbers of bodies, joints, discs and laws.

And initial states on the rods that effects add.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pbrl_ppl.effects import (
    Attached,
    Clock,
    Command,
    Force,
    Friction,
    Properties,
    Sensor,
    Structure,
    Values,
    at_stage,
)
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS, JOINT_INDICES, Layout
from pbrl_ppl.physics.world import (
    COLUMN,
    COLUMNS,
    HINGE,
    JOINT,
    JOINT_COLUMNS,
    JOINT_KINDS,
    never_turning,
)
from pbrl_ppl.scene import WORLD, Scene, smallest_radius
from pbrl_ppl.state import Floats, Ints

_POSITIVE = ("mass", "moment")
#: Columns of friction of a ring under a body, of a wheel, and against turning.
_PATCH, _WHEEL, _TURN = ("patch_mu",), ("mu_x", "mu_y"), ("turn_torque",)
_ANY_SIGN = ("w_x", "w_y", "w_theta", "extra_gravity_x", "extra_gravity_y", "com_x", "com_y")
#: Names that effects see in place of a column: moment per mass and the whole gravity.
SEEN = {
    "moment_per_mass": "moment",
    "gravity_x": "extra_gravity_x",
    "gravity_y": "extra_gravity_y",
}
#: The time of what acts after the recording.
_AFTER = Clock(*np.full((3, 1, 1), np.inf))


class EngineInput(NamedTuple):
    """Numbers for the engine, for each proposal.

    Attributes
    ----------
    bodies : ndarray
        Shape (proposal, 1, body, column), columns as in :data:`COLUMNS`, SI units; or (proposal,
        interval, body, column) where they depend on the time.
    joints : ndarray
        Shape (proposal, joint, 9), columns as in :data:`JOINT_COLUMNS`, m.
    discs : ndarray
        x, y and radius of hidden discs, shape (proposal, disc, 3), m.
    commands, forces, frictions : ndarray
        Parameters of the laws of each stage, one after the other, shape (proposal, q).
    indices : ndarray
        Indices into ``scene.joinable`` of an inferred joint's bodies, shape (proposal, free
        joint, 2).
    """

    bodies: Floats
    joints: Floats
    discs: Floats
    commands: Floats
    forces: Floats
    frictions: Floats
    indices: Ints


def staged(effects: tuple[Attached, ...], kind: type) -> list[tuple[Attached, Any]]:
    """Return the effects that act at a stage, each with it."""
    return [(attached, attached.effect.stage) for attached in at_stage(effects, kind)]


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
            known = dict(body.known) | ({"mass": 1.0} if body.kinematic else {})  # not used
            for index, name in enumerate(BODY_PARAMETERS):
                self._known[i, index] = known.get(name, 0.0)
                place = places.get(f"{name}[{body.owner}]")
                if place is not None:
                    moved.append((place, i, index))
        self._moved = np.array(moved, dtype=int).reshape(-1, 3).T
        self._unit_moment = np.array([body.shape.unit_moment for body in scene.moving])
        self._places = places
        self._modifying, self._sensors = staged(effects, Properties), staged(effects, Sensor)
        self._structures = staged(effects, Structure)
        self._bodies = bodies
        #: Which bodies never turn, and all reference angles.
        self.upright = never_turning(scene)
        self.angles = np.array([scene.reference_angle(name) for name in bodies])
        #: Whether a body's numbers depend on time.
        self.timed = any(stage.timed for _, stage in self._modifying)
        self._tying = [(one, stage.rod) for one, stage in self._structures if stage.rod]
        #: Number of discs that the structure stage adds.
        self.n_discs = self._discs(np.zeros((1, layout.size))).shape[1]
        #: Bodies under which effects put a ring of friction, a wheel, and friction against turning.
        self.under = tuple(map(self._changed, (_PATCH, _WHEEL, _TURN)))
        #: Body and row among all joints of each rod that an effect adds.
        tied = enumerate(self._tying, len(scene.joints))
        self.tied = tuple((bodies.index(one.body), row) for row, (one, _) in tied)
        self.joints = SceneJoints(scene, places)

    def _changed(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Return the bodies for which effects change one of these columns, by trial evaluations."""
        changed: set[str] = set()
        for one, stage in self._modifying:
            row = {name: np.zeros((1, 1)) for name in (*COLUMNS, *SEEN)}
            centre = {p.name: np.full((1, 1), p.prior.centre) for p in one.effect.parameters}
            stage.modify(row, centre, _AFTER)
            changed |= {one.body for name in names if row[name].any()}
        return tuple(i for i, name in enumerate(self._bodies) if name in changed)

    def values(self, attached: Attached, phi: Floats, axes: int = 0) -> dict[str, Floats]:
        """Return an effect's parameters by name, shape (proposal, 1, ...) with ``axes`` ones.

        A parameter that is not in phi has its null value.
        """
        result = {}
        for parameter in attached.effect.parameters:
            label = f"{attached.effect.variable(parameter)}[{attached.body}]"
            place = self._places.get(label)
            column = np.full(len(phi), parameter.null) if place is None else phi[:, place]
            result[parameter.name] = column.reshape(-1, *(1,) * axes)
        return result

    def sensors(self, phi: Floats) -> list[tuple[int, Sensor, Values]]:
        """Return body, sensor and its parameters, shape (proposal, 1, 1), in the sensors' order."""
        index = self._bodies.index
        return [(index(one.body), stage, self.values(one, phi, 2)) for one, stage in self._sensors]

    def __call__(self, phi: Floats, clock: Clock | None = None) -> EngineInput:
        """Return the engine's numbers for proposals.

        Parameters
        ----------
        phi : ndarray
            Proposals, shape (proposal, p), in SI units.
        clock : Clock, optional
            Times of the intervals; by default they are after the recording.

        Raises
        ------
        ParameterError
            If a value is not finite, a mass or moment is not positive, a friction is negative or
            an index names nothing; the message names the body or joint.
        """
        if not np.isfinite(phi).all():
            first = int(np.argwhere(~np.isfinite(phi))[0, 1])
            block, owner, _ = self._layout.entries[first]
            raise ParameterError(
                f"{block.of} {owner!r}: {block.name} is not finite; give a finite number"
            )
        bodies = np.repeat(self._known[None], len(phi), axis=0)
        place, body, column = self._moved
        bodies[:, body, column] = phi[:, place]
        bodies = self._modified(bodies, phi, clock)
        self._check(bodies)
        bodies[..., self.upright, COLUMN.moment] = np.inf
        joints, indices = self.joints(phi)
        if self._tying:
            joints = np.concatenate([joints, self._rods(phi)], axis=1)
        laws = (self._law_parameters(phi, stage) for stage in (Command, Force, Friction))
        return EngineInput._make((bodies, joints, self._discs(phi), *laws, indices))

    def _modified(self, bodies: Floats, phi: Floats, clock: Clock | None) -> Floats:
        """Return properties after the properties stage, with the moments of inertia."""
        bodies[..., COLUMN.moment] = bodies[..., COLUMN.mass] * self._unit_moment
        if not self._modifying:
            return bodies[:, None]
        clock = clock if self.timed and clock is not None else _AFTER
        m, gravity = clock.begin.shape[1], self._scene.gravity
        result = np.repeat(bodies[:, None], m, axis=1)
        for name in dict.fromkeys(attached.body for attached, _ in self._modifying):
            i = self._bodies.index(name)
            own = [key for key in COLUMNS if key not in SEEN.values()]
            row = {key: result[:, :, i, COLUMNS.index(key)].copy() for key in own}
            for key, value in zip(SEEN, (self._unit_moment[i], *gravity), strict=True):
                row[key] = np.full((len(phi), m), value)
            for attached, stage in self._modifying:
                if attached.body == name:
                    stage.modify(row, self.values(attached, phi, 1), clock)
            row["moment"] = row["mass"] * row["moment_per_mass"]
            row["extra_gravity_x"] = row["gravity_x"] - gravity[0]
            row["extra_gravity_y"] = row["gravity_y"] - gravity[1]
            for column, key in enumerate(COLUMNS):
                result[:, :, i, column] = row[key]
        return result

    def _law_parameters(self, phi: Floats, stage: type) -> Floats:
        """Return parameters and constants of a stage's laws, one after another, (proposal, q)."""
        columns: list[Floats] = []
        for law in at_stage(self._effects, stage):
            constants = (np.full(len(phi), constant) for constant in law.effect.constants)
            columns += [*self.values(law, phi).values(), *constants]
        return np.stack(columns, axis=1) if columns else np.empty((len(phi), 0))

    def _discs(self, phi: Floats) -> Floats:
        """Return the structure stage's discs, shape (proposal, disc, 3)."""
        rows = [
            np.stack(np.broadcast_arrays(disc.x, disc.y, disc.radius), axis=-1)
            for attached, stage in self._structures
            for disc in stage.discs(self.values(attached, phi))
        ]
        if not rows:
            return np.empty((len(phi), 0, 3))
        discs = np.stack(rows, axis=1)
        if not (np.isfinite(discs).all() and (discs[..., 2] >= 0).all()):
            raise ParameterError(
                "a hidden disc has a place or radius that is not finite, or a radius below 0; give"
                " finite numbers, and 0 for no disc"
            )
        return discs

    def _rods(self, phi: Floats) -> Floats:
        """Return the structure stage's rods, shape (proposal, rod, 9)."""
        rods = np.zeros((len(phi), len(self._tying), len(JOINT_COLUMNS)))
        for j, (attached, rod) in enumerate(self._tying):
            ends = rod(self.values(attached, phi))
            rods[:, j, : JOINT.length + 1] = np.stack(np.broadcast_arrays(*ends), axis=-1)
        if not (np.isfinite(rods).all() and (rods[..., JOINT.length] >= 0).all()):
            raise ParameterError(
                "a rod that an effect adds has an end or a length that is not finite, or a length"
                " below 0; give finite numbers, and 0 for no rod"
            )
        return rods

    def _check(self, bodies: Floats) -> None:
        """Refuse impossible numbers of bodies."""
        least = np.zeros(len(COLUMNS))
        least[[COLUMNS.index(name) for name in _POSITIVE]] = np.nextafter(0, 1)
        least[[COLUMNS.index(name) for name in _ANY_SIGN]] = -np.finfo(float).max
        possible = (bodies >= least) & (bodies < np.inf)
        if possible.all():
            return
        first = tuple(np.argwhere(~possible)[0])
        *_, body, column = first
        value, name = bodies[first], COLUMNS[column]
        where = f"body {self._scene.moving[body].name!r}: {name}"
        if not np.isfinite(value):
            raise ParameterError(f"{where} is not finite; give a finite number")
        expected = "a positive number" if name in _POSITIVE else "zero or more"
        raise ParameterError(f"{where} is {value:g}, expected {expected}")


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
        #: Ends of the sliders' lines from the first body's anchor, zero of other joints; no body
        #: reaches one.
        self._ends = np.zeros((len(scene.joints), 4))
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
            if joint.traits.slides and joint.bodies:
                turn = scene.direction(joint) - scene.reference_angle(joint.bodies[0])
                along = 1e6 * smallest_radius(scene) * np.array([np.cos(turn), np.sin(turn)])
                self._ends[j] = *-along, *along
        self._moved_anchors = np.array(moved, dtype=int).reshape(-1, 3).T
        self._free = np.array(free, dtype=int).reshape(-1, 3)
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
        joints[..., JOINT.low_x :] = self._ends + np.tile(joints[..., : JOINT.b_x], 2)
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
        joints[..., JOINT.length] = self._lengths(joints[..., :4], holders)
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
    exists = rod[:, JOINT.length] > 0
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
