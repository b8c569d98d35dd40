"""Start states that cannot be: bodies deep inside each other or a wall, joints that are apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import pymunk

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.world import _shapes, bounding_radius
from pbrl_ppl.scene import WORLD, Body, Joint, Scene

#: What is put down to noise and resting contact: a share of the smaller body's size.
ALLOWED = 0.25
_ORIGIN = (0.0, 0.0, 0.0)


def check_placement(scene: Scene, start: Array, where: Callable[[int], str] | None = None) -> None:
    """Refuse start states in which bodies lie deep inside each other or joints are apart.

    The engine would throw such bodies apart, and a fit would explain that by physics. Shallow
    overlaps are measurement noise or resting contact. Bodies that a joint joins do not collide in
    the engine, nor does a body that is joined to the world with the walls: they may overlap, and
    where an inferred joint could join any two, any two may. A body whose state is not finite is
    left out, as is a joint that is not known.

    Parameters
    ----------
    scene : Scene
        Shapes, walls, static bodies and joints.
    start : ndarray
        Start states, shape (transition, body, 6), bodies in the order of ``scene.dynamic``:
        x, y, theta, vx, vy, omega (m, m, rad, m/s, m/s, rad/s).
    where : callable, optional
        ``where(i)`` is what a message calls transition ``i``; ``transition i`` by default.

    Raises
    ------
    SimulationError
        If two shapes overlap by more than a quarter of the width of the smaller one (a wall has
        none, a concave polygon that of its widest convex part), or the anchors of a known joint are
        off by more than a quarter of the bounding radius of the smaller moving body. The first such
        transition is named. Also if ``start`` has the wrong shape.

    Examples
    --------
    >>> from pbrl_ppl.scene import Shape
    >>> pucks = (Body("a", Shape.circle(0.1)), Body("b", Shape.circle(0.2)))
    >>> scene = Scene(time_step=0.1, bodies=pucks)
    >>> start = np.zeros((1, 2, 6))
    >>> start[0, 1, 0] = 0.28
    >>> check_placement(scene, start)
    >>> start[0, 1, 0] = 0.18
    >>> check_placement(scene, start)
    Traceback (most recent call last):
    pbrl_ppl.errors.SimulationError: transition 0: bodies "a" and "b" overlap by 0.12 m, allowed ...
    """
    start = np.asarray(start, dtype=float)
    k = len(scene.dynamic)
    if start.ndim != 3 or start.shape[1:] != (k, 6):
        raise SimulationError(
            f"start has shape {start.shape}, expected (transition, {k}, 6)"
            " in the order x, y, theta, vx, vy, omega"
        )
    complete = np.isfinite(start).all(axis=-1, keepdims=True)
    poses = np.where(complete, start[..., :3], np.nan)
    faults = [*_apart(scene, poses), *_overlaps(scene, poses)]
    if faults:
        i, message = min(faults, key=lambda fault: fault[0])
        raise SimulationError(f"{where(i) if where else f'transition {i}'}: {message}")


# -- joints ----------------------------------------------------------------------------------------


def _apart(scene: Scene, poses: Array) -> Iterator[tuple[int, str]]:
    """First transition and message of every known joint whose anchors are not where they must."""
    moving = {body.name: i for i, body in enumerate(scene.dynamic)}
    reference = {body.name: body.pose or _ORIGIN for body in scene.bodies} | {WORLD: _ORIGIN}
    for joint in scene.joints:
        if not joint.known or joint.bodies is None:
            continue
        fixed = [np.array([reference[name]]) for name in joint.bodies]
        now = [
            poses[:, moving[name]] if name in moving else pose
            for name, pose in zip(joint.bodies, fixed, strict=True)
        ]
        length = _anchor_distance(joint, fixed)[0] if joint.kind == "distance" else 0.0
        found = _anchor_distance(joint, now)
        smaller = min(bounding_radius(scene.body(n)) for n in joint.bodies if n in moving)
        off = np.flatnonzero(np.abs(found - length) > ALLOWED * smaller)
        if len(off):
            a, b = (name if name == WORLD else f'"{name}"' for name in joint.bodies)
            yield (
                int(off[0]),
                f"the anchors of the {joint.kind} joint of {a} and {b} are {found[off[0]]:.3g} m"
                f" apart, expected {length:.3g} m to within {ALLOWED * smaller:.3g} m (a quarter of"
                " the smaller moving body's bounding radius); correct the poses or the anchors",
            )


def _anchor_distance(joint: Joint, poses: list[Array]) -> Array:
    anchors = (joint.anchor_a or (0.0, 0.0), joint.anchor_b or (0.0, 0.0))
    a, b = (_put(np.array([at]), pose) for at, pose in zip(anchors, poses, strict=True))
    return np.asarray(np.hypot(*np.moveaxis(a - b, -1, 0))[:, 0])


# -- shapes ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Solid:
    """A body, or a wall, and where it is in each transition.

    ``parts`` are convex: corners (k, 2) counter-clockwise in its frame and a radius about them
    (one corner is a circle, two are a wall); ``core`` and ``reach`` are a part about all of them.
    """

    name: str
    poses: Array  # (transition, 3)
    parts: tuple[tuple[Array, float], ...]
    core: Array
    reach: float
    width: float


def _solid(body: Body, poses: Array) -> _Solid:
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
    return _Solid(body.name, poses, tuple(parts), np.zeros((1, 2)), bounding_radius(body), width)


def _overlaps(scene: Scene, poses: Array) -> Iterator[tuple[int, str]]:
    """First transition and message of every two shapes that lie deep inside each other."""
    still = np.zeros((len(poses), 3))
    moving = [_solid(body, poses[:, i]) for i, body in enumerate(scene.dynamic)]
    static = [_solid(body, still + body.pose) for body in scene.bodies if body.pose and body.static]
    ends = [np.array([wall.start, wall.end]) for wall in scene.walls]
    walls = [_Solid(WORLD, still, ((end, 0.0),), end, 0.0, np.inf) for end in ends]
    joined = [set(joint.bodies) for joint in scene.joints if joint.bodies is not None]
    anyhow = any(joint.bodies is None for joint in scene.joints)  # it could join any of joinable
    for a, b in [*combinations(moving, 2), *product(moving, [*walls, *static])]:
        if {a.name, b.name} in joined or (anyhow and b not in static):
            continue
        allowed = ALLOWED * min(a.width, b.width)
        # two shapes overlap by no more than what is about them does
        near = np.flatnonzero(
            _depth((a.core, a.reach), a.poses, (b.core, b.reach), b.poses) > allowed
        )
        if not len(near):
            continue
        depth = np.max(
            [_depth(p, a.poses[near], q, b.poses[near]) for p, q in product(a.parts, b.parts)],
            axis=0,
        )
        deep = np.flatnonzero(depth > allowed)
        if len(deep):
            what, whose = f'bodies "{a.name}" and "{b.name}"', "the smaller one's"
            if b.name == WORLD:
                (x, y), (to_x, to_y) = b.core
                what = f'body "{a.name}" and the wall from ({x:g}, {y:g}) to ({to_x:g}, {to_y:g})'
                whose = "the body's"
            yield (
                int(near[deep[0]]),
                f"{what} overlap by {depth[deep[0]]:.3g} m, allowed is {allowed:.3g} m (a quarter"
                f" of {whose} width); correct the poses, the shapes or the walls",
            )


# -- geometry --------------------------------------------------------------------------------------


def _put(points: Array, poses: Array) -> Array:
    """Points (k, 2) of a body's frame in the world, at each pose (n, 3): shape (n, k, 2)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points.T
    return np.stack([c * x - s * y + poses[:, :1], s * x + c * y + poses[:, 1:2]], axis=-1)


