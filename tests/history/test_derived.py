"""Velocities that were computed from positions, or lag them, are recognised; measured ones not."""

from itertools import product

import numpy as np
import pandas as pd
import pytest
from scipy.signal import butter, lfilter, savgol_filter

from pbrl_ppl.history import (
    History,
    computed_lag,
    measured_alone,
    measurement_noise,
    unused_velocities,
    velocity_lag,
)
from pbrl_ppl.likelihood import observed_coordinates
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import COLUMNS
from tests.helpers.places import RECORDED

pytestmark = pytest.mark.one_stack

DT = 0.05
PUCK = Scene(time_step=DT, bodies=(Body("puck", Shape.circle(0.2)),))
ALL = ["vx", "vy", "omega"]


def backward(p, dt):
    return np.concatenate([[0.0], np.diff(p)]) / dt


#: Velocities as loggers compute them, and by how many rows they are late.
FILTERS = {
    "forward": (lambda p, dt: np.append(np.diff(p), 0.0) / dt, -0.5),
    "backward": (backward, 0.5),
    "gradient": (np.gradient, 0.0),
    "backward over 4": (
        lambda p, dt: np.append(np.zeros(4), p[4:] - p[:-4]) / (4 * dt),
        2.0,
    ),
}
for window in (5, 9):
    for order in (2, 3, 4):
        FILTERS[f"Savitzky-Golay {window}, {order}"] = (
            lambda p, dt, w=window, o=order: savgol_filter(p, w, o, deriv=1, delta=dt),
            0.0,
        )
#: Low-passes, which no finite number of rows gives exactly: order, cut and what they smooth.
LOW_PASSES = list(product((1, 2), (0.1, 0.3), (backward, np.gradient)))


def motion(kind, dt, n, rng):
    """Positions and velocities without noise: pushed at random, falling with drag, swinging."""
    t = np.arange(n) * dt
    if kind == "pushed":
        push = rng.normal(0.0, 2.0, n)
        v = np.cumsum(np.concatenate([rng.normal(size=1), dt * push]))[:n]
        return np.cumsum(np.concatenate([[0.0], dt * v[:-1] + dt**2 / 2 * push[:-1]])), v
    if kind == "falling":
        k, v0 = 0.3, rng.normal()
        v = (v0 + 9.81 / k) * np.exp(-k * t) - 9.81 / k
        return (v0 + 9.81 / k) / k * (1 - np.exp(-k * t)) - 9.81 / k * t, v
    w, phase = rng.uniform(2.0, 8.0), rng.uniform(0.0, 6.0)
    return np.sin(w * t + phase), w * np.cos(w * t + phase)


@pytest.mark.parametrize("kind", ["pushed", "falling", "swinging"])
@pytest.mark.parametrize("rate", [10, 50, 500])
@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_of_positions_is_recognised_in_short_logs(name, rate, kind) -> None:
    """In 44 rows of one trajectory and in four of 12 rows, positions with 1 mm of noise."""
    computed, expected = FILTERS[name]
    rng, dt = np.random.default_rng(5), 1 / rate
    for trajectories, n in ((1, 44), (4, 12)):
        runs = []
        for _ in range(trajectories):
            x = motion(kind, dt, n, rng)[0] + rng.normal(0.0, 0.001, n)
            runs.append((x, computed(x, dt)))
        assert computed_lag(runs, dt) == pytest.approx(expected * dt, abs=1e-3 * dt)


@pytest.mark.parametrize("window", [11, 15, 21, 31])
@pytest.mark.parametrize("order", [2, 3, 4])
def test_long_windows_are_recognised_in_three_windows(window, order) -> None:
    n = 3 * window
    for rate in (10, 50, 500):
        for kind in ("pushed", "falling", "swinging"):
            x = motion(kind, 1 / rate, n, np.random.default_rng(7))[0]
            x = x + np.random.default_rng(8).normal(0.0, 0.001, n)
            v = savgol_filter(x, window, order, deriv=1, delta=1 / rate)
            found = computed_lag([(x, v)], 1 / rate)
            assert found == pytest.approx(0.0, abs=1e-3 / rate)


@pytest.mark.parametrize("kind", ["pushed", "falling", "swinging"])
@pytest.mark.parametrize("rate", [10, 50, 500])
@pytest.mark.parametrize(("order", "cut", "differ"), LOW_PASSES)
def test_a_low_pass_of_differences_is_computed_or_late(order, cut, differ, rate, kind) -> None:
    """In eight trajectories of 41 rows, positions with 1 mm of noise."""
    rng, dt, runs = np.random.default_rng(5), 1 / rate, []
    for _ in range(8):
        x = motion(kind, dt, 41, rng)[0] + rng.normal(0.0, 0.001, 41)
        runs.append((x, lfilter(*butter(order, cut), differ(x, dt))))
    assert computed_lag(runs, dt) is not None or velocity_lag(runs, dt) > 0


