"""Contact of moving bodies within an interval, from where they are at its ends."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.properties import Array
from pbrl_ppl.physics.solids import depth_of, solid_of
from pbrl_ppl.scene import Scene

#: Places looked at between the ends of an interval.
_LOOKS = 5
#: Outlines are known to about this share of a body's width (engines round corners by as much), and
#: what moves between two looks is at most this share of how far it goes.
_OUTLINE, _SHARE = 0.05, 0.25


def touching(scene: Scene, begin: Array, end: Array) -> NDArray[np.bool_]:
    """Whether two bodies that forces move touch within an interval, or come so near that they may.

    Parameters
    ----------
    scene : Scene
        Shapes; bodies that a joint joins do not collide.
    begin, end : ndarray
        States, shape (transition, body, 6), SI units.

    Returns
    -------
    ndarray of bool
        Shape (transition,).
    """
    touched = np.zeros(len(begin), dtype=bool)
    for i, j in pairs(scene):
        a, b = (solid_of(scene.moving[place]) for place in (i, j))
        moved = end[:, (i, j), :3] - begin[:, (i, j), :3]
        shift = moved[:, 0, :2] - moved[:, 1, :2]
        reach = np.array([scene.moving[place].shape.bounding_radius for place in (i, j)])
        outline = _OUTLINE * min(a.width, b.width)
        way = np.hypot(shift[:, 0], shift[:, 1])
        gap = outline + _SHARE * (way + np.abs(moved[:, :, 2]) @ reach)
        apart = begin[:, i, :2] - begin[:, j, :2]
        far = np.hypot(apart[:, 0], apart[:, 1]) - way
        near = np.flatnonzero(far < reach.sum() + outline)
        for share in np.linspace(0.0, 1.0, _LOOKS):
            at = begin[near][:, (i, j), :3] + share * moved[near]
            # the circles about them bound how near they are, however fast they turn
            between = at[:, 0, :2] - at[:, 1, :2]
            close = np.hypot(between[:, 0], between[:, 1]) < reach.sum() + outline
            for p, q in product(a.parts, b.parts):
                touched[near] |= close & (depth_of(p, at[:, 0], q, at[:, 1]) > -gap[near])
    return touched


def pairs(scene: Scene) -> list[tuple[int, int]]:
    """Pairs of bodies that forces move and that nothing joins, by their places."""
    free = [i for i, body in enumerate(scene.moving) if not body.kinematic]
    names = [body.name for body in scene.moving]
    joined = [set(joint.bodies) for joint in scene.joints if joint.bodies is not None]
    return [(i, j) for i, j in combinations(free, 2) if {names[i], names[j]} not in joined]
