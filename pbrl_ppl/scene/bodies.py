"""Bodies and walls of a scene, and the shapes of bodies with their moments of inertia."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.checks import Named, Point
from pbrl_ppl.scene.joints import WORLD
from pbrl_ppl.state import Floats


@dataclass(frozen=True)
class Shape:
    """Outline of a body in its frame, whose origin is the centroid.

    Attributes
    ----------
    kind : str
        ``"box"``, ``"circle"`` or ``"polygon"``.
    size : tuple of float, optional
        Width and height of a box (m).
    radius : float, optional
        Radius of a circle (m).
    vertices : tuple of tuple of float, optional
        Corners of a polygon in order, either way round (m); it may be concave.

    Raises
    ------
    SceneError
        If the shape is impossible: not positive, self-intersecting, centroid off the origin.

    Examples
    --------
    >>> Shape.circle(0.5).unit_moment
    0.125
    """

    kind: str
    size: tuple[float, float] | None = None
    radius: float | None = None
    vertices: tuple[Point, ...] | None = None

    def __post_init__(self) -> None:
        needs = {"box": "size", "circle": "radius", "polygon": "vertices"}
        checks.settle(self, "shape", kind=checks.choice(needs))
        for kind, key in needs.items():
            present = getattr(self, key) is not None
            if present and kind != self.kind:
                raise SceneError(f'shape: a {self.kind} has no "{key}"; drop it')
            if not present and kind == self.kind:
                raise SceneError(f'shape: a {self.kind} needs "{key}"; add it')
        size = partial(checks.vector, check=checks.positive)
        checks.settle(self, "shape", size=size, radius=checks.positive, vertices=_polygon)

    @classmethod
    def box(cls, width: float, height: float) -> Shape:
        """Return a box of this width and height (m)."""
        return cls("box", size=(width, height))

    @classmethod
    def circle(cls, radius: float) -> Shape:
        """Return a circle of this radius (m)."""
        return cls("circle", radius=radius)

    @classmethod
    def polygon(cls, vertices: Iterable[Point]) -> Shape:
        """Return a polygon with these corners (m)."""
        return cls("polygon", vertices=tuple(vertices))

    @property
    def outline(self) -> tuple[Point, ...] | None:
        """Corners counter-clockwise (m); None for a circle."""
        if self.size is not None:
            x, y = self.size[0] / 2, self.size[1] / 2
            return ((-x, -y), (x, -y), (x, y), (-x, y))
        if self.vertices is not None:
            return self.vertices if _moments(self.vertices)[0] > 0 else self.vertices[::-1]
        return None

    @property
    def bounding_radius(self) -> float:
        """Radius of the circle about the origin that holds the whole shape (m)."""
        if self.outline is None:
            return float(self.radius or 0.0)
        return max(math.hypot(x, y) for x, y in self.outline)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Extent in the body frame: ``x_min, x_max, y_min, y_max`` (m)."""
        if self.outline is None:
            radius = float(self.radius or 0.0)
            return (-radius, radius, -radius, radius)
        x, y = zip(*self.outline, strict=True)
        return (min(x), max(x), min(y), max(y))

    @property
    def unit_moment(self) -> float:
        """Moment of inertia about the centroid per kg, uniform density (m^2)."""
        if self.size is not None:
            return (self.size[0] ** 2 + self.size[1] ** 2) / 12.0
        if self.radius is not None:
            return self.radius**2 / 2.0
        return _moments(self.vertices or ())[2]


def _moments(vertices: tuple[Point, ...]) -> tuple[float, Floats, float]:
    """Return a polygon's signed area, centroid (2,) and unit moment about the centroid."""
    corners = np.asarray(vertices, dtype=float)
    # Relative to a corner: a polygon far from the origin must not lose its area to rounding.
    a = corners - corners[0]
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = float(cross.sum()) / 2.0
    if area == 0.0:
        return 0.0, corners[0], 0.0
    centroid = ((a + b) * cross[:, None]).sum(axis=0) / (6.0 * area)
    second = (cross * (a * a + a * b + b * b).sum(axis=1)).sum() / 12.0
    return area, corners[0] + centroid, float(second / area - centroid @ centroid)


