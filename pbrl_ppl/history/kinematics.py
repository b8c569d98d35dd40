"""Kinematics of a history: angles, recorded paths, hinges, and complete start states."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.signal import savgol_filter

from pbrl_ppl.scene import WORLD, Point, Scene
from pbrl_ppl.state import THETA, wrapped

Floats = npt.NDArray[np.float64]


def unwrapped(time: Floats, angle: Floats, rate: Floats) -> Floats:
    """Angles without jumps; measured rates say how often a body has turned round meanwhile.

    Parameters
    ----------
    time, angle, rate : ndarray
        Shape (n,): s, rad, rad/s. A rate that is not known everywhere is not used.

    Examples
    --------
    >>> time = np.arange(4.0)
    >>> unwrapped(time, np.array([0.0, 1.0, 2.0, 3.0]), np.full(4, 7.0)).round(3)
    array([ 0.   ,  7.283, 14.566, 21.85 ])
    """
    if not np.isfinite(rate).all():
        return np.asarray(np.unwrap(angle))
    turned = np.cumsum(0.5 * np.diff(time) * (rate[1:] + rate[:-1]))
    turned = np.concatenate([np.zeros(1), turned])
    return np.asarray(np.unwrap(angle - turned) + turned)


Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def kinematic_bodies(scene: Scene) -> Bools:
    """Which of the moving bodies are kinematic, shape (body,)."""
    return np.array([body.kinematic for body in scene.moving], dtype=bool)


def path_velocities(poses: Floats, time_step: float) -> Floats:
    """Constant velocities that lead from each pose to the next.

    Parameters
    ----------
    poses : ndarray
        Shape (..., time, body, 3): x, y, theta (m, m, rad).
    time_step : float
        Between poses (s).

    Returns
    -------
    ndarray
        Shape (..., time - 1, body, 3): m/s, m/s, rad/s, the shorter way round.
    """
    change = np.diff(poses, axis=-3)
    change[..., 2] = wrapped(change[..., 2])
    return np.asarray(change / time_step)


def fill_path_velocities(state: Floats, scene: Scene) -> None:
    """Fill missing velocities of kinematic bodies in place, by differences of their positions.

    Parameters
    ----------
    state : ndarray
        Shape (trajectory, time, body, 6); changed.
    scene : Scene
        Says which bodies are kinematic.
    """
    follows = kinematic_bodies(scene)
    if not follows.any():
        return
    path = state[:, :, follows]
    rate = path_velocities(path[..., :3], scene.time_step)
    # the velocity of the interval that begins there, of a last row the one that ends
    ahead = np.concatenate([rate, rate[:, -1:]], axis=1)
    behind = np.concatenate([rate[:, :1], rate], axis=1)
    filled = np.where(np.isnan(ahead), behind, ahead)
    path[..., 3:] = np.where(np.isnan(path[..., 3:]), filled, path[..., 3:])
    state[:, :, follows] = path


Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def complete_start(state: Floats, scene: Scene) -> tuple[Floats, Bools]:
    """Return the states completed, and which columns of them rest on no measurement.

    Measured cells are kept. Hinges and paths give what follows from them; a position that was never
    measured is that of the scene; velocities that were never measured are estimated from positions.

    Parameters
    ----------
    state : (trajectory, time, body, 6) array
        Measured states, NaN where missing (m, m, rad, m/s, m/s, rad/s).
    scene : Scene
        Its known hinges give positions and velocities from angles; its kinematic bodies' positions
        give their velocities.

    Returns
    -------
    start : (trajectory, time, body, 6) array
        NaN in rows that do not have what others have.
    assumed : (body, 6) array of bool
        Columns that are estimated, or as in the scene.
    """
    start = state.copy()
    fill_path_velocities(start, scene)
    fill_hinges(start, scene)
    assumed: Bools = np.asarray(np.isnan(start).all(axis=(0, 1)))
    hung = np.array([body.name in hung_bodies(scene) for body in scene.moving])
    for i, body in enumerate(scene.moving):
        pose = body.pose or (0.0, 0.0, 0.0)
        for d in np.flatnonzero(assumed[i, :3]):
            if d == THETA or not hung[i]:
                start[:, :, i, d] = pose[d]
    # The angular velocity first: hinges turn it into velocities.
    estimate_rates(start, scene.time_step, (5,))
    fill_hinges(start, scene)
    estimate_rates(start, scene.time_step)
    fill_hinges(start, scene)
    return start, assumed


def fill_hinges(start: Floats, scene: Scene) -> None:
    """Fill missing x, y, vx, vy of hinged bodies in place, breadth first from the world."""
    position = {body.name: i for i, body in enumerate(scene.moving)}
    for parent, child, at_parent, at_child in _hinge_order(scene):
        if child not in position:
            continue
        if parent in position:
            origin = start[:, :, position[parent]]
        else:
            pose = (0.0, 0.0, 0.0) if parent == WORLD else scene.body(parent).pose
            origin = np.broadcast_to(
                np.array([*(pose or ()), 0.0, 0.0, 0.0]), (*start.shape[:2], 6)
            )
        body = start[:, :, position[child]]
        arm, arm_rate = lever(origin, at_parent)
        own, own_rate = lever(body, at_child)
        place = origin[..., :2] + arm - own
        speed = origin[..., 3:5] + arm_rate - own_rate
        for columns, filled in ((slice(0, 2), place), (slice(3, 5), speed)):
            body[..., columns] = np.where(np.isnan(body[..., columns]), filled, body[..., columns])


def hung_bodies(scene: Scene) -> list[str]:
    """Names of the moving bodies whose place follows from angles: hinges tie them to the world."""
    moving = [body.name for body in scene.dynamic]
    reached = {WORLD, *(body.name for body in scene.bodies if body.static)}
    hung = []
    for parent, child, *_ in _hinge_order(scene):
        if parent in reached and child in moving and child not in reached:
            reached.add(child)
            hung.append(child)
    return hung


def lever(state: Floats, anchor: Point) -> tuple[Floats, Floats]:
    """Return an anchor's offset from its body's origin in the world, and that offset's rate."""
    cos, sin = np.cos(state[..., 2]), np.sin(state[..., 2])
    x = cos * anchor[0] - sin * anchor[1]
    y = sin * anchor[0] + cos * anchor[1]
    return np.stack([x, y], -1), np.stack([-y, x], -1) * state[..., 5:6]


