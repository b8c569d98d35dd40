"""Parts of a scene: bodies, walls and joints, frozen and checked when they are built."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.checks import (
    CONTACT_NAMES,
    Point,
    flag,
    hyper_parameters,
    index_probabilities,
    known_parameters,
    label,
    names,
    nearest,
    vector,
)
from pbrl_ppl.scene.shape import Shape

WORLD = "world"
"""The name of the ground in a joint."""


@dataclass(frozen=True)
class Body:
    """A rigid body: what is known of it, and what is to be inferred.

    Attributes
    ----------
    name : str
        Name, as in the history's ``body`` column.
    shape : Shape
        Outline (m).
    wheel : bool
        Whether an anisotropic-friction wheel is part of its prior.
    static : bool
        Whether it never moves; it then needs a `pose`.
    kinematic : bool
        Whether it follows its recorded path whatever it meets, as a robot's finger does; of its
        parameters only ``r`` and ``mu_c`` matter then.
    known : tuple of (str, float)
        Parameters that are given, not inferred; a mapping is accepted.
    prior : tuple of (str, tuple of (str, float))
        Hyper-parameters (``mu``, ``sigma``, ``kappa``) that replace the defaults, of Table 1's
        parameters and of declared effects' (``linear_drag_coefficient``); a mapping of mappings is
        accepted.
    effects : tuple of str
        Effects of the catalogue that are declared from the start.
    pose : tuple of float, optional
        ``x, y, theta`` (m, m, rad) of a static body; of another, its reference pose.
    object_class : str, optional
        Class of the OO-MDP, such as ``chair``; TOML key ``class``. Bodies of one class with equal
        attributes have one set of Table 1's parameters, under the name `owner`.
    attributes : tuple of str
        Attributes of the OO-MDP, such as ``wheels_locked``.

    Raises
    ------
    SceneError
        If a name, number or combination is impossible.

    Examples
    --------
    >>> Body("cart", Shape.box(1.0, 0.6), known={"mass": 2.0}).known
    (('mass', 2.0),)
    >>> Body("seat 3", Shape.circle(0.3), object_class="chair", attributes=("locked",)).owner
    'chair (locked)'
    """

    name: str
    shape: Shape
    wheel: bool = False
    static: bool = False
    kinematic: bool = False
    known: tuple[tuple[str, float], ...] = ()
    prior: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = ()
    effects: tuple[str, ...] = ()
    pose: tuple[float, float, float] | None = None
    object_class: str | None = None
    attributes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        label(self.name, "body: name")
        where = f'body "{self.name}"'
        if self.name == WORLD:
            raise SceneError(f'{where}: "world" is the name of the ground; call the body otherwise')
        if not isinstance(self.shape, Shape):
            raise SceneError(f"{where}: shape is {self.shape!r}, expected a Shape")
        flag(self.wheel, f"{where}: wheel")
        flag(self.static, f"{where}: static")
        object.__setattr__(self, "known", known_parameters(self.known, where))
        for key in ("effects", "attributes"):
            object.__setattr__(self, key, names(getattr(self, key), f"{where}: {key}"))
        object.__setattr__(self, "prior", hyper_parameters(self.prior, where, self.effects))
        if self.object_class is not None:
            label(self.object_class, f"{where}: class")
        for name in dict(self.known).keys() & dict(self.prior).keys():
            raise SceneError(f"{where}: {name} is in both known and prior; drop one of them")
        if self.pose is not None:
            object.__setattr__(self, "pose", vector(self.pose, 3, f"{where}: pose"))
        if self.static and self.pose is None:
            raise SceneError(f"{where}: it is static and has no pose; add pose = [x, y, theta]")
        if self.static and self.wheel:
            raise SceneError(f"{where}: a static body cannot have a wheel; drop one of the two")
        flag(self.kinematic, f"{where}: kinematic")
        if self.kinematic:
            self._check_kinematic(where)

    @property
    def owner(self) -> str:
        """What owns its parameters of Table 1: its class with its attributes, or itself."""
        if self.object_class is None:
            return self.name
        listed = ", ".join(sorted(self.attributes))
        return f"{self.object_class} ({listed})" if listed else self.object_class

    def _check_kinematic(self, where: str) -> None:
        """Raise `SceneError` where a kinematic body is given what only dynamic bodies have."""
        for name in ("static", "wheel", "effects"):
            if getattr(self, name):
                raise SceneError(
                    f"{where}: it is kinematic, it goes where its path leads, and has {name} ="
                    f" {getattr(self, name)!r}; drop one of the two"
                )
        for table in ("known", "prior"):
            for name, _ in getattr(self, table):
                if name not in CONTACT_NAMES:
                    raise SceneError(
                        f"{where}: it is kinematic and {table} has {name}, which does not matter"
                        f" then; expected {' or '.join(CONTACT_NAMES)}; drop it"
                    )


@dataclass(frozen=True)
class Wall:
    """An immovable segment between two points of the world (m); TOML keys ``from`` and ``to``."""

    start: Point
    end: Point

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", vector(self.start, 2, "wall: from"))
        object.__setattr__(self, "end", vector(self.end, 2, "wall: to"))
        if self.start == self.end:
            raise SceneError(f"wall: from and to are both {list(self.start)}; its length is zero")


@dataclass(frozen=True)
class Joint:
    """J_d: a joint between two bodies, or a body and the world; what is left out is inferred.

    Attributes
    ----------
    kind : str
        ``"distance"``, which keeps the distance that the anchors have in the bodies' reference
        poses (zero is a hinge), or ``"hinge"``.
    bodies : tuple of str, optional
        Two names; ``"world"`` is the ground. None where which bodies it joins (the indices ``i_a``
        and ``i_b`` of Table 1) is to be inferred.
    anchor_a, anchor_b : tuple of float, optional
        Where it holds the first and the second, each in that body's frame (m). Of a joint that is
        not known these are the centres of the anchors' priors, or None for the default.
    known : bool
        Whether the anchors are given (True) or to be inferred.
    name : str, optional
        What its parameters are labelled with; by default its place in the scene: ``joint1``, ...
    prior : tuple of (str, tuple of (str, float))
        Of a joint of unknown bodies: probabilities of the indices by name, such as
        ``{"i_a": {"cart": 0.7, "world": 0.3}}``, scaled to add up to one; a mapping of mappings is
        accepted. Names left out have none; all are equally probable for an index left out.

    Raises
    ------
    SceneError
        If a kind, name or number is impossible, or a known joint lacks one.

    Examples
    --------
    >>> Joint("hinge", known=False).bodies is None  # which bodies, and where, is to be inferred
    True
    """

    kind: str
    bodies: tuple[str, str] | None = None
    anchor_a: Point | None = None
    anchor_b: Point | None = None
    known: bool = True
    name: str | None = None
    prior: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = ()

    def __post_init__(self) -> None:
        if self.name is not None:
            label(self.name, "joint: name")
        if self.kind not in ("hinge", "distance"):
            raise SceneError(
                f'joint: kind is {self.kind!r}, expected "hinge" or "distance"'
                f"{nearest(self.kind, ('hinge', 'distance'))}"
            )
        flag(self.known, "joint: known")
        if self.known and None in (self.bodies, self.anchor_a, self.anchor_b):
            raise SceneError(
                "joint: it lacks bodies, anchor_a or anchor_b; add them, or set known = false to"
                " infer what is left out"
            )
        where = "joint"
        if self.bodies is not None:
            bodies = self._check_bodies(self.bodies)
            where = f"joint of {bodies[0]} and {bodies[1]}"
        object.__setattr__(self, "prior", index_probabilities(self.prior, where))
        if self.prior and self.bodies is not None:
            raise SceneError(
                f"{where}: it has bodies and a prior of which they are; drop one of the two"
            )
        for key in ("anchor_a", "anchor_b"):
            anchor = getattr(self, key)
            if anchor is not None and self.bodies is None:
                raise SceneError(
                    f"{where}: it has {key} and no bodies; in which body's frame is the anchor? Add"
                    f" bodies, or drop {key}"
                )
            if anchor is not None:
                object.__setattr__(self, key, vector(anchor, 2, f"{where}: {key}"))

    def _check_bodies(self, given: object) -> tuple[str, str]:
        if isinstance(given, str) or not isinstance(given, Iterable):
            raise SceneError(f"joint: bodies is {given!r}, expected two names")
        bodies = tuple(label(name, "joint: bodies") for name in given)
        if len(bodies) != 2:
            raise SceneError(f"joint: bodies is {list(bodies)}, expected two names")
        if bodies[0] == bodies[1]:
            raise SceneError(f'joint: it joins "{bodies[0]}" with itself; name two bodies')
        object.__setattr__(self, "bodies", bodies)
        return bodies
