"""Shapes of bodies: boxes, circles and polygons, with their areas and moments of inertia."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.checks import Point, choice, positive, settle, vector
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
    >>> Shape.box(1.0, 0.6).area
    0.6
    """

    kind: str
    size: tuple[float, float] | None = None
    radius: float | None = None
    vertices: tuple[Point, ...] | None = None

    def __post_init__(self) -> None:
        needs = {"box": "size", "circle": "radius", "polygon": "vertices"}
        choice(self.kind, "shape: kind", needs, '"box", "circle" or "polygon"')
        for kind, key in needs.items():
            present = getattr(self, key) is not None
            if present and kind != self.kind:
                raise SceneError(f'shape: a {self.kind} has no "{key}"; drop it')
            if not present and kind == self.kind:
                raise SceneError(f'shape: a {self.kind} needs "{key}"; add it')
        settle(self, "shape", size=_size, radius=positive, vertices=_polygon)

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
    def area(self) -> float:
        """Area (m^2)."""
        if self.size is not None:
            return self.size[0] * self.size[1]
        if self.radius is not None:
            return float(np.pi * self.radius**2)
        return abs(_moments(self.vertices or ())[0])

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


def _size(value: object, where: str) -> tuple[float, ...]:
    """Return the width and the height of a box."""
    return tuple(positive(side, where) for side in vector(value, where))


def _polygon(value: object, where: str) -> tuple[Point, ...]:
    """Return a polygon's corners as given, or raise."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected a list of points")
    vertices: tuple[Point, ...] = tuple(vector(point, where) for point in value)
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
