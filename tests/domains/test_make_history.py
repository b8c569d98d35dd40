"""The generator of the demo histories against closed forms and against recorded data."""

import cmath
import importlib.util
import json
import math
import tomllib
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.special import ellipk

from tests.helpers.places import RECORDED, ROOT

pytest.importorskip("Box2D", reason="Box2D makes the histories; install the extra `test`")

pytestmark = pytest.mark.one_stack  # nothing is fitted here
CART_FOLDER, PENDULUM_FOLDER = ROOT / "models/shopping_cart", ROOT / "models/pendulum"
NULL_DATA = RECORDED / "cart-null"
STATE = ["x", "y", "theta", "vx", "vy", "omega"]
WRENCH = ["force_x", "force_y", "torque"]
G = 9.81


def load_generator():
    spec = importlib.util.spec_from_file_location("make_history", CART_FOLDER / "make_history.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


mh = load_generator()
PUCK = mh.Setup(name="puck", size=(0.4, 0.2), mass=2.0)  # no wheel, no walls
INERTIA = 2.0 * (0.4**2 + 0.2**2) / 12


def end_of(setup, start, seconds, wrench=(0.0, 0.0, 0.0), **effects):
    """State after some seconds under one wrench."""
    setup = replace(setup, time_step=seconds)
    return mh.rollout(setup, np.array(start), np.array([wrench]), mh.Effects(**effects))[-1]


def test_free_flight():
    got = end_of(PUCK, [1.0, -2.0, 0.3, 0.5, -0.25, 2.0], 1.0)
    np.testing.assert_allclose(
        got, [1.5, -2.25, 2.3, 0.5, -0.25, 2.0], atol=1e-4
    )  # single precision


def test_uniform_acceleration():
    got = end_of(PUCK, np.zeros(6), 0.5, wrench=(4.0, -2.0, 0.02))
    alpha = 0.02 / INERTIA
    expected = [0.25, -0.125, alpha / 8, 1.0, -0.5, alpha / 2]
    np.testing.assert_allclose(got, expected, rtol=1e-4)  # a step of 1 ms is not seen


def test_second_order():
    """Drag from 1 m/s: place and speed agree with each other to the square of the step."""
    got = end_of(PUCK, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], 0.1, linear_drag=20.0)
    assert got[0] == pytest.approx((1 - math.exp(-1.0)) / 10, rel=2e-5)
    assert got[3] == pytest.approx(math.exp(-1.0), rel=2e-5)


@pytest.mark.parametrize(("theta", "mu"), [(0.0, 0.3), (math.pi / 2, 0.5)])
def test_coulomb_sliding_distance(theta, mu):
    """Along one wheel axis the cart slides v^2 / (2 mu g)."""
    cart = replace(PUCK, wheel=mh.Wheel(x=0.0, y=0.0, theta=0.0, mu_x=0.3, mu_y=0.5))
    got = end_of(cart, [0.0, 0.0, theta, 1.5, 0.0, 0.0], 1.0)
    assert got[0] == pytest.approx(1.5**2 / (2 * mu * G), abs=1e-3)
    np.testing.assert_allclose(got[3:], 0.0, atol=1e-5)


def test_wheel_sticks_below_its_limit_and_slips_above():
    cart = replace(PUCK, wheel=mh.Wheel(x=0.0, y=0.0, theta=0.0, mu_x=0.3, mu_y=0.3))
    limit = 0.3 * 2.0 * G
    stuck = end_of(cart, np.zeros(6), 0.5, wrench=(0.99 * limit, 0.0, 0.0))
    slips = end_of(cart, np.zeros(6), 0.5, wrench=(limit + 2.0, 0.0, 0.0))
    np.testing.assert_allclose(stuck, 0.0, atol=1e-6)
    assert slips[3] == pytest.approx(0.5, rel=1e-3)


def test_wheel_axes_may_be_solved_in_any_order():
    """A wheel turned by a right angle with its coefficients swapped is the same wheel."""
    start = [0.0, 0.0, 0.4, 1.0, -0.7, 2.0]
    one = replace(PUCK, wheel=mh.Wheel(x=-0.15, y=0.05, theta=0.2, mu_x=0.1, mu_y=0.4))
    turned = mh.Wheel(x=-0.15, y=0.05, theta=0.2 + math.pi / 2, mu_x=0.4, mu_y=0.1)
    np.testing.assert_allclose(
        end_of(one, start, 0.5), end_of(replace(one, wheel=turned), start, 0.5), atol=1e-4
    )


