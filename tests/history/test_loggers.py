"""Logs as loggers write them: clocks, streams, orientation, lost tracking and heads of files."""

import json
import re
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from pbrl_ppl import history as room
from pbrl_ppl.cli import main
from pbrl_ppl.effects import attach
from pbrl_ppl.errors import (
    HistoryError,
    LayoutError,
    RecordingWarning,
    ResamplingWarning,
    SceneError,
)
from pbrl_ppl.history import History, read_recording
from pbrl_ppl.history.cuts import frozen_poses, telling, zero_poses
from pbrl_ppl.history.guesses import planar_yaw
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Actuator, Body, Joint, Recording, Scene, Shape
from tests.helpers.places import ROOT
from tests.helpers.plain import PlainSimulator

pytestmark = [pytest.mark.one_stack, pytest.mark.filterwarnings("ignore::UserWarning")]

PUCK = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))
#: An arm of 0.3 m below its hinge; seen from the side.
POLE = Scene(
    time_step=0.05, gravity=(0.0, -9.81), normal_gravity=0.0,
    bodies=(Body("pole", Shape.circle(0.02)),),
    joints=(Joint("hinge", ("pole", "world"), (0.0, 0.3), (0.0, 0.0)),),
)  # fmt: skip
N = 60


def load(frame: pd.DataFrame, scene: Scene = PUCK, *, commands=None, **layout) -> History:
    return History.from_dataframe(frame, scene, layout=Recording(**layout), commands=commands)


def of(history: History, name: str) -> np.ndarray:
    kind, dim = (
        ("action", "wrench") if "force" in name or name == "torque" else ("observed", "state")
    )
    return history.dataset[kind].sel({dim: name}).to_numpy()[0, :, 0]


def moving(n: int = N, dt: float = 0.1) -> pd.DataFrame:
    time = dt * np.arange(n)
    return pd.DataFrame({"t": time, "x": np.sin(time), "y": np.cos(time)})


