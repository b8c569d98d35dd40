"""Checks of start states: bodies that interpenetrate, joints whose anchors are apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.solids import Pairs, circles, depth, put, scenery
from pbrl_ppl.scene import WORLD, Joint, Scene

#: What is put down to noise and resting contact: a share of the smaller body's size.
ALLOWED = 0.25
_ORIGIN = (0.0, 0.0, 0.0)
_CHUNK = 2048  # transitions at a time, to spare memory


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
        Start states, shape (transition, body, 6), bodies in the order of ``scene.moving``:
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
    for begin in range(0, len(poses), _CHUNK):
        part = poses[begin : begin + _CHUNK]
        faults = [*_apart(scene, part), *_overlaps(scene, part)]
        if faults:
            first, message = min(faults, key=lambda fault: fault[0])
            i = begin + first
            raise SimulationError(f"{where(i) if where else f'transition {i}'}: {message}")


def check_history(scene: Scene, history: History, segments: Segments) -> None:
    """Refuse a history with start states that cannot be; see :func:`check_placement`.

    Parameters
    ----------
    scene : Scene
        Shapes, walls, static bodies and joints.
    history : History
        Gives the trajectories their names.
    segments : Segments
        Of the history.
    """
    names = history.dataset["trajectory"].values

    def where(i: int) -> str:
        return f"history trajectory {names[segments.trajectory[i]]}, step {segments.step[i]}"

    check_placement(scene, segments.start, where)


def overlap(scene: Scene, poses: Array) -> Array:
    """Penetration depth of the deepest two shapes (m), shape (n,).

    Negative where bodies are apart by so much at least, no more than their bounding circles are;
    pairs that a joint joins do not count.

    Parameters
    ----------
    scene : Scene
        Shapes, walls, static bodies and joints.
    poses : ndarray
        Shape (n, body, 3), bodies in the order of ``scene.moving``: x, y, theta (m, m, rad).
    """
    world, pairs = scenery(scene), _may_not(scene)
    poses = world.with_fixed(poses)
    deepest = np.full(len(poses), -np.inf)
    if not pairs:
        return deepest
    bound = circles(world.solids, pairs, poses)
    for pair, (i, j) in enumerate(pairs):
        rows = np.flatnonzero(bound[:, pair] > 0)
        own = bound[:, pair].copy()
        if len(rows):
            own[rows] = depth(world.solids[i], poses[rows, i], world.solids[j], poses[rows, j])
        deepest = np.maximum(deepest, own)
    return deepest


# -- joints ----------------------------------------------------------------------------------------


def _apart(scene: Scene, poses: Array) -> Iterator[tuple[int, str]]:
    """First transition and message of every known joint whose anchors are not where they must."""
    moving = {body.name: i for i, body in enumerate(scene.moving)}
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
        smaller = min(scene.body(n).shape.bounding_radius for n in joint.bodies if n in moving)
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
    a, b = (put(np.array([at]), pose) for at, pose in zip(anchors, poses, strict=True))
    return np.asarray(np.hypot(*np.moveaxis(a - b, -1, 0))[:, 0])


# -- shapes ----------------------------------------------------------------------------------------


def _may_not(scene: Scene) -> Pairs:
    """Pairs of solids that may not overlap."""
    pairs = scenery(scene).pairs
    if all(joint.bodies is not None for joint in scene.joints):
        return pairs
    # a joint of unknown bodies could join any two of the moving ones and the world
    first = len(scene.moving) + len(scene.walls)
    return tuple((i, j) for i, j in pairs if j >= first)


def _overlaps(scene: Scene, poses: Array) -> Iterator[tuple[int, str]]:
    """First transition and message of every two shapes that lie deep inside each other."""
    world, pairs = scenery(scene), _may_not(scene)
    if not pairs:
        return
    poses, solids = world.with_fixed(poses), world.solids
    smaller = [ALLOWED * min(solids[i].width, solids[j].width) for i, j in pairs]
    # shapes overlap by no more than the circles about them do
    near = circles(solids, pairs, poses) > np.array(smaller)
    for pair in np.flatnonzero(near.any(axis=0)):
        i, j = pairs[pair]
        a, b, allowed = solids[i], solids[j], smaller[pair]
        rows = np.flatnonzero(near[:, pair])
        found = depth(a, poses[rows, i], b, poses[rows, j])
        deep = np.flatnonzero(found > allowed)
        if len(deep):
            what, whose = f'bodies "{a.name}" and "{b.name}"', "the smaller one's"
            if b.name == WORLD:
                (x, y), (to_x, to_y) = b.core
                what = f'body "{a.name}" and the wall from ({x:g}, {y:g}) to ({to_x:g}, {to_y:g})'
                whose = "the body's"
            yield (
                int(rows[deep[0]]),
                f"{what} overlap by {found[deep[0]]:.3g} m, allowed is {allowed:.3g} m (a quarter"
                f" of {whose} width); correct the poses, the shapes or the walls",
            )
