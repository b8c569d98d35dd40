"""Phi and effects -> the numbers that the engine is given for each body, joint, disc and law."""

from __future__ import annotations

from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import (
    Attached,
    Clock,
    Command,
    Force,
    Properties,
    Sensor,
    Structure,
    Values,
    at_stage,
)
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import BODY_PARAMETERS, Layout
from pbrl_ppl.physics.scene_joints import JOINT_COLUMNS, SceneJoints
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Columns of a body's properties. ``moment`` is about the centre of mass (kg m^2), which is at
#: ``com_x`` and ``com_y`` of the body's frame (m); ``pivot_torque`` (N m) and ``pivot_damping``
#: (N m s) act in the body's hinge, ``patch_mu`` (1) and ``patch_radius`` (m) are of the friction
#: under it, ``extra_gravity_x`` and ``extra_gravity_y`` (m/s^2) come on top of the scene's gravity.
COLUMNS = (
    *BODY_PARAMETERS,
    "moment",
    "pivot_torque",
    "pivot_damping",
    "patch_mu",
    "patch_radius",
    "extra_gravity_x",
    "extra_gravity_y",
    "com_x",
    "com_y",
)
COLUMN = {name: i for i, name in enumerate(COLUMNS)}
_MAX = np.finfo(float).max
_POSITIVE = ("mass", "moment")
#: How strong the friction under a body is: of a ring that carries it, and of a wheel.
_PATCH, _WHEEL = ("patch_mu",), ("mu_x", "mu_y")
_ANYTHING = ("w_x", "w_y", "w_theta", "extra_gravity_x", "extra_gravity_y", "com_x", "com_y")
#: What an effect sees in place of a column: the moment follows from the mass, gravity is the whole.
_GIVEN = {
    "moment_per_mass": "moment",
    "gravity_x": "extra_gravity_x",
    "gravity_y": "extra_gravity_y",
}
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
        Shape (proposal, 1, body, column), columns as in :data:`COLUMNS`, SI units; or (proposal,
        interval, body, column) where they depend on the time.
    joints : ndarray
        Shape (proposal, joint, 5), columns as in :data:`JOINT_COLUMNS`, m.
    discs : ndarray
        x, y and radius of hidden discs, shape (proposal, disc, 3), m.
    commands, forces : ndarray
        Parameters of the command and of the force laws, one after the other, shape (proposal, q).
    indices : ndarray
        Which of ``scene.joinable`` an inferred joint holds; shape (proposal, free joint, 2).
    """

    bodies: Array
    joints: Array
    discs: Array
    commands: Array
    forces: Array
    indices: NDArray[np.int64]


def _sets(attached: Attached) -> frozenset[str]:
    """Names of a body's numbers that an effect changes, by a trial evaluation."""
    stage = attached.effect.stage
    if not isinstance(stage, Properties):
        return frozenset()
    row = {name: np.zeros((1, 1)) for name in (*COLUMNS, *_GIVEN)}
    centre = {p.name: np.full((1, 1), p.prior.centre) for p in attached.effect.parameters}
    never = np.full((1, 1), np.inf)
    stage.modify(row, centre, Clock(never, never, never))
    return frozenset(name for name, value in row.items() if value.any())


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
            for name in BODY_PARAMETERS:
                self._known[i, COLUMN[name]] = known.get(name, 0.0)
                place = places.get(f"{name}[{body.owner}]")
                if place is not None:
                    moved.append((place, i, COLUMN[name]))
        self._moved = np.array(moved, dtype=int).reshape(-1, 3).T
        self._unit_moment = np.array([body.shape.unit_moment for body in scene.moving])
        self._places = places
        stages = (Structure, Properties, Command, Force, Sensor)
        self._acting: dict[type, list[Attached]] = {s: at_stage(effects, s) for s in stages}
        self._bodies = bodies
        #: Whether a body's numbers depend on the time.
        self.timed = any(
            isinstance(attached.effect.stage, Properties) and attached.effect.stage.timed
            for attached in effects
        )
        self._tying = [
            (attached, attached.effect.stage.rod)
            for attached in self._acting[Structure]
            if isinstance(attached.effect.stage, Structure) and attached.effect.stage.rod
        ]
        #: How many discs the structure stage adds.
        self.n_discs = self._discs(np.zeros((1, layout.size))).shape[1]
        #: Bodies that effects put friction under: rings, and wheels.
        self.under = (self._changed(effects, _PATCH), self._changed(effects, _WHEEL))
        #: Bodies that effects tie to a place, and each rod's place after the scene's joints.
        self.tied = tuple(
            (bodies.index(attached.body), len(scene.joints) + j)
            for j, (attached, _) in enumerate(self._tying)
        )
        self.joints = SceneJoints(scene, places)

    def _changed(self, effects: tuple[Attached, ...], names: tuple[str, ...]) -> tuple[int, ...]:
        """Bodies of which effects change one of these numbers."""
        own = {attached.body for attached in effects if _sets(attached).intersection(names)}
        return tuple(i for i, name in enumerate(self._bodies) if name in own)

    def slides(self, bodies: Array) -> NDArray[np.bool_]:
        """Whether there is any of it, shape (proposal,), in numbers (proposal, 1, body, column)."""
        found = np.zeros(len(bodies), dtype=bool)
        for own, names in zip(self.under, (_PATCH, _WHEEL), strict=True):
            columns = [COLUMN[name] for name in names]
            found |= (bodies[:, :, list(own)][..., columns] > 0).any(axis=(1, 2, 3))
        return found

    def values(self, attached: Attached, phi: Array, axes: int = 0) -> dict[str, Array]:
        """An effect's parameters by name, shape (proposal, 1, ...) with so many further axes.

        One that is not in phi has its null value.
        """
        result = {}
        for parameter, label in zip(attached.effect.parameters, attached.labels, strict=True):
            place = self._places.get(label)
            column = np.full(len(phi), parameter.null) if place is None else phi[:, place]
            result[parameter.name] = column.reshape(-1, *(1,) * axes)
        return result

    def sensors(self, phi: Array) -> list[tuple[int, Sensor, Values]]:
        """Body, sensor and its parameters, shape (proposal, 1, 1), in their order."""
        return [
            (
                self._bodies.index(attached.body),
                attached.effect.stage,
                self.values(attached, phi, 2),
            )
            for attached in self._acting[Sensor]
            if isinstance(attached.effect.stage, Sensor)
        ]

    def __call__(self, phi: Array, clock: Clock | None = None) -> EngineInput:
        """Translate.

        Parameters
        ----------
        phi : ndarray
            Proposals, shape (proposal, p), in SI units.
        clock : Clock, optional
            When the intervals are; after the recording without it.

        Raises
        ------
        ParameterError
            If a value is not finite, a mass or moment is not positive, a friction is negative or
            an index names nothing; the message names the body or joint.
        """
        if not np.isfinite(phi).all():
            self._refuse_phi(phi)
        bodies = np.repeat(self._known[None], len(phi), axis=0)
        place, body, column = self._moved
        bodies[:, body, column] = phi[:, place]
        bodies = self._modified(bodies, phi, clock)
        self._check(bodies)
        joints, indices = self.joints(phi)
        if self._tying:
            joints = np.concatenate([joints, self._rods(phi)], axis=1)
        commands, forces = (self._law_parameters(phi, stage) for stage in (Command, Force))
        return EngineInput(bodies, joints, self._discs(phi), commands, forces, indices)

    def _modified(self, bodies: Array, phi: Array, clock: Clock | None) -> Array:
        """The properties stage, and the moments that follow from it."""
        modifying = self._acting[Properties]
        bodies[..., COLUMN["moment"]] = bodies[..., COLUMN["mass"]] * self._unit_moment
        if not modifying:
            return bodies[:, None]
        never = np.full((1, 1), np.inf)
        clock = clock if self.timed and clock is not None else Clock(never, never, never)
        m, gravity = clock.begin.shape[1], self._scene.gravity
        result = np.repeat(bodies[:, None], m, axis=1)
        for name in dict.fromkeys(attached.body for attached in modifying):
            i = self._bodies.index(name)
            row = {key: result[:, :, i, column].copy() for key, column in COLUMN.items()}
            for key in _GIVEN.values():
                del row[key]
            row["moment_per_mass"] = np.full((len(phi), m), self._unit_moment[i])
            for key, own in zip(("gravity_x", "gravity_y"), gravity, strict=True):
                row[key] = np.full((len(phi), m), own)
            for attached in modifying:
                if attached.body == name and isinstance(attached.effect.stage, Properties):
                    attached.effect.stage.modify(row, self.values(attached, phi, 1), clock)
            row["moment"] = row["mass"] * row["moment_per_mass"]
            row["extra_gravity_x"] = row["gravity_x"] - gravity[0]
            row["extra_gravity_y"] = row["gravity_y"] - gravity[1]
            for key, column in COLUMN.items():
                result[:, :, i, column] = row[key]
        return result

    def _law_parameters(self, phi: Array, stage: type) -> Array:
        """Parameters of the laws of a stage, one after the other, shape (proposal, q)."""
        if not self._acting[stage]:
            return np.empty((len(phi), 0))
        columns = [
            column
            for attached in self._acting[stage]
            for column in self.values(attached, phi).values()
        ]
        return np.stack(columns, axis=1)

    def _discs(self, phi: Array) -> Array:
        """The structure stage's discs, shape (proposal, disc, 3)."""
        rows = [
            np.stack(np.broadcast_arrays(disc.x, disc.y, disc.radius), axis=-1)
            for attached in self._acting[Structure]
            if isinstance(attached.effect.stage, Structure)
            for disc in attached.effect.stage.discs(self.values(attached, phi))
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

    def _rods(self, phi: Array) -> Array:
        """The structure stage's rods, shape (proposal, rod, 5)."""
        rods = np.empty((len(phi), len(self._tying), len(JOINT_COLUMNS)))
        for j, (attached, rod) in enumerate(self._tying):
            ends = rod(self.values(attached, phi))
            rods[:, j] = np.stack(np.broadcast_arrays(*ends), axis=-1)
        if not (np.isfinite(rods).all() and (rods[..., 4] >= 0).all()):
            raise ParameterError(
                "a rod that an effect adds has an end or a length that is not finite, or a length"
                " below 0; give finite numbers, and 0 for no rod"
            )
        return rods

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
        where_not = tuple(np.argwhere(~possible)[0])
        *_, body, column = where_not
        found, name = bodies[where_not], COLUMNS[column]
        where = f"body {self._scene.moving[body].name!r}: {name}"
        if not np.isfinite(found):
            raise ParameterError(f"{where} is not finite; give a finite number")
        expected = "a positive number" if name in _POSITIVE else "zero or more"
        raise ParameterError(f"{where} is {found:g}, expected {expected}")
