"""What is near what: depths of solids, checks of initial states, contacts in an interval."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product

import numpy as np
import pymunk

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.physics.calls import compiled, inner
from pbrl_ppl.physics.world import JOINT_KINDS, engine_shapes
from pbrl_ppl.scene import WORLD, Body, Joint, Scene
from pbrl_ppl.state import Bools, Floats, Ints, wrapped

Pairs = tuple[tuple[int, int], ...]
#: Number of poses checked along each body's path.
_POSES = 5
#: Accuracy of outlines as a share of a body's width (engines round corners by about as much), and
#: greatest distance from the nearest checked pose as a share of the path.
_OUTLINE, _SHARE = 0.05, 0.5 / (_POSES - 1)

#: Violation that noise and resting contact may explain, as a share of the smaller body's size.
ALLOWED = 0.25


@dataclass(frozen=True, eq=False)
class Solid:
    """A body in its frame, or a wall in the world's.

    ``parts`` are convex: corners (k, 2) counter-clockwise and a radius around them; one corner is a
    circle, two are a wall. All parts are within ``reach`` of the ``core``, a segment (2, 2).
    """

    name: str
    parts: tuple[tuple[Floats, float], ...]
    core: Floats
    reach: float
    width: float


def solid_of(body: Body) -> Solid:
    """Return the solid of a moving or static body."""
    if body.shape.radius:
        parts = [(np.zeros((1, 2)), float(body.shape.radius))]
    else:
        shapes = engine_shapes(body, pymunk.Body())
        parts = [(np.array(s.get_vertices()), 0.0) for s in shapes if isinstance(s, pymunk.Poly)]
    x_min, x_max, y_min, y_max = body.shape.bounds
    width = min(x_max - x_min, y_max - y_min)
    if len(parts) > 1:  # a part of a thin frame is never as deep as the frame is wide
        width = min(width, max(float(np.ptp(corners, axis=0).min()) for corners, _ in parts))
    return Solid(body.name, tuple(parts), np.zeros((2, 2)), body.shape.bounding_radius, width)


@dataclass(frozen=True, eq=False)
class Scenery:
    """Solids of a scene: moving bodies, then walls and static bodies.

    ``fixed`` are the poses of walls and static bodies, shape (fixed, 3); ``pairs`` are the pairs of
    solids without a common joint, a moving body first.
    """

    solids: tuple[Solid, ...]
    fixed: Floats
    pairs: Pairs

    def with_fixed(self, moving: Floats) -> Floats:
        """Return poses or states (n, body, 3 or 6) of all solids, shape (n, solid, 3 or 6)."""
        n, _, width = moving.shape
        still = np.zeros((n, len(self.fixed), width))
        still[..., :3] = self.fixed
        return np.concatenate([moving, still], axis=1)


@lru_cache(maxsize=16)
def scenery(scene: Scene) -> Scenery:
    """Return the solids of a scene, and which of them may touch."""
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


def depth(a: Solid, poses_a: Floats, b: Solid, poses_b: Floats) -> Floats:
    """Return the greatest penetration depth of two solids' parts at each pose (m), shape (n,)."""
    parts = product(a.parts, b.parts)
    return np.asarray(np.max([depth_of(p, poses_a, q, poses_b) for p, q in parts], axis=0))


def circles(solids: tuple[Solid, ...], pairs: Pairs, poses: Floats) -> Floats:
    """Return penetration depths of bounding circles, or of one and a wall (m): (n, pair)."""
    i, j = np.array(pairs, dtype=int).reshape(-1, 2).T
    cores = np.array([solid.core for solid in solids])
    reach = np.array([solid.reach for solid in solids])
    arm = poses[:, i, :2] - poses[:, j, :2] - cores[j, 0]
    gap = to_segment(arm, cores[j, 1] - cores[j, 0])
    return np.asarray(reach[i] + reach[j] - gap)