@pytest.mark.parametrize("name", ["forward", "gradient", "Savitzky-Golay 5, 2"])
def test_rounding_afterwards_does_not_hide_a_filter(name) -> None:
    """Positions to 0.1 mm after the velocity was computed, velocities to 0.1 mm/s."""
    rng = np.random.default_rng(3)
    runs = []
    for _ in range(3):
        x = motion("swinging", 0.02, 30, rng)[0] + rng.normal(0.0, 0.002, 30)
        runs.append((x.round(4), FILTERS[name][0](x, 0.02).round(4)))
    assert computed_lag(runs, 0.02) is not None


@pytest.mark.parametrize("rate", [10, 50, 500])
def test_false_alarms_on_measured_velocities(rate) -> None:
    """At most 1 of 648 columns: at one in a hundred, such a test is passed at p = 0.012."""
    rng, dt, alarms = np.random.default_rng(rate), 1 / rate, 0
    sizes, noises = ((1, 44), (4, 12), (12, 31)), ((0.0003, 0.002), (0.003, 0.03, 0.3))
    cases = product(sizes, ("pushed", "falling", "swinging"), *noises, (False, True), range(6))
    for (trajectories, n), kind, noise, of_rate, rounded, _ in cases:
        runs = []
        for _ in range(trajectories):
            x, v = motion(kind, dt, n, rng)
            x, v = x + rng.normal(0.0, noise, n), v + rng.normal(0.0, of_rate, n)
            runs.append((x.round(3), v.round(2)) if rounded else (x, v))
        alarms += computed_lag(runs, dt) is not None or velocity_lag(runs, dt) != 0
    assert alarms <= 1


@pytest.mark.parametrize("rows", [0.3, 1.0, 2.6])
def test_a_late_velocity_of_another_sensor_is_told_with_its_lag(rows) -> None:
    """Six trajectories of 40 rows, 50 Hz; the lag within a tenth of a row."""
    rng, dt, runs = np.random.default_rng(11), 0.02, []
    for _ in range(6):
        w, phase, t = rng.uniform(3.0, 8.0), rng.uniform(0.0, 6.0), dt * np.arange(40)
        x = np.sin(w * t + phase) + rng.normal(0.0, 0.001, 40)
        v = w * np.cos(w * (t - rows * dt) + phase) + rng.normal(0.0, 0.02, 40)
        runs.append((x, v))
    assert computed_lag(runs, dt) is None
    assert velocity_lag(runs, dt) == pytest.approx(rows * dt, abs=0.1 * dt)


def test_the_lag_of_a_causal_filter_is_told() -> None:
    """Exponential smoothing with alpha of backward differences: 1 / alpha - 1 / 2 rows."""
    x = np.cumsum(np.random.default_rng(2).normal(0.0, 0.1, 200))
    v = lfilter([0.5], [1.0, -0.5], backward(x, DT))
    assert computed_lag([(x, v)], DT) == pytest.approx(1.5 * DT, rel=1e-3)


def recorded(
    rates, seed: int = 0, position_noise: float = 0.002, n: int = 8, spin: float = 0.0
) -> History:
    """Pushed at random, with measured positions, and rates as a function of positions and truth."""
    rng = np.random.default_rng(seed)
    rows = []
    for trajectory in range(n):
        push = rng.normal(size=(40, 3)) * (2.0, 2.0, 8.0)
        v = np.cumsum(np.vstack([[*rng.normal(size=2), rng.normal() + spin], DT * push]), axis=0)
        moved = DT * v[:-1] + DT**2 / 2 * push
        p = np.cumsum(np.vstack([rng.normal(size=3), moved]), axis=0)
        p = p + position_noise * rng.normal(size=p.shape)
        rate = rates(p, v, rng)
        p[:, 2] = np.angle(np.exp(1j * p[:, 2]))
        for step in range(len(p)):
            wrench = [0.0] * 3 if step < len(p) - 1 else [np.nan] * 3
            rows.append([trajectory, step, step * DT, "puck", *p[step], *rate[step], *wrench])
    return History.from_dataframe(pd.DataFrame(rows, columns=COLUMNS), PUCK)


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.1, 1.0])
def test_a_measured_velocity_is_not(noise: float) -> None:
    """At seeds 0 to 9, from a tenth of what positions would give to fifty times that."""
    for seed in range(10):
        history = recorded(lambda p, v, rng: v + noise * rng.normal(size=v.shape), seed)
        assert not unused_velocities(history)


