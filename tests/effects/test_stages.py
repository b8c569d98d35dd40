"""Effects act by stage, whatever the order of the catalogue: closed forms for one of each stage."""

import itertools
import math

import numpy as np
import pytest

from pbrl_ppl.effects import (
    Attached,
    Command,
    Effect,
    EffectParameter,
    Force,
    Properties,
    attach,
    catalogue,
)
from pbrl_ppl.errors import EffectError
from pbrl_ppl.parameters import Prior
from pbrl_ppl.physics import Physics, Simulator, build_layout
from pbrl_ppl.physics.world import FINER
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.examples import EXAMPLES
from tests.helpers.plain import simulator_of
from tests.helpers.worlds import BY_NAME, G, body, phi_of, predict, state

pytestmark = pytest.mark.one_stack

BOX = Shape.box(0.9, 0.55)
MASS = 2.0
PATHS = pytest.mark.parametrize("path", ["auto", "python"])


def free(time_step: float = 1.0, substeps: int = 100, **options) -> Scene:
    bodies = (body("puck", BOX, mass=MASS),)
    return Scene(time_step=time_step, substeps=substeps, bodies=bodies, **options)


def simulate(scene, named, start, inputs, **options):
    """Predictions (n, H, body, 6) under effects on the first body, in the order they are given."""
    first = scene.dynamic[0].name
    attached = attach(scene, [BY_NAME[name].on(first) for name in named])
    engine = simulator_of(Physics(scene, attached), **options)
    return engine(
        phi_of(engine.physics.layout, named), np.asarray(start, float), np.asarray(inputs, float)
    )


def inputs(wrench, previous=(0.0, 0.0, 0.0), trajectory=0.0, begin=0.0, end=1.0):
    """One interval of one body, as in INPUT, shape (1, 1, 1, 9)."""
    return np.array([*wrench, *previous, trajectory, begin, end]).reshape(1, 1, 1, 9)


# -- command ---------------------------------------------------------------------------------------


@PATHS
def test_a_turned_command_acts_beside_the_origin_as_turned(path) -> None:
    # 1 N along x, turned to y, 0.1 m ahead: 0.1 N m
    end = predict(
        free(0.1), state(), (1.0, 0.0, 0.0), engine=path,
        effects={"actuator_rotation": math.pi / 2, "push_offset": (0.1, 0.0)},
    )[0, 0]  # fmt: skip
    assert end[5] == pytest.approx(0.1 * 0.1 / (MASS * BOX.unit_moment), rel=1e-4)
    assert end[3:5] == pytest.approx([0.0, 0.1 / MASS], abs=1e-9)


def test_the_order_of_the_catalogue_does_not_matter_across_stages() -> None:
    named = {"push_offset": (0.1, 0.05), "actuator_rotation": 0.7, "inertia_scale": 1.3}
    ends = []
    for order in itertools.permutations(named):
        given = {name: named[name] for name in order}
        ends.append(simulate(free(), given, [[state(vx=1.0)]], inputs((1.0, 0.3, 0.1))))
    assert all((end == ends[0]).all() for end in ends)


@PATHS
@pytest.mark.parametrize("share", [0.0, 0.3, 0.305, 1.0])
def test_a_late_command_gives_the_momentum_of_the_one_before(share, path) -> None:
    end = simulate(
        free(substeps=50), {"actuator_delay": share}, [[state()]],
        inputs((2.0, 0.0, 0.4), previous=(-1.0, 3.0, 0.0)), engine=path,
    )[0, 0, 0]  # fmt: skip
    late, now = share / MASS, (1.0 - share) / MASS
    assert end[3] == pytest.approx(2.0 * now - 1.0 * late)
    assert end[4] == pytest.approx(3.0 * late)
    assert end[5] == pytest.approx(0.4 * now / BOX.unit_moment)


def test_a_delay_is_smooth_in_its_share() -> None:
    shares = np.linspace(0.3, 0.34, 41)  # a substep is 0.02 long
    speeds = [
        simulate(
            free(substeps=50), {"actuator_delay": share}, [[state()]], inputs((2.0, 0.0, 0.0))
        )[0, 0, 0, 3]
        for share in shares
    ]
    assert np.diff(speeds, 2) == pytest.approx(0.0, abs=1e-9)


@PATHS
def test_what_comes_before_is_changed_as_what_is_held(path) -> None:
    # turned by a right angle, both the late part (from x to y) and the rest (from y to -x)
    end = simulate(
        free(), {"actuator_rotation": math.pi / 2, "actuator_delay": 0.25}, [[state()]],
        inputs((0.0, 1.0, 0.0), previous=(1.0, 0.0, 0.0)), engine=path,
    )[0, 0, 0]  # fmt: skip
    assert end[3:5] == pytest.approx([-0.75 / MASS, 0.25 / MASS], abs=1e-9)