# Clocks -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [0.0, 1.7e9], ids=["power-on", "epoch"])
@pytest.mark.parametrize(("unit", "size"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_the_unit_of_times_is_proposed_from_the_numbers(unit, size, origin) -> None:
    frame = moving()
    frame["t"] = size * (frame["t"] + origin)
    with pytest.raises(
        LayoutError, match=f'looks like {unit}: units = {{ time = "{unit}" }}'
    ) as it:
        load(frame, columns={"time": "t"})
    assert it.value.entries == {"units": {"time": unit}}
    history = load(frame, columns={"time": "t"}, units=it.value.entries["units"])
    np.testing.assert_allclose(history.dataset["clock"][0], 0.1 * np.arange(N), atol=1e-5)
    assert history.dataset["clock"][0, 0] == 0.0


def test_times_in_seconds_since_1970_and_slow_ones_that_are_declared() -> None:
    frame = moving()
    frame["t"] += 1.7e9
    assert load(frame, columns={"time": "t"}).n_transitions == N - 1
    slow = PUCK.replace(time_step=5.0)
    with pytest.raises(LayoutError, match="looks like ms"):
        load(moving(dt=5.0), slow, columns={"time": "t"})
    assert load(moving(dt=5.0), slow, columns={"time": "t"}, units={"time": "s"}).n_transitions


def test_dates_are_times() -> None:
    dates = pd.Timestamp("2024-05-28T10:00:00") + pd.to_timedelta(0.1 * np.arange(N), unit="s")
    frame = moving().assign(t=dates.strftime("%Y-%m-%dT%H:%M:%S.%f"))
    np.testing.assert_allclose(load(frame, columns={"time": "t"}).dataset["clock"][0, 5], 0.5)
    with pytest.raises(HistoryError, match="expected a number or a date such as 2024"):
        load(moving().assign(t="soon"), columns={"time": "t"})


def bursts(seed: int = 1, size: int = 8) -> pd.DataFrame:
    rng, count = np.random.default_rng(seed), np.arange(400)
    arrived = 0.1 * size * (count // size + 1) + rng.uniform(0.0, 1e-3, len(count))
    return pd.DataFrame({"t": np.round(arrived, 4), "count": count, "x": np.sin(0.1 * count)})


def test_stamps_in_bursts_offer_the_true_rate() -> None:
    with pytest.raises(LayoutError, match=r"come in bursts.*rate = 10, counter = .count.") as it:
        load(bursts(), columns={"time": "t"})
    assert "sort" not in str(it.value)
    history = load(bursts(), columns={"time": "t"}, **it.value.entries)
    np.testing.assert_allclose(of(history, "x"), np.sin(0.1 * np.arange(400)))
    with pytest.raises(LayoutError) as it:
        load(bursts().drop(columns="count"), columns={"time": "t"})
    assert it.value.entries == {"time": {"rate": 10.0}}
    assert load(bursts(), columns={"time": "t"}, time={"rate": 10.0}).n_transitions == 399
    lost = bursts().drop(index=range(100, 120))
    gap = load(lost, columns={"time": "t"}, time={"rate": 10.0, "counter": "count"},
               cut={"gaps": 0.5})  # fmt: skip
    assert gap.dataset["n_rows"].to_numpy().tolist() == [100, 280]


def test_bodies_that_share_a_stamp_are_no_bursts() -> None:
    """One row for each body: half of the rows have the stamp of the row before."""
    scene = PUCK.replace(bodies=(*PUCK.bodies, Body("disc", Shape.circle(0.1))))
    other = moving().assign(x=lambda table: table["x"] + 1.0, object="disc")
    both = pd.concat([moving().assign(object="puck"), other]).sort_values("t", kind="stable")
    history = load(both, scene, columns={"time": "t", "body": "object"})
    assert history.n_transitions == N - 1


@pytest.mark.parametrize("seed", range(20))
def test_jittered_stamps_are_no_bursts(seed: int) -> None:
    """Twenty clocks that jitter by up to 40 % of a step: no false alarm."""
    rng, frame = np.random.default_rng(seed), moving(300)
    frame["t"] += rng.uniform(0.0, 0.04, len(frame))
    with pytest.warns(ResamplingWarning):
        load(frame, columns={"time": "t"}, resample=True)


def test_a_clock_that_starts_again_begins_a_trajectory() -> None:
    runs = pd.concat([moving(20), moving(30), moving(10)], ignore_index=True)
    with pytest.warns(RecordingWarning, match="falls back 2 times: a new trajectory begins"):
        history = load(runs, columns={"time": "t"})
    assert history.dataset["n_rows"].to_numpy().tolist() == [20, 30, 10]


def test_rows_out_of_order_and_twice() -> None:
    frame = moving()
    order = [*range(10), 11, 10, *range(12, N)]
    with pytest.warns(RecordingWarning, match="1 rows are out of order .* sorted by time"):
        swapped = load(frame.iloc[order], columns={"time": "t"})
    assert swapped.data_sha256 == load(frame, columns={"time": "t"}).data_sha256
    twice = frame.iloc[[*range(10), 9, *range(10, N)]]
    with pytest.warns(RecordingWarning, match=r"1 rows repeat a time and are left out$"):
        assert load(twice, columns={"time": "t"}).data_sha256 == swapped.data_sha256
    other = twice.copy()
    other.iloc[10, 1] = 9.0
    with pytest.warns(RecordingWarning, match="left out, 1 of them with other values"):
        assert load(other, columns={"time": "t"}).data_sha256 == swapped.data_sha256


# Resampling ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("measured", [False, True], ids=["positions", "velocities"])
def test_resampling_makes_no_data_up(measured: bool) -> None:
    """Pairs of stamps 3e-5 s apart with a millimetre of noise: a cubic would leave by metres."""
    rng, time = np.random.default_rng(2), 0.1 * np.arange(200) + np.tile([0.0, -0.0999], 100)
    true = np.sin(time)
    frame = pd.DataFrame({"t": time, "x": true + rng.normal(0.0, 1e-3, 200)})
    if measured:
        frame["vx"] = np.cos(time) + rng.normal(0.0, 1e-3, 200)
    coarse = PUCK.replace(time_step=0.2)
    with pytest.warns(ResamplingWarning):
        history = load(frame, coarse, columns={"time": "t"}, resample=True)
    clock = history.dataset["clock"].to_numpy()[0]
    assert np.abs(of(history, "x") - np.sin(clock))[5:-5].max() < 6e-3


def test_a_resampled_position_stays_between_its_neighbours() -> None:
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.06, 0.14, 300))
    steps = np.cumsum(rng.normal(0.0, 1.0, 300))
    with pytest.warns(ResamplingWarning):
        history = load(pd.DataFrame({"t": time, "x": steps}), columns={"time": "t"}, resample=True)
    clock = (
        history.dataset["clock"].to_numpy()[0] + time[0] - history.dataset["clock"].to_numpy()[0, 0]
    )
    at = np.clip(np.searchsorted(time, clock, side="right") - 1, 0, 298)
    low, high = np.minimum(steps[at], steps[at + 1]), np.maximum(steps[at], steps[at + 1])
    x = of(history, "x")
    assert (x > low - 1e-9).all() and (x < high + 1e-9).all()


def test_gaps_offer_a_cut() -> None:
    frame = moving(100).drop(index=range(40, 60))
    frame["t"] += np.random.default_rng(1).uniform(0, 0.01, len(frame))
    with pytest.raises(LayoutError, match=r"cut = \{ gaps = 0.5 \}") as it:
        load(frame, columns={"time": "t"}, resample=True)
    with pytest.warns(ResamplingWarning):
        history = load(frame, columns={"time": "t"}, resample=True, **it.value.entries)
    assert history.n_trajectories == 2


# Streams ------------------------------------------------------------------------------------------


def test_commands_of_another_file_are_held(tmp_path: Path) -> None:
    frame = moving().assign(t=1.7e9 + 0.1 * np.arange(N))
    commands = pd.DataFrame({"stamp": [1.7e18 + 2.5e7, 1.7e18 + 1.03e9], "push.x": [1.0, 3.0]})
    frame.to_csv(tmp_path / "run.csv", index=False)
    commands.to_csv(tmp_path / "run_cmd.csv", index=False)
    layout = Recording(
        columns={"time": "t", "force_x": "push.x"}, commands="{stem}_cmd.csv"
    )  # fmt: skip
    with pytest.warns(
        RecordingWarning, match="push.x, which begins 0.025 s after the rows, is held"
    ):
        history = History.load(tmp_path / "run.csv", PUCK.replace(recording=layout))
    force = of(history, "force_x")[:-1]
    expected = np.where(np.arange(N - 1) < 10, 1.0, 3.0)
    expected[10] = 0.3 * 1.0 + 0.7 * 3.0  # a command that changes within a row keeps its impulse
    np.testing.assert_allclose(force, expected, atol=1e-5)
    assert (of(history, "torque")[:-1] == 0.0).all()


def test_commands_that_share_no_clock_are_refused() -> None:
    commands = pd.DataFrame({"t": 100.0 + np.arange(5.0), "force_x": 1.0})
    with pytest.raises(HistoryError, match=r"no time in common.*time = \{ offset"):
        load(moving(), columns={"time": "t"}, commands=commands)
    with pytest.warns(RecordingWarning):
        history = load(moving(), columns={"time": "t"}, commands=commands, time={"offset": -100.0})
    assert (of(history, "force_x")[:-1] == 1.0).all()
    with pytest.raises(HistoryError, match="has no column of times"):
        load(moving(), columns={"time": "t"}, commands=commands.rename(columns={"t": "when"}))
    with pytest.raises(HistoryError, match="no column of a wrench"):
        load(moving(), columns={"time": "t"}, commands=commands.rename(columns={"force_x": "u"}))


def test_columns_with_clocks_of_their_own() -> None:
    """A shorter column is padded; of a smooth signal samples are no steps."""
    n, m = 200, 40
    times = {"angle_time [ms]": 50.0 * np.arange(n), "torque_time [ms]": 7.0 + 250.0 * np.arange(m)}
    values = {"angle [deg]": np.degrees(0.3 * np.sin(0.05 * np.arange(n))),
              "torque [N m]": np.sin(0.25 * np.arange(m))}  # fmt: skip
    frame = pd.concat([pd.Series(v, name=k) for k, v in {**times, **values}.items()], axis=1)
    layout = dict(columns={"theta": "angle", "torque": "torque"},
                  time={"theta": "angle_time [ms]", "torque": "torque_time [ms]"})  # fmt: skip
    with pytest.warns(RecordingWarning, match="0.007 s after the rows, is interpolated"):
        smooth = load(frame, POLE, **layout)
    np.testing.assert_allclose(of(smooth, "theta"), 0.3 * np.sin(0.05 * np.arange(n)), atol=1e-9)
    inside = slice(5, m * 5 - 10)
    clock = smooth.dataset["clock"].to_numpy()[0, inside]
    np.testing.assert_allclose(of(smooth, "torque")[inside], np.sin(clock - 0.007), atol=0.01)
    with pytest.warns(RecordingWarning, match="is held"):
        held = load(frame, POLE, hold=True, **layout)
    assert of(held, "torque")[7] == pytest.approx(np.sin(0.25))
    with pytest.raises(HistoryError, match="no such column"):
        load(frame, POLE, columns={"theta": "angle"}, time={"theta": "clock"})


def test_an_empty_command_holds_and_lacking_ones_are_zero() -> None:
    frame = moving().assign(u=np.where(np.arange(N) % 5 == 0, np.arange(N), np.nan))
    with pytest.warns(RecordingWarning, match="force_x is empty in 47 rows: the command before"):
        history = load(frame, columns={"time": "t", "force_x": "u"})
    np.testing.assert_array_equal(of(history, "force_x")[:-1], np.arange(N - 1) // 5 * 5)
    assert (of(history, "force_y")[:-1] == 0.0).all()


# Orientation --------------------------------------------------------------------------------------

YAW = np.linspace(0.0, 9.0, N)


@pytest.mark.parametrize("names", ["x y z w", "qx qy qz qw", "pose.orientation.x pose.orientation.y"
                                   " pose.orientation.z pose.orientation.w"])  # fmt: skip
@pytest.mark.parametrize("order", ["x y z w", "w x y z"])
def test_quaternions_by_name_or_by_what_is_planar(names: str, order: str) -> None:
    parts = np.stack([0 * YAW, 0 * YAW, np.sin(YAW / 2), np.cos(YAW / 2)], axis=1)
    parts = parts if order == "x y z w" else np.roll(parts, 1, axis=1)
    frame = pd.DataFrame(parts, columns=names.split()).assign(t=0.1 * np.arange(N))
    if order == "x y z w":
        history = load(frame, columns={"time": "t", "theta": "yaw"})
    else:
        with pytest.warns(RecordingWarning, match="are not x, y, z, w: yaw is of their order w x"):
            history = load(frame, columns={"time": "t", "theta": "yaw"})
    np.testing.assert_allclose(of(history, "theta"), YAW, atol=1e-9)


def test_a_plane_with_another_axis_up_and_a_tilted_rig() -> None:
    rng = np.random.default_rng(1)
    parts = np.stack([0 * YAW, np.sin(YAW / 2), 0 * YAW, np.cos(YAW / 2)], axis=1)
    yaw, order = planar_yaw(parts)
    np.testing.assert_allclose(yaw, YAW)
    assert order == "x y z w, about y"
    tilted = np.stack([0 * YAW, 0 * YAW, np.sin(YAW / 2), np.cos(YAW / 2)], axis=1)
    tilted += rng.normal(0.0, 0.02, tilted.shape)
    yaw, order = planar_yaw(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))
    assert order == "" and np.abs(yaw - YAW).max() < 0.2
    none, _ = planar_yaw(np.zeros((3, 4)))
    assert np.isnan(none).all()


@pytest.mark.parametrize("turn", [360.0, 180.0])
def test_wrapped_degrees_and_clockwise_headings(turn: float) -> None:
    clockwise = np.degrees(-YAW) % 360.0 - (180.0 if turn == 180.0 else 0.0)
    frame = pd.DataFrame({"t": 0.1 * np.arange(N), "heading_deg": clockwise})
    frame["t"] += np.random.default_rng(1).uniform(0.0, 1e-3 * 3, N)
    with pytest.warns(ResamplingWarning):
        history = load(frame, columns={"time": "t", "theta": "-heading_deg"}, resample=True)
    steps = np.diff(of(history, "theta"))
    np.testing.assert_allclose(steps, 9.0 / (N - 1), atol=5e-3)


@pytest.mark.parametrize(
    ("zero", "logged"),
    [("hanging", 0.0), ("horizontal", -90.0), ("upright", 180.0), (-67.0, -67.0), (0, 0.0)],
)
def test_the_zero_of_a_hinges_angle(zero, logged: float) -> None:
    """The pole hangs at rest: its theta is 0 whatever the column's zero."""
    frame = pd.DataFrame({"t": 0.05 * np.arange(N), "knee": logged + 0.01 * np.sin(np.arange(N))})
    history = load(
        frame, POLE, columns={"time": "t", "theta": {"column": "knee", "zero": zero}},
        units={"theta": "deg"},
    )  # fmt: skip
    theta = of(history, "theta")
    assert np.abs(np.angle(np.exp(1j * theta))).max() < 1e-3


def test_a_zero_that_is_unknown_or_has_no_hinge() -> None:
    frame = pd.DataFrame({"t": 0.05 * np.arange(N), "knee": 0.0})
    for scene, zero, says in ((POLE, "up", "expected a number or one of hanging, horizontal"),
                              (PUCK, "hanging", "hangs on no hinge")):  # fmt: skip
        with pytest.raises(HistoryError, match=says):
            load(frame, scene, columns={"time": "t", "theta": {"column": "knee", "zero": zero}})
    with pytest.raises(SceneError, match="expected a table such as"):
        Recording(columns={"theta": {"column": "knee"}})


def warned(frame: pd.DataFrame, scene: Scene, path: Path, **layout) -> str:
    """Return what reading a recording warns of."""
    frame.to_csv(path / "log.csv", index=False)
    with pytest.warns(UserWarning) as caught:
        read_recording(path / "log.csv", scene.replace(recording=Recording(**layout)))
    return " ".join(str(one.message) for one in caught)


def test_angles_of_another_convention_are_asked_about(tmp_path: Path) -> None:
    time = 0.05 * np.arange(200)
    swing = np.exp(-0.5 * time) * np.sin(5 * time)
    names = {"time": "t", "theta": "knee"}
    said = warned(pd.DataFrame({"t": time, "knee": 40 * swing}), POLE, tmp_path, columns=names)
    assert 'looks like deg: units = { theta = "deg" }' in said
    rest = pd.DataFrame({"t": time, "knee": np.radians(-67) + 0.5 * swing})
    assert "comes to rest -67 degrees from hanging" in warned(rest, POLE, tmp_path, columns=names)
    spun = pd.DataFrame({"t": time, "knee": swing, "w": -np.gradient(swing, time)})
    said = warned(spun, POLE, tmp_path, columns=names | {"omega": "w"})
    assert "one of them is clockwise" in said
    headings = pd.DataFrame({"t": time, "knee": (60 * time) % 360})
    assert "jumps by 360" in warned(headings, PUCK.replace(time_step=0.05), tmp_path, columns=names)


def test_an_angle_that_wraps_at_hanging_does_not_look_like_degrees(tmp_path: Path) -> None:
    time = 0.05 * np.arange(200)
    swing = 0.1 + 0.8 * np.exp(-0.1 * time) * np.sin(5 * time)
    pd.DataFrame({"t": time, "knee": swing % (2 * np.pi)}).to_csv(tmp_path / "log.csv", index=False)
    layout = Recording(columns={"time": "t", "theta": "knee"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        history = read_recording(tmp_path / "log.csv", POLE.replace(recording=layout))
    assert np.ptp(of(history, "theta")) > 6.0


def test_a_body_without_a_column_of_forces_is_not_pushed() -> None:
    """Nothing is said of empty cells: the file has no such column."""
    scene = PUCK.replace(bodies=(*PUCK.bodies, Body("disc", Shape.circle(0.1))))
    names = {"puck.x": "a", "disc.x": "b", "disc.force_x": "f"}
    frame = pd.DataFrame({"time": 0.1 * np.arange(N), "a": 0.1, "b": 0.5, "f": 2.0})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action = load(frame, scene, columns=names).dataset["action"].to_numpy()[0, :-1]
    assert (action[:, 1, 0] == 2.0).all() and not action[:, 0].any()


def test_places_of_a_bob_give_its_angle() -> None:
    theta = 0.8 * np.cos(0.2 * np.arange(N))
    frame = pd.DataFrame(
        {"t": 0.05 * np.arange(N), "x": 0.3 * np.sin(theta), "y": -0.3 * np.cos(theta)}
    )
    history = load(frame, POLE, columns={"time": "t"})
    start = history.dataset["start"].to_numpy()[0, :, 0]
    np.testing.assert_allclose(start[:, 2], theta, atol=1e-9)
    assert not history.dataset["assumed"].to_numpy()[0, :3].any()
    assert np.isnan(of(history, "theta")).all()


def test_forces_along_the_bodys_axes_turn_with_it() -> None:
    """A spinning puck under a steady thrust: the closed form of its velocity."""
    scene = PUCK.replace(recording=Recording(forces="body"))
    known = (("mass", 2.0), ("r", 0.5), ("mu_c", 0.3))
    scene = scene.replace(bodies=(Body("puck", Shape.circle(0.1), known=known),))
    physics = Physics(scene, attach(scene))
    turning, push = 3.0, 4.0
    start = np.array([[[0.0, 0.0, 0.5, 0.0, 0.0, turning]]])
    actions = np.tile([push, 0.0, 0.0], (1, 10, 1, 1))
    end = physics.predict(np.zeros(0), start, actions)[0, -1, 0]
    angles = 0.5 + turning * np.array([0.0, 1.0])
    speed = push / 2.0 / turning * np.array([np.sin(angles[1]) - np.sin(angles[0]),
                                             np.cos(angles[0]) - np.cos(angles[1])])  # fmt: skip
    np.testing.assert_allclose(end[3:5], speed, atol=1e-4)
    plain = PlainSimulator(physics)(np.zeros(0), start, actions)
    np.testing.assert_allclose(plain[0, -1, 0], end, atol=1e-4)
    with pytest.raises(SceneError, match="expected world or body"):
        Recording(forces="ground")


# Lost tracking ------------------------------------------------------------------------------------


def test_frozen_and_zeroed_poses_are_missing() -> None:
    frame = moving().assign(theta=0.3 * np.arange(N))
    frozen = frame.copy()
    frozen.loc[20:24, ["x", "y", "theta"]] = frozen.loc[19, ["x", "y", "theta"]].to_numpy()
    frozen.loc[40:41, ["x", "y", "theta"]] = 0.0
    with pytest.warns(
        RecordingWarning, match="x = y = theta = 0 in 2 rows.*5 rows repeat the pose"
    ):
        history = load(frozen, columns={"time": "t"})
    assert np.flatnonzero(np.isnan(of(history, "x"))).tolist() == [20, 21, 22, 23, 24, 40, 41]


def test_the_path_of_a_finger_is_kept() -> None:
    finger = PUCK.replace(bodies=(*PUCK.bodies, Body("finger", Shape.circle(0.01), kinematic=True)))
    frame = moving().assign(theta=0.0, body="finger")
    frame.loc[20:24, ["x", "y"]] = frame.loc[19, ["x", "y"]].to_numpy()
    both = pd.concat([frame, frame.assign(body="puck")])
    with pytest.warns(RecordingWarning, match="^history: 5 rows repeat the pose"):
        history = load(both, finger, columns={"time": "t"})
    lost = history.dataset["observed"].isnull().sel(state="x").sum(("trajectory", "time"))
    assert lost.sel(body=["puck", "finger"]).to_numpy().tolist() == [5, 0]


def test_rest_quantisation_and_a_slow_camera() -> None:
    time = 0.02 * np.arange(500)
    braked = np.where(time < 5.0, time - time**2 / 10, 2.5)[:, None]
    struck = np.where(time < 5.0, 0.0, 2.0 * (time - 5.0))[:, None]
    for poses in (braked, struck, np.round(braked, 2), np.round(np.sin(time), 1)[:, None]):
        assert not frozen_poses(np.hstack([poses, 0.3 * poses])).any()
    slow = np.repeat(np.sin(0.1 * np.arange(100)), 2)[:, None]
    assert frozen_poses(np.hstack([slow, slow**2])).sum() > 80  # a row twice is one fix
    through = np.stack([np.linspace(-1, 1, 101), 2 * np.linspace(-1, 1, 101)], axis=1)
    assert not zero_poses(through).any()  # a path through the origin


# Heads of files -----------------------------------------------------------------------------------

ROWS = "0,000;0,10;1,0\n0,100;0,20;2,0\n0,200;0,40;3,0\n"


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
def test_heads_of_text_files(tmp_path: Path, coding: str) -> None:
    head = "Pendel Vers\u00fcch 3;;\n\nt;x;v\ns;cm;km/h\n"
    (tmp_path / "a.csv").write_bytes((head + ROWS).encode(coding))
    layout = Recording(columns={"time": "t", "vx": "v"})
    history = History.load(tmp_path / "a.csv", PUCK.replace(recording=layout))
    np.testing.assert_allclose(of(history, "x"), [1e-3, 2e-3, 4e-3])
    np.testing.assert_allclose(of(history, "vx"), np.array([1.0, 2.0, 3.0]) / 3.6)


def test_declared_units_go_before_those_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;x\ns;cm\n" + "0;1\n0.1;2\n")
    layout = Recording(columns={"time": "t"}, units={"x": "mm"})
    history = History.load(tmp_path / "a.csv", PUCK.replace(recording=layout))
    np.testing.assert_allclose(of(history, "x"), [1e-3, 2e-3])
    (tmp_path / "b.csv").write_text("t;x\ns;furlong\n" + "0;1\n0.1;2\n")
    with pytest.raises(HistoryError, match=r'"furlong" is none of x.*row of units says so'):
        History.load(tmp_path / "b.csv", PUCK.replace(recording=Recording(columns={"time": "t"})))


@pytest.mark.parametrize("labels", [("X", "0", "7"), ("0", "X", "7"), ("0", "7", "X")])
def test_trajectories_of_words_and_numbers_are_all_read(labels, tmp_path: Path) -> None:
    """A word in a column of numbers makes no title of a row: the next row has it, too."""
    head = "trajectory,time,body,x,y,theta,vx,vy,omega,force_x,force_y,torque"
    rows = [f"{label},{0.1 * i},puck,{i},0,0,0,0,0,0,0,0" for label in labels for i in range(20)]
    (tmp_path / "a.csv").write_text("\n".join([head, *rows, ""]))
    history = History.load(tmp_path / "a.csv", PUCK)
    assert tuple(history.dataset["trajectory"].to_numpy()) == labels
    assert history.n_transitions == 57


@pytest.mark.parametrize(
    ("column", "unit", "factor"),
    [("omega", "rpm", 2 * np.pi / 60), ("omega", "deg/s", np.pi / 180), ("vx", "km/h", 1 / 3.6),
     ("x", "ft", 0.3048), ("force_x", "kN", 1e3), ("force_x", "g", 9.80665e-3),
     ("torque", "N mm", 1e-3), ("torque", "kg cm", 0.0980665), ("theta", "\u00b0", np.pi / 180)],
)  # fmt: skip
def test_units(column: str, unit: str, factor: float) -> None:
    frame = moving(5).assign(q=np.arange(5.0))
    history = load(
        frame.drop(columns="x"), columns={"time": "t", column: "q"}, units={column: unit}
    )
    np.testing.assert_allclose(of(history, column)[:4], factor * np.arange(4.0))


def test_cut_off_and_padded_lines(tmp_path: Path) -> None:
    text = "time , x\n0.0 ,  1.0\n 0.1, 2.0 \n0.2,3.0\n0.3"
    (tmp_path / "a.csv").write_text(text)
    with pytest.warns(RecordingWarning, match="line 5 is cut off and left out"):
        history = History.load(tmp_path / "a.csv", PUCK.replace(recording=Recording()))
    np.testing.assert_array_equal(of(history, "x"), [1.0, 2.0, 3.0])
    (tmp_path / "b.csv").write_text("title\ntime,x\n0,1\n0.1,2\n0.2,oops\n")
    with pytest.raises(HistoryError, match=r"b.csv row 5: x is 'oops'"):
        History.load(tmp_path / "b.csv", PUCK.replace(recording=Recording()))


def test_messages_name_rows_of_the_file_and_no_piece(tmp_path: Path) -> None:
    frame = moving(100)
    frame.loc[70, "x"] = np.inf
    frame.to_csv(tmp_path / "a.csv", index=False)
    layout = Recording(columns={"time": "t"}, cut={"every": 2.0})
    with pytest.raises(HistoryError, match=r'a.csv row 72: x of body "puck" is inf') as it:
        History.load(tmp_path / "a.csv", PUCK.replace(recording=layout))
    assert not re.search(r"trajectory \d", str(it.value))


def test_a_log_of_sysid(tmp_path: Path) -> None:
    rows = [[0.1 * i, 2.0, 0.5 * i, 5.0] for i in range(10)]
    log = {"sysid": True, "test": "Simple", "units": "Rotations", "fast-forward": rows,
           "slow-forward": rows[:5]}  # fmt: skip
    (tmp_path / "log.json").write_text(json.dumps(log))
    layout = Recording(columns={"theta": "position", "omega": "velocity"})
    history = History.load(tmp_path / "log.json", PUCK.replace(recording=layout))
    assert history.dataset["trajectory"].to_numpy().tolist() == ["fast-forward", "slow-forward"]
    np.testing.assert_allclose(of(history, "theta")[:3], 2 * np.pi * np.array([0, 0.5, 1.0]))
    np.testing.assert_allclose(of(history, "omega"), 10 * np.pi)
    (tmp_path / "other.json").write_text('{"a": [1, 2]}')
    with pytest.raises(HistoryError, match="not a log of WPILib's SysId"):
        History.load(tmp_path / "other.json", PUCK)


def test_a_format_is_one_new_file(tmp_path: Path, monkeypatch) -> None:
    """CONTRIBUTING's first task: a module of the room, which is found by its declaration."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    added = re.search(r"\+\+\+ b/pbrl_ppl/history/npz.py\n@@.*\n((?:\+.*\n)+)", text)
    (tmp_path / "npz.py").write_text(re.sub("(?m)^\\+", "", added[1]), encoding="utf-8")
    np.savez(tmp_path / "log.npz", t=0.1 * np.arange(20), px=np.arange(20.0), y=np.ones(20))
    scene = PUCK.replace(recording=Recording(columns={"time": "t", "x": "px"}))
    with pytest.raises(HistoryError, match=r"suffix is '.npz', expected one of .csv"):
        History.load(tmp_path / "log.npz", scene)
    monkeypatch.setattr(room, "__path__", [*room.__path__, str(tmp_path)])
    np.testing.assert_array_equal(of(History.load(tmp_path / "log.npz", scene), "x"), range(20))
    (tmp_path / "bad.npz").write_bytes(b"PK no")
    for name, message in (("bad", "no arrays of one length"), ("none", "no such file")):
        with pytest.raises(HistoryError, match=message):
            History.load(tmp_path / f"{name}.npz", scene)


def test_a_matlab_file(tmp_path: Path) -> None:
    log = {"t": 0.1 * np.arange(20), "log": {"x": np.arange(20.0), "m": np.ones((20, 2))}, "n": 3.0}
    scipy.io.savemat(tmp_path / "log.mat", log)
    layout = Recording(columns={"time": "t", "x": "log.x", "y": "log.m[1]"})
    history = History.load(tmp_path / "log.mat", PUCK.replace(recording=layout))
    np.testing.assert_array_equal(of(history, "x"), np.arange(20.0))
    (tmp_path / "bad.mat").write_bytes(b"MATLAB no")
    with pytest.raises(HistoryError, match="not a MATLAB file"):
        History.load(tmp_path / "bad.mat", PUCK)


def test_a_damaged_matlab_file_does_not_end_the_process(tmp_path: Path) -> None:
    """SciPy reads memory that is not its own."""
    path = tmp_path / "bad.mat"
    scipy.io.savemat(path, {"log": {"x": np.arange(20.0), "name": "a"}})
    whole = path.read_bytes()
    path.write_bytes(whole[:224] + b"\5" + whole[225:])
    with pytest.raises(HistoryError, match=r"not a MATLAB file .*damaged"):
        History.load(path, PUCK)


# ``new`` ------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("forces", [(), ("fx",), ("fy", "torque"), ("fx", "fy", "torque")])
def test_what_new_writes_check_accepts(forces: tuple[str, ...], capsys) -> None:
    frame = moving(80).assign(yaw_deg=4.0 * np.arange(80), **dict.fromkeys(forces, 0.5))
    frame["t"] = 1e3 * frame["t"]
    frame.to_csv("run.csv", index=False)
    assert main(["new", "scene.toml", "--history", "run.csv", "--body", "puck=circle:0.1"]) == 0
    said = capsys.readouterr().out
    assert "looks like ms" in said and "theta = yaw_deg" in said
    assert main(["check", "scene.toml", "run.csv", "--no-prior", "-q"]) == 0
    scene = Scene.load("scene.toml")
    history = read_recording(Path("run.csv"), scene)
    theta = history.dataset["observed"].sel(state="theta").to_numpy().ravel()
    np.testing.assert_allclose(theta, np.radians(4.0 * np.arange(80)), atol=1e-9)
    torque = history.dataset["action"].sel(wrench="torque").to_numpy()[:, :-1]
    assert (torque == 0.5 * ("torque" in forces)).all()


@pytest.mark.usefixtures("folder")
def test_new_reads_bursts_streams_and_circles(capsys) -> None:
    bursts().assign(note=1.0, spare=np.arange(400) % 7).to_csv("run.csv", index=False)
    assert main(["new", "a.toml", "--history", "run.csv", "--body", "puck=circle:0.1"]) == 0
    assert dict(Scene.load("a.toml").recording.time) == {"rate": 10.0, "counter": "count"}
    assert "columns that are not used: spare" in capsys.readouterr().out
    theta = 0.8 * np.cos(0.2 * np.arange(200))
    swing = {"t": 0.05 * np.arange(200), "x": 1 + 0.3 * np.sin(theta), "y": -0.3 * np.cos(theta)}
    pd.DataFrame(swing).to_csv("swing.csv", index=False)
    assert (
        main(["new", "b.toml", "--history", "swing.csv", "--side", "--body", "bob=circle:0.02"])
        == 0
    )
    (hinge,) = Scene.load("b.toml").joints
    assert hinge.anchor_b == pytest.approx((1.0, 0.0), abs=1e-6)
    assert hinge.anchor_a == pytest.approx((0.0, 0.3), abs=1e-6)
    frame = moving(600, dt=0.01)
    frame.to_csv("pose.csv", index=False)
    pd.DataFrame({"t": 0.1 * np.arange(60), "fx": 1.0 * (np.arange(60) % 2)}).to_csv("cmd.csv")
    options = "new c.toml --history pose.csv --commands cmd.csv --body puck=circle:0.1"
    assert main(options.split()) == 0
    scene = Scene.load("c.toml")
    assert scene.time_step == 0.1 and scene.recording.commands == "cmd.csv"
    assert "time_step is the commands'" in capsys.readouterr().out
    assert main(["check", "c.toml", "pose.csv", "--no-prior", "-q"]) == 0


# Cuts and angles ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("seconds", "every"), [(60.0, 10.0), (30.0, 7.5), (200.0, 17.0)])
def test_pieces_of_a_long_take_hold_eight_periods(seconds, every, tmp_path: Path) -> None:
    """Of a period of 1.26 s; four pieces at least, twelve at most."""
    time = np.arange(0.0, seconds, 0.02)
    swing = 0.3 * np.exp(-0.01 * time) * np.sin(2 * np.pi * time / 1.26)
    pd.DataFrame({"t": time, "theta": swing}).to_csv(tmp_path / "log.csv", index=False)
    scene = tmp_path / "scene.toml"
    asked = ["--history", str(tmp_path / "log.csv"), "--columns", "time=t,theta=theta"]
    assert main(["new", str(scene), *asked, "--side", "--body", "pole=box:0.02x0.3", "-q"]) == 0
    recording = Scene.load(scene).recording
    assert recording is not None
    assert dict(recording.cut)["every"] == pytest.approx(every, rel=0.1)


def test_pieces_of_a_motion_that_does_not_swing_hold_three_time_constants() -> None:
    rng, steps = np.random.default_rng(1), 40_000
    place = np.zeros(steps)
    for i in range(1, steps):  # a correlation of 2 s
        place[i] = (1 - 0.02 / 2.0) * place[i - 1] + rng.normal()
    time = 0.02 * np.arange(steps)
    slow = np.exp(-time[:2000] / 8.0)[:, None]
    assert 1.0 < telling(time[:2000], slow) / 3.0 < 12.0
    assert telling(time, place[:, None]) > 3.0 * 1.5


def pendulum(speed: float, damping: float, seconds: float = 40.0) -> np.ndarray:
    """Angles of a pendulum every 0.05 s that begins to hang, with this speed; also turns."""
    angle, out = 0.0, []
    for step in range(round(seconds / 0.001)):
        if step % 50 == 0:
            out.append(angle)
        speed -= 0.001 * (25.0 * np.sin(angle) + damping * speed)
        angle += 0.001 * speed
    return np.array(out)


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_turns_are_no_degrees_and_degrees_are(noise: float, tmp_path: Path) -> None:
    """A pendulum that whirls, a few turns on and back: in rad it is no swing of 50 degrees."""
    rng, names = np.random.default_rng(1), {"time": "t", "theta": "knee"}
    on = pendulum(14.0, 0.0, 10.0)
    whirled = np.concatenate([on, on[-2::-1], on[1:], on[-2::-1], on[1:]])
    swung = np.degrees(pendulum(3.0, 0.02))
    for angle, asked in ((whirled, False), (swung, True)):
        off = noise * rng.standard_normal(len(angle)) * (1.0 if not asked else 57.3)
        time = 0.05 * np.arange(len(angle))
        said = warned(pd.DataFrame({"t": time, "knee": angle + off}), POLE, tmp_path, columns=names)
        assert ("looks like deg" in said) == asked


def test_whole_numbers_of_thousands_are_asked_about_as_counts(tmp_path: Path) -> None:
    counts = np.round(pendulum(3.0, 0.02) * 8192 / (2 * np.pi) * 40)
    time = 0.05 * np.arange(len(counts))
    log = pd.DataFrame({"t": time, "knee": counts})
    names = {"time": "t", "theta": "knee"}
    assert 'units = { theta = "8192/turn" }' in warned(log, POLE, tmp_path, columns=names)
    units = {"theta": "8192/turn"}
    assert "counts" not in warned(log, POLE, tmp_path, columns=names, units=units)


def test_a_pose_that_repeats_within_the_noise_is_a_measurement() -> None:
    """Rounded to a tenth of the noise, a slow place is twice the same by chance."""
    rng, time = np.random.default_rng(1), 0.02 * np.arange(4000)
    place = np.round(0.05 * np.sin(time) + 2e-3 * rng.standard_normal(4000), 4)
    place[1000] = place[999]
    assert not frozen_poses(place[:, None].repeat(2, axis=1)).any()
    moving_on = np.round(np.sin(time) + 1e-4 * rng.standard_normal(4000), 6)
    moving_on[1000] = moving_on[999]
    assert np.flatnonzero(frozen_poses(moving_on[:, None].repeat(2, axis=1))).tolist() == [1000]


def test_an_empty_command_of_an_actuator_holds_in_a_history(tmp_path: Path) -> None:
    """Also where no [recording] is declared."""
    motor = Actuator(name="duty", kind="thruster", body="puck", known={"gain": 0.5})
    scene = PUCK.replace(actuators=(motor,))
    frame = moving().rename(columns={"t": "time"}).assign(trajectory=0, body="puck", theta=0.0)
    frame = frame.assign(vx=np.nan, vy=np.nan, omega=np.nan)
    frame["duty"] = np.where(np.arange(N) % 5 == 0, np.arange(N), np.nan)
    for table in (frame, frame.rename(columns={"duty": "force_x"}).assign(force_y=0.0, torque=0.0)):
        with pytest.warns(RecordingWarning, match="the command before holds"):
            history = History.from_dataframe(table, scene)
        np.testing.assert_array_equal(of(history, "force_x")[:-1], np.arange(N - 1) // 5 * 5)
    with pytest.raises(HistoryError, match="an empty cell holds the command before"):
        History.from_dataframe(
            frame.rename(columns={"duty": "force_x"}).assign(force_y=0.0, torque=0.0), PUCK
        )
