"""Velocities that were computed from positions are recognised, and measured ones are not."""

import numpy as np
import pandas as pd
import pytest
from scipy.signal import butter, filtfilt, savgol_filter

from pbrl_ppl.history import History, derived_velocities, measured_alone, measurement_noise
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import COLUMNS

DT = 0.05
PUCK = Scene(time_step=DT, bodies=(Body("puck", Shape.circle(0.2)),))
SMOOTHERS = {
    "gradient": lambda p: np.gradient(p, DT),
    "backward difference": lambda p: np.concatenate([[0.0], np.diff(p)]) / DT,
    "rounded gradient": lambda p: np.round(np.gradient(p, DT), 4),
    "local quadratic": lambda p: savgol_filter(p, 5, 2, deriv=1, delta=DT),
    "long local cubic": lambda p: savgol_filter(p, 11, 3, deriv=1, delta=DT),
    "low-pass": lambda p: np.gradient(filtfilt(*butter(2, 0.3), p), DT),
}


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


@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_smoother_of_positions_is_recognised(name: str) -> None:
    smoother = SMOOTHERS[name]
    history = recorded(lambda p, v, rng: np.apply_along_axis(smoother, 0, p))
    assert derived_velocities(history).tolist() == [[False] * 3 + [True] * 3]


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.1, 1.0])
def test_a_measured_velocity_is_not(noise: float) -> None:
    """At seeds 0 to 9, from a tenth of what positions would give to fifty times that."""
    for seed in range(10):
        history = recorded(lambda p, v, rng: v + noise * rng.normal(size=v.shape), seed)
        assert not derived_velocities(history).any()


def test_a_body_may_turn_by_more_than_half_a_turn_between_samples() -> None:
    fast = 1.3 * np.pi / DT
    own = recorded(lambda p, v, rng: v + 0.05 * rng.normal(size=v.shape), spin=fast)
    assert not derived_velocities(own).any()
    computed = recorded(lambda p, v, rng: np.gradient(p, DT, axis=0), spin=fast)
    assert derived_velocities(computed).tolist() == [[False] * 3 + [True] * 3]


def test_a_short_recording_says_nothing() -> None:
    history = recorded(lambda p, v, rng: np.gradient(p, DT, axis=0), n=1)
    assert not derived_velocities(history).any()


def test_what_was_computed_counts_as_missing_and_is_started_from() -> None:
    history = recorded(lambda p, v, rng: np.gradient(p, DT, axis=0))
    alone = measured_alone(history)
    assert np.isnan(alone.dataset["observed"].sel(state=["vx", "vy", "omega"])).all()
    assert np.isfinite(alone.dataset["observed"].sel(state=["x", "y", "theta"])).all()
    assert alone.dataset["start"].equals(history.dataset["start"])
    assert alone.data_sha256 == history.data_sha256
    kept = measured_alone(history, np.zeros((1, 6), dtype=bool))
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