def test_the_interval_before_is_the_row_before() -> None:
    late = {"actuator_delay": 1.0}
    wrenches = np.array([[1.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]]).reshape(1, 3, 1, 3)
    end = simulate(free(), late, [[state()]], wrenches)[0, :, 0, 3]
    assert end == pytest.approx(np.array([0.0, 1.0, 3.0]) / MASS)


@PATHS
@pytest.mark.parametrize(("name", "kept"), [("force_cutoff", 1.0), ("dead_zone", None)])
def test_an_actuators_threshold_swallows_weak_forces_and_no_torque(name, kept, path) -> None:
    """A cut-off passes a stronger force in full, a dead zone what exceeds the threshold."""
    for force, strong in (((0.6, 0.7), False), ((0.8, 0.7), True)):
        end = simulate(free(), {name: 1.0}, [[state()]], inputs((*force, 0.3)), engine=path)[
            0, 0, 0
        ]
        share = kept or 1.0 - 1.0 / np.hypot(*force)
        expected = np.array(force) / MASS * share * strong
        assert end[3:5] == pytest.approx(expected, abs=1e-9)
        assert end[5] == pytest.approx(0.3 / (MASS * BOX.unit_moment))


# -- properties ------------------------------------------------------------------------------------


@PATHS
def test_a_load_comes_at_a_trajectory_and_a_time(path) -> None:
    def speed(trajectory, begin, horizon=1):
        each = [inputs((1.0, 0, 0), (0, 0, 0), trajectory, begin + h, begin + h + 1)
                for h in range(horizon)]  # fmt: skip
        given = np.concatenate(each, axis=1)
        load = {"mass_change": (1.5, 3.0, 2.0)}
        return simulate(free(), load, [[state()]], given, engine=path)[0, :, 0, 3] * MASS

    assert speed(2, 5.0) == pytest.approx([1.0])  # before that trajectory
    assert speed(3, 0.0) == pytest.approx([1.0])  # in it, before that time
    assert speed(3, 2.0) == pytest.approx([1 / 1.5])
    assert speed(4, 1.5) == pytest.approx([1 / 1.25])  # the interval in which it happens: a half
    assert speed(7, 1.0, horizon=3) == pytest.approx([1.0, 1.0 + 1 / 1.5, 1.0 + 2 / 1.5])


def test_the_moment_follows_from_the_mass() -> None:
    end = simulate(free(), {"inertia_scale": 2.0, "mass_change": (1.5, 0.0, 0.0)}, [[state()]],
                   inputs((0.0, 0.0, 1.0)))  # fmt: skip
    assert end[0, 0, 0, 5] == pytest.approx(1.0 / (1.5 * 2.0 * MASS * BOX.unit_moment))


def test_after_the_recording_the_load_is_there() -> None:
    end = predict(free(), state(), (1.0, 0.0, 0.0), effects={"mass_change": (2.0, 30.0, 5.0)})
    assert end[0, 0, 3] == pytest.approx(0.5 / MASS)


# -- structure -------------------------------------------------------------------------------------


@PATHS
def test_a_hidden_disc_is_a_static_body(path) -> None:
    start = [[state(x=-1.2, vx=1.5, omega=0.3)], [state(y=3.0, vx=1.5)]]
    moving = body("puck", Shape.circle(0.2), mass=MASS, r=0.5, mu_c=0.3)
    still = Body("post", Shape.circle(0.3), static=True, pose=(0.0, 0.1, 0.0))
    # near hidden discs steps are finer
    with_post = Scene(time_step=1.0, substeps=25 * FINER, bodies=(moving, still))
    without = Scene(time_step=1.0, substeps=25, bodies=(moving,))
    push = np.zeros((2, 1, 1, 3))
    expected = simulate(with_post, {}, start, push, engine=path)
    found = simulate(without, {"hidden_obstacle": (0.0, 0.1, 0.3)}, start, push, engine=path)
    assert found == pytest.approx(expected, abs=1e-9)
    assert found[0, 0, 0, 3] < 0.5  # it bounced
    assert found[1, 0, 0, 3] == pytest.approx(1.5)


def test_a_disc_without_radius_is_no_disc() -> None:
    scene = Scene(time_step=1.0, bodies=(body("puck", Shape.circle(0.2), mass=MASS),))
    end = predict(scene, state(x=-1.0, vx=1.5), effects={"hidden_obstacle": (0.0, 0.0, 0.0)})
    assert end[0, 0, 0] == pytest.approx(0.5)


