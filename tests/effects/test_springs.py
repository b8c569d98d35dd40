"""A rod that the scene does not declare: a declared one's physics, and found from poses alone."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.effects import attach
from pbrl_ppl.errors import EffectError, ParameterError
from pbrl_ppl.history import History
from pbrl_ppl.physics.properties import on_rod
from pbrl_ppl.scene import Joint, Scene, Shape, Wall
from tests.helpers.worlds import BY_NAME, G, body, predict, simulator, state

pytestmark = pytest.mark.one_stack

PATHS = pytest.mark.parametrize("path", ["auto", "python"])
BOX = Shape.box(0.9, 0.55)
A, B, LENGTH = (0.2, 0.1), (1.5, 0.4), np.hypot(1.3, 0.3)
WALL = (Wall((1.0, -2.0), (1.0, 2.0)),)
ROD = {"distance_joint": (*A, *B, LENGTH)}


def scene(declared: bool, walls: tuple[Wall, ...] = (), **wheel: float) -> Scene:
    known = {"mass": 3.0, "r": 0.3, "mu_c": 0.3} | wheel
    box = body("box", BOX, wheel=bool(wheel), **known)
    box = replace(box, pose=(0.0, 0.0, 0.0))
    rod = (Joint("distance", ("box", "world"), A, B),) if declared else ()
    floor = {"time_step": 0.1, "substeps": 20, "normal_gravity": G}
    return Scene(bodies=(box,), walls=walls, joints=rod, **floor)


@PATHS
@pytest.mark.parametrize("walls", [(), WALL], ids=["alone", "wall"])
@pytest.mark.parametrize("wheel", [{}, {"mu_x": 0.05, "mu_y": 0.4}], ids=["free", "wheel"])
def test_it_is_the_joint_of_table_1(path, walls, wheel) -> None:
    rng = np.random.default_rng(2)
    start = rng.normal(0, [0.05, 0.05, 0.1, 1, 1, 2], (20, 1, 6))
    start[:, 0] = on_rod(start[:, 0][None], np.array([[*A, *B, LENGTH]]), BOX.unit_moment)[0]
    actions = rng.normal(0, [10, 10, 2], (20, 3, 1, 3))
    declared = simulator(scene(True, walls, **wheel), engine=path)(np.zeros(0), start, actions)
    own = simulator(scene(False, walls, **wheel), (BY_NAME["distance_joint"],), engine=path)
    both = own(np.array([[*A, *B, LENGTH], np.zeros(5)]), start, actions)
    np.testing.assert_allclose(both[0], declared, rtol=0, atol=1e-12)
    without = simulator(scene(False, walls, **wheel), engine=path)(np.zeros(0), start, actions)
    np.testing.assert_array_equal(both[1], without)
    assert np.abs(both[0] - without).max() > 0.01


@PATHS
def test_it_goes_round_at_its_speed(path) -> None:
    """Held at its centre, without forces, it goes on a circle: v t / L round, at the same speed."""
    rod = {"distance_joint": (0.0, 0.0, 0.0, 0.0, 1.5)}
    still = Scene(time_step=0.5, substeps=400, bodies=(body("box", BOX),))
    got = predict(still, state(x=1.5, vy=0.9), effects=rod, engine=path)[0, 0]
    angle = 0.9 * 0.5 / 1.5
    expected = state(1.5 * np.cos(angle), 1.5 * np.sin(angle))
    expected[3:5] = 0.9 * np.array([-np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_two_rods_are_there_each_for_itself() -> None:
    """Of two bodies, one, the other, both or none are tied, in one call."""
    bodies = tuple(body(name, BOX) for name in "ab")
    two = Scene(time_step=0.1, substeps=20, bodies=bodies)
    sim = simulator(two, (BY_NAME["distance_joint"],))
    start = np.stack([state(x=1.5, vy=0.9), state(x=8.5, y=5.0, vy=-0.9)])[None]
    lengths = (
        sim.physics.layout.labels.index("distance_joint_length[a]"),
        sim.physics.layout.labels.index("distance_joint_length[b]"),
    )
    phi = np.zeros((4, sim.physics.layout.size))
    phi[:, sim.physics.layout.labels.index("distance_joint_b_x[b]")] = 7.0
    phi[:, sim.physics.layout.labels.index("distance_joint_b_y[b]")] = 5.0
    phi[:, list(lengths)] = [[0.0, 0.0], [1.5, 0.0], [0.0, 1.5], [1.5, 1.5]]
    states = sim(phi, start, np.zeros((1, 1, 2, 3)))[:, 0, 0]
    free, one, other, both = states
    np.testing.assert_allclose(free[:, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(one[1], free[1], atol=1e-12)
    np.testing.assert_allclose(other[0], free[0], atol=1e-12)
    np.testing.assert_allclose(both, [one[0], other[1]], atol=1e-12)
    assert one[0, 3] < -0.01 and other[1, 3] < -0.01  # turned towards their middles


def test_a_measured_state_is_off_the_rod_and_its_prediction_is_not() -> None:
    """By noise of 5 mm: with ten times as many steps it is the same to 1e-4, and on the rod."""
    rng = np.random.default_rng(3)
    noise = [0.005, 0.005, 0.01, 0.02, 0.02, 0.05]
    start = state(x=0.3, y=0.5, vx=1.0) + rng.normal(0, noise, (30, 1, 6))
    rod = np.array([0.1, 0.05, 1.0, -0.5, np.hypot(0.6, 1.05)])
    puck = Scene(time_step=0.1, bodies=(body("puck", Shape.box(0.4, 0.3), mass=2.0),))
    few, many = (
        simulator(puck, (BY_NAME["distance_joint"],), substeps=n)(
            rod, start, np.zeros((30, 1, 1, 3))
        )
        for n in (40, 640)
    )
    np.testing.assert_allclose(few, many, atol=1e-4)
    x, y, theta = many[:, 0, 0, :3].T
    end_x = x + np.cos(theta) * rod[0] - np.sin(theta) * rod[1]
    end_y = y + np.sin(theta) * rod[0] + np.cos(theta) * rod[1]
    np.testing.assert_allclose(np.hypot(end_x - rod[2], end_y - rod[3]), rod[4], atol=1e-5)


def test_a_length_below_zero_is_refused() -> None:
    sim = simulator(scene(False), (BY_NAME["distance_joint"],))
    with pytest.raises(ParameterError, match="a length below 0"):
        sim(np.array([0, 0, 0, 0, -1.0]), np.zeros((1, 1, 6)), np.zeros((1, 1, 1, 3)))


def test_what_hangs_is_not_tied() -> None:
    hinge = Joint("hinge", ("box", "world"), (0.0, 0.2), (0.0, 0.0))
    hung = Scene(time_step=0.1, gravity=(0, -G), bodies=(body("box", BOX),), joints=(hinge,))
    with pytest.raises(EffectError, match="does not apply"):
        attach(hung, (BY_NAME["distance_joint"].on("box"),))


def grid_points(make_history, **hidden) -> np.ndarray:
    setup = make_history.Setup(
        name="puck", size=(0.4, 0.3), mass=2.0, n_train=4, n_test=1, wrench_sd=(4.0, 4.0, 0.1)
    )
    train, _ = make_history.simulate(3, setup, **hidden)
    puck = Scene(time_step=0.1, bodies=(body("puck", Shape.box(0.4, 0.3), mass=2.0),))
    history = History.from_dataframe(train, puck)
    return BY_NAME["distance_joint"].scan(puck, history, puck.bodies[0])


def test_it_is_found_from_poses_alone(make_history) -> None:
    """Both ends and the length within 5 mm, of a hundred poses measured to 2 mm and 4 mrad."""
    hidden = (0.1, 0.05, 1.0, -0.5, 1.5)
    found = grid_points(make_history, distance_joint=hidden)
    assert np.abs(found - hidden).max(axis=1).min() < 0.005
    assert len(grid_points(make_history)) == 0  # a free one goes on no circle
