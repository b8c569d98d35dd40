"""Scenes: the known part of the physics (Gamma): shapes, walls, joints, gravity and the clock.

Everything here is frozen and hashable, in SI units, and checked when it is built, whether it comes
from a TOML file, whose every key is checked, or from Python.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.bodies import Body, Shape, Wall, check_classes
from pbrl_ppl.scene.checks import Named, Point
from pbrl_ppl.scene.joints import WORLD, Actuator, Joint, check_actuators
from pbrl_ppl.scene.recording import Recording
from pbrl_ppl.state import STATE

#: Fields of a scene that are arrays of tables, with the key and the class of each.
_PARTS: Mapping[str, tuple[str, type]] = {
    "bodies": ("body", Body),
    "walls": ("wall", Wall),
    "joints": ("joint", Joint),
    "actuators": ("actuator", Actuator),
}
#: Values that are written of a body though they are empty.
_EMPTY: Mapping[str, object] = {"known": {}, "prior": {}, "effects": ()}


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that is known before a measurement (Gamma, and what Phi is to contain).

    Attributes
    ----------
    gravity : tuple of float
        Acceleration in the plane (m/s^2).
    normal_gravity : float
        Acceleration that presses bodies on the floor (m/s^2); 0 in a side view.
    time_step : float
        Time between samples (s).
    substeps : int
        Engine steps a sample.
    bodies : tuple of Body
        At least one of them dynamic: neither static nor kinematic.
    walls : tuple of Wall
        Immovable segments.
    joints : tuple of Joint
        Hinges, sliders and distance joints.
    actuators : tuple of Actuator
        What the commands of bodies mean; those of a body without any are wrenches in the world's
        frame.
    noise : tuple of (str, float)
        Standard deviation of measuring a state dimension where it is known (m, rad, m/s, rad/s),
        for the likelihood of whole trajectories, which infers the others; a dict will do.
    test_is_later : bool
        Whether a test recording was made after the training recording, so that what lasts from some
        trajectory on, such as a payload, holds in it.
    recording : Recording, optional
        How files of recordings are laid out; by default as a history's.

    Raises
    ------
    SceneError
        If the parts do not fit together.

    Examples
    --------
    >>> from pbrl_ppl.scene import Shape
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))
    >>> Scene.from_toml(scene.to_toml()) == scene
    True
    """

    time_step: float
    bodies: tuple[Body, ...]
    gravity: Point = (0.0, 0.0)
    normal_gravity: float = 0.0
    substeps: int = 10
    walls: tuple[Wall, ...] = ()
    joints: tuple[Joint, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    noise: Named = ()
    test_is_later: bool = True
    recording: Recording | None = None

    def __post_init__(self) -> None:
        checks.settle(self, "[world]", gravity=checks.vector, normal_gravity=checks.not_negative)
        checks.settle(self, "[world]", time_step=checks.positive, substeps=check_substeps)
        checks.settle(self, "[world]", test_is_later=checks.flag)
        for key, (_, kind) in _PARTS.items():
            parts = checks.each(checks.instance(kind, f"a {kind.__name__}"))
            checks.settle(self, "scene", **{key: parts})
        noise = checks.table(self.noise, "[noise]", dict.fromkeys(STATE, checks.positive))
        object.__setattr__(self, "noise", noise)
        checks.settle(self, "scene", recording=checks.instance(Recording, "a Recording"))
        self._check_bodies()
        self._check_joints()
        check_actuators(self.actuators, [body.name for body in self.dynamic])

    def _check_bodies(self) -> None:
        checks.different([body.name for body in self.bodies], "bodies")
        if not self.dynamic:
            raise SceneError(
                "scene: it has no body that moves freely; add a [[body]] that is neither static nor"
                " kinematic"
            )
        for body in self.bodies:
            if body.wheel and self.normal_gravity <= 0:
                raise SceneError(
                    f'body "{body.name}": wheel = true but nothing presses it on the floor; set '
                    "normal_gravity (9.81 in a top view) in [world], or wheel = false"
                )
        check_classes(self.bodies)

    def _check_joints(self) -> None:
        names = [WORLD, *(body.name for body in self.bodies)]
        checks.different(self.joint_names, "joints")
        for position, joint in enumerate(self.joints, start=1):
            where = f"[[joint]] number {position}"
            for name in joint.bodies or ():
                checks.known(name, names, f"{where}: there is no body")
            for index, probabilities in joint.prior:
                for name, _ in probabilities:
                    said = f"{where}: prior {index} names what is no moving body or the world,"
                    checks.known(name, self.joinable, said)
            could = joint.bodies or names
            if not any(body.name in could for body in self.dynamic):
                raise SceneError(
                    f"{where}: neither {could[0]} nor {could[1]} can move freely; join a body that"
                    " is neither static nor kinematic"
                )
            for body in self.bodies:
                needs_pose = not joint.known and joint.traits.needs_reference_poses
                if needs_pose and body.name in could and body.pose is None:
                    raise SceneError(
                        f'{where}: its anchors are to be inferred and body "{body.name}" has no'
                        f" pose; a {joint.kind} joint keeps the distance that its anchors have in"
                        " the reference pose: add pose = [x, y, theta] to the body"
                    )

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene from a TOML file.

        Raises
        ------
        SceneError
            If the file is missing, is not TOML (says the line), or describes an impossible scene.
        """
        text = checks.read_file(path, "scene")
        with checks.located(f"scene {path}"):
            return cls.from_toml(text)

    @classmethod
    def from_toml(cls, text: str) -> Scene:
        """Build a scene from TOML text.

        Raises
        ------
        SceneError
            As `load`; an unknown key is named with its table and the nearest known key.
        """
        document = checks.document(text)
        arrays = [key for key, _ in _PARTS.values()]
        checks.keyed(document, "the file", ["world"], ["noise", "recording", *arrays])
        optional = ["gravity", "normal_gravity", "substeps", "test_is_later", "joints"]
        world = checks.keyed(document["world"], "[world]", ["time_step"], optional)
        if (joints := world.pop("joints", None)) not in ("any", None):
            raise SceneError(
                f'[world]: joints is {joints!r}, expected "any" (any two bodies, or a body and the'
                " world, may be joined by a rod); declare those that are there as [[joint]]"
            )
        world["noise"] = checks.keyed(document.get("noise", {}), "[noise]", [], STATE)
        if "recording" in document:
            entries = checks.fields_of(Recording, document["recording"], "[recording]")
            world["recording"] = Recording(**entries)
        for field, (key, kind) in _PARTS.items():
            world[field] = tuple(_part(kind, *place) for place in checks.tables(document, key))
        scene = cls(**world)
        return scene.with_any_joints() if joints else scene

    def to_toml(self) -> str:
        """Return TOML text from which `from_toml` builds an equal scene."""
        return toml_of(self._sections())

    def _sections(self) -> Iterator[tuple[str, Mapping[str, object]]]:
        """Yield the header and the table of each section of its file."""
        always = ("gravity", "normal_gravity", "time_step", "substeps")
        world = {key: getattr(self, key) for key in always}
        yield "[world]", world if self.test_is_later else {**world, "test_is_later": False}
        if self.noise:
            yield "[noise]", dict(self.noise)
        if self.recording is not None:
            yield "[recording]", self.recording.table()
        for field, (key, kind) in _PARTS.items():
            empty = _EMPTY if kind is Body else {}
            for part in getattr(self, field):
                table = {
                    name: empty.get(name) if value in ((), "") else value
                    for name, value in vars(part).items()
                }
                for name in filter(table.__contains__, checks.RENAMED):
                    table[checks.RENAMED[name]] = table.pop(name)
                yield f"[[{key}]]", table

    @property
    def moving(self) -> tuple[Body, ...]:
        """The bodies that are not static, in order: those of a history and of arrays of states."""
        return tuple(body for body in self.bodies if not body.static)

    @property
    def dynamic(self) -> tuple[Body, ...]:
        """The moving bodies that forces move: those that are not kinematic, in order."""
        return tuple(body for body in self.moving if not body.kinematic)

    @property
    def owners(self) -> dict[str, tuple[str, ...]]:
        """Names of the moving bodies by the owner of their parameters: `Body.owner`."""
        names: dict[str, tuple[str, ...]] = {}
        for body in self.moving:
            names[body.owner] = (*names.get(body.owner, ()), body.name)
        return names

    @property
    def joinable(self) -> tuple[str, ...]:
        """Names for the indices ``i_a``, ``i_b`` of an inferred joint: dynamic bodies, world."""
        return (*(body.name for body in self.dynamic), WORLD)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """One name a joint: as given, or ``joint1``, ``joint2``, ... by its place in the file."""
        return tuple(
            joint.name or f"joint{number}" for number, joint in enumerate(self.joints, start=1)
        )

    @property
    def extent(self) -> tuple[float, float, float, float] | None:
        """Extent of walls and reference poses: ``x_min, x_max, y_min, y_max`` (m), if any."""
        points = [end for wall in self.walls for end in (wall.start, wall.end)]
        for body in self.bodies:
            if body.pose is not None:
                x_min, x_max, y_min, y_max = body.shape.bounds
                reach = max(-x_min, x_max, -y_min, y_max)
                x, y = body.pose[:2]
                points += [(x - reach, y - reach), (x + reach, y + reach)]
        if not points:
            return None
        x, y = np.array(points).T
        return float(x.min()), float(x.max()), float(y.min()), float(y.max())

    def actuators_of(self, body: str) -> tuple[Actuator, ...]:
        """Return the actuators of a body, in order: those of its columns of commands."""
        return tuple(one for one in self.actuators if one.body == body)

    def body(self, name: str) -> Body:
        """Return the body of this name.

        Raises
        ------
        SceneError
            If there is none; the nearest name is given.
        """
        names = [body.name for body in self.bodies]
        checks.known(name, names, "scene: there is no body")
        return self.bodies[names.index(name)]

    def reference_angle(self, name: str) -> float:
        """Return the angle in a body's reference pose (rad): 0 without one, and of the world."""
        pose = None if name == WORLD else self.body(name).pose
        return pose[2] if pose else 0.0

    def direction(self, slider: Joint) -> float:
        """Return the direction of a slider's axis where its bodies are in their poses (rad)."""
        (x, y), (_, second) = slider.axis or (0.0, 0.0), slider.bodies or ("", WORLD)
        return self.reference_angle(second) + math.atan2(y, x)

    def replace(self, **changes: Any) -> Scene:
        """Return a scene with these attributes changed, checked again."""
        return dataclasses.replace(self, **changes)

    def subset(self, names: Iterable[str]) -> Scene:
        """Return the scene without its other moving bodies, and without the joints that hold those.

        Raises
        ------
        SceneError
            If a name is no moving body's.
        """
        kept = {self.body(name).name for name in names}
        bodies = tuple(body for body in self.bodies if body.static or body.name in kept)
        there = {WORLD, *(body.name for body in bodies)}
        joints = tuple(
            dataclasses.replace(joint, name=name)
            for name, joint in zip(self.joint_names, self.joints, strict=True)
            if joint.bodies is None or set(joint.bodies) <= there
        )
        actuators = tuple(one for one in self.actuators if one.body in kept)
        return self.replace(bodies=bodies, joints=joints, actuators=actuators)

    def with_any_joints(self) -> Scene:
        """Return a scene in which any two bodies, or a body and the world, may be joined by a rod.

        That is Eq. 8's ``{J_d}^k``: as many distance joints of unknown bodies as there are dynamic
        bodies, each of which may join nothing. In a file, ``joints = "any"`` in ``[world]``.

        Raises
        ------
        SceneError
            If a body has no pose: a rod keeps the length that it has in the reference poses.

        Examples
        --------
        >>> from pbrl_ppl.scene import Shape
        >>> disc = Shape.circle(0.1)
        >>> pucks = Body("a", disc, pose=(0, 0, 0)), Body("b", disc, pose=(1, 0, 0))
        >>> Scene(time_step=0.1, bodies=pucks).with_any_joints().joint_names
        ('joint1', 'joint2')
        """
        rods = (Joint("distance", known=False),) * len(self.dynamic)
        return self.replace(joints=(*self.joints, *rods))

    def with_effects(self, body_name: str, *names: str) -> Scene:
        """Return a scene in which this body has these effects declared as well.

        Raises
        ------
        SceneError
            If there is no such body.
        """
        body = self.body(body_name)
        effects = tuple(dict.fromkeys((*body.effects, *names)))
        changed = dataclasses.replace(body, effects=effects)
        return self.replace(bodies=tuple(changed if b is body else b for b in self.bodies))


def check_substeps(value: Any, where: str = "substeps", *, most: int = 1280) -> int:
    """Return a number of engine steps a sample.

    ``most``: twice what `close_loop` goes to where data are that exact.

    Raises
    ------
    SceneError
        If it is no whole number from 1 to the most that change a prediction.
    """
    number = checks.whole(value, where)
    if number > most:
        raise SceneError(
            f"{where} is {value}, expected at most {most}: more change no"
            " prediction and take long; use fewer, or record with a shorter time_step"
        )
    return number


def toml_of(sections: Iterable[tuple[str, Mapping[str, object]]]) -> str:
    """Return TOML text of tables with these headers; entries that are None are left out."""
    parts = []
    for header, table in sections:
        lines = [f"{key} = {_value(item)}" for key, item in table.items() if item is not None]
        parts.append("\n".join([header, *lines, ""]))
    return "\n".join(parts)


def _part(kind: type[Any], where: str, table: object) -> Any:
    """Return a body, wall, joint or actuator from its table."""
    entries = checks.fields_of(kind, table, where)
    shape = checks.fields_of(Shape, entries["shape"], f"shape of {where}") if kind is Body else None
    with checks.located(where):
        if shape is not None:
            entries["shape"] = Shape(**shape)
        return kind(**entries)


def _value(item: object) -> str:
    """Return one TOML value: a string, boolean, number, list or inline table."""
    if isinstance(item, str):
        # TOML's basic strings take JSON's escapes, except that DEL must be escaped in TOML.
        return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(item, Shape):
        item = vars(item)
    if isinstance(item, tuple) and item and all(map(_is_entry, item)):
        item = dict(item)
    if isinstance(item, Mapping):
        pairs = [
            f"{_key(key)} = {_value(value)}" for key, value in item.items() if value is not None
        ]
        return "{ " + ", ".join(pairs) + " }" if pairs else "{}"
    if isinstance(item, tuple | list):
        return "[" + ", ".join(_value(part) for part in item) + "]"
    return repr(item).lower()  # a number, true or false


def _is_entry(item: object) -> bool:
    """Return whether this is an entry of a table: a name and a value."""
    return isinstance(item, tuple) and len(item) == 2 and isinstance(item[0], str)


def _key(name: str) -> str:
    """Return a key, in quotes where it needs them: a body's name may be anything."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _value(name)