def test_a_body_may_turn_by_more_than_half_a_turn_between_samples() -> None:
    fast = 1.3 * np.pi / DT
    own = recorded(lambda p, v, rng: v + 0.05 * rng.normal(size=v.shape), spin=fast)
    assert not unused_velocities(own)
    computed = recorded(lambda p, v, rng: np.gradient(p, DT, axis=0), spin=fast)
    assert [each.state for each in unused_velocities(computed)] == ALL


@pytest.mark.parametrize("rows", [8, 60])
def test_a_velocity_that_is_zero_while_its_position_moves_was_not_measured(rows: int) -> None:
    frame = recorded(lambda p, v, rng: 0.0 * v, n=6).to_dataframe()
    unused = unused_velocities(History.from_dataframe(frame[frame["step"] < rows], PUCK))
    assert [each.state for each in unused] == ALL
    assert unused[0].sentence == "vx of puck is 0 in all rows while x moves, and is not used"


def test_a_resting_body_s_zero_velocities_are_used() -> None:
    frame = recorded(lambda p, v, rng: 0.0 * v, n=6).to_dataframe()
    frame[["x", "y", "theta"]] = 0.001 * np.random.default_rng(0).normal(size=(len(frame), 3))
    history = History.from_dataframe(frame, PUCK)
    assert not unused_velocities(history)
    # and a model of whole trajectories has accelerations that are unexplained
    assert observed_coordinates(PUCK, history).rates == (3, 4, 5)


def test_gaps_do_not_prevent_recognition_and_angles_are_unwrapped() -> None:
    def gradient_with_gaps(p, v, rng):
        rates = np.gradient(p, DT, axis=0)
        rates[20], p[21] = np.nan, np.nan
        return rates

    unused = unused_velocities(recorded(gradient_with_gaps, n=2, spin=30.0))
    assert [each.state for each in unused] == ALL
    assert unused[2].sentence == "omega of puck was computed from theta and is not used"


def test_what_was_computed_counts_as_missing_and_is_started_from() -> None:
    history = recorded(lambda p, v, rng: np.gradient(p, DT, axis=0))
    alone = measured_alone(history)
    assert np.isnan(alone.dataset["observed"].sel(state=["vx", "vy", "omega"])).all()
    assert np.isfinite(alone.dataset["observed"].sel(state=["x", "y", "theta"])).all()
    assert alone.dataset["start"].equals(history.dataset["start"])
    assert alone.data_sha256 == history.data_sha256
    kept = measured_alone(history, ())
    assert kept.dataset["observed"].equals(history.dataset["observed"])


def test_noise_is_known_from_kinematics_alone() -> None:
    """Of pushes that jump from one interval to the next, too; 2000 rows, 8 standard errors."""
    rng, dt = np.random.default_rng(3), 0.02
    acceleration = rng.normal(0.0, 3.0, (8, 250))
    velocity = np.cumsum(dt * acceleration, axis=1)
    place = np.cumsum(dt * velocity - dt**2 / 2 * acceleration, axis=1)
    rows = []
    for t in range(8):
        for i in range(250):
            x = place[t, i] + 0.002 * rng.standard_normal()
            vx = velocity[t, i] + 0.1 * rng.standard_normal()
            wrench = [np.nan] * 3 if i == 249 else [0.0] * 3
            rows.append([t, i, i * dt, "puck", x, 0.0, 0.0, vx, 0.0, 0.0, *wrench])
    scene = Scene(time_step=dt, bodies=(Body("puck", Shape.circle(0.1)),))
    noise = measurement_noise(History.from_dataframe(pd.DataFrame(rows, columns=COLUMNS), scene))
    assert noise[0, 0] == pytest.approx(0.002, rel=0.2)
    assert noise[0, 3] == pytest.approx(0.1, rel=0.2)
    assert noise[0, 1] == noise[0, 4] == 0.0


@pytest.mark.skipif(not RECORDED.is_dir(), reason="../shared/data is not beside the repository")
def test_delivered_velocities_are_used() -> None:
    """Simulated logs with independent noise, and velocities fitted to positions of a faster log."""
    for path in sorted(RECORDED.rglob("*.csv")):
        history = History.load(path, Scene.load(path.parent / "scene.toml"))
        assert unused_velocities(history) == ()
