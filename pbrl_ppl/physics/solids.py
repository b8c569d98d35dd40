"""Solids of convex parts, and how deep they lie in each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product

import numpy as np
import pymunk

from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.world import _shapes
from pbrl_ppl.scene import WORLD, Body, Scene

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, eq=False)
class Solid:
    """A body in its own frame, or a wall in the world's.

    ``parts`` are convex: corners (k, 2) counter-clockwise and a radius about them; one corner is a
    circle, two are a wall. All of them are within ``reach`` of the ``core``, a segment (2, 2).
    """

    name: str
    parts: tuple[tuple[Array, float], ...]
    core: Array
    reach: float
    width: float


def solid_of(body: Body) -> Solid:
    """Describe a moving or static body."""
    parts: list[tuple[Array, float]] = []
    for shape in _shapes(body, pymunk.Body()):
        if isinstance(shape, pymunk.Poly):
            parts.append((np.array(shape.get_vertices()), 0.0))
        else:
            parts.append((np.zeros((1, 2)), float(body.shape.radius or 0.0)))
    x_min, x_max, y_min, y_max = body.shape.bounds
    width = min(x_max - x_min, y_max - y_min)
    if len(parts) > 1:  # no part of a thin frame can lie as deep as the whole is wide
        width = min(width, max(float(np.ptp(corners, axis=0).min()) for corners, _ in parts))
    return Solid(body.name, tuple(parts), np.zeros((2, 2)), body.shape.bounding_radius, width)


@dataclass(frozen=True, eq=False)
class Scenery:
    """Solids of a scene: moving bodies, then walls and static bodies.

    ``fixed`` are the poses of those that do not move, shape (fixed, 3); ``pairs`` are the solids
    that nothing joins, the first of which moves.
    """

    solids: tuple[Solid, ...]
    fixed: Array
    pairs: Pairs

    def with_fixed(self, moving: Array) -> Array:
        """Poses or states (n, body, 3 or 6) of all solids, shape (n, solid, 3 or 6)."""
        n, _, width = moving.shape
        still = np.zeros((n, len(self.fixed), width))
        still[..., :3] = self.fixed
        return np.concatenate([moving, still], axis=1)


@lru_cache(maxsize=16)
def scenery(scene: Scene) -> Scenery:
    """Describe what a scene's bodies may meet."""
    static = [body for body in scene.bodies if body.static]
    walls = [np.array([wall.start, wall.end]) for wall in scene.walls]
    solids = [solid_of(body) for body in scene.moving]
    solids += [Solid(WORLD, ((wall, 0.0),), wall, 0.0, np.inf) for wall in walls]
    solids += [solid_of(body) for body in static]
    origin = (0.0, 0.0, 0.0)
    fixed = [origin] * len(walls) + [body.pose or origin for body in static]
    joined = [set(joint.bodies) for joint in scene.joints if joint.bodies is not None]
    pairs = tuple(
        (i, j)
        for i, j in combinations(range(len(solids)), 2)
        if i < len(scene.moving) and {solids[i].name, solids[j].name} not in joined
    )
    return Scenery(tuple(solids), np.array(fixed, dtype=float).reshape(-1, 3), pairs)


def depth(a: Solid, poses_a: Array, b: Solid, poses_b: Array) -> Array:
    """Penetration depth of the deepest parts of two solids at each pose (m), shape (n,)."""
    parts = product(a.parts, b.parts)
    return np.asarray(np.max([depth_of(p, poses_a, q, poses_b) for p, q in parts], axis=0))


def circles(solids: tuple[Solid, ...], pairs: Pairs, poses: Array) -> Array:
    """Penetration depth of each pair's bounding circles, or of one and a wall: (n, pair)."""
    i, j = np.array(pairs, dtype=int).reshape(-1, 2).T
    cores = np.array([solid.core for solid in solids])
    reach = np.array([solid.reach for solid in solids])
    arm = poses[:, i, :2] - poses[:, j, :2] - cores[j, 0]
    gap = to_segment(arm, cores[j, 1] - cores[j, 0])
    return np.asarray(reach[i] + reach[j] - gap)


def put(points: Array, poses: Array) -> Array:
    """Points (k, 2) of a body's frame in the world, at each pose (n, 3): shape (n, k, 2)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points.T
    return np.stack([c * x - s * y + poses[:, :1], s * x + c * y + poses[:, 1:2]], axis=-1)


def depth_of(
    part_a: tuple[Array, float], poses_a: Array, part_b: tuple[Array, float], poses_b: Array
) -> Array:
    """Penetration depth of two convex parts at each pose (m); negative if they are apart.

    The engine's own answer is not used: it is zero for polygons whose centres coincide.
    """
    a, b = put(part_a[0], poses_a), put(part_b[0], poses_b)
    radii = part_a[1] + part_b[1]
    if a.shape[1] == 1:
        return radii - _distance(a[:, 0], b)
    if b.shape[1] == 1:
        return radii - _distance(b[:, 0], a)
    return radii + np.minimum(_behind(a, b), _behind(b, a))


def _behind(a: Array, b: Array) -> Array:
    """Least depth of corners b behind an edge of a (separating axes), shape (n,)."""
    least = np.full(len(a), np.inf)
    for corner, after in zip(
        np.moveaxis(a, 1, 0), np.moveaxis(np.roll(a, -1, 1), 1, 0), strict=True
    ):
        x, y = (after - corner).T
        outward = np.stack([y, -x], axis=-1) / np.hypot(x, y)[:, None]
        reach = ((b - corner[:, None]) * outward[:, None]).sum(axis=-1).min(axis=1)
        least = np.minimum(least, -reach)
    return least


def _distance(point: Array, corners: Array) -> Array:
    """Distance of a point (n, 2) from corners (n, k, 2), negative inside a polygon, shape (n,)."""
    edge = np.roll(corners, -1, axis=1) - corners
    arm = point[:, None] - corners
    distance = to_segment(arm, edge).min(axis=1)
    left = edge[..., 0] * arm[..., 1] >= edge[..., 1] * arm[..., 0]
    inside = left.all(axis=1) & (corners.shape[1] > 2)
    return np.asarray(np.where(inside, -distance, distance))


def to_segment(arm: Array, edge: Array) -> Array:
    """Distance of points from segments, given from each one's begin (..., 2); it may be a point."""
    square = np.maximum((edge**2).sum(axis=-1), np.finfo(float).tiny)
    share = np.clip((arm * edge).sum(axis=-1) / square, 0.0, 1.0)
    return np.asarray(np.hypot(*np.moveaxis(arm - share[..., None] * edge, -1, 0)))
