"""Helpers of the effects: bodies in hinges, and points of a body that scans try."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.errors import EffectError
from pbrl_ppl.scene import WORLD, Body, Joint, Scene
from pbrl_ppl.state import Floats

#: Points tried on a body, as shares of its half extent.
_POINTS = np.array([(0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7)])


def is_pivoted(scene: Scene, body: Body) -> bool:
    """Return whether the body hangs in a hinge: the hinge's friction acts on this body."""
    hinges = (joint for joint in scene.joints if joint.kind == "hinge" and joint.bodies)
    return any(hanging_body(scene, joint) == body.name for joint in hinges)


def is_unpivoted(scene: Scene, body: Body) -> bool:
    """Return whether the body hangs in no hinge; along a hinge's circle many forces look alike."""
    return not is_pivoted(scene, body)


def hanging_body(scene: Scene, joint: Joint) -> str:
    """Return the name of the body that hangs in a hinge: the farther from the world by hinges.

    Raises
    ------
    EffectError
        If it is not known which bodies the hinge joins.
    """
    if joint.bodies is None:
        raise EffectError("which bodies the hinge joins is to be inferred; none hangs in it yet")
    depth = {body.name: 0 for body in scene.bodies if body.static or body.kinematic} | {WORLD: 0}
    pairs = [hinge.bodies for hinge in scene.joints if hinge.kind == "hinge" and hinge.bodies]
    for _ in pairs:
        for pair in pairs:
            for near, far in (pair, pair[::-1]):
                if near in depth and far not in depth:
                    depth[far] = depth[near] + 1
    # of two bodies that nothing ties to the world, the second hangs on the first
    first, second = joint.bodies
    return first if depth.get(first, 0) > depth.get(second, 1) else second


def body_points(body: Body) -> Floats:
    """Return the middle of a body and a point towards each side, in its frame, shape (5, 2), m."""
    x_min, x_max, y_min, y_max = body.shape.bounds
    return np.asarray(0.5 * np.array([x_max - x_min, y_max - y_min]) * _POINTS)
