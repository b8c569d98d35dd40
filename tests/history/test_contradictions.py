"""Columns that contradict each other: velocities, clocks, commands that are rows early or late."""

import json
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.cli import main
from pbrl_ppl.criticism.prior_check import informative_horizon, prior_predictive_check
from pbrl_ppl.history import (
    History,
    command_shifts,
    measured_alone,
    shift_sentence,
    unused_velocities,
    wrong_clock,
)
from pbrl_ppl.history.velocities import contradiction
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Joint, Recording, Scene, Shape

pytestmark = [pytest.mark.one_stack, pytest.mark.filterwarnings("ignore::UserWarning")]

CART = Scene(time_step=0.02, bodies=(Body("cart", Shape.box(0.2, 0.1)),))
TIME = 0.02 * np.arange(500)
SPEED = 3.0 * np.cos(3.0 * TIME) + 0.5 * np.cos(1.1 * TIME)
PLACE = np.sin(3.0 * TIME) + 0.5 / 1.1 * np.sin(1.1 * TIME)


def driven(change=lambda v: v, seed: int = 1, noise: float = 1e-4) -> pd.DataFrame:
    """A carriage whose speed was measured apart, and changed before it was written."""
    rng = np.random.default_rng(seed)
    speed = SPEED + 0.01 * rng.standard_normal(len(TIME))
    place = PLACE + noise * rng.standard_normal(len(TIME))
    return pd.DataFrame({"time": TIME, "x": place, "y": 0.0, "vx": change(speed)})


def read(frame: pd.DataFrame, scene: Scene = CART, **layout) -> History:
    return History.from_dataframe(frame, scene, layout=Recording(**layout))


FAULTS = {
    "wraps every 3,": lambda v: (v + 1.5) % 3.0 - 1.5,
    "is clipped at 2,": lambda v: np.clip(v, -2.0, 2.0),
    "is 0,": lambda v: np.where(np.arange(len(v)) % 4 == 3, 0.0, v),
    "is 0.25 times the rate": lambda v: 0.25 * v,
    "has the other sign": lambda v: -v,
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_velocity_that_contradicts_its_position_is_named(kind: str, tmp_path: Path) -> None:
    """`new` writes the entry by which nothing is left to say; the column is not used before."""
    frame = driven(FAULTS[kind])
    history = read(frame)
    (found,) = unused_velocities(history)
    assert kind in found.sentence
    off = np.abs(frame["vx"] - SPEED).to_numpy()[1:-1] > 0.5
    assert found.fault is not None
    assert found.fault.row == 1 + int(off.argmax())
    assert found.fault.share == pytest.approx(off.mean(), abs=0.15)
    assert np.isnan(measured_alone(history).dataset["observed"].sel(state="vx")).all()
    frame.to_csv(tmp_path / "log.csv", index=False)
    scene, log = str(tmp_path / "scene.toml"), str(tmp_path / "log.csv")
    asked = ["--history", log, "--columns", "body=cart", "--body", "cart=box:0.2x0.1", "--quiet"]
    assert main(["new", scene, *asked]) == 0
    written = Scene.load(scene)
    assert written.recording is not None
    expected = {"vx": "0.25/m"} if "times" in kind else {}
    assert written.recording.velocities == ("measured" if expected else "computed")
    units = dict(written.recording.units)
    assert units.keys() == expected.keys()
    if expected:
        assert float(units["vx"].removesuffix("/m")) == pytest.approx(0.25, rel=0.01)
    assert unused_velocities(History.load(log, written)) == ()


@pytest.mark.parametrize("kind", ["wraps every 3,", "is 0.25 times the rate", "lags x by 60"])
def test_new_leaves_velocities_of_a_whole_history_out(kind, tmp_path: Path, capsys) -> None:
    """Its units are SI units, whatever [recording] says; a column that is late counts as well."""
    late = 3.0 * np.cos(3.0 * (TIME - 0.06)) + 0.5 * np.cos(1.1 * (TIME - 0.06))
    noise = 0.01 * np.random.default_rng(2).standard_normal(len(TIME))
    frame = driven(FAULTS.get(kind, lambda v: late + noise))
    frame = frame.assign(trajectory=0, body="cart", theta=np.nan, vy=np.nan, omega=np.nan)
    frame.assign(force_x=0.0, force_y=0.0, torque=0.0).to_csv(tmp_path / "log.csv", index=False)
    scene, log = tmp_path / "scene.toml", str(tmp_path / "log.csv")
    assert main(["new", str(scene), "--history", log, "--body", "cart=box:0.2x0.1"]) == 0
    assert kind in capsys.readouterr().out.replace("59.9", "60").replace("60.1", "60")
    recording = Scene.load(scene).recording
    assert recording is not None and recording.velocities == "computed"


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [0.0, 1e-4, 3e-3])
def test_a_velocity_with_noise_a_bias_or_impacts_contradicts_nothing(seed, noise) -> None:
    """A constant offset is the law `sensor_bias`, which the loop finds."""
    assert unused_velocities(read(driven(seed=seed, noise=noise))) == ()
    biased = unused_velocities(read(driven(lambda v: v + 0.5, seed, noise)))
    assert not any(one.fault for one in biased)
    there = np.abs((TIME + 0.3 * seed) % 2.0 - 1.0)  # to and fro between two walls
    bounced = driven(seed=seed, noise=noise)
    bounced["x"] += there - PLACE
    bounced["vx"] += np.sign((TIME + 0.3 * seed) % 2.0 - 1.0) - SPEED
    assert not any(one.fault for one in unused_velocities(read(bounced)))


