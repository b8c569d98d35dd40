"""Hanging bodies: which body of a hinge has the hinge's friction."""

from __future__ import annotations

from pbrl_ppl.errors import EffectError
from pbrl_ppl.scene import WORLD, Body, Joint, Scene


def is_pivoted(scene: Scene, body: Body) -> bool:
    """Whether the body hangs in a hinge; the friction of a hinge belongs to the body that does."""
    return any(hanging_body(scene, joint) == body.name for joint in _hinges(scene))


def hangs_in_none(scene: Scene, body: Body) -> bool:
    """Whether the body goes where it will; along a hinge's circle, many pulls look the same."""
    return not is_pivoted(scene, body)


def _hinges(scene: Scene) -> list[Joint]:
    return [joint for joint in scene.joints if joint.kind == "hinge" and joint.bodies]


def hanging_body(scene: Scene, joint: Joint) -> str:
    """Name of the body that hangs in a hinge: the one farther from the world along the hinges.

    Raises
    ------
    EffectError
        If which bodies the hinge joins is not known.
    """
    if joint.bodies is None:
        raise EffectError("which bodies the hinge joins is to be inferred; none hangs in it yet")
    fixed = {WORLD, *(body.name for body in scene.bodies if body.static or body.kinematic)}
    depth = dict.fromkeys(fixed, 0)
    pairs = [hinge.bodies for hinge in _hinges(scene) if hinge.bodies]
    for _ in pairs:
        for pair in pairs:
            for near, far in (pair, pair[::-1]):
                if near in depth and far not in depth:
                    depth[far] = depth[near] + 1
    # of two bodies that nothing ties to the world, the second hangs on the first
    first, second = joint.bodies
    return first if depth.get(first, 0) > depth.get(second, 1) else second
