"""The contact-free fast path of single bodies agrees with the engine."""

import numpy as np
import pytest

from pbrl_ppl.effects import attach
from pbrl_ppl.physics import Physics, Simulator, build_layout, compiled, lockstep
from pbrl_ppl.physics.tree import tree_of
from pbrl_ppl.physics.world import HINGE, ROD, World
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.engines import BOX, proposals
from tests.helpers.plain import PlainSimulator, simulator_of
from tests.helpers.worlds import G

pytestmark = pytest.mark.one_stack

PATHS = ("auto", "python")
POST = Body("post", Shape.circle(0.05), static=True, pose=(3.0, -2.0, 0.7))


def cart(*effects: str, walls: bool = False) -> Scene:
    around = (Wall((-1.0, -9.0), (-1.0, 9.0)), Wall((-9, 2), (9, 2)))
    box = Body("box", BOX, wheel="wheel" not in effects, effects=effects)
    return Scene(time_step=0.1, normal_gravity=G, bodies=(box,), walls=around if walls else ())


SCENES = {
    "free": cart("wheel").with_effects("box"),
    "wheel": cart(),
    "walls": cart(walls=True),
    "payload": cart("mass_change", "actuator_delay"),
    "disc": cart("hidden_obstacle"),
    "sensor": cart("sensor_scale"),
}


def case(name: str, **options) -> tuple[Simulator, np.ndarray, np.ndarray, np.ndarray]:
    """A simulator, parameters, starts and inputs of a scene."""
    scene = SCENES[name]
    attached = attach(scene)
    layout = build_layout(scene, attached)
    phi = proposals(layout, 3)
    labels = list(layout.labels)
    for label, values in {
        "hidden_obstacle_radius[box]": (0.1, 0.5, 0.3),
        "mass_change_trajectory[box]": (0.5, 1.5, 2.5),
        "mass_change_time[box]": (0.05, 0.13, 0.2),
    }.items():
        if label in labels:
            phi[:, labels.index(label)] = values
    rng = np.random.default_rng(8)
    start = rng.normal(0, [0.8, 0.8, 1, 2, 2, 1], (40, 1, 6))
    start[7, 0, 5] = 80.0  # more than half a radian in a substep
    actions = rng.normal(0, [12, 12, 2], (40, 3, 1, 3))
    inputs = np.concatenate([actions, 0.5 * actions, np.zeros_like(actions)], axis=-1)
    inputs[..., 6] = np.arange(40)[:, None, None] % 4  # the trajectory, and when it begins and ends
    inputs[..., 7:] = 0.1 * (np.arange(3)[:, None, None] + np.arange(2))
    return Simulator(Physics(scene, attached, **options)), phi, start, inputs


@pytest.mark.parametrize("name", SCENES)
def test_it_agrees_with_the_engine(name) -> None:
    simulator, phi, start, inputs = case(name)
    if name in ("walls", "disc"):  # of several intervals those that touch alone are the engine's
        inputs = inputs[:, :1]
    got = simulator(phi, start, inputs)
    reference = PlainSimulator(simulator.physics)
    expected = reference(phi, start, inputs)
    assert np.isfinite(expected).all()
    off = np.abs(got - expected) / (1.0 + np.abs(expected))
    assert np.quantile(off, 0.99) < 1e-11
    assert off.max() < 1e-9


@pytest.mark.parametrize("name", ["wheel", "walls"])
def test_transitions_of_a_block_do_not_depend_on_each_other(name) -> None:
    simulator, phi, start, inputs = case(name)
    whole = simulator(phi, start, inputs)
    order = np.random.default_rng(1).permutation(len(start))
    np.testing.assert_array_equal(simulator(phi, start[order], inputs[order]), whole[:, order])
    one = np.stack([simulator(phi[1], start[[i]], inputs[[i]])[0] for i in range(10)])
    np.testing.assert_array_equal(one, whole[1, :10])


