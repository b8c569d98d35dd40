"""Chains of joined bodies, and states that satisfy their joints."""

from collections.abc import Sequence

import numpy as np

from pbrl_ppl.effects import attach
from pbrl_ppl.physics import Physics, Simulator, build_layout
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, Shape
from tests.helpers.engines import BOX, proposals
from tests.helpers.worlds import BY_NAME, G

LINK = Shape.box(0.04, 0.3)
POST = Body("post", Shape.circle(0.02), static=True, pose=(2.0, 1.0, 0.4))


def chain(kinds: str, *, holder: str = WORLD, turned: Sequence[int] = (), **options) -> Scene:
    """Return links ``b0``, ``b1``, ... under each other, with joints of the given ``kinds``.

    ``h`` is a hinge, ``r`` a rod of 0.25 m and ``-`` nothing; the first is to the holder.
    ``turned`` are joints whose bodies are named the other way round.
    """
    names = [holder, *(f"b{i}" for i in range(len(kinds)))]
    bodies = tuple(Body(name, LINK, pose=(0.0, -0.55 * i, 0.0)) for i, name in enumerate(names[1:]))
    joints = []
    for i, kind in enumerate(kinds):
        ends = [(names[i], (0.02, -0.15) if i else (0.0, 0.4)), (names[i + 1], (-0.01, 0.15))]
        (a, anchor_a), (b, anchor_b) = ends[::-1] if i in turned else ends
        if kind != "-":
            joints.append(Joint("hinge" if kind == "h" else "distance", (a, b), anchor_a, anchor_b))
    bodies += (POST,) if holder == "post" else ()
    given = {"time_step": 0.05, "substeps": 10, "gravity": (0.3, -G)} | options
    return Scene(bodies=bodies, joints=tuple(joints), **given)


def cart_with_trailers(**options) -> Scene:
    """Return a wheeled cart that drags a wheeled trailer and, on a rod, a sledge."""
    bodies = (
        Body("cart", BOX, wheel=True, pose=(0.0, 0.0, 0.0)),
        Body("trailer", Shape.box(0.5, 0.4), wheel=True, pose=(-1.2, 0.0, 0.0)),
        Body("sledge", Shape.box(0.3, 0.3), pose=(-2.2, 0.0, 0.0)),
    )
    joints = (
        Joint("hinge", ("cart", "trailer"), (-0.6, 0.0), (0.6, 0.0)),
        Joint("distance", ("sledge", "trailer"), (0.2, 0.05), (-0.3, 0.0)),
    )
    given = {"time_step": 0.1, "normal_gravity": G} | options
    return Scene(bodies=bodies, joints=joints, **given)


def joined_states(scene: Scene, n: int, seed: int, turning: float = 3.0) -> np.ndarray:
    """Random states (n, body, 6) in which joints neither are apart nor part.

    Joints are taken in their order; a rod has the length and the direction of the reference poses.
    """
    rng = np.random.default_rng(seed)
    names = [body.name for body in scene.moving]
    states = rng.normal(0.0, 1.0, (n, len(names), 6))
    states[..., 2] = rng.uniform(-1.0, 1.0, (n, len(names)))
    states[..., 5] = rng.normal(0.0, turning, (n, len(names)))
    reference = {body.name: np.array(body.pose or (0, 0, 0.0)) for body in scene.bodies}
    reference[WORLD] = np.zeros(3)
    held = {WORLD, *(body.name for body in scene.bodies if body.static)}
    for joint in scene.joints:
        ends = list(zip(joint.bodies, (joint.anchor_a, joint.anchor_b), strict=True))
        if ends[1][0] in held and ends[0][0] not in held:
            ends.reverse()
        (near, near_at), (far, far_at) = ends
        apart = _point(reference[far], far_at) - _point(reference[near], near_at)
        body = states[:, names.index(far)]
        at, speed = _moving_point(_state_of(near, names, states, reference), near_at)
        own, turned = _moving_point(np.where(np.arange(6) % 3 == 2, body, 0.0), far_at)
        body[:, :2] = at + (apart if joint.kind == "distance" else 0.0) - own
        body[:, 3:5] = speed - turned
        held |= {near, far}
    return states


def _state_of(name, names, states, reference) -> np.ndarray:
    if name in names:
        return states[:, names.index(name)]
    return np.broadcast_to(np.concatenate([reference[name], np.zeros(3)]), (len(states), 6))


def _point(pose, anchor) -> np.ndarray:
    return _moving_point(np.concatenate([pose, np.zeros(3)])[None], anchor)[0][0]


def _moving_point(states, anchor) -> tuple[np.ndarray, np.ndarray]:
    """Place and velocity (n, 2) of a body's point."""
    c, s = np.cos(states[:, 2]), np.sin(states[:, 2])
    x, y = c * anchor[0] - s * anchor[1], s * anchor[0] + c * anchor[1]
    turn = states[:, 5:] * np.stack([-y, x], axis=-1)
    return states[:, :2] + np.stack([x, y], axis=-1), states[:, 3:5] + turn


def case(
    scene: Scene, effects: Sequence[str], seed: int, n: int = 8, horizon: int = 2
) -> tuple[Simulator, np.ndarray, np.ndarray, np.ndarray]:
    """A simulator, parameters (3, p), starts and all inputs (n, H, body, 9)."""
    attached = attach(scene, [BY_NAME[name] for name in effects])
    layout = build_layout(scene, attached)
    phi = proposals(layout, 3)
    rng = np.random.default_rng(seed)
    for i, label in enumerate(layout.labels):
        if label.startswith("com_offset"):
            phi[:, i] = rng.normal(0.0, 0.05, 3)
        elif label.startswith("mass_change_t"):  # a trajectory, and when in it
            phi[:, i] = rng.uniform(0.5, 1.5, 3) if "trajectory" in label else 0.06
    start = joined_states(scene, n, seed)
    actions = rng.normal(0, 1.0, (n, horizon, len(scene.moving), 3)) * (2.0, 2.0, 0.1)
    inputs = np.concatenate([actions, 0.5 * actions, np.zeros_like(actions)], axis=-1)
    inputs[..., 6] = np.arange(n)[:, None, None] % 3  # the trajectory, and when it begins and ends
    inputs[..., 7:] = scene.time_step * (np.arange(horizon)[:, None, None] + np.arange(2))
    return Simulator(Physics(scene, attached)), phi, start, inputs