@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_wall_returns_the_restitution(speed):
    puck = replace(PUCK, room=1.0, r=0.6)
    got = end_of(puck, [0.5, 0.0, 0.0, speed, 0.0, 0.0], 0.45 / speed)
    assert got[3] == pytest.approx(-0.6 * speed, rel=1e-3)


def test_wall_rubs_with_the_friction_of_the_body():
    puck = replace(PUCK, room=1.0, mu_c=0.25)
    got = end_of(puck, [-0.5, -0.9, 0.0, 1.5, 0.0, 0.0], 0.4, wrench=(0.0, -10.0, 0.0))
    assert got[3] == pytest.approx(1.5 - 0.25 * 10.0 / 2.0 * 0.4, abs=5e-3)


@pytest.mark.parametrize("amplitude", [0.05, 1.5])
def test_pendulum_period(amplitude):
    arm = replace(mh.PENDULUM, time_step=0.001)
    k_squared = (0.03**2 + 0.4**2) / 12 + 0.18**2
    period = 4 * math.sqrt(k_squared / (G * 0.18)) * ellipk(math.sin(amplitude / 2) ** 2)
    states = mh.rollout(arm, np.array([0, 0, amplitude, 0, 0, 0]), np.zeros((3000, 3)))
    theta, omega = states[:, 2], states[:, 5]
    down = np.flatnonzero((theta[:-1] > 0) & (theta[1:] <= 0))
    times = (down + theta[down] / (theta[down] - theta[down + 1])) * 0.001
    np.testing.assert_allclose(np.diff(times), period, rtol=2e-3)
    energy = 0.5 * k_squared * omega**2 - G * 0.18 * np.cos(theta)
    assert np.ptp(energy) < 0.01 * np.ptp(0.5 * k_squared * omega**2)
    np.testing.assert_allclose(states[:, :2], _hang(theta), atol=1e-4)


def _hang(theta):
    return 0.18 * np.column_stack([np.sin(theta), -np.cos(theta)])


def test_pivot_friction_takes_its_work_from_a_swing():
    """From rest at a to rest at -b: m g l (cos b - cos a) = torque (a + b)."""
    arm = replace(mh.PENDULUM, time_step=0.001)
    torque, a = 0.015, 1.2
    states = mh.rollout(
        arm,
        np.array([0, 0, a, 0, 0, 0]),
        np.zeros((800, 3)),
        mh.Effects(pivot_friction=torque),
    )
    b = -states[:, 2].min()
    assert 0.5 * G * 0.18 * (math.cos(b) - math.cos(a)) == pytest.approx(torque * (a + b), rel=0.01)


def test_pivot_damping_shrinks_a_small_swing():
    arm = replace(mh.PENDULUM, time_step=0.001)
    about_hinge = 0.5 * ((0.03**2 + 0.4**2) / 12 + 0.18**2)
    states = mh.rollout(
        arm, np.array([0, 0, 0.1, 0, 0, 0]), np.zeros((4000, 3)), mh.Effects(pivot_damping=0.02)
    )
    theta = states[:, 2]
    peaks = np.flatnonzero((theta[1:-1] > theta[:-2]) & (theta[1:-1] >= theta[2:])) + 1
    rate = -np.polyfit(peaks * 0.001, np.log(theta[peaks]), 1)[0]
    assert rate == pytest.approx(0.02 / (2 * about_hinge), rel=0.02)


START = (0.0, 0.0, 0.5, 1.0, -0.5, 2.0)
SPEED = math.hypot(1.0, 0.5)
SLOWED = 1 - 0.1 * G * 0.4 / SPEED


