"""Goals of a plan: target poses, tolerances and the contact penalty."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pbrl_ppl.errors import GoalError
from pbrl_ppl.scene import Scene, checks, nearest
from pbrl_ppl.state import POSE, Floats

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

#: A class of what a table of a file declares.
Table = TypeVar("Table", bound="DataclassInstance")


@dataclass(frozen=True)
class Target:
    """Target pose of one body; a coordinate that is None is free.

    Attributes
    ----------
    body : str
        A moving body of the scene.
    x, y, theta : float, optional
        m, m, rad.
    weight : float
        Weight of the body in the L2 distance.
    tolerance : float, optional
        Largest error of the position at the goal (m); by default a fifth of the radius of the
        body's bounding circle.
    angle_tolerance : float
        Largest error of the angle at the goal (rad).
    speed : float, optional
        Largest speed at the goal, that of the rim included (m/s); any speed by default.

    Raises
    ------
    GoalError
        If a number is not finite, a weight or tolerance not positive, or nothing is asked for.
    """

    body: str
    x: float | None = None
    y: float | None = None
    theta: float | None = None
    weight: float = 1.0
    tolerance: float | None = None
    angle_tolerance: float = 0.1
    speed: float | None = None

    def __post_init__(self) -> None:
        with checks.located(kind=GoalError):
            checks.label(self.body, "goal: body")
            for field in fields(self)[1:]:
                check = checks.finite if field.name in POSE else checks.positive
                checks.settle(self, f"goal of {self.body}", **{field.name: check})
        if self.x is None and self.y is None and self.theta is None:
            raise GoalError(f"goal of {self.body}: x, y and theta are all free; give one")


@dataclass(frozen=True)
class Goal:
    """Targets of a plan and its penalty for contact.

    Attributes
    ----------
    targets : tuple of Target
        One or more bodies, each once.
    contact_penalty : float
        Cost of a second in contact, in addition to the second; infinite if nothing may touch.
        Contacts are checked at the ends of the sampling intervals.

    Raises
    ------
    GoalError
        If there is no target, a body has two, or the penalty is negative.

    Examples
    --------
    >>> goal = Goal.of({"cart": (3.0, 1.0, None)})  # any heading
    >>> goal.targets[0].angle_tolerance
    0.1
    """

    targets: tuple[Target, ...]
    contact_penalty: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets", tuple(self.targets))
        if not self.targets:
            raise GoalError("goal: it has no target; say where a body should be")
        names = [target.body for target in self.targets]
        for name in names:
            if names.count(name) > 1:
                raise GoalError(f"goal: {name} has {names.count(name)} targets; keep one")
        if self.contact_penalty != math.inf:
            with checks.located(kind=GoalError):
                checks.settle(self, "goal", contact_penalty=checks.not_negative)

    @classmethod
    def of(cls, targets: Goal | Mapping[str, Sequence[float | None]], **options: float) -> Goal:
        """Return a goal from poses by body name: ``{"cart": (x, y, theta)}``, None where free.

        Parameters
        ----------
        targets : mapping or Goal
            Pose of each body, m and rad; a goal as it is.
        **options
            ``contact_penalty`` of the goal, and options of every target.

        Raises
        ------
        GoalError
            If a pose has not three values, or an option is unknown.
        """
        if isinstance(targets, Goal):
            return targets
        penalty = {k: options.pop(k) for k in ("contact_penalty",) if k in options}
        known = [field.name for field in fields(Target)][4:]
        with checks.located(kind=GoalError):
            checks.keyed(options, "goal", (), known)
        for name, pose in targets.items():
            if len(pose) != 3:
                raise GoalError(f"goal of {name}: got {len(pose)} values, expected x, y, theta")
        read = (
            Target(name, pose[0], pose[1], pose[2], **options) for name, pose in targets.items()
        )
        return cls(tuple(read), **penalty)

    @classmethod
    def load(cls, path: str | Path) -> Goal:
        """Read a TOML file: ``contact_penalty``, and a ``[[target]]`` for each body.

        Raises
        ------
        GoalError
            If it is missing, is not TOML, or has an unknown key.
        """
        targets, options = read_tables(path, "goal", Target, ("contact_penalty",))
        return cls(tuple(targets), **options)

    def check(self, scene: Scene) -> None:
        """Check that the scene has the bodies, and that they can be pushed.

        Raises
        ------
        GoalError
            If one cannot; it names the body.
        """
        check_pushed(scene, (target.body for target in self.targets), "goal")

    def places(self, scene: Scene) -> list[int]:
        """Return the indices of the targets' bodies among the scene's moving bodies."""
        moving = [body.name for body in scene.moving]
        return [moving.index(target.body) for target in self.targets]

    def tolerances(self, scene: Scene, *, share: float = 0.2) -> list[float]:
        """Return the position tolerance of each target (m).

        ``share``: position tolerance by default, as a share of the body's bounding radius.
        """
        return [
            t.tolerance or share * scene.body(t.body).shape.bounding_radius for t in self.targets
        ]

    def errors(self, scene: Scene, states: Floats) -> Floats:
        """Return offsets from the targets, 0 where free, shape (..., target, 3): m, m, rad.

        Parameters
        ----------
        scene : Scene
            Orders the bodies.
        states : ndarray
            Shape (..., body, 6).
        """
        poses = states[..., self.places(scene), :3]
        wanted = np.array(
            [[np.nan if v is None else v for v in (t.x, t.y, t.theta)] for t in self.targets]
        )
        offset = poses - wanted
        offset[..., 2] = np.mod(offset[..., 2] + np.pi, 2 * np.pi) - np.pi
        return np.where(np.isnan(wanted), 0.0, offset)

    def distance(self, scene: Scene, states: Floats) -> Floats:
        """Return the weighted L2 distance from the targets (m), angles at the rims, shape (...)."""
        lever = np.array([scene.body(t.body).shape.bounding_radius for t in self.targets])
        weight = np.array([t.weight for t in self.targets])
        offset = self.errors(scene, states)
        offset[..., 2] *= lever
        return np.asarray(np.sqrt((weight[:, None] * offset**2).sum(axis=(-2, -1))))

    def shortfall(self, scene: Scene, states: Floats) -> Floats:
        """Return the error of the worst target in units of its tolerances; 1 or less is reached."""
        offset = self.errors(scene, states)
        worst = np.zeros(offset.shape[:-2])
        targets = zip(self.targets, self.places(scene), self.tolerances(scene), strict=True)
        for i, (t, place, tolerance) in enumerate(targets):
            far = np.hypot(offset[..., i, 0], offset[..., i, 1]) / tolerance
            worst = np.maximum(worst, np.maximum(far, abs(offset[..., i, 2]) / t.angle_tolerance))
            if t.speed is not None:
                body = states[..., place, :]
                rim = scene.body(t.body).shape.bounding_radius * abs(body[..., 5])
                worst = np.maximum(worst, (np.hypot(body[..., 3], body[..., 4]) + rim) / t.speed)
        return worst


def check_pushed(scene: Scene, names: Iterable[str], where: str, hint: str = "") -> None:
    """Check that the scene has bodies that can be pushed.

    Raises
    ------
    GoalError
        If not; it names the body.
    """
    free = [body.name for body in scene.dynamic]
    for name in names:
        if name not in free:
            raise GoalError(
                f'{where}: the scene has no moving body "{name}" that can be pushed'
                f"{nearest(name, free)}{hint}"
            )


def read_tables(
    path: str | Path, what: str, kind: type[Table], options: Iterable[str]
) -> tuple[list[Table], dict[str, Any]]:
    """Read a TOML file: a Target or Action for each of its tables, and options.

    Raises
    ------
    GoalError
        If it is missing, is not TOML, has another key, or a table names no body.
    """
    key = kind.__name__.lower()
    with checks.located(kind=GoalError):
        text = checks.read_file(path, what)
    with checks.located(f"{what} {path}", GoalError):
        document = checks.document(text)
        checks.keyed(document, "the file", (), (*options, key))
        tables = [checks.fields_of(kind, table, at) for at, table in checks.tables(document, key)]
    document.pop(key, None)
    return [kind(**table) for table in tables], document