def put(points: Floats, poses: Floats) -> Floats:
    """Return points (k, 2) of a body's frame in the world at each pose (n, 3): (n, k, 2)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points.T
    return np.stack([c * x - s * y + poses[:, :1], s * x + c * y + poses[:, 1:2]], axis=-1)


def depth_of(
    part_a: tuple[Floats, float], poses_a: Floats, part_b: tuple[Floats, float], poses_b: Floats
) -> Floats:
    """Return the penetration depth of two convex parts at each pose (m); negative if apart.

    The engine's answer is not used: it is zero for polygons whose centres coincide.
    """
    a, b = put(part_a[0], poses_a), put(part_b[0], poses_b)
    radii = part_a[1] + part_b[1]
    if a.shape[1] == 1:
        return radii - _distance(a[:, 0], b)
    if b.shape[1] == 1:
        return radii - _distance(b[:, 0], a)
    return radii + np.minimum(_behind(a, b), _behind(b, a))


def _behind(a: Floats, b: Floats) -> Floats:
    """Return the least depth of corners b behind an edge of a (separating axes), (n,)."""
    least = np.full(len(a), np.inf)
    for k in range(a.shape[1]):
        corner, after = a[:, k - 1], a[:, k]
        x, y = (after - corner).T
        outward = np.stack([y, -x], axis=-1) / np.hypot(x, y)[:, None]
        reach = ((b - corner[:, None]) * outward[:, None]).sum(axis=-1).min(axis=1)
        least = np.minimum(least, -reach)
    return least


def _distance(point: Floats, corners: Floats) -> Floats:
    """Return the distance of points (n, 2) from polygons (n, k, 2), negative inside, (n,)."""
    edge = np.roll(corners, -1, axis=1) - corners
    arm = point[:, None] - corners
    distance = to_segment(arm, edge).min(axis=1)
    left = edge[..., 0] * arm[..., 1] >= edge[..., 1] * arm[..., 0]
    inside = left.all(axis=1) & (corners.shape[1] > 2)
    return np.asarray(np.where(inside, -distance, distance))


def to_segment(arm: Floats, edge: Floats) -> Floats:
    """Return the distance of points from segments, both relative to the begin (..., 2)."""
    square = np.maximum((edge**2).sum(axis=-1), np.finfo(float).tiny)
    share = np.clip((arm * edge).sum(axis=-1) / square, 0.0, 1.0)
    return np.asarray(np.hypot(*np.moveaxis(arm - share[..., None] * edge, -1, 0)))


def touching(scene: Scene, begin: Floats, end: Floats) -> Bools:
    """Return whether bodies touch within an interval, or come so near that they may.

    Parameters
    ----------
    scene : Scene
        Shapes, walls and static bodies. Joined bodies do not collide, and bodies that follow a
        path are left out.
    begin, end : ndarray
        States, shape (transition, body, 6), SI units.

    Returns
    -------
    ndarray of bool
        Shape (transition,).
    """
    world = scenery(scene)
    begin, end = world.with_fixed(begin), world.with_fixed(end)
    kinematic = {i for i, body in enumerate(scene.moving) if body.kinematic}
    touched = np.zeros(len(begin), dtype=bool)
    pairs = tuple(pair for pair in world.pairs if kinematic.isdisjoint(pair))
    if not pairs:
        return touched
    near = _near(world, pairs, begin, scene.time_step) | _near(world, pairs, end, scene.time_step)
    for p in np.flatnonzero(near.any(axis=0)):
        (i, j), rows = pairs[p], np.flatnonzero(near[:, p])
        first, last = begin[rows][:, (i, j)], end[rows][:, (i, j)]
        a, b = world.solids[i], world.solids[j]
        touched[rows] |= _touch_on_path(a, b, first, last, scene.time_step)
    return touched


def _near(world: Scenery, pairs: Pairs, states: Floats, dt: float) -> Bools:
    """Return the pairs whose bounding circles may meet within an interval, (n, pair)."""
    i, j = np.array(pairs).T
    width = np.array([solid.width for solid in world.solids])
    rate = states[:, i, 3:5] - states[:, j, 3:5]
    way = dt * (1.0 + _SHARE) * np.hypot(rate[..., 0], rate[..., 1])
    way += _OUTLINE * np.minimum(width[i], width[j])
    return np.asarray(circles(world.solids, pairs, states) > -way)


def _touch_on_path(a: Solid, b: Solid, begin: Floats, end: Floats, dt: float) -> Bools:
    """Return whether two solids touch on a free path from begin or end, (transition, 2, 6).

    If they touched, they would overlap on one of the paths that they would take without contact.
    """
    outline = _OUTLINE * min(a.width, b.width)
    touched = np.zeros(len(begin), dtype=bool)
    for state, way in ((begin, dt), (end, -dt)):
        rate = state[:, 0, 3:5] - state[:, 1, 3:5]
        reach = outline + dt * _SHARE * np.hypot(rate[:, 0], rate[:, 1])
        gap = reach + dt * _SHARE * np.abs(state[..., 5]) @ np.array([a.reach, b.reach])
        for share in np.linspace(0.0, 1.0, _POSES if state[..., 3:].any() else 1):
            at = state[..., :3] + share * way * state[..., 3:]
            # bounding circles hold however fast a body turns
            near = np.flatnonzero(circles((a, b), ((0, 1),), at)[:, 0] > -reach)
            if len(near):
                touched[near] |= depth(a, at[near, 0], b, at[near, 1]) > -gap[near]
    return touched


def check_placement(scene: Scene, start: Floats, where: Callable[[int], str] | None = None) -> None:
    """Raise an error if bodies overlap deeply, or joints are apart, in initial states.

    The engine would push such bodies apart, and a fit would explain that by physics. Shallow
    overlaps are measurement noise or resting contact. Joined bodies do not collide in the engine,
    nor does a body that is joined to the world with the walls: they may overlap. If a joint of
    unknown bodies could join any two, any two may. Bodies whose state is not finite and joints that
    are not known are left out.

    Parameters
    ----------
    scene : Scene
        Shapes, walls, static bodies and joints.
    start : ndarray
        Initial states, shape (transition, body, 6), bodies in the order of ``scene.moving``:
        x, y, theta, vx, vy, omega (m, m, rad, m/s, m/s, rad/s).
    where : callable, optional
        ``where(i)`` names transition ``i`` in a message; ``transition i`` by default.

    Raises
    ------
    SimulationError
        If two shapes overlap by more than a quarter of the width of the smaller one (a wall has
        none, a concave polygon that of its widest convex part), or the anchors of a known joint are
        off by more than a quarter of the bounding radius of the smaller moving body, or a known
        slider's bodies turned by more than a quarter radian. The first such transition is named.
        Also if ``start`` has the wrong shape.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
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
    k = len(scene.moving)
    if start.ndim != 3 or start.shape[1:] != (k, 6):
        raise SimulationError(
            f"start has shape {start.shape}, expected (transition, {k}, 6)"
            " in the order x, y, theta, vx, vy, omega"
        )
    complete = np.isfinite(start).all(axis=-1, keepdims=True)
    poses = np.where(complete, start[..., :3], np.nan)
    for begin in range(0, len(poses), chunk := 2048):  # to spare memory
        part = poses[begin : begin + chunk]
        faults = [*_apart(scene, part), *_overlaps(scene, part)]
        if faults:
            first, message = min(faults, key=lambda fault: fault[0])
            i = begin + first
            raise SimulationError(f"{where(i) if where else f'transition {i}'}: {message}")


