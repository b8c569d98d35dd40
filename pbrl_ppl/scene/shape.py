"""Shapes of bodies: boxes, circles and polygons, with their areas and moments of inertia."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.checks import Point, nearest, positive, vector

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """Outline of a body in its own frame, whose origin is the centroid.

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
        if self.kind not in needs:
            raise SceneError(
                f'shape: kind is {self.kind!r}, expected "box", "circle" or "polygon"'
                f"{nearest(self.kind, needs)}"
            )
        for kind, key in needs.items():
            given = getattr(self, key) is not None
            if given and kind != self.kind:
                raise SceneError(f'shape: a {self.kind} has no "{key}"; drop it')
            if not given and kind == self.kind:
                raise SceneError(f'shape: a {self.kind} needs "{key}"; add it')
        if self.size is not None:
            width, height = vector(self.size, 2, "shape: size")
            size = (positive(width, "shape: size"), positive(height, "shape: size"))
            object.__setattr__(self, "size", size)
        if self.radius is not None:
            object.__setattr__(self, "radius", positive(self.radius, "shape: radius"))
        if self.vertices is not None:
            object.__setattr__(self, "vertices", _check_polygon(self.vertices))

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
        corners = self.outline
        if corners is None:
            radius = float(self.radius or 0.0)
            return (-radius, radius, -radius, radius)
        x, y = zip(*corners, strict=True)
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


def _check_polygon(value: object) -> tuple[Point, ...]:
    """Return a polygon's corners as given, or raise."""
    where = "shape: vertices"
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected a list of points")
    vertices: tuple[Point, ...] = tuple(vector(point, 2, where) for point in value)
    if len(vertices) < 3:
        raise SceneError(f"{where} has {len(vertices)} points, expected at least 3")
    for i, same in enumerate(vertices):
        if vertices.index(same) < i:
            raise SceneError(
                f"{where}: point {i + 1} is point {vertices.index(same) + 1} again; list each "
                "corner once (the outline closes by itself)"
            )
    crossing = _self_intersection(np.array(vertices))
    if crossing is not None:
        raise SceneError(
            f"{where}: edges {crossing[0] + 1} and {crossing[1] + 1} meet; list the corners in "
            "order round the outline"
        )
    size = float(np.ptp(np.array(vertices), axis=0).max())
    area, centroid, _ = _moments(vertices)
    if abs(area) <= 1e-12 * size**2:
        raise SceneError(f"{where}: the polygon has no area; move its points apart")
    if np.abs(centroid).max() > 1e-6 * size:
        x, y = (float(c) for c in centroid)
        raise SceneError(
            f"{where}: the centroid is at ({x:.9g}, {y:.9g}), expected the origin of the body's "
            f"frame; subtract ({x:.9g}, {y:.9g}) from every vertex"
        )
    return vertices


def _self_intersection(a: Floats) -> tuple[int, int] | None:
    """Return the first two edges that touch other than at a shared corner, or None."""
    n = len(a)

    def side(o: Any, u: Any, v: Any) -> float:
        return float((u[0] - o[0]) * (v[1] - o[1]) - (u[1] - o[1]) * (v[0] - o[0]))

    def between(o: Any, u: Any, v: Any) -> bool:
        return bool(np.all(np.minimum(o, u) <= v) and np.all(v <= np.maximum(o, u)))

    for i in range(n):
        o, u = a[i], a[(i + 1) % n]
        for j in range(i + 1, n):
            v, w = a[j], a[(j + 1) % n]
            if j == i + 1 or (j + 1) % n == i:
                # Neighbours share a corner; they meet elsewhere only when one folds back.
                corner, first, second = (u, o, w) if j == i + 1 else (o, u, v)
                folded = (
                    side(corner, first, second) == 0
                    and float((first - corner) @ (second - corner)) > 0
                )
                if folded:
                    return i, j
                continue
            d = (side(o, u, v), side(o, u, w), side(v, w, o), side(v, w, u))
            if d[0] * d[1] < 0 and d[2] * d[3] < 0:
                return i, j
            points = ((o, u, v), (o, u, w), (v, w, o), (v, w, u))
            for s, (from_, to, at) in zip(d, points, strict=True):
                if s == 0 and between(from_, to, at):
                    return i, j
    return None
