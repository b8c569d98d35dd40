"""Natural units that a recording shows, and masses that it contradicts."""

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.history import History, with_units
from pbrl_ppl.scene import Body, Scene, Shape, units_of

pytestmark = pytest.mark.one_stack


def scene(**options) -> Scene:
    return Scene(time_step=0.1, bodies=(Body("sled", Shape.circle(0.5), **options),))


def pushed(mass: float, noise: float = 0.0, rows: int = 60) -> History:
    """Return a sled on ice, pushed along x by a force of 6 N that turns round every second."""
    force = np.where(np.arange(rows) // 10 % 2, -6.0, 6.0)
    v = np.concatenate([[0.0], np.cumsum(force[:-1] / mass * 0.1)])
    x = np.concatenate([[0.0], np.cumsum(0.1 * v[:-1] + 0.005 * force[:-1] / mass)])
    x = x + noise * np.random.default_rng(0).standard_normal(rows)
    frame = pd.DataFrame({"trajectory": 0, "time": 0.1 * np.arange(rows), "body": "sled", "x": x})
    frame = frame.assign(y=0.0, theta=0.0, vx="", vy="", omega="")
    frame = frame.assign(force_x=force, force_y=0.0, torque=0.0)
    return History.from_dataframe(frame, scene())


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_units_are_the_recording_s(noise) -> None:
    """Closed forms: speeds rise from 0 to 3 m/s and fall again, at 3 m/s^2."""
    units = units_of(with_units(scene(known={"mass": 2.0}), pushed(2.0, noise)), "sled")
    assert units.speed == pytest.approx(np.sqrt(3.0), rel=0.05)
    assert units.force == pytest.approx(6.0, rel=0.1)
    assert units.time == pytest.approx(5.9)
    assert units.x == pytest.approx(pushed(2.0).dataset["observed"][..., 0].mean().item(), abs=0.01)


def test_stated_units_are_kept() -> None:
    stated = scene(typical={"speed": 7.0})
    once = with_units(stated, pushed(2.0))
    assert units_of(once, "sled").speed == 7.0
    assert with_units(once, pushed(5.0)) == once


def test_an_angle_that_nobody_saw_may_turn() -> None:
    """By a scale of next to no turning, drags were so large that the engine could not step."""
    sled = Scene(time_step=0.1, normal_gravity=9.81, bodies=scene().bodies)
    frame = pushed(2.0, 0.002).to_dataframe()

    def turn_rate(theta: object) -> float:
        history = History.from_dataframe(frame.assign(theta=theta), sled)
        return units_of(with_units(sled, history), "sled").turn_rate

    assert turn_rate(0.0) < 0.1
    assert turn_rate("") == units_of(sled, "sled").turn_rate > 1.0