def test_discs_of_one_call_do_not_meet_those_of_another() -> None:
    scene = Scene(time_step=1.0, bodies=(body("puck", Shape.circle(0.2), mass=MASS),))
    attached = attach(scene, [BY_NAME["hidden_obstacle"]])
    engine = Simulator(Physics(scene, attached))
    start, push = np.array([[state(x=-1.0, vx=1.5)]] * 3), np.zeros((3, 1, 1, 3))
    phi = np.array([[0.0, 0.0, 0.3], [0.0, 2.0, 0.3], [0.0, 0.0, 0.3], [5.0, 0.0, 0.1]])
    together = engine(phi, start, push)
    for each, expected in zip(phi, together, strict=True):
        fresh = Simulator(Physics(scene, attached))
        assert (fresh(each, start, push) == expected).all()


# -- sensor ----------------------------------------------------------------------------------------


@PATHS
def test_a_biased_sensor_shifts_what_is_measured(path) -> None:
    bias = np.array([0.1, -0.2, 0.05, 0.3, 0.0, -0.4])
    measured = state(x=1.0, vx=1.3, omega=0.1)
    true = measured - bias
    push = inputs((1.0, 0.5, 0.2))
    expected = simulate(free(), {}, [[true]], push, engine=path)[0, 0, 0] + bias
    found = simulate(free(), {"sensor_bias": tuple(bias)}, [[measured]], push, engine=path)[0, 0, 0]
    assert found == pytest.approx(expected, abs=1e-12)


@PATHS
def test_a_scaled_sensor_shows_lengths_and_angles_larger(path) -> None:
    true = state(x=1.0, y=-0.5, theta=0.4, vx=1.3, omega=0.1)
    factors = np.array([1.1, 1.1, 0.9, 1.1, 1.1, 0.9])
    push = inputs((1.0, 0.5, 0.2))
    expected = simulate(free(), {}, [[true]], push, engine=path)[0, 0, 0] * factors
    scale = {"sensor_scale": (1.1, 0.9)}
    found = simulate(free(), scale, [[true * factors]], push, engine=path)[0, 0, 0]
    assert found == pytest.approx(expected, abs=1e-12)


@PATHS
def test_in_a_turned_frame_pushes_go_askew(path) -> None:
    """A push along the commands' x is seen to go along the frame's."""
    found = simulate(
        free(), {"frame_rotation": 0.3}, [[state(x=1.0, theta=0.1)]], inputs((2.0, 0.0, 0.0)),
        engine=path,
    )[0, 0, 0]  # fmt: skip
    way = np.array([math.cos(0.3), math.sin(0.3)])
    assert found[3:5] == pytest.approx(2.0 / MASS * way)
    assert found[:2] == pytest.approx(np.array([1.0, 0.0]) + 1.0 / MASS * way)
    assert found[2] == pytest.approx(0.1)


def test_a_hinged_body_stays_in_its_hinge_whatever_its_sensor_says() -> None:
    rod = body("rod", Shape.box(0.05, 1.0), mass=1.0)
    hinge = Joint("hinge", ("rod", "world"), (0.0, 0.5), (0.0, 0.0))
    scene = Scene(gravity=(0.0, -G), time_step=0.1, substeps=100, bodies=(rod,), joints=(hinge,))

    def hanging(angle, rate):
        return state(0.5 * math.sin(angle), -0.5 * math.cos(angle), angle,
                     0.5 * rate * math.cos(angle), 0.5 * rate * math.sin(angle), rate)  # fmt: skip

    nothing = np.zeros((1, 1, 1, 3))
    off = simulate(
        scene, {"sensor_bias": (0, 0, 0.1, 0, 0, 0)}, [[hanging(0.5, 0.2)]], nothing
    )[0, 0, 0]  # fmt: skip
    true = simulate(scene, {}, [[hanging(0.4, 0.2)]], nothing)[0, 0, 0]
    assert off[2] - 0.1 == pytest.approx(true[2], abs=1e-9)
    assert off[5] == pytest.approx(true[5], abs=1e-9)


# -- all of them -----------------------------------------------------------------------------------


def room() -> Scene:
    cart = body("cart", BOX, wheel=True, mass=MASS, r=0.3, mu_c=0.3, mu_x=0.05, mu_y=0.4, w_x=-0.2)
    walls = (Wall((-1.0, -2.0), (-1.0, 2.0)), Wall((1.0, -2.0), (1.0, 2.0)))
    return Scene(time_step=0.1, normal_gravity=G, bodies=(cart,), walls=walls)


