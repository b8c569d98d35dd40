"""Bodies and walls of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.checks import Named, Point
from pbrl_ppl.scene.joints import WORLD
from pbrl_ppl.scene.shape import Shape


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
    typical : tuple of (str, float)
        Natural units of the body, names of :class:`Units`, in which default priors of effects are
        numbers; a mapping is accepted. A recording and the scene give those that are left out.

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
    known: Named = ()
    prior: tuple[tuple[str, Named], ...] = ()
    effects: tuple[str, ...] = ()
    pose: tuple[float, float, float] | None = None
    object_class: str | None = None
    attributes: tuple[str, ...] = ()
    typical: Named = ()

    def __post_init__(self) -> None:
        checks.label(self.name, "body: name")
        where = f'body "{self.name}"'
        if self.name == WORLD:
            raise SceneError(f'{where}: "world" is the name of the ground; choose another name')
        if not isinstance(self.shape, Shape):
            raise SceneError(f"{where}: shape is {self.shape!r}, expected a Shape")
        checks.settle(self, where, wheel=checks.flag, static=checks.flag, kinematic=checks.flag)
        pose = partial(checks.vector, length=3)
        checks.settle(self, where, effects=checks.names, attributes=checks.names, pose=pose)
        self._settle_tables(where)
        if self.object_class is not None:
            checks.label(self.object_class, f"{where}: class")
        if self.static and self.pose is None:
            raise SceneError(f"{where}: it is static and has no pose; add pose = [x, y, theta]")
        if self.static and self.wheel:
            raise SceneError(f"{where}: a static body cannot have a wheel; drop one of the two")
        if self.kinematic:
            self._check_kinematic(where)

    @property
    def owner(self) -> str:
        """Name of the owner of its parameters of Table 1: its class and attributes, or itself."""
        if self.object_class is None:
            return self.name
        listed = ", ".join(sorted(self.attributes))
        return f"{self.object_class} ({listed})" if listed else self.object_class

    def _settle_tables(self, where: str) -> None:
        """Bring ``known``, ``prior`` and ``typical`` into canonical form."""
        # which parameters an effect has is known where the catalogue is: `prior.build_layout`
        beginnings = tuple(f"{effect}_" for effect in self.effects)
        others = sorted(
            name
            for name in checks.items(self.prior, f"prior of {where}")
            if name not in checks.PARAMETERS and str(name).startswith(beginnings)
        )
        hint = " (an effect's parameter needs the effect among the body's effects)"
        priors = dict.fromkeys((*checks.PARAMETERS, *others), checks.hyper_parameters)
        checks.settle_table(self, where, "known", checks.PARAMETERS, "parameter")
        checks.settle_table(self, where, "prior", priors, "parameter", hint)
        checks.settle_table(self, where, "typical", checks.UNITS, "size")
        checks.not_both(self.known, self.prior, where)

    def _check_kinematic(self, where: str) -> None:
        """Raise `SceneError` where a kinematic body is given what only dynamic bodies have."""
        for name in ("static", "wheel", "effects"):
            if getattr(self, name):
                raise SceneError(
                    f"{where}: it is kinematic, follows its recorded path, and has {name} ="
                    f" {getattr(self, name)!r}; drop one of the two"
                )
        for key in ("known", "prior"):
            for name, _ in getattr(self, key):
                if name not in checks.CONTACT_NAMES:
                    raise SceneError(
                        f"{where}: it is kinematic and {key} has {name}, which does not matter"
                        f" then; expected {' or '.join(checks.CONTACT_NAMES)}; drop it"
                    )


@dataclass(frozen=True)
class Wall:
    """An immovable segment between two points of the world (m); TOML keys ``from`` and ``to``."""

    start: Point
    end: Point

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", checks.vector(self.start, "wall: from"))
        object.__setattr__(self, "end", checks.vector(self.end, "wall: to"))
        if self.start == self.end:
            raise SceneError(f"wall: from and to are both {list(self.start)}; its length is zero")


def check_classes(bodies: Sequence[Body]) -> None:
    """Check that names of classes differ from bodies', and that bodies can share parameters.

    Parameters
    ----------
    bodies : sequence of Body
        All bodies of a scene.

    Raises
    ------
    SceneError
        If a class is called as another body or the world is, or bodies that share parameters differ
        in what shapes these.
    """
    first: dict[str, Body] = {}
    for body in bodies:
        if body.object_class is None:
            continue
        where = f'body "{body.name}"'
        others = [WORLD, *(other.name for other in bodies if other is not body)]
        for name in (body.object_class, body.owner):
            if name in others:
                raise SceneError(
                    f'{where}: its class makes "{name}" the owner of its parameters, which is also'
                    " the name of another body or of the ground; give the class another name"
                )
        if body.static:
            continue
        other = first.setdefault(body.owner, body)
        for key, mine, its in _differing(body, other):
            raise SceneError(
                f'{where}: it shares the parameters of class "{body.owner}" with body'
                f' "{other.name}", and they differ in {key}: {mine} and {its}; make them equal, or'
                " give one of them another class or attributes"
            )


def _differing(body: Body, other: Body) -> list[tuple[str, object, object]]:
    """Return what shapes the parameters and differs between two bodies: its name, both values."""

    def shaping(one: Body) -> dict[str, object]:
        # an effect's parameters belong to each body alone
        prior = {name: dict(hyper) for name, hyper in one.prior if name in checks.PARAMETERS}
        return {
            **{key: getattr(one, key) for key in ("object_class", "wheel", "kinematic")},
            "known": dict(one.known),
            "prior": prior,
            "attributes": sorted(one.attributes),
            "shape": one.shape if one.wheel else None,  # the wheel's place is bounded by it
        }

    pairs = zip(shaping(body).items(), shaping(other).values(), strict=True)
    return [(key, mine, its) for (key, mine), its in pairs if mine != its]
