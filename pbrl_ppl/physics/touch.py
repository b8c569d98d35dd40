"""Contact of moving bodies within an interval, from their states at its ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.solids import Pairs, Scenery, Solid, circles, depth, scenery
from pbrl_ppl.scene import Scene

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
    world = scenery(scene)
    begin, end = world.with_fixed(begin), world.with_fixed(end)
    led = {i for i, body in enumerate(scene.moving) if body.kinematic}
    touched = np.zeros(len(begin), dtype=bool)
    pairs = tuple(pair for pair in world.pairs if led.isdisjoint(pair))
    if not pairs:
        return touched
    near = _near(world, pairs, begin, scene.time_step) | _near(world, pairs, end, scene.time_step)
    for p in np.flatnonzero(near.any(axis=0)):
        (i, j), rows = pairs[p], np.flatnonzero(near[:, p])
        first, last = begin[rows][:, (i, j)], end[rows][:, (i, j)]
        touched[rows] |= _meet(world.solids[i], world.solids[j], first, last, scene.time_step)
    return touched


def _near(world: Scenery, pairs: Pairs, states: Array, dt: float) -> NDArray[np.bool_]:
    """Pairs whose bounding circles may meet within an interval of states, shape (n, pair)."""
    i, j = np.array(pairs).T
    width = np.array([solid.width for solid in world.solids])
    rate = states[:, i, 3:5] - states[:, j, 3:5]
    way = dt * (1.0 + _SHARE) * np.hypot(rate[..., 0], rate[..., 1])
    way += _OUTLINE * np.minimum(width[i], width[j])
    return np.asarray(circles(world.solids, pairs, states) > -way)


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
        looks = np.linspace(0.0, 1.0, _LOOKS if state[..., 3:].any() else 1)  # at rest, one will do
        for share in looks:
            at = state[..., :3] + share * way * state[..., 3:]
            # circles about a body bound how near it is, however fast it turns
            near = np.flatnonzero(circles((a, b), ((0, 1),), at)[:, 0] > -reach)
            if len(near):
                touched[near] |= depth(a, at[near, 0], b, at[near, 1]) > -gap[near]
    return touched
