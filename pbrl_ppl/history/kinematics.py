"""Kinematics of a history: angles, noise, recorded paths, joints, and complete initial states."""

from collections.abc import Iterable
from itertools import product
from math import comb

import numpy as np
from scipy.signal import savgol_filter

from pbrl_ppl.scene import WORLD, Joint, Point, Scene
from pbrl_ppl.state import THETA, Bools, Floats, wrapped

#: Standard deviation of a Gaussian over the median of its absolute values.
GAUSSIAN = 1.4826
#: Rows on either side that an estimated velocity depends on.
RATE_REACH = 2


def unwrapped(time: Floats, angle: Floats, rate: Floats) -> Floats:
    """Return angles without jumps of a turn; measured rates tell the turns between two rows.

    Parameters
    ----------
    time, angle, rate : ndarray
        Shape (n,): s, rad, rad/s. Rates that are not all finite are not used.

    Examples
    --------
    >>> time = np.arange(4.0)
    >>> unwrapped(time, np.array([0.0, 1.0, 2.0, 3.0]), np.full(4, 7.0)).round(3)
    array([ 0.   ,  7.283, 14.566, 21.85 ])
    """
    if not np.isfinite(rate).all():
        return np.asarray(np.unwrap(angle))
    turned = np.append(0.0, np.cumsum(0.5 * np.diff(time) * (rate[1:] + rate[:-1])))
    return np.asarray(np.unwrap(angle - turned) + turned)


def column_noise(
    series: Iterable[Floats], order: int = 3, *, robust: bool = False, angle: bool = False
) -> float:
    """Return the standard deviation of the noise of a column, from differences of its rows.

    Differences of a smooth motion vanish with their order; those of white noise have ``comb(2
    order, order)`` times its variance.

    Parameters
    ----------
    series : iterable of ndarray
        Values of each trajectory at even times, shape (time,), NaN where missing.
    order : int
        Of the differences: the higher, the faster a motion may be.
    robust : bool
        Whether the median tells the size rather than the mean square, so that impacts do not count.
    angle : bool
        Whether the column wraps (rad).

    Returns
    -------
    float
        In the column's unit; 0 where there are no differences.

    Examples
    --------
    >>> rng, t = np.random.default_rng(1), 0.01 * np.arange(4000)
    >>> round(column_noise([np.sin(t) + rng.normal(0.0, 0.002, 4000)]), 4)
    0.002
    """
    changes = [np.diff(values) for values in series]
    if angle:
        changes = [wrapped(change) for change in changes]
    change = np.concatenate([np.zeros(0), *(np.diff(one, order - 1) for one in changes)])
    change = np.abs(change[np.isfinite(change)])
    if not len(change):
        return 0.0
    size = GAUSSIAN * np.median(change) if robust else np.sqrt(np.mean(change**2))
    return float(size / np.sqrt(comb(2 * order, order)))


def finest_step(column: Floats, *, rounding: float = 1e-9) -> float:
    """Return the finest step between a column's values: its quantisation, or rounding.

    Parameters
    ----------
    column : ndarray
        Any shape, NaN where missing.
    rounding : float
        Of numbers, as a share of the column's largest value or range.

    Returns
    -------
    float
        Infinite where fewer than two values differ.
    """
    values = np.unique(column[np.isfinite(column)])
    if len(values) < 2:
        return np.inf
    least = rounding * float(max(np.abs(values).max(), values[-1] - values[0]))
    steps = np.diff(values)
    return float(steps[steps > least].min()) if (steps > least).any() else least


def kinematic_bodies(scene: Scene) -> Bools:
    """Return which of the moving bodies are kinematic, shape (body,)."""
    return np.array([body.kinematic for body in scene.moving], dtype=bool)