@pytest.mark.parametrize(
    ("effects", "velocities"),
    [
        ({"linear_drag": 1.5}, [math.exp(-0.3), -0.5 * math.exp(-0.3), 2.0]),
        ({"quadratic_drag": 2.0}, [1 / (1 + 0.4 * SPEED), -0.5 / (1 + 0.4 * SPEED), 2.0]),
        ({"angular_drag": 0.1}, [1.0, -0.5, 2.0 * math.exp(-0.1 * 0.4 / INERTIA)]),
        ({"constant_force": (1.2, -0.6)}, [1.24, -0.62, 2.0]),
        ({"constant_torque": 0.05}, [1.0, -0.5, 2.0 + 0.05 * 0.4 / INERTIA]),
        ({"stiction_patch": 0.1}, [1.0 * SLOWED, -0.5 * SLOWED, 2.0]),
        ({"stribeck": (0.1 * 2.0 * G, 1e3)}, [1.0 * SLOWED, -0.5 * SLOWED, 2.0]),  # all but dry
        ({"stribeck": (0.1 * 2.0 * G, 0.1)}, [1.0, -0.5, 2.0]),  # too fast for it
    ],
)
def test_effect_on_a_coasting_body(effects, velocities):
    got = end_of(PUCK, START, 0.4, **effects)
    np.testing.assert_allclose(got[3:], velocities, rtol=3e-3)


def test_body_force_turns_with_the_body():
    """The integral of a force that turns at omega: F / (m omega) (sin, 1 - cos)."""
    got = end_of(PUCK, [0, 0, 0, 0, 0, 2.0], 0.5, body_force=(3.0, 0.0))
    expected = 3.0 / (2.0 * 2.0) * np.array([math.sin(1.0), 1 - math.cos(1.0)])
    np.testing.assert_allclose(got[3:5], expected, rtol=3e-3)


@pytest.mark.parametrize(
    ("effects", "gain"),
    [
        ({"actuator_rotation": 0.12}, cmath.exp(0.12j)),
        ({"time_varying_gain": (0.3, 0.4)}, 1 + 0.3 * 2 / math.pi),  # mean over half a period
        ({"saturation": 2.0}, 2.0 / abs(complex(4.0, 1.0))),
        ({"dead_zone": 1.5}, 1 - 1.5 / abs(complex(4.0, 1.0))),  # what exceeds it passes
        ({"dead_zone": 4.5}, 0.0),
        ({"force_cutoff": 4.0}, 1.0),  # a stronger force acts whole
        ({"force_cutoff": 4.5}, 0.0),
        # 1 - exp(-t / tau), mean over 0.2 s
        ({"actuator_lag": 0.1}, 1 - 0.5 * (1 - math.exp(-2.0))),
        ({"anisotropic_gain": (1.5, 1.5)}, 1.5),
    ],
)
def test_effect_on_the_command(effects, gain):
    got = end_of(PUCK, np.zeros(6), 0.2, wrench=(4.0, 1.0, 0.0), **effects)
    expected = complex(4.0, 1.0) * gain * 0.2 / 2.0
    np.testing.assert_allclose(got[3:], [expected.real, expected.imag, 0.0], rtol=1e-3, atol=1e-6)


def test_gains_are_of_the_axes_of_the_world():
    got = end_of(
        PUCK, [0, 0, 0.7, 0, 0, 0], 0.2, wrench=(4.0, 1.0, 0.0), anisotropic_gain=(1.2, 0.5)
    )
    np.testing.assert_allclose(got[3:], [0.48, 0.05, 0.0], rtol=1e-3, atol=1e-6)


def test_spring_swings_the_body_about_its_anchor():
    w = math.sqrt(3.0 / 2.0)
    got = end_of(PUCK, [1.5, 0.5, 0, 0, 0, 0], 1.0, spring=(3.0, 0.5, 0.5))
    expected = [0.5 + math.cos(w), 0.5, 0.0, -w * math.sin(w), 0.0, 0.0]
    np.testing.assert_allclose(got, expected, atol=2e-3)


def test_magnus_force_turns_the_velocity():
    got = end_of(PUCK, [0, 0, 0, 1.0, 0, 2.0], 0.5, magnus_force=0.4)
    angle = 0.4 * 2.0 / 2.0 * 0.5
    np.testing.assert_allclose(got[3:5], [math.cos(angle), math.sin(angle)], atol=2e-3)


def test_a_rod_keeps_its_length_and_the_energy():
    """Of a body that is pushed by nothing else: to a millionth, and to one in ten thousand."""
    rod = (0.1, 0.05, 1.0, -0.5, 1.5)
    start = mh.tied(rod, np.array([0.0, 1.0, 0.3, 1.0, 0.5, 3.0]))
    end = end_of(PUCK, start, 2.0, distance_joint=rod)
    for state in (start, end):
        point = complex(*state[:2]) + complex(*rod[:2]) * cmath.exp(1j * state[2])
        assert abs(point - complex(*rod[2:4])) == pytest.approx(rod[4], abs=2e-6)
    energy = [0.5 * (2.0 * (s[3] ** 2 + s[4] ** 2) + INERTIA * s[5] ** 2) for s in (start, end)]
    assert energy[1] == pytest.approx(energy[0], rel=1e-4)
    assert np.abs(end[:2] - start[:2]).max() > 0.5