def _depth(
    one: tuple[Array, float], at_one: Array, other: tuple[Array, float], at_other: Array
) -> Array:
    """How far two convex parts must move to part, at each pose (m); negative if they are apart.

    The engine's own answer is not used: it is zero for polygons whose centres coincide.
    """
    a, b = _put(one[0], at_one), _put(other[0], at_other)
    radii = one[1] + other[1]
    if a.shape[1] == 1:
        return radii - _distance(a[:, 0], b)
    if b.shape[1] == 1:
        return radii - _distance(b[:, 0], a)
    return radii + np.minimum(_behind(a, b), _behind(b, a))


def _behind(a: Array, b: Array) -> Array:
    """How far corners b reach behind the edge of a behind which they reach least, shape (n,)."""
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
    square = np.maximum((edge**2).sum(axis=-1), np.finfo(float).tiny)  # a single corner has no edge
    share = np.clip((arm * edge).sum(axis=-1) / square, 0.0, 1.0)
    distance = np.hypot(*np.moveaxis(arm - share[..., None] * edge, -1, 0)).min(axis=1)
    left = edge[..., 0] * arm[..., 1] >= edge[..., 1] * arm[..., 0]
    inside = left.all(axis=1) & (corners.shape[1] > 2)
    return np.asarray(np.where(inside, -distance, distance))
