"""Friction under a body and of a wheel: closed forms, sticking, and both paths alike."""

import numpy as np
import pytest

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.errors import EffectError
from pbrl_ppl.history import from_segments
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.plain import simulator_of
from tests.helpers.worlds import BY_NAME, G, body, predict, simulator, state

pytestmark = pytest.mark.one_stack

PATHS = pytest.mark.parametrize("path", ["auto", "python"])
BOX = Shape.box(0.9, 0.55)
MASS, MU, RADIUS = 2.0, 0.3, 0.25
INERTIA = MASS * BOX.unit_moment
PATCH = {"sliding_friction": (MU, RADIUS)}


def floor(**options) -> Scene:
    known = {"time_step": 0.1, "substeps": 40, "normal_gravity": G}
    return Scene(bodies=(body("block", BOX, mass=MASS),), **known | options)


def after(start, wrench=0.0, effects=None, scene=None, **options) -> np.ndarray:
    """States (H, 6) of the block."""
    given = PATCH if effects is None else effects
    return predict(scene or floor(), start, wrench, effects=given, **options)[:, 0]


def spun(state: np.ndarray, angle: float) -> np.ndarray:
    """States (..., 6) in a world that is turned."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    turned = state.copy()
    turned[..., :2], turned[..., 3:5] = state[..., :2] @ turn.T, state[..., 3:5] @ turn.T
    turned[..., 2] += angle
    return turned


@PATHS
def test_a_sliding_block_stops_after_its_way(path) -> None:
    """v^2 / 2 mu g, and stays there."""
    states = after(state(vx=1.2, vy=-0.9), horizon=12, engine=path)
    way = 1.5**2 / (2 * MU * G)
    np.testing.assert_allclose(states[-1, :2], [0.8 * way, -0.6 * way], rtol=2e-3)
    np.testing.assert_allclose(states[-3:, 3:], 0.0, atol=1e-12)
    np.testing.assert_allclose(states[-1], states[-3], atol=1e-12)


@PATHS
def test_a_spinning_block_is_slowed_at_the_ring(path) -> None:
    """All of the weight is at the radius: a torque of mu m g R."""
    states = after(state(omega=3.0), horizon=2, engine=path)
    slowing = MU * MASS * G * RADIUS / INERTIA
    np.testing.assert_allclose(states[:, 5], 3.0 - slowing * np.array([0.1, 0.2]), rtol=1e-5)
    np.testing.assert_allclose(states[:, :2], 0.0, atol=1e-12)


@PATHS
@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_a_push_below_the_limit_moves_nothing(path, angle) -> None:
    push = 0.95 * MU * MASS * G
    wrench = [push * np.cos(angle), push * np.sin(angle), 0.0]
    states = after(state(x=0.3, theta=0.7), wrench, horizon=5, engine=path)
    # the solver's warm-up is all that it moves by, a few nanometres
    np.testing.assert_allclose(states[:, :3], np.tile([0.3, 0.0, 0.7], (5, 1)), atol=1e-8)
    np.testing.assert_allclose(states[1:], states[:-1], atol=1e-12)


def test_a_push_above_the_limit_moves_it_by_the_rest() -> None:
    push = 1.5 * MU * MASS * G
    states = after(state(), [0.0, push, 0.0], horizon=3)
    np.testing.assert_allclose(states[:, 4], 0.5 * MU * G * np.array([0.1, 0.2, 0.3]), rtol=1e-5)


def test_a_torque_below_the_limit_turns_nothing() -> None:
    states = after(state(), [0.0, 0.0, 0.9 * MU * MASS * G * RADIUS], horizon=5)
    np.testing.assert_allclose(states, 0.0, atol=1e-8)
    np.testing.assert_allclose(states[:, 3:], 0.0, atol=1e-12)


def test_a_fast_spin_leaves_little_resistance_to_translation() -> None:
    """Friction opposes each point's motion: its mean along a slow drift is v / (2 omega R)."""
    slow, omega = 0.05, 8.0
    states = after(state(vx=slow, omega=omega), scene=floor(time_step=0.01))
    braking = (slow - states[0, 3]) / 0.01
    expected = MU * G * slow / (2 * omega * RADIUS)
    assert braking == pytest.approx(expected, rel=0.05)
    alone = after(state(vx=slow), scene=floor(time_step=0.01))
    assert (slow - alone[0, 3]) / 0.01 > 50 * braking


def test_energy_never_rises() -> None:
    rng = np.random.default_rng(1)
    start = rng.normal(0, [1, 1, 1, 1, 1, 3], (20, 1, 6))
    scene = floor(time_step=0.02, substeps=4)
    sim = simulator(scene, (BY_NAME["sliding_friction"],), extrapolate=False)
    states = sim(np.array([MU, RADIUS]), start, np.zeros((20, 60, 1, 3)))[:, :, 0]
    every = np.concatenate([start, states], axis=1)
    energy = 0.5 * MASS * (every[..., 3] ** 2 + every[..., 4] ** 2)
    energy += 0.5 * INERTIA * every[..., 5] ** 2
    assert (np.diff(energy, axis=1) <= 1e-12).all()
    assert (energy[:, -1] < 1e-20).all()