def path_velocities(poses: Floats, time_step: float) -> Floats:
    """Return the constant velocities that lead from each pose to the next.

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


def complete_start(state: Floats, scene: Scene) -> tuple[Floats, Bools]:
    """Return states completed for a simulation to start from, and their columns without data.

    Measured values are kept. Hinges, sliders and paths give what follows from them; a position that
    was never measured is that of the scene; velocities that were never measured are estimated.

    Parameters
    ----------
    state : (trajectory, time, body, 6) array
        Measured states, NaN where missing (m, m, rad, m/s, m/s, rad/s).
    scene : Scene
        Its known hinges give positions and velocities from angles, its known sliders from one
        position; its kinematic bodies' positions give their velocities.

    Returns
    -------
    start : (trajectory, time, body, 6) array
        NaN in rows without the measurements that other rows have.
    assumed : (body, 6) array of bool
        Columns that are estimated, or as in the scene.
    """
    start = state.copy()
    follows = kinematic_bodies(scene)
    path = start[:, :, follows]
    rate = path_velocities(path[..., :3], scene.time_step)
    # the velocity of the interval that begins there, of a last row the one that ends
    ahead = np.concatenate([rate, rate[:, -1:]], axis=1)
    behind = np.concatenate([rate[:, :1], rate], axis=1)
    start[:, :, follows, 3:] = _filled(path[..., 3:], _filled(ahead, behind))
    fill_joints(start, scene)
    assumed: Bools = np.asarray(np.isnan(start).all(axis=(0, 1)))
    given = joint_coordinates(scene)
    for i, body in enumerate(scene.moving):
        pose = body.pose or (0.0, 0.0, 0.0)
        for d in np.flatnonzero(assumed[i, :3]):
            if d in (THETA, given.get(body.name, d)):
                start[:, :, i, d] = pose[d]
    # The angular velocity first: hinges turn it into velocities.
    for columns in ((5,), (3, 4)):
        estimate_rates(start, scene.time_step, columns)
        fill_joints(start, scene)
    return start, assumed


def _filled(values: Floats, others: Floats) -> Floats:
    return np.where(np.isnan(values), others, values)


def fill_joints(start: Floats, scene: Scene) -> None:
    """Fill missing coordinates of bodies in hinges and sliders in place, from the world on.

    In a hinge positions and their velocities follow from angles, and angles from positions. In a
    slider the angle follows from the other body's, and positions from one of them.
    """
    position = {body.name: i for i, body in enumerate(scene.moving)}
    for parent, child, at_parent, at_child, joint in joint_order(scene):
        if child not in position:
            continue
        if parent in position:
            origin = start[:, :, position[parent]]
        else:
            pose = (0.0, 0.0, 0.0) if parent == WORLD else scene.body(parent).pose or ()
            origin = np.broadcast_to(np.array([*pose, 0.0, 0.0, 0.0]), (*start.shape[:2], 6))
        body = start[:, :, position[child]]
        arm, arm_rate = lever(origin, at_parent)
        if joint.traits.slides:
            turn = scene.reference_angle(child) - scene.reference_angle(parent)
            body[..., 2] = _filled(body[..., 2], origin[..., 2] + turn)
            body[..., 5] = _filled(body[..., 5], origin[..., 5])
            child_arm, child_rate = lever(body, at_child)
            angle = origin[..., 2] + scene.direction(joint) - scene.reference_angle(parent)
            along = np.stack([np.cos(angle), np.sin(angle)], -1)
            across = np.stack([-along[..., 1], along[..., 0]], -1) * origin[..., 5:6]
            base = origin[..., :2] + arm - child_arm
            way = _along(body[..., :2] - base, along)
            body[..., :2] = _filled(body[..., :2], base + way * along)
            base = origin[..., 3:5] + arm_rate - child_rate + way * across
            rate = _along(body[..., 3:5] - base, along)
            body[..., 3:5] = _filled(body[..., 3:5], base + rate * along)
            continue
        if np.any(at_child) and np.isnan(body[..., 2]).all():  # angles from places, then exact ones
            to = body[..., :2] - origin[..., :2] - arm
            turned = np.arctan2(to[..., 1], to[..., 0]) - np.arctan2(-at_child[1], -at_child[0])
            body[..., 2] = wrapped(turned)
            body[..., :2] = np.where(np.isfinite(turned)[..., None], np.nan, body[..., :2])
        child_arm, child_rate = lever(body, at_child)
        body[..., :2] = _filled(body[..., :2], origin[..., :2] + arm - child_arm)
        body[..., 3:5] = _filled(body[..., 3:5], origin[..., 3:5] + arm_rate - child_rate)


def _along(way: Floats, direction: Floats) -> Floats:
    """Return how far ways (..., 2) with missing coordinates lead along unit vectors, (..., 1)."""
    seen = np.where(np.isfinite(way), direction, 0.0)
    square = (seen**2).sum(axis=-1, keepdims=True)
    along = (np.nan_to_num(way) * seen).sum(axis=-1, keepdims=True)
    return np.asarray(np.where(square > 1e-12, along / np.maximum(square, 1e-12), np.nan))


def joint_coordinates(scene: Scene) -> dict[str, int]:
    """Return the dynamic bodies that hinges and sliders tie to the world, with a column of each.

    All else of a body's pose follows from that column: the angle in a hinge, x or y, which changes
    more, in a slider. A slider on what turns has none.
    """
    moving = [body.name for body in scene.dynamic]
    reached = {WORLD, *(body.name for body in scene.bodies if body.static)}
    columns: dict[str, int] = {}
    for parent, child, _, _, joint in joint_order(scene):
        slides = joint.traits.slides
        if parent not in reached or child not in moving or child in reached:
            continue
        if slides and columns.get(parent) == THETA:
            continue
        angle = scene.direction(joint) if slides else 0.0
        columns[child] = int(abs(np.sin(angle)) > abs(np.cos(angle))) if slides else THETA
        reached.add(child)
    return columns


def hung_bodies(scene: Scene) -> list[str]:
    """Return the dynamic bodies that hinges tie to the world: positions follow from angles."""
    return [name for name, column in joint_coordinates(scene).items() if column == THETA]


def lever(state: Floats, anchor: Point) -> tuple[Floats, Floats]:
    """Return an anchor's offset from its body's origin in the world, and that offset's rate."""
    cos, sin = np.cos(state[..., 2]), np.sin(state[..., 2])
    x, y = cos * anchor[0] - sin * anchor[1], sin * anchor[0] + cos * anchor[1]
    return np.stack([x, y], -1), np.stack([-y, x], -1) * state[..., 5:6]