def test_a_hidden_wheel_is_the_declared_one():
    wheel = (0.1, 0.0, 0.5, 0.002, 0.02)
    start = np.array([0.0, 0.0, 0.3, 1.0, 0.5, 3.0])
    declared = end_of(replace(PUCK, wheel=mh.Wheel(*wheel)), start, 0.5)
    np.testing.assert_array_equal(end_of(PUCK, start, 0.5, wheel=wheel), declared)


def test_sliding_friction_stops_sliding_and_turning_and_holds():
    ring = {"sliding_friction": (0.1, 0.15)}
    slides = end_of(PUCK, [0, 0, 0, 1.0, 0, 0], 0.4, **ring)
    np.testing.assert_allclose(slides[3:], [1 - 0.1 * G * 0.4, 0, 0], atol=1e-3)
    turns = end_of(PUCK, [0, 0, 0, 0, 0, 10.0], 0.2, **ring)
    np.testing.assert_allclose(turns[5], 10 - 0.1 * 2.0 * G * 0.15 * 0.2 / INERTIA, rtol=1e-3)
    held = end_of(PUCK, np.zeros(6), 0.5, wrench=(0.9 * 0.1 * 2.0 * G, 0.0, 0.0), **ring)
    np.testing.assert_allclose(held, 0.0, atol=1e-5)


def test_push_offset_and_inertia_scale():
    """Small angles: torque = offset x force, in the body frame."""
    start = [0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0]
    push = {"wrench": (1.0, 0.0, 0.0), "push_offset": (0.05, 0.08)}
    one, two = end_of(PUCK, start, 0.05, **push), end_of(PUCK, start, 0.05, **push, inertia_scale=2)
    assert one[5] == pytest.approx(-0.05 * 0.05 / INERTIA, rel=0.02)
    assert one[5] / two[5] == pytest.approx(2.0, rel=0.02)


def test_same_seed_same_history():
    short = replace(mh.CART, n_train=2, n_test=1, n_intervals=4)
    one, two, other = (mh.simulate(seed, short, linear_drag=1.0) for seed in (3, 3, 4))
    for a, b, c in zip(one, two, other, strict=True):
        pd.testing.assert_frame_equal(a, b)
        assert not np.allclose(a[STATE], c[STATE])


def test_history_format():
    train, test = mh.simulate(0, replace(mh.CART, n_train=3, n_test=2, n_intervals=7))
    assert list(train) == ["trajectory", "step", "time", "body", *STATE, *WRENCH]
    assert train.groupby("trajectory").size().tolist() == [8, 8, 8]
    assert test["trajectory"].unique().tolist() == [0, 1]
    last = train["step"] == 7
    assert train.loc[last, WRENCH].isna().all(axis=None)
    assert train.loc[~last, WRENCH].notna().all(axis=None)
    assert train.loc[train["trajectory"] == 0, "force_x"].nunique() == 3  # each held 3 intervals


def test_a_load_from_some_trajectory_on_is_on_all_test_trajectories():
    """They were recorded later: pushed alike from rest, they are slower by the factor."""
    short = replace(
        PUCK, n_train=3, n_test=2, n_intervals=2, hold=2, wrench_sd=(4.0, 4.0, 0.0),
        start_sd=(0.0,) * 3, noise=(0.0,) * 6,
    )  # fmt: skip
    plain, loaded = (mh.simulate(3, short, mass_change=(k, 2.0, 0.0)) for k in (1.0, 2.0))
    for light, heavy, factors in zip(plain, loaded, ([1, 1, 2], [2, 2]), strict=True):
        speeds = [frame.loc[frame["step"] == 2, "vx"].to_numpy() for frame in (light, heavy)]
        np.testing.assert_allclose(speeds[0] / speeds[1], factors, rtol=1e-3)