def test_a_turned_world_gives_turned_states() -> None:
    start = state(x=0.2, y=-0.1, theta=0.3, vx=0.7, vy=0.2, omega=2.0)
    wrench = np.array([3.0, -2.0, 0.4])
    angle = 1.1
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([c * 3.0 + s * 2.0, s * 3.0 - c * 2.0, 0.4])
    expected = spun(after(start, wrench, horizon=4, tolerance=1e-10), angle)
    got = after(spun(start, angle), turned, horizon=4, tolerance=1e-10)
    np.testing.assert_allclose(got, expected, atol=1e-9)


def test_eight_points_are_nearly_a_ring() -> None:
    """Where the block points to at first makes less than 3 % of its way and turn."""
    ends = []
    for theta in np.linspace(0.0, np.pi / 4, 7):
        start = state(theta=theta, vx=0.8, omega=2.5)
        ends.append(after(start, horizon=10)[-1] - state(theta=theta))
    spread = np.ptp(ends, axis=0)
    way = np.abs(ends).max(axis=0)
    assert (spread[[0, 2]] < 0.03 * way[[0, 2]]).all()


@PATHS
def test_without_friction_it_is_as_if_it_were_not_there(path) -> None:
    start, push = state(vx=1.0, omega=2.0), [1.0, 2.0, 0.3]
    none = after(start, push, {"sliding_friction": (0.0, RADIUS)}, horizon=3, engine=path)
    np.testing.assert_allclose(none, after(start, push, {}, horizon=3, engine=path), atol=1e-12)


def crowd() -> tuple[Simulator, np.ndarray, np.ndarray, np.ndarray]:
    """Two blocks with friction under them, one without and a finger, that meet."""
    declared = ("sliding_friction",)
    bodies = (
        Body("a", Shape.box(0.3, 0.2), effects=declared),
        Body("finger", Shape.circle(0.05), kinematic=True),
        Body("b", Shape.circle(0.1), wheel=True),
        Body("c", Shape.circle(0.1), effects=declared),
    )
    scene = Scene(time_step=0.05, normal_gravity=G, bodies=bodies)
    attached = attach(scene)
    sim = Simulator(Physics(scene, attached))
    rng = np.random.default_rng(2)
    start = rng.normal(0, [0.02, 0.02, 1, 1, 1, 2], (30, 4, 6))
    start[..., :2] += [(0.0, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.3, 0.0)]
    actions = rng.normal(0, 2.0, (30, 3, 4, 3))
    actions[:, :, 1] = rng.normal((2.0, 0.0, 0.0), 0.3, (30, 3, 3))
    phi = rng.uniform(0.1, 0.6, (2, sim.physics.layout.size))
    return sim, phi, start, actions


def test_paths_agree_and_nothing_is_remembered() -> None:
    sim, phi, start, actions = crowd()
    expected = sim(phi, start, actions)
    some, plain = (
        simulator_of(sim.physics, path)(phi, start[:8], actions[:8])
        for path in ("chipmunk", "python")
    )
    np.testing.assert_allclose(some, plain, rtol=1e-9, atol=1e-9)
    order = np.random.default_rng(6).permutation(len(start))
    np.testing.assert_array_equal(sim(phi, start[order], actions[order]), expected[:, order])
    np.testing.assert_array_equal(sim(phi[:1], start[7:9], actions[7:9]), expected[:1, 7:9])
    np.testing.assert_array_equal(sim(phi[::-1], start, actions), expected[::-1])


def test_paths_agree_where_nothing_touches() -> None:
    scene = floor()
    effects = (BY_NAME["sliding_friction"], BY_NAME["linear_drag"])
    rng = np.random.default_rng(3)
    start, actions = rng.normal(0, 1, (10, 1, 6)), rng.normal(0, 4, (10, 3, 1, 3))
    phi = rng.uniform(0.1, 0.5, (2, 3))
    both = [
        simulator(scene, effects, engine=path)(phi, start, actions)
        for path in ("python", "chipmunk")
    ]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-12, atol=1e-12)


def test_it_needs_a_floor() -> None:
    scene = floor(normal_gravity=0.0)
    with pytest.raises(EffectError, match="does not apply to body 'block'"):
        attach(scene, (BY_NAME["sliding_friction"].on("block"),))


def test_dry_friction_alone_stops_a_body() -> None:
    """Of all that may act on one that slides and turns; a rod from its centre holds that, too."""
    scene, coasting = floor(substeps=10), state(vx=0.5, vy=0.2, omega=1.0)[None, None]
    stopped = {}
    for effect in catalogue:
        if effect.applies(scene, scene.bodies[0]):
            sim = simulator(scene, (effect,), engine="python")
            centre = np.array([prior.centre for prior in sim.physics.layout.priors])
            *_, vx, vy, omega = sim(centre, coasting, np.zeros((1, 10, 1, 3)))[0, -1, 0]
            speeds = {"slides": np.hypot(vx, vy), "turns": abs(omega)}
            stopped[effect.name] = [way for way, speed in speeds.items() if speed < 1e-9]
    assert {name: ways for name, ways in stopped.items() if ways} == {
        "sliding_friction": ["slides", "turns"],
        "turning_friction": ["turns"],
        "wheel": ["slides"],
        "distance_joint": ["slides"],
    }