def joint_order(scene: Scene) -> list[tuple[str, str, Point, Point, Joint]]:
    """Return known hinges and sliders as (parent, child, anchors, joint), from static bodies on."""
    edges = []
    for joint in scene.joints:
        if joint.traits.hangs and joint.known and joint.bodies:
            a, b = joint.bodies
            at_a, at_b = joint.anchor_a or (0.0, 0.0), joint.anchor_b or (0.0, 0.0)
            edges += [(a, b, at_a, at_b, joint), (b, a, at_b, at_a, joint)]
    reached, order = [WORLD, *(body.name for body in scene.bodies if body.static)], []
    for parent in reached:  # the list grows while it is walked: that is the breadth-first queue
        for edge in edges:
            if edge[0] == parent and edge[1] not in reached:
                order.append(edge)
                reached.append(edge[1])
    # Then chains from a body whose position was measured.
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
    for body, column in product(range(start.shape[2]), columns):
        if np.isnan(start[:, :, body, column]).all():
            for states in start[:, :, body]:
                states[:, column] = _derivative(states[:, column - 3], dt, angle=column == 5)


def _derivative(values: Floats, dt: float, *, angle: bool) -> Floats:
    """Return the rate of a series where it is finite; NaN elsewhere."""
    rate = np.full(values.shape, np.nan)
    finite = np.flatnonzero(np.isfinite(values))
    level = np.unwrap(values[finite]) if angle else values[finite]
    rate[finite] = np.gradient(level, dt * finite) if len(finite) > 1 else 0.0
    for run in np.split(np.arange(len(finite)), np.flatnonzero(np.diff(finite) > 1) + 1):
        if len(run) > 2:
            # An even window would give the rate between samples.
            window = min(2 * RATE_REACH + 1, len(run) - 1 + len(run) % 2)
            rate[finite[run]] = savgol_filter(level[run], window, 2, deriv=1, delta=dt)
    return rate