def _hinge_order(scene: Scene) -> list[tuple[str, str, Point, Point]]:
    """Return known hinges as (parent, child, anchors), breadth first from what is fixed."""
    edges = []
    for joint in scene.joints:
        if joint.kind == "hinge" and joint.known and joint.bodies:
            a, b = joint.bodies
            at_a, at_b = joint.anchor_a or (0.0, 0.0), joint.anchor_b or (0.0, 0.0)
            edges += [(a, b, at_a, at_b), (b, a, at_b, at_a)]
    fixed = [WORLD, *(body.name for body in scene.bodies if body.static)]
    reached, order = list(fixed), []
    for parent in reached:  # the list grows while it is walked: that is the breadth-first queue
        for edge in edges:
            if edge[0] == parent and edge[1] not in reached:
                order.append(edge)
                reached.append(edge[1])
    # Then chains that hang on a body whose position was measured.
    return order + [edge for _ in scene.bodies for edge in edges]


def estimate_rates(start: Floats, dt: float, columns: tuple[int, ...] = (3, 4, 5)) -> None:
    """Fill velocities that no row has, by a local polynomial of the positions, in place.

    Parameters
    ----------
    start : ndarray
        States, shape (trajectory, time, body, 6), SI units; changed.
    dt : float
        Time step (s).
    columns : tuple of int
        Velocities to fill.
    """
    for body in range(start.shape[2]):
        for column in columns:
            if not np.isnan(start[:, :, body, column]).all():
                continue
            for trajectory in range(start.shape[0]):
                values = start[trajectory, :, body, column - 3]
                start[trajectory, :, body, column] = _derivative(values, dt, angle=column == 5)


def _derivative(values: Floats, dt: float, *, angle: bool) -> Floats:
    """Return the rate of a series where it is finite; NaN elsewhere."""
    rate = np.full(values.shape, np.nan)
    finite = np.flatnonzero(np.isfinite(values))
    if len(finite) < 2:
        rate[finite] = 0.0
        return rate
    level = np.unwrap(values[finite]) if angle else values[finite]
    rate[finite] = np.gradient(level, dt * finite)
    for run in np.split(np.arange(len(finite)), np.flatnonzero(np.diff(finite) > 1) + 1):
        if len(run) > 2:
            # An even window would give the rate between samples.
            window = 5 if len(run) >= 5 else 3
            rate[finite[run]] = savgol_filter(level[run], window, 2, deriv=1, delta=dt)
    return rate
