"""Contact of moving bodies within an interval, from their states at its ends."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.solids import Solid, depth_of, solid_of, to_segment
from pbrl_ppl.scene import WORLD, Scene
from pbrl_ppl.state import STATE

#: Places looked at on the ways.
_LOOKS = 5
#: Outlines are known to about this share of a body's width (engines round corners by as much), and
#: what moves is at most this share of its way from one of the looks.
_OUTLINE, _SHARE = 0.05, 0.5 / (_LOOKS - 1)


def touching(scene: Scene, begin: Array, end: Array) -> NDArray[np.bool_]:
    """Whether a body touches another within an interval, or comes so near that it may.

    Parameters
    ----------
    scene : Scene
        Shapes, walls and static bodies; what a joint joins does not collide, and a body that
        follows a path is no matter.
    begin, end : ndarray
        States, shape (transition, body, 6), SI units.

    Returns
    -------
    ndarray of bool
        Shape (transition,).
    """
    solids, fixed = _solids(scene)
    still = np.broadcast_to(fixed, (len(begin), *fixed.shape))
    begin, end = (np.concatenate([states, still], axis=1) for states in (begin, end))
    touched = np.zeros(len(begin), dtype=bool)
    for i, j in _pairs(scene, len(solids)):
        touched |= _meet(solids[i], solids[j], begin[:, (i, j)], end[:, (i, j)], scene.time_step)
    return touched


def _solids(scene: Scene) -> tuple[list[Solid], Array]:
    """Moving bodies, then walls and static bodies, with the states (fixed, 6) of these."""
    static = [body for body in scene.bodies if body.static]
    walls = [np.array([wall.start, wall.end]) for wall in scene.walls]
    solids = [solid_of(body) for body in scene.moving]
    solids += [Solid(WORLD, ((wall, 0.0),), wall, 0.0, np.inf) for wall in walls]
    solids += [solid_of(body) for body in static]
    states = np.zeros((len(walls) + len(static), len(STATE)))
    for state, body in zip(states[len(walls) :], static, strict=True):
        state[:3] = body.pose or (0.0, 0.0, 0.0)
    return solids, states


def _pairs(scene: Scene, n: int) -> list[tuple[int, int]]:
    """Pairs of solids, of which a force moves the first, that nothing joins."""
    bodies = [*scene.moving, *(None for _ in scene.walls), *(b for b in scene.bodies if b.static)]
    names = [WORLD if body is None else body.name for body in bodies]
    joined = [set(joint.bodies) for joint in scene.joints if joint.bodies is not None]
    led = [body is not None and body.kinematic for body in bodies]
    return [
        (i, j)
        for i, j in combinations(range(n), 2)
        if i < len(scene.moving) and not (led[i] or led[j]) and {names[i], names[j]} not in joined
    ]


def _meet(a: Solid, b: Solid, begin: Array, end: Array, dt: float) -> NDArray[np.bool_]:
    """Whether two solids touch on their way on from, or back from, states (transition, 2, 6).

    Where they did, one of the ways that they would have gone by themselves leads through.
    """
    outline = _OUTLINE * min(a.width, b.width)
    touched = np.zeros(len(begin), dtype=bool)
    for state, way in ((begin, dt), (end, -dt)):
        rate = state[:, 0, 3:5] - state[:, 1, 3:5]
        reach = outline + dt * _SHARE * np.hypot(rate[:, 0], rate[:, 1])
        gap = reach + dt * _SHARE * np.abs(state[..., 5]) @ np.array([a.reach, b.reach])
        for share in np.linspace(0.0, 1.0, _LOOKS):
            at = state[..., :3] + share * way * state[..., 3:]
            # circles about a body bound how near it is, however fast it turns
            near = np.flatnonzero(_between(a, b, at) < reach)
            for p, q in product(a.parts, b.parts):
                touched[near] |= depth_of(p, at[near, 0], q, at[near, 1]) > -gap[near]
    return touched


def _between(a: Solid, b: Solid, poses: Array) -> Array:
    """Distance of the circles about two solids, or of one's and a wall, shape (transition,)."""
    arm = poses[:, 0, :2] - poses[:, 1, :2] - b.core[0]
    return to_segment(arm, b.core[1] - b.core[0]) - a.reach - b.reach