def test_an_angle_that_turns_is_compared_by_the_shorter_way() -> None:
    turning = pd.DataFrame({"time": TIME, "x": 0.0, "y": 0.0, "theta": (9 * TIME) % (2 * np.pi)})
    turning["theta"] += 1e-4 * np.random.default_rng(1).standard_normal(len(TIME))
    assert not any(v.fault for v in unused_velocities(read(turning.assign(omega=9.0))))
    wrong = turning.assign(omega=np.where(TIME < 4.0, 3.0, 9.0))
    assert any(v.fault for v in unused_velocities(read(wrong)))


# Clocks -------------------------------------------------------------------------------------------


def thrown(pace: float, drag: float = 0.1, seed: int = 1, noise: float = 2e-4) -> pd.DataFrame:
    """A ball that is thrown, with drag (1/m); its clock counts ``pace`` seconds in one."""
    dt, rows = 1 / 240, []
    rng = np.random.default_rng(seed)
    for take in range(3):
        place, speed = np.zeros(2), np.array([2.0 + take, 5.0])
        for row in range(200):
            seen = place + noise * rng.standard_normal(2)
            rows.append((take, pace * dt * row, *seen))
            for _ in range(4):
                speed = speed + 0.25 * dt * (
                    np.array([0.0, -9.81]) - drag * np.linalg.norm(speed) * speed
                )
                place = place + 0.25 * dt * speed
    return pd.DataFrame(rows, columns=["trajectory", "time", "x", "y"])


def seen_from_the_side(pace: float) -> Scene:
    body = Body("ball", Shape.circle(0.02), known={"mass": 0.0027})
    return Scene(time_step=pace / 240, gravity=(0.0, -9.81), normal_gravity=0.0, bodies=(body,))


@pytest.mark.parametrize("pace", [8.0, 4.0, 0.5, 0.1])
def test_a_fall_tells_that_the_clock_is_wrong(pace: float, tmp_path: Path) -> None:
    scene = seen_from_the_side(pace).replace(recording=Recording())
    history = read(thrown(pace), scene)
    clock = wrong_clock(history, scene)
    assert clock is not None and clock.factor == pytest.approx(pace)
    assert f'units = {{ time = "{pace:g}/s" }}' in clock.sentence(scene)
    thrown(pace).to_csv(tmp_path / "log.csv", index=False)
    path, log = str(tmp_path / "scene.toml"), str(tmp_path / "log.csv")
    asked = ["--history", log, "--columns", "body=ball", "--body", "ball=circle:0.02", "--quiet"]
    assert main(["new", path, "--side", *asked]) == 0
    written = Scene.load(path)
    assert written.recording is not None and dict(written.recording.units)["time"] == f"{pace:g}/s"
    assert written.time_step == pytest.approx(1 / 240, rel=1e-3)
    assert wrong_clock(History.load(log, written), written) is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("drag", [0.0, 0.1, 0.3])
def test_a_true_clock_is_not_doubted(drag: float, seed: int) -> None:
    scene = seen_from_the_side(1.0)
    assert wrong_clock(read(thrown(1.0, drag, seed, 1e-3), scene), scene) is None
    above = scene.replace(gravity=(0.0, 0.0))
    assert (
        wrong_clock(read(thrown(8.0, drag, seed), above.replace(time_step=1 / 30)), above) is None
    )


def test_a_held_body_tells_nothing_of_the_clock() -> None:
    hinge = Joint("hinge", ("ball", "world"), (0.0, 0.3), (0.0, 0.0))
    scene = seen_from_the_side(8.0)
    history = read(thrown(8.0), scene)
    assert wrong_clock(history, scene.replace(joints=(hinge,))) is None
    pushed = read(thrown(8.0).assign(force_y=0.02), scene)
    assert wrong_clock(pushed, scene) is None


def test_the_prior_check_names_the_clock_first() -> None:
    scene = seen_from_the_side(8.0)
    history = read(thrown(8.0), scene)
    problem = Problem.of(Physics.declare(scene), history, horizon=informative_horizon(history))
    said = prior_predictive_check(problem, draws=60).sentences
    assert "the clock runs 8 times too fast" in said[0]
    assert not any("94 %" in sentence for sentence in said)


