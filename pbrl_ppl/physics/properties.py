"""Translation of phi and effects into the engine's numbers of bodies, joints, discs and laws."""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple, TypeVar

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
from pbrl_ppl.parameters import BODY_PARAMETERS, Layout
from pbrl_ppl.physics.joints import JOINT_COLUMNS, LENGTH, SceneJoints, never_turning
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats, Ints

#: Columns of a body's properties. ``moment`` is about the centre of mass (kg m^2), which is at
#: ``com_x`` and ``com_y`` of the body's frame (m); ``pivot_torque`` (N m) and ``pivot_damping``
#: (N m s) act in the body's hinge (along its slider: N and N s/m), ``turn_torque`` (N m) against
#: any turning of a free one; ``patch_mu`` (1) and ``patch_radius`` (m) describe the friction under
#: it, ``extra_gravity_x`` and ``extra_gravity_y`` (m/s^2) are added to the scene's gravity.
COLUMNS = (
    *BODY_PARAMETERS,
    *("moment", "pivot_torque", "pivot_damping", "turn_torque", "patch_mu", "patch_radius"),
    *("extra_gravity_x", "extra_gravity_y", "com_x", "com_y"),
)
#: Index of each column, by name.
COLUMN: Any = namedtuple("COLUMN", COLUMNS)(*range(len(COLUMNS)))
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
S = TypeVar("S")


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


def staged(effects: tuple[Attached, ...], kind: type[S]) -> list[tuple[Attached, S]]:
    """Return the effects that act at a stage, each with it."""
    stages = ((attached, attached.effect.stage) for attached in at_stage(effects, kind))
    return [(attached, stage) for attached, stage in stages if isinstance(stage, kind)]


def _changed_columns(attached: Attached, stage: Properties) -> frozenset[str]:
    """Return the names of the body's numbers that an effect changes, by a trial evaluation."""
    row = {name: np.zeros((1, 1)) for name in (*COLUMNS, *SEEN)}
    centre = {p.name: np.full((1, 1), p.prior.centre) for p in attached.effect.parameters}
    stage.modify(row, centre, _AFTER)
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
                index = COLUMNS.index(name)
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
        self.tied = tuple(
            (bodies.index(attached.body), len(scene.joints) + j)
            for j, (attached, _) in enumerate(self._tying)
        )
        self.joints = SceneJoints(scene, places)

    def _changed(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Return the bodies for which effects change one of these columns."""
        changed = {
            one.body
            for one, stage in self._modifying
            if _changed_columns(one, stage).intersection(names)
        }
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
        return [
            (self._bodies.index(attached.body), stage, self.values(attached, phi, 2))
            for attached, stage in self._sensors
        ]

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
            name, owner = self._layout.labels[first][:-1].split("[")
            raise ParameterError(
                f"{self._layout.owner_kind(first)} {owner!r}: {name} is not finite; give a finite"
                " number"
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
        commands, forces, frictions = (
            self._law_parameters(phi, stage) for stage in (Command, Force, Friction)
        )
        discs = self._discs(phi)
        return EngineInput(bodies, joints, discs, commands, forces, frictions, indices)

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
            row = {
                key: result[:, :, i, column].copy()
                for column, key in enumerate(COLUMNS)
                if key not in SEEN.values()
            }
            row["moment_per_mass"] = np.full((len(phi), m), self._unit_moment[i])
            for key, value in zip(("gravity_x", "gravity_y"), gravity, strict=True):
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
        columns = [
            column
            for law in at_stage(self._effects, stage)
            for column in (
                *self.values(law, phi).values(),
                *(np.full(len(phi), constant) for constant in law.effect.constants),
            )
        ]
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
            rods[:, j, : LENGTH + 1] = np.stack(np.broadcast_arrays(*ends), axis=-1)
        if not (np.isfinite(rods).all() and (rods[..., LENGTH] >= 0).all()):
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
