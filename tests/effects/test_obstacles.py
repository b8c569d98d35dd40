"""Grid points of the scan for a hidden disc: on what the hits say, exactly where they say all."""

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from tests.helpers.worlds import BY_NAME, body, predict, state

pytestmark = pytest.mark.one_stack

SCAN = BY_NAME["hidden_obstacle"].scan
DISC = np.array([0.4, -0.2, 0.3])
DT = 0.05


def recording(shape: Shape, starts: list[np.ndarray], steps: int = 20) -> tuple[Scene, History]:
    """Free motions of a body that bounces off the disc, without noise."""
    scene = Scene(time_step=DT, substeps=40, bodies=(body("puck", shape, r=0.6),))
    rows = []
    for trajectory, start in enumerate(starts):
        states = predict(
            scene, start, horizon=steps, effects={"hidden_obstacle": tuple(DISC)}, phi=DISC
        )[:, 0]
        for step, values in enumerate([start, *states]):
            row = dict(zip(("x", "y", "theta", "vx", "vy", "omega"), values, strict=True))
            rows.append({"trajectory": trajectory, "time": DT * step, "body": "puck", **row})
    wrench = dict.fromkeys(("force_x", "force_y", "torque"), 0.0)
    return scene, History.from_dataframe(pd.DataFrame(rows).assign(**wrench), scene)


def grid_points(shape: Shape, starts: list[np.ndarray]) -> np.ndarray:
    scene, history = recording(shape, starts)
    return np.asarray(SCAN(scene, history, scene.bodies[0]))


def test_two_hits_give_the_disc() -> None:
    """Centre and radius follow from two places and directions; contacts last a substep."""
    starts = [state(x=-0.6, y=-0.1, vx=2.0), state(x=0.3, y=1.0, vy=-1.5, vx=0.1)]
    found = grid_points(Shape.circle(0.1), starts)
    assert np.abs(found[0] - DISC).max() < 0.02


@pytest.mark.parametrize("shape", [Shape.box(0.2, 0.12), Shape.circle(0.1)])
def test_a_single_hit_gives_the_place_on_the_disc(shape) -> None:
    """Every disc that is tried touches the place of the hit, off the centre or not."""
    for y in (-0.32, -0.2, -0.1):
        found = grid_points(shape, [state(x=-0.6, y=y, theta=0.3, vx=2.0)])
        gap = np.linalg.norm(found[:, :2] - DISC[:2], axis=1) - DISC[2]
        straight = found[::3]  # without a turn, the disc and the one tried touch inside
        apart = np.linalg.norm(straight[:, :2] - DISC[:2], axis=1) - abs(straight[:, 2] - DISC[2])
        assert len(found) == 9
        assert np.abs(apart).max() < 0.03
        assert np.abs(gap).min() < DISC[2]


def test_what_never_changes_its_velocity_hit_nothing() -> None:
    assert grid_points(Shape.circle(0.1), [state(x=-0.6, y=5.0, vx=1.0)]).shape == (0, 3)


def test_a_hit_that_was_not_measured_is_left_out() -> None:
    scene = Scene(time_step=DT, bodies=(Body("puck", Shape.circle(0.1)),))
    _, history = recording(Shape.circle(0.1), [state(x=-0.6, y=-0.1, vx=2.0)])
    table = history.to_dataframe()
    table.loc[table["step"] > 2, ["vx", "vy"]] = np.nan
    assert SCAN(scene, History.from_dataframe(table, scene), scene.bodies[0]).shape == (0, 3)


@pytest.mark.parametrize("stopped", [False, True])
def test_a_swing_hits_nothing_unless_it_is_stopped(stopped) -> None:
    """A hinge changes the velocity all the time; where a stop reverses it, something is there."""
    arm = Body("arm", Shape.box(0.04, 0.4))
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.18), (0.0, 0.0))
    scene = Scene(time_step=DT, gravity=(0.0, -9.81), bodies=(arm,), joints=(hinge,))
    time = DT * np.arange(60)
    theta, omega = 0.5 * np.cos(4.0 * time), -2.0 * np.sin(4.0 * time)
    if stopped:  # at the bottom, where it is fastest
        omega *= np.sign(theta)
        theta = abs(theta)
    table = pd.DataFrame({"trajectory": 0, "time": time, "body": "arm", "theta": theta})
    table = table.assign(omega=omega, force_x=0.0, force_y=0.0, torque=0.0)
    history = History.from_dataframe(table, scene)
    found = np.asarray(SCAN(scene, history, arm))
    assert (len(found) > 0) == stopped