# Commands -----------------------------------------------------------------------------------------


def pushed(
    shift: int = 0, delay: float = 0.0, lag: float = 0.0, *, feedback: bool = False, seed: int = 0
) -> pd.DataFrame:
    """A cart with drag; its commands are logged rows late, or act late by a part of one."""
    rng, dt, parts = np.random.default_rng(seed), 0.02, 20
    sent = np.repeat(rng.normal(0.0, 3.0, 120), 5)
    place = speed = force = 0.0
    seen, acted = [], []
    for row in range(len(sent)):
        seen.append(place + 1e-4 * rng.standard_normal())
        if feedback:
            rate = (seen[-1] - seen[-2]) / dt if row else 0.0
            sent[row] = 20.0 * (np.sin(0.5 * row * dt) - seen[-1]) - 4.0 * rate
        for _ in range(parts):
            acted.append(sent[row])
            command = acted[max(0, len(acted) - 1 - round(delay * parts))]
            force = command if not lag else force + dt / parts / lag * (command - force)
            speed += dt / parts * (force - speed - 0.3 * np.sign(speed))
            place += dt / parts * speed
    logged = np.roll(sent, shift)
    time = dt * np.arange(len(sent))
    return pd.DataFrame({"time": time, "x": seen, "y": 0.0, "force_x": logged})


@pytest.mark.parametrize("shift", [1, -1, 2])
def test_commands_rows_early_or_late_are_found_and_moved(
    shift: int, tmp_path: Path, capsys
) -> None:
    found = command_shifts(read(pushed(shift)), CART)
    assert found == {"cart": -shift}
    entry = f"time = {{ offset = {-0.02 * shift:g} }}"
    assert entry in shift_sentence(CART, "cart", -shift)
    moved = read(pushed(shift), time={"offset": -0.02 * shift})
    assert command_shifts(moved, CART) == {}
    inner = slice(5, -5)
    np.testing.assert_allclose(
        moved.dataset["action"].to_numpy()[0, inner, 0, 0], pushed()["force_x"][inner], atol=1e-9
    )
    pushed(shift).to_csv(tmp_path / "log.csv", index=False)
    scene = CART.replace(recording=Recording(columns={"body": "cart"}))
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    argv = ["check", str(tmp_path / "scene.toml"), str(tmp_path / "log.csv"), "--no-prior"]
    assert main([*argv, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["command_shifts"] == {"cart": -shift}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "how", [{}, {"delay": 0.5}, {"lag": 0.02}, {"lag": 0.1}, {"feedback": True}], ids=str
)
def test_actuators_and_controllers_are_no_shifted_log(how, seed: int) -> None:
    assert command_shifts(read(pushed(**how, seed=seed)), CART) == {}


def test_two_topics_in_one_table_are_two_streams() -> None:
    """Twice, as the clock starts again; between commands the last one holds."""
    poses = pd.DataFrame({"t": 0.1 * np.arange(40), "x": np.sin(0.1 * np.arange(40))})
    sent = pd.DataFrame({"t": 0.05 + 0.5 * np.arange(8), "u": np.arange(8.0)})
    once = pd.concat([poses, sent]).sort_values("t", kind="stable")
    scene = CART.replace(time_step=0.1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        history = read(pd.concat([once, once]), scene, columns={"time": "t", "force_x": "u"})
    assert any("16 rows hold commands and no state" in str(one.message) for one in caught)
    force = history.dataset["action"].to_numpy()[:, :-1, 0, 0]
    expected = np.arange(39) // 5 - 0.5 * (np.arange(39) % 5 == 0) * (np.arange(39) > 0)
    np.testing.assert_allclose(force, np.tile(expected, (2, 1)), atol=1e-9)
    assert not history.dataset["observed"].sel(state="x").isnull().any()


def test_lost_poses_beside_commands_are_missing_measurements() -> None:
    frame = pushed()
    frame.loc[100:109, ["x", "y"]] = np.nan
    assert int(read(frame).dataset["observed"].sel(state="x").isnull().sum()) == 10
    frame.loc[frame.index % 20 != 0, "force_x"] = np.nan  # sent at a twentieth of the rate
    assert int(read(frame).dataset["observed"].sel(state="x").isnull().sum()) == 10


@pytest.mark.parametrize("seed", range(20))
def test_speeds_that_turn_round_within_rows_contradict_nothing(seed: int) -> None:
    """Exact steps under a force of its own in each interval: speeds leave both quotients."""
    pushes = np.random.default_rng(seed).normal(0.0, 3.0, (14, 5))
    rate = np.pad(np.cumsum(0.1 * pushes, axis=1), ((0, 0), (1, 0)))
    steps = 0.05 * (rate[:, 1:] + rate[:, :-1])
    position = np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0)))
    assert contradiction(position, rate, 0.1) is None