def test_noise_is_what_is_asked_for():
    noiseless = replace(mh.CART, n_train=4, noise=(0.0,) * 6)
    (clean, _), (noisy, _) = mh.simulate(1, noiseless), mh.simulate(1, replace(mh.CART, n_train=4))
    first = clean["trajectory"] == 0  # the same draws are behind the first trajectory of both
    sd = (noisy.loc[first, STATE] - clean.loc[first, STATE]).std()
    np.testing.assert_allclose(sd, mh.CART.noise, rtol=0.5)


def test_wrong_effects_are_refused(capsys):
    with pytest.raises(ValueError, match="push_offset"):
        mh.Effects(push_offset=0.1)
    with pytest.raises(ValueError, match="hinge"):
        mh.simulate(0, pivot_friction=0.1)
    with pytest.raises(SystemExit):
        mh.main(["--effect", "angular_dragg=1", "--seed", "1", "--out", "nowhere"])
    assert "angular_drag" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("folder", "arguments"),
    [
        (CART_FOLDER, ["--effect", "angular_drag=1.2", "--seed", "5"]),
        (PENDULUM_FOLDER, ["--setup=pendulum", "--effect=pivot_friction=0.015", "--seed=7"]),
    ],
)
def test_recorded_files_are_what_the_readme_says(folder, arguments, tmp_path):
    mh.main([*arguments, "--out", str(tmp_path)])
    for name in ("train.csv", "test.csv"):
        recorded = folder / "recorded" / name
        assert recorded.stat().st_size < 60_000
        pd.testing.assert_frame_equal(
            pd.read_csv(recorded), pd.read_csv(tmp_path / name), rtol=0.0, atol=1e-3
        )


@pytest.mark.parametrize(
    ("folder", "setup"), [(CART_FOLDER, mh.CART), (PENDULUM_FOLDER, mh.PENDULUM)]
)
def test_scene_describes_the_setup(folder, setup):
    scene = tomllib.loads((folder / "scene.toml").read_text())
    (body,) = scene["body"]
    assert body["name"] == setup.name
    assert tuple(body["shape"]["size"]) == setup.size
    assert body["wheel"] == (setup.wheel is not None)
    assert scene["world"]["time_step"] == setup.time_step
    assert scene["world"]["gravity"] == [0.0, -setup.gravity]
    if setup.hinge is not None:
        assert scene["joint"][0]["anchor_a"] == [setup.hinge.real, setup.hinge.imag]
        assert body["known"] == {"mass": setup.mass}
    else:
        assert {abs(c) for w in scene["wall"] for c in w["from"]} == {setup.room}


def test_agrees_with_an_independent_recording():
    """One step ahead from each measured row; noise at both ends makes the ratio exceed 1."""
    if not NULL_DATA.is_dir():
        pytest.skip("no ../shared/data/cart-null beside this checkout: nothing to compare with")
    truth = json.loads((NULL_DATA / "truth.json").read_text())
    (body,) = truth["truth"]["bodies"]
    setup = mh.Setup(
        name="cart",
        size=tuple(body["size"]),
        mass=body["mass"],
        r=body["r"],
        mu_c=body["mu_c"],
        wheel=mh.Wheel(**body["wheel"]),
        room=12.0,
    )
    frame = pd.read_csv(NULL_DATA / "train.csv")
    state, wrench = frame[STATE].to_numpy(), frame[WRENCH].to_numpy()
    rows = np.flatnonzero(~np.isnan(wrench[:, 0]))
    predicted = np.array([mh.rollout(setup, state[i], wrench[i : i + 1])[1] for i in rows])
    ratio = (state[rows + 1] - predicted).std(axis=0) / truth["noise"]
    assert np.all((ratio > 1.2) & (ratio < 1.75)), ratio


def test_a_step_of_a_rolling_cart_is_short_enough():
    """Friction that holds the wheel on its way, and slips; against ten times shorter steps."""
    starts = np.random.default_rng(0).normal(0.0, [2, 2, 2, 1.2, 1.2, 0.8], (8, 6))
    pushes = np.random.default_rng(1).normal(0.0, [12, 12, 2], (8, 1, 3))

    def ends(setup):
        return [mh.rollout(setup, *each)[1] for each in zip(starts, pushes, strict=True)]

    finer = replace(mh.CART, step=mh.CART.step / 10)
    np.testing.assert_allclose(ends(mh.CART), ends(finer), atol=0.02 * np.max(mh.CART.noise))