def check_history(scene: Scene, history: History, segments: Segments) -> None:
    """Raise an error if initial states of a history are impossible; see :func:`check_placement`.

    Parameters
    ----------
    scene : Scene
        Shapes, walls, static bodies and joints.
    history : History
        Gives the trajectories their names.
    segments : Segments
        Segments of the history.
    """
    names = history.dataset["trajectory"].values

    def where(i: int) -> str:
        return f"history trajectory {names[segments.trajectory[i]]}, step {segments.step[i]}"

    check_placement(scene, segments.start, where)


def overlap(scene: Scene, poses: Floats) -> Floats:
    """Return the penetration depth of the deepest two shapes (m), shape (n,).

    Negative values are lower bounds of the distance between bodies, at most that of their bounding
    circles. Joined bodies do not count.

    Parameters
    ----------
    scene : Scene
        Shapes, walls, static bodies and joints.
    poses : ndarray
        Shape (n, body, 3), bodies in the order of ``scene.moving``: x, y, theta (m, m, rad).
    """
    world, pairs = scenery(scene), _colliding(scene)
    poses = world.with_fixed(poses)
    bound = circles(world.solids, pairs, poses)
    for pair, rows, depths in _depths(world.solids, pairs, poses, bound > 0):
        bound[rows, pair] = depths
    return np.asarray(bound.max(axis=1, initial=-np.inf))