@pytest.mark.slow
def test_friction_and_radius_are_recovered() -> None:
    """Within 3.3 standard deviations: false alarms in 1 of 500."""
    scene = floor(substeps=20).with_effects("block", "sliding_friction")
    rng = np.random.default_rng(7)
    start = rng.normal(0, [1, 1, 1, 0.8, 0.8, 2], (40, 1, 6))
    actions = rng.normal(0, [6, 6, 1], (40, 2, 1, 3))
    truth = np.array([MU, RADIUS])
    states = simulator(scene)(truth, start, actions)
    noise = np.array([1e-3, 1e-3, 2e-3, 5e-3, 5e-3, 1e-2])
    history = from_segments(scene, start, actions, states + noise * rng.normal(size=states.shape))
    problem = problem_in(physics_model(scene, history, horizon=2))
    mode = find_mode(problem, initial=np.array([0.05, 0.6]))  # from far off
    sd = np.sqrt(np.diag(mode.covariance))
    assert (np.abs(mode.phi - truth) < 3.3 * sd).all()
    assert (sd < 0.02 * truth).all()


def test_friction_of_zero_is_solved_as_any_other() -> None:
    """Candidates are scored there: a derivative does not see the difference of two solvers."""
    sim = simulator(floor(), (BY_NAME["sliding_friction"], BY_NAME["linear_drag"]))
    start, actions = state(vx=1.0, omega=2.0)[None, None], np.zeros((1, 1, 1, 3))
    values = {"linear_drag_coefficient": 0.5, "sliding_friction_radius": RADIUS}
    none, little = (
        np.array(
            [(values | {"sliding_friction_mu": mu})[label.split("[")[0]]
             for label in sim.physics.layout.labels]
        )
        for mu in (0.0, 1e-7)
    )  # fmt: skip
    both = sim(np.stack([none, little]), start, actions)
    np.testing.assert_array_equal(both[0], sim(none, start, actions))
    assert 0.0 < np.abs(both[1] - both[0]).max() < 1e-6
    decayed = np.exp(-0.5 / MASS * 0.1)  # free but for the drag
    np.testing.assert_allclose(both[0, 0, 0, 0, 3], decayed, rtol=1e-8)


# -- a wheel that the scene does not declare -------------------------------------------------------

WHEEL = {"w_x": -0.25, "w_y": 0.05, "w_theta": 0.3, "mu_x": 0.05, "mu_y": 0.4}
WALL = (Wall((1.0, -2.0), (1.0, 2.0)),)


def wheeled(wheel: bool, walls: tuple[Wall, ...] = ()) -> Scene:
    known = WHEEL if wheel else {}
    box = body("box", BOX, wheel=wheel, mass=3.0, r=0.3, mu_c=0.3, **known)
    return Scene(time_step=0.1, substeps=20, normal_gravity=G, bodies=(box,), walls=walls)


@PATHS
@pytest.mark.parametrize("walls", [(), WALL], ids=["alone", "wall"])
def test_it_is_the_wheel_of_table_1(path, walls) -> None:
    rng = np.random.default_rng(2)
    start = rng.normal(0, [0.5, 0.5, 1, 1, 1, 2], (20, 1, 6))
    actions = rng.normal(0, [10, 10, 2], (20, 3, 1, 3))
    declared = simulator(wheeled(True, walls), engine=path)(np.zeros(0), start, actions)
    own = simulator(wheeled(False, walls), (BY_NAME["wheel"],), engine=path)
    added = own(np.array(list(WHEEL.values())), start, actions)
    np.testing.assert_allclose(added, declared, rtol=0, atol=1e-12)
    frictionless = own(np.zeros(5), start, actions)
    assert np.abs(added - frictionless).max() > 0.01


def test_a_body_has_one_wheel() -> None:
    with pytest.raises(EffectError, match="does not apply to body 'box'"):
        attach(wheeled(True), (BY_NAME["wheel"].on("box"),))


def test_places_are_on_the_body_and_directions_within_a_right_angle() -> None:
    grid = BY_NAME["wheel"].scan(wheeled(False), None, wheeled(False).bodies[0])
    x_min, x_max, y_min, y_max = BOX.bounds
    assert ((grid[:, 0] > x_min) & (grid[:, 0] < x_max)).all()
    assert ((grid[:, 1] > y_min) & (grid[:, 1] < y_max)).all()
    assert (grid[:, 2] < 0.5 * np.pi).all()
    assert np.isnan(grid[:, 3:]).all()