def test_arrays_of_every_layout_use_the_same_machine_code() -> None:
    """The rollouts take ten seconds to compile, and would again for another kind of array."""
    for name in ("wheel", "walls", "sensor"):
        simulator, phi, start, inputs = case(name)
        expected = simulator(phi, start, inputs)
        compiled_once = [
            len(path.signatures) for path in (lockstep.rollout_free, compiled.rollout_engine)
        ]
        start.setflags(write=False)
        np.testing.assert_array_equal(simulator(phi, start, np.asfortranarray(inputs)), expected)
        coarse = Simulator(simulator.physics.changed(extrapolate=False))
        assert np.isfinite(coarse(phi, start, inputs)).all()
        signatures = [
            len(path.signatures) for path in (lockstep.rollout_free, compiled.rollout_engine)
        ]
        assert signatures == compiled_once
    assert len(compiled.rollout_engine.signatures) == 1
    assert len(lockstep.rollout_free.signatures) == 1


def test_contacts_are_left_to_the_engine() -> None:
    """Near the walls as the engine has it, and elsewhere as if there were none."""
    near, phi, start, inputs = case("walls", extrapolate=False)
    far = case("wheel", extrapolate=False)[0]
    touched = (near(phi, start, inputs) != far(phi, start, inputs)).any(axis=(2, 3, 4))
    assert 0.1 < touched.mean() < 0.9
    plain = PlainSimulator(near.physics)(phi, start, inputs)
    np.testing.assert_allclose(near(phi, start, inputs), plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("at_the_wall", [(0,), (1,), (2,), (0, 2), ()])
def test_one_of_several_bodies_at_a_wall_is_enough(at_the_wall) -> None:
    """Any of them bounces off, whatever the others do."""
    wall = Wall((-1.0, -90.0), (-1.0, 90.0))
    known = {"mass": 2.0, "r": 0.5, "mu_c": 0.3}
    bodies = tuple(Body(name, Shape.circle(0.2), known=known) for name in "abc")
    scene = Scene(time_step=0.2, bodies=bodies, walls=(wall,))
    start = np.zeros((40, 3, 6))
    start[:, :, 0], start[:, :, 1] = 5.0, 10.0 * np.arange(3)
    start[:, :, 3:] = np.random.default_rng(2).normal(0.0, 0.5, (40, 3, 3))
    for body in at_the_wall:
        start[:, body, 0], start[:, body, 3] = -0.7, -1.0
    layout, actions = build_layout(scene), np.zeros((40, 2, 3, 3))
    phi = np.zeros(layout.size)
    ours, plain = (
        simulator_of(Physics(scene, extrapolate=False), path)(phi, start, actions) for path in PATHS
    )
    np.testing.assert_allclose(ours, plain, rtol=1e-9, atol=1e-9)
    bounced = (ours[:, -1, :, 3] > 0.4).all(axis=0) & (ours[:, -1, :, 0] > -0.85).all(axis=0)
    assert np.flatnonzero(bounced).tolist() == list(at_the_wall)
    assert (ours[:, -1, :, 0] > -0.85).all()


def test_worlds_of_the_fast_path() -> None:
    """All of bodies that nothing joins, holds or moves."""
    assert lockstep.free_wheels(World(SCENES["wheel"])) is not None
    bodies = (Body("a", BOX), Body("b", BOX, wheel=True))
    two = SCENES["wheel"].replace(bodies=bodies)
    assert lockstep.free_wheels(World(two)).under.tolist() == [False, True]
    joint = Joint("hinge", ("a", "b"), (0.5, 0.0), (-0.5, 0.0))
    joined = World(two.replace(joints=(joint,)), (HINGE,))
    assert lockstep.free_wheels(joined) is None
    assert tree_of(joined) is not None
    pushed = World(two.replace(bodies=(bodies[0], Body("finger", BOX, kinematic=True))))
    assert lockstep.free_wheels(pushed) is None
    assert tree_of(pushed).bodies.tolist() == [0, -1]
    held = pushed.scene.replace(joints=(Joint("hinge", ("a", "finger"), (0.5, 0.0), (-0.5, 0.0)),))
    assert tree_of(World(held, (HINGE,))) is None
    closed = (joint, Joint("distance", ("a", "b"), (0.0, 0.3), (0.0, -0.3)))
    assert tree_of(World(two.replace(joints=closed), (HINGE, ROD))) is None
