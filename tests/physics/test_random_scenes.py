"""The plain and the compiled path agree on scenes that nobody thought of.

One to four bodies, mostly apart, with walls, a joint and effects at random: in some transitions
some bodies touch something, and others do not.
"""

import numpy as np
import pytest

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.physics import Physics, Simulator, build_layout
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.engines import proposals
from tests.helpers.plain import simulator_of
from tests.helpers.worlds import G

pytestmark = pytest.mark.one_stack

SHAPES = (
    Shape.box(0.4, 0.3),
    Shape.circle(0.2),
    Shape.polygon([(-0.2, -0.1), (0.2, -0.1), (0.0, 0.2)]),
)
#: Of a transition that friction decides by the last digits, at most this share.
KINKS = 0.02


def scene_and_effects(rng: np.random.Generator):
    """Bodies 3 m apart, from above or from the side, and what acts on them."""
    count, above = int(rng.integers(1, 5)), bool(rng.random() < 0.7)
    bodies = tuple(
        Body(
            f"b{i}", SHAPES[rng.integers(3)], wheel=above and bool(rng.random() < 0.4),
            pose=(3.0 * i, 0.0, 0.0),
        )
        for i in range(count)
    )  # fmt: skip
    kind = rng.random()
    joints: tuple[Joint, ...] = ()
    if kind < 0.25:
        joints = (Joint("hinge", ("b0", "world"), (0.1, 0.05), (0.1, 0.05)),)
    elif kind < 0.45 and count > 1:
        joints = (Joint("distance", ("b0", "b1"), (0.1, 0.0), (-0.1, 0.0)),)
    elif kind < 0.55:
        joints = (Joint("distance", ("world", f"b{count - 1}"), (0.3, 0.8), (0.0, 0.1)),)
    ends = rng.uniform((-4.0, -1.2), (12.0, 3.6), (int(rng.integers(0, 4)), 2, 2))
    scene = Scene(
        time_step=0.1, substeps=6, gravity=(0.0, 0.0) if above else (0.0, -G),
        normal_gravity=G if above else 0.0, bodies=bodies, joints=joints,
        walls=tuple(Wall(tuple(a), tuple(b)) for a, b in ends.tolist()),
    )  # fmt: skip
    usable = [e for e in catalogue if any(e.applies(scene, body) for body in bodies)]
    if joints:  # a start that is measured at a tenth of its size is far off the joint: chaos
        usable = [e for e in usable if e.name != "sensor_scale"]
    chosen = rng.choice(len(usable), size=int(rng.integers(0, 3)), replace=False)
    return scene, [usable[i] for i in chosen]


def agreement(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, effects = scene_and_effects(rng)
    attached = attach(scene, effects)
    layout = build_layout(scene, attached)
    phi, n, k = proposals(layout, 2), 40, len(scene.moving)
    start = rng.normal(0.0, (0.3, 0.3, 1.0, 1.5, 1.5, 1.0), (n, k, 6))
    start[..., 0] += 3.0 * np.arange(k)
    if scene.joints:  # as the joint has them, at rest
        start[..., :3], start[..., 3:] = [body.pose for body in scene.moving], 0.0
    inputs = np.zeros((n, 3, k, 9))
    inputs[..., :3] = rng.normal(0.0, (5.0, 5.0, 0.5), (n, 3, k, 3))
    inputs[:, 1:, :, 3:6] = inputs[:, :-1, :, :3]
    inputs[..., 6] = np.arange(n)[:, None, None]
    inputs[..., 7] = scene.time_step * np.arange(3)[:, None]
    inputs[..., 8] = inputs[..., 7] + scene.time_step
    # joined bodies, and bodies on friction, are the limit of the engine's steps: see test_tree
    under = {"sliding_friction", "wheel", "distance_joint"}
    limit = bool(scene.joints) or any(one.effect.name in under for one in attached)
    fast = "chipmunk" if limit else "auto"
    ours, plain = (
        simulator_of(Physics(scene, attached), path, extrapolate=False)(phi, start, inputs)
        for path in (fast, "python")
    )
    alone = Simulator(Physics(scene, attached, engine=fast, extrapolate=False))
    for i in range(0, n, 4):  # whatever came before
        np.testing.assert_array_equal(alone(phi[1], start[[i]], inputs[[i]])[0], ours[1, i])
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(plain))
    off = np.nanmax(np.abs(ours - plain) / (1.0 + np.abs(plain)), axis=(2, 3, 4))
    assert (off > 1e-6).mean() <= KINKS, (seed, scene, effects)


@pytest.mark.parametrize("seed", range(10))
def test_paths_agree(seed) -> None:
    agreement(seed)


@pytest.mark.long
def test_paths_agree_on_many() -> None:
    for seed in range(10, 150):
        agreement(seed)