def _depths(
    solids: tuple[Solid, ...], pairs: Pairs, poses: Floats, near: Bools
) -> Iterator[tuple[int, Ints, Floats]]:
    """Yield each pair that is near somewhere, where it is, and how deep, by ``near`` (n, pair)."""
    for pair in np.flatnonzero(near.any(axis=0)):
        (i, j), rows = pairs[pair], np.flatnonzero(near[:, pair])
        yield int(pair), rows, depth(solids[i], poses[rows, i], solids[j], poses[rows, j])


def _apart(scene: Scene, poses: Floats) -> Iterator[tuple[int, str]]:
    """Yield the first transition and a message for each known joint with wrong anchors."""
    moving = {body.name: i for i, body in enumerate(scene.moving)}
    origin = (0.0, 0.0, 0.0)
    reference = {body.name: body.pose or origin for body in scene.bodies} | {WORLD: origin}
    for joint in scene.joints:
        if not joint.known or joint.bodies is None:
            continue
        fixed = [np.array([reference[name]]) for name in joint.bodies]
        placed = zip(joint.bodies, fixed, strict=True)
        now = [poses[:, moving[name]] if name in moving else pose for name, pose in placed]
        length = JOINT_KINDS[joint.kind].gap(_anchor_distance(scene, joint, fixed)[0])
        distance = _anchor_distance(scene, joint, now)
        smaller = min(scene.body(n).shape.bounding_radius for n in joint.bodies if n in moving)
        off = np.flatnonzero(np.abs(distance - length) > ALLOWED * smaller)
        if len(off):
            a, b = (name if name == WORLD else f'"{name}"' for name in joint.bodies)
            yield (
                int(off[0]),
                f"the anchors of the {joint.kind} joint of {a} and {b} are {distance[off[0]]:.3g} m"
                f" apart, expected {length:.3g} m to within {ALLOWED * smaller:.3g} m (a quarter of"
                " the smaller moving body's bounding radius); correct the poses or the anchors",
            )
        turned = wrapped(now[0][:, 2] - now[1][:, 2] - fixed[0][:, 2] + fixed[1][:, 2])
        off = np.flatnonzero(np.abs(turned) > ALLOWED)
        if joint.traits.slides and len(off):
            yield (
                int(off[0]),
                f"{joint.bodies[0]} is turned by {turned[off[0]]:.3g} rad against"
                f" {joint.bodies[1]} from their reference poses, whose angle the slider keeps,"
                f" expected 0 to within {ALLOWED} rad; correct theta in the bodies' pose",
            )


def _anchor_distance(scene: Scene, joint: Joint, poses: list[Floats]) -> Floats:
    """Return the distance of a joint's anchors, of a slider across its axis, shape (n,)."""
    anchors = (joint.anchor_a or (0.0, 0.0), joint.anchor_b or (0.0, 0.0))
    a, b = (put(np.array([at]), pose) for at, pose in zip(anchors, poses, strict=True))
    x, y = np.moveaxis(a - b, -1, 0)[..., 0]
    if joint.traits.slides and joint.bodies:
        second = joint.bodies[1]
        angle = poses[1][:, 2] + scene.direction(joint) - scene.reference_angle(second)
        return np.asarray(np.abs(np.cos(angle) * y - np.sin(angle) * x))
    return np.asarray(np.hypot(x, y))