def test_both_paths_agree_with_effects_of_every_stage() -> None:
    scene, rng = room(), np.random.default_rng(4)
    laws = (*catalogue, EXAMPLES["sensor_drift"])  # a measurement that knows the time
    fitting = [effect for effect in laws if effect.applies(scene, scene.dynamic[0])]
    attached = attach(scene, fitting)
    layout = build_layout(scene, attached)
    phi = np.stack([prior.sample(rng, 3) for prior in layout.priors], axis=1)
    phi[:, layout.index("hidden_obstacle_x", "cart")] = [0.6, 0.0, 3.0]
    phi[:, layout.index("hidden_obstacle_y", "cart")] = [0.0, 0.7, 3.0]
    phi[:2, layout.index("distance_joint_length", "cart")] = 0.0  # a rod pulls hard at once
    for name in ("b_x", "b_y"):  # its end on the floor is where the cart starts
        phi[2, layout.index(f"distance_joint_{name}", "cart")] = 0.0
    for name in ("x", "y", "theta"):  # a minute's drift takes a start far off the rod
        phi[2, layout.index(f"sensor_drift_{name}", "cart")] = 0.0
    start = rng.normal(0, 1, (8, 1, 6)) * [0.2, 0.2, 1, 2, 2, 2]
    clock = np.cumsum(np.full((8, 3, 1), 0.1), axis=1) + rng.uniform(0, 60, (8, 1, 1))
    given = np.concatenate(
        [rng.normal(0, 5, (8, 3, 6)), np.full((8, 3, 1), 40.0), clock - 0.1, clock], axis=-1
    )[:, :, None]
    compiled, plain = (
        simulator_of(Physics(scene, attached), path, substeps=8)(phi, start, given)
        for path in ("chipmunk", "python")
    )
    assert compiled == pytest.approx(plain, rel=1e-9, abs=1e-9, nan_ok=True)
    diverged = np.isnan(plain).any(axis=(-3, -2, -1))  # drag of 33 kg/m at 8 substeps
    assert diverged.mean() < 0.1


def test_order_and_threads_change_nothing_with_effects_of_every_stage() -> None:
    scene, rng = room(), np.random.default_rng(5)
    attached = attach(scene, [BY_NAME[n] for n in ("mass_change", "hidden_obstacle", "sensor_bias",
                                                   "actuator_delay")])  # fmt: skip
    layout = build_layout(scene, attached)
    phi = np.stack([prior.sample(rng, 2) for prior in layout.priors], axis=1)
    start = rng.normal(0, 1, (60, 1, 6)) * [0.2, 0.2, 1, 2, 2, 2]
    given = rng.uniform(0, 3, (60, 1, 1, 9))
    given[..., 8] = given[..., 7] + 0.1
    whole = Simulator(Physics(scene, attached))(phi, start, given)
    order = rng.permutation(60)
    other = Simulator(Physics(scene, attached, threads=2))(phi, start[order], given[order])
    assert (other == whole[:, order]).all()


# -- a user's own ----------------------------------------------------------------------------------

GAIN = (EffectParameter("gain", "1", Prior("log_normal", sigma=0.3), null=1.0),)


def _half(state, command, parameters, wrench) -> None:
    wrench[0] *= parameters[0]


def _heavier(properties, parameters, clock) -> None:
    properties["mass"] = properties["mass"] * parameters["gain"]


@pytest.mark.parametrize("stage", [Command(_half), Properties(_heavier)], ids=["command", "mass"])
def test_an_effect_of_ones_own_needs_no_registry(stage) -> None:
    mine = Effect("mine", GAIN, "a gain of my own", "a test", stage)
    scene = free()
    attached = attach(scene, [mine])
    engine = Simulator(Physics(scene, attached))
    end = engine(np.array([2.0]), np.array([[state()]]), inputs((1.0, 0, 0)))[0, 0, 0, 3] * MASS
    assert end == pytest.approx(2.0 if isinstance(stage, Command) else 0.5)


def test_a_law_alone_is_a_force() -> None:
    mine = Effect("mine", GAIN, "a gain of my own", "a test", force=_half)
    assert mine.stage == Force(_half)
    assert isinstance(mine.on("puck"), Attached)


@pytest.mark.parametrize("given", [{}, {"stage": _half}, {"stage": Force(_half), "force": _half}])
def test_no_stage_or_two_are_refused(given) -> None:
    with pytest.raises(EffectError, match="expected one of Structure, Properties, Command, Force"):
        Effect("mine", GAIN, "a gain of my own", "a test", **given)
