"""Checks of initial states: interpenetrating bodies, and joints whose anchors are apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.physics.joints import JOINT_KINDS
from pbrl_ppl.physics.solids import Pairs, circles, depth, put, scenery
from pbrl_ppl.scene import WORLD, Joint, Scene
from pbrl_ppl.state import Floats, wrapped

#: Violation that noise and resting contact may explain, as a share of the smaller body's size.
ALLOWED = 0.25
_ORIGIN = (0.0, 0.0, 0.0)


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
    deepest = np.full(len(poses), -np.inf)
    if not pairs:
        return deepest
    bound = circles(world.solids, pairs, poses)
    for pair, (i, j) in enumerate(pairs):
        rows = np.flatnonzero(bound[:, pair] > 0)
        deep = bound[:, pair].copy()
        if len(rows):
            deep[rows] = depth(world.solids[i], poses[rows, i], world.solids[j], poses[rows, j])
        deepest = np.maximum(deepest, deep)
    return deepest


def _apart(scene: Scene, poses: Floats) -> Iterator[tuple[int, str]]:
    """Yield the first transition and a message for each known joint with wrong anchors."""
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
    if not pairs:
        return
    poses, solids = world.with_fixed(poses), world.solids
    smaller = [ALLOWED * min(solids[i].width, solids[j].width) for i, j in pairs]
    # shapes overlap by no more than their bounding circles
    near = circles(solids, pairs, poses) > np.array(smaller)
    for pair in np.flatnonzero(near.any(axis=0)):
        i, j = pairs[pair]
        a, b, allowed = solids[i], solids[j], smaller[pair]
        rows = np.flatnonzero(near[:, pair])
        depths = depth(a, poses[rows, i], b, poses[rows, j])
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