def _colliding(scene: Scene) -> Pairs:
    """Return the pairs of solids that must not overlap."""
    pairs = scenery(scene).pairs
    if all(joint.bodies is not None for joint in scene.joints):
        return pairs
    # a joint of unknown bodies could join any two of the moving ones and the world
    first = len(scene.moving) + len(scene.walls)
    return tuple((i, j) for i, j in pairs if j >= first)


def _overlaps(scene: Scene, poses: Floats) -> Iterator[tuple[int, str]]:
    """Yield the first transition and a message for each two shapes that overlap deeply."""
    world, pairs = scenery(scene), _colliding(scene)
    poses, solids = world.with_fixed(poses), world.solids
    smaller = [ALLOWED * min(solids[i].width, solids[j].width) for i, j in pairs]
    # shapes overlap by no more than their bounding circles
    near = circles(solids, pairs, poses) > np.array(smaller)
    for pair, rows, depths in _depths(solids, pairs, poses, near):
        a, b, allowed = *(solids[i] for i in pairs[pair]), smaller[pair]
        deep = np.flatnonzero(depths > allowed)
        if len(deep):
            which, whose = f'bodies "{a.name}" and "{b.name}"', "the smaller one's"
            if b.name == WORLD:
                (x, y), (to_x, to_y) = b.core
                which = f'body "{a.name}" and the wall from ({x:g}, {y:g}) to ({to_x:g}, {to_y:g})'
                whose = "the body's"
            yield (
                int(rows[deep[0]]),
                f"{which} overlap by {depths[deep[0]]:.3g} m, allowed is {allowed:.3g} m (a quarter"
                f" of {whose} width); correct the poses, the shapes or the walls",
            )


@inner
def place_discs(still, discs):  # type: ignore[no-untyped-def]
    """Put the hidden discs (disc, 3) of a proposal among the obstacles."""
    for j in range(len(discs)):
        one, there = still.obstacles[len(still.obstacles) - len(discs) + j], discs[j, 2] > 0.0
        one[0] = one[2] = discs[j, 0] if there else 1e9 * still.length
        one[1], one[3], one[4] = discs[j, 1], discs[j, 1], discs[j, 2]


@inner
def segment(obstacle):  # type: ignore[no-untyped-def]
    """Return an obstacle's begin, its way to the end, one over the way's square, and its radius."""
    a_x, a_y, b_x, b_y, radius = obstacle
    d_x, d_y = b_x - a_x, b_y - a_y
    square = d_x * d_x + d_y * d_y
    return a_x, a_y, d_x, d_y, 1.0 / square if square > 0.0 else 0.0, radius


@inner
def reaches(x, y, d_x, d_y, scale, reach):  # type: ignore[no-untyped-def]
    """Return whether a place relative to a segment's begin is within ``reach`` of the segment."""
    t = (x * d_x + y * d_y) * scale
    t = 0.0 if t < 0.0 else t
    t = 1.0 if t > 1.0 else t
    x, y = x - t * d_x, y - t * d_y
    return x * x + y * y <= reach * reach


@compiled
def near_contact(state, radii, obstacles, can_touch):  # type: ignore[no-untyped-def]
    """Return whether a body may touch an obstacle, or another body.

    ``state`` has x and y of each body first; obstacles are segments with a radius, shape
    (obstacle, 5). Which bodies can touch each other, and obstacles (the diagonal), is (body, body).
    """
    for i in range(len(radii)):
        x, y = state[i, 0], state[i, 1]
        for j in range(len(obstacles) if can_touch[i, i] else 0):
            a_x, a_y, d_x, d_y, scale, radius = segment(obstacles[j])
            if reaches(x - a_x, y - a_y, d_x, d_y, scale, radii[i] + radius):
                return True
        for j in range(i):
            if can_touch[i, j]:
                reach = radii[i] + radii[j]
                if reaches(x - state[j, 0], y - state[j, 1], 0.0, 0.0, 0.0, reach):
                    return True
    return False