def _polygon(value: object, where: str) -> tuple[Point, ...]:
    """Return a polygon's corners as given, or raise."""
    vertices = checks.each(checks.vector, "a list of points")(value, where)
    if len(vertices) < 3:
        raise SceneError(f"{where} has {len(vertices)} points, expected at least 3")
    for number, point in enumerate(vertices, start=1):
        if (first := vertices.index(point) + 1) < number:
            raise SceneError(
                f"{where}: point {number} is point {first} again; list each corner once (the"
                " outline closes by itself)"
            )
    corners = np.array(vertices)
    if crossing := _self_intersection(corners):
        raise SceneError(
            f"{where}: edges {crossing[0] + 1} and {crossing[1] + 1} meet; list the corners in "
            "order round the outline"
        )
    size = float(np.ptp(corners, axis=0).max())
    area, centroid, _ = _moments(vertices)
    if abs(area) <= 1e-12 * size**2:
        raise SceneError(f"{where}: the polygon has no area; move its points apart")
    if np.abs(centroid).max() > 1e-6 * size:
        x, y = centroid
        raise SceneError(
            f"{where}: the centroid is at ({x:.9g}, {y:.9g}), expected the origin of the body's "
            f"frame; subtract ({x:.9g}, {y:.9g}) from every vertex"
        )
    return vertices


def _self_intersection(a: Floats) -> tuple[int, int] | None:
    """Return the first two edges that touch other than at a shared corner, or None."""

    def side(o: Floats, u: Floats, v: Floats) -> float:
        return float((u[0] - o[0]) * (v[1] - o[1]) - (u[1] - o[1]) * (v[0] - o[0]))

    def between(o: Floats, u: Floats, v: Floats) -> bool:
        return bool(np.all(np.minimum(o, u) <= v) and np.all(v <= np.maximum(o, u)))

    n = len(a)
    for i, j in combinations(range(n), 2):
        o, u, v, w = a[i], a[(i + 1) % n], a[j], a[(j + 1) % n]
        if j == i + 1 or (j + 1) % n == i:
            # Neighbours share a corner; they meet elsewhere only when one folds back.
            corner, first, second = (u, o, w) if j == i + 1 else (o, u, v)
            along = float((first - corner) @ (second - corner))
            if side(corner, first, second) == 0 and along > 0:
                return i, j
            continue
        ends = ((o, u, v), (o, u, w), (v, w, o), (v, w, u))
        d = [side(*corners) for corners in ends]
        crosses = d[0] * d[1] < 0 and d[2] * d[3] < 0
        if crosses or any(s == 0 and between(*corners) for s, corners in zip(d, ends, strict=True)):
            return i, j
    return None


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
        checks.settle(self, where, shape=checks.instance(Shape, "a Shape"))
        checks.settle(self, where, **dict.fromkeys(("wheel", "static", "kinematic"), checks.flag))
        checks.settle(self, where, **dict.fromkeys(("effects", "attributes"), checks.names))
        checks.settle(self, where, pose=partial(checks.vector, length=3), object_class=checks.label)
        self._settle_tables(where)
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
            str(name)
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
        mine, its = _shaping(body), _shaping(other)
        for key in (key for key in mine if mine[key] != its[key]):
            raise SceneError(
                f'{where}: it shares the parameters of class "{body.owner}" with body'
                f' "{other.name}", and they differ in {key}: {mine[key]} and {its[key]}; make them'
                " equal, or give one of them another class or attributes"
            )


def _shaping(body: Body) -> dict[str, object]:
    """Return what shapes a body's parameters, but for effects', which belong to it alone."""
    prior = {name: dict(hyper) for name, hyper in body.prior if name in checks.PARAMETERS}
    return {
        **{key: getattr(body, key) for key in ("object_class", "wheel", "kinematic")},
        "known": dict(body.known),
        "prior": prior,
        "attributes": sorted(body.attributes),
        "shape": body.shape if body.wheel else None,  # the wheel's place is bounded by it
    }
