"""Whole held-out trajectories, from fitted initial states, and what was never measured."""

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.misfit import simulation_test
from pbrl_ppl.reporting.motion import held_out_motions
from pbrl_ppl.scene import Recording

pytestmark = [pytest.mark.one_stack, pytest.mark.filterwarnings("ignore")]

DT, MASS, DRAG, NOISE = 0.05, 5.8, 0.012, 0.4


def test_an_error_far_beyond_the_noise_fails() -> None:
    noise, motion = {"x": 0.01, "theta": 0.001}, {"x": 2.0, "theta": 0.5}
    near = simulation_test({"x": 0.02, "theta": 0.001}, noise, motion, 4.0, DEFAULT)
    assert near.passed and near.dimension == "" and "simulated over 4 s" in near.sentence
    far = simulation_test({"x": 0.9, "theta": 0.004}, noise, motion, 4.0, DEFAULT)
    assert not far.passed and far.dimension == "x" and far.size == pytest.approx(90.0)
    assert "0.9 m off in x, 90 times the measurement noise" in far.sentence
    # 1 % of the motion is negligible, however small the noise
    small = simulation_test({"x": 0.019}, {"x": 1e-4}, motion, 4.0, DEFAULT)
    assert small.passed
    untested = simulation_test({}, noise, motion, 4.0, DEFAULT)
    assert untested.passed and not untested.tested


def climbs(starts: list[float], seed: int, n: int = 120) -> pd.DataFrame:
    """Altitudes of a body that coasts upwards against quadratic drag: errors of AR(0.9)."""
    rng, rows = np.random.default_rng(seed), []
    for run, speed in enumerate(starts):
        y, v, error = 0.0, speed, NOISE * rng.normal()
        for row in range(n):
            rows.append((run, DT * row, y + error))
            for _ in range(50):
                v += DT / 50 * (-9.81 - DRAG / MASS * v * abs(v))
                y += DT / 50 * v
            error = 0.9 * error + np.sqrt(0.19) * NOISE * rng.normal()
    return pd.DataFrame(rows, columns=["trajectory", "t", "y"])


@pytest.mark.slow
def test_correlated_errors_of_a_sensor_do_not_hide_a_drag() -> None:
    """What was called adequate, with forecasts far off, is a law; its interval holds the truth."""
    body = pp.Body("craft", pp.Shape.circle(0.05), known=(("mass", MASS),))
    layout = Recording(columns={"time": "t"})
    scene = pp.Scene(
        time_step=DT, gravity=(0.0, -9.81), normal_gravity=0.0, bodies=(body,), recording=layout
    )
    train, test = (
        pp.History.from_dataframe(climbs(starts, seed), scene, layout=layout)
        for starts, seed in (([260.0, 240.0, 200.0], 1), ([250.0, 220.0], 2))
    )
    loop = pp.close_loop(scene, train, test, method="laplace")
    assert loop.verdict == "effects-added"
    assert [one.effect for one in loop.added] == ["quadratic_drag"]
    low, high = loop.added[0].parameters["coefficient"].hdi
    assert low < DRAG < high and high - low < 0.2 * DRAG
    before, after = loop.before.simulated_rmse["y"], loop.after.simulated_rmse["y"]
    assert after < 2 * NOISE < 0.2 * before


@pytest.mark.slow
def test_what_was_never_measured_is_not_animated() -> None:
    """Of a car of which the speed alone was logged."""
    rng = np.random.default_rng(3)
    scene = pp.Scene(
        time_step=0.1,
        bodies=(pp.Body("car", pp.Shape.box(0.4, 0.2), known=(("mass", 2.0),)),),
    )
    states = np.full((6, 40, 1, 6), np.nan)
    time = 0.1 * np.arange(40)
    for run, speed in enumerate(rng.uniform(1.0, 3.0, 6)):
        states[run, :, 0, 3] = speed * np.exp(-0.4 * time) + rng.normal(0.0, 0.01, 40)
    history = pp.History.of_arrays(states, scene)
    loop = pp.close_loop(scene, history, method="laplace")
    assert {one.effect for one in loop.added} & {"linear_drag"}
    assert held_out_motions(loop) == []
    assert set(loop.after.simulated_rmse) == {"vx"}
