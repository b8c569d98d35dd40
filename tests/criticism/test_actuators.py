"""What is wrong with one actuator is named, in units of its column; motion by SciPy."""

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import pbrl_ppl as pp

pytestmark = [pytest.mark.slow, pytest.mark.one_stack]

STEP, MOMENT, FRICTION, DEAD = 0.02, 0.002, 0.004, 0.05
#: Torque for each unit of duty (N m), and what the speed takes off it (N m s).
GAIN, LOSS = 0.05 * 12.0 / 1.2, 0.05**2 / 1.2
MOTOR = pp.Actuator(
    name="duty", kind="motor", body="wheel",
    known={"torque_constant": 0.05, "resistance": 1.2, "supply": 12.0},
)  # fmt: skip
SCENE = pp.Scene(
    time_step=STEP,
    bodies=(pp.Body("wheel", pp.Shape.circle(0.1), known={"mass": 0.4}),),
    joints=(pp.Joint("hinge", ("wheel", "world"), (0.0, 0.0), (0.0, 0.0)),),
    actuators=(MOTOR,),
)


def recording(seed: int) -> pd.DataFrame:
    """Two runs of 4 s; 2 mrad of noise."""
    rng, rows = np.random.default_rng(seed), []
    for run in range(2):
        z, u = np.zeros(2), 0.0
        for k in range(200):
            u = rng.uniform(-0.3, 0.3) if k % 25 == 0 else u
            rows.append((run, k * STEP, z[0] + 2e-3 * rng.normal(), u))
            acting = GAIN * np.sign(u) * max(abs(u) - DEAD, 0.0)

            def slope(t: float, z: np.ndarray, acting: float = acting) -> list[float]:
                resisting = LOSS * z[1] + FRICTION * np.tanh(z[1] / 1e-3)
                return [z[1], (acting - resisting) / MOMENT]

            z = solve_ivp(slope, (0, STEP), z, method="LSODA", rtol=1e-8, atol=1e-9).y[:, -1]
    return pd.DataFrame(rows, columns=["trajectory", "time", "theta", "duty"])


def test_the_dead_zone_of_a_motor_s_duty() -> None:
    found = pp.attribute(SCENE, pp.History.from_dataframe(recording(1), SCENE), seed=1)
    named = {law.effect: law.estimate for law in found.laws}
    assert set(named) == {"duty_dead_zone", "pivot_friction"}
    assert named["duty_dead_zone"]["threshold"] == pytest.approx(DEAD, rel=0.02)
    assert named["pivot_friction"]["torque"] == pytest.approx(FRICTION, rel=0.05)


def test_a_dead_zone_in_counts_of_a_register() -> None:
    """The gain is inferred, and a full command of 255 counts says of what size both are."""
    counts = recording(1)
    counts["duty"] *= 255.0
    prior = {"loss": {"sigma": 0.01}}
    motor = pp.Actuator(name="duty", kind="motor", body="wheel", full=255.0, prior=prior)
    scene = SCENE.replace(actuators=(motor,))
    found = pp.attribute(scene, pp.History.from_dataframe(counts, scene), seed=1)
    named = {law.effect: law.estimate for law in found.laws}
    assert set(named) == {"duty_dead_zone", "pivot_friction"}
    assert named["duty_dead_zone"]["threshold"] == pytest.approx(255.0 * DEAD, rel=0.05)
    assert found.after["theta"] == pytest.approx(2e-3, rel=0.1)
