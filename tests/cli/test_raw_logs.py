"""From a raw log to a verdict in three commands, without a tool beside."""

import json
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.cli import main
from pbrl_ppl.errors import HistoryError, RecordingWarning, SceneError
from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Recording, Scene, Shape
from tests.helpers import raw_logs
from tests.helpers.bags import Bag

pytestmark = [pytest.mark.one_stack, pytest.mark.first(2)]

PUCK = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))


def run(text: str) -> int:
    return main(shlex.split(text))


def load(text: str, path: Path, **layout) -> History:
    """Read a table of a puck as a layout says."""
    path.write_text(text)
    return History.load(path, PUCK.replace(recording=Recording(**layout)))


def x_of(history: History) -> np.ndarray:
    return history.dataset["observed"].to_numpy()[:, :, 0, 0]


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def named(folder: str) -> tuple[str, set[str]]:
    """Return the verdict and the effects of a report."""
    found = json.loads((Path(folder) / "report.json").read_text())
    return found["verdict"], {one["effect"] for one in found["added"]}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_angles_between_blanks_in_one_take() -> None:
    raw_logs.angles(Path("pole.txt"))
    assert run(f"new --history pole.txt --columns time=0,theta=1 {raw_logs.POLE}") == 0
    raw_logs.weighed(Path("scene.toml"), 0.2)
    scene = Scene.load("scene.toml")
    assert scene.time_step == 0.05 and dict(scene.recording.cut) == {"every": 5.0}
    assert run("check scene.toml pole.txt -q") == 0
    assert run("close-loop scene.toml pole.txt --method laplace -q -o out") == 0
    verdict, effects = named("out")
    # in pieces of 5 s kinks of the friction leave an acceleration of 2.7 % unexplained
    assert verdict in ("effects-added", "unexplained")
    # of one pole all three drags are the same law
    drags = effects & {"pivot_damping", "angular_drag", "linear_drag"}
    assert len(drags) == 1 and effects - drags == {"pivot_friction"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_an_encoder_with_a_computed_velocity(capsys: pytest.CaptureFixture[str]) -> None:
    raw_logs.encoder(Path("encoder.csv"))
    columns = "--columns time=t,theta=angle,omega=speed"
    assert run(f"new --history encoder.csv {columns} {raw_logs.POLE}") == 0
    raw_logs.weighed(Path("scene.toml"), 0.2)
    assert "omega of pole was computed from theta" in capsys.readouterr().out
    assert Scene.load("scene.toml").recording.velocities == "computed"
    assert run("check scene.toml encoder.csv -q") == 0
    assert run("close-loop scene.toml encoder.csv --method laplace -q -o out") == 0
    verdict, effects = named("out")
    assert verdict == "effects-added" and "pivot_friction" in effects


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_camera_that_loses_a_puck_between_walls(capsys: pytest.CaptureFixture[str]) -> None:
    raw_logs.camera(Path("puck.csv"))
    assert run("new --history puck.csv --columns duration=0,x=1,y=2 --body puck=circle:0.03") == 0
    said = capsys.readouterr().out
    assert "read as not seen" in said and "the velocity jumps, as at a wall" in said
    assert run("close-loop scene.toml puck.csv --method laplace -q -o out") == 0
    verdict, effects = named("out")
    assert verdict == "effects-added" and "linear_drag" in effects


def pushed(folder: Path, runs: int = 8, rows: int = 60) -> None:
    """Write ``run``, a ROS 2 bag of a puck that is pushed now and then and slides with a drag."""
    rng = np.random.default_rng(5)
    bag = Bag("db3")
    for run in range(runs):
        heading, place = rng.uniform(0, 2 * np.pi), rng.uniform(-1, 1, 2)
        for row in range(rows):
            slid = 1.5 / raw_logs.DRAG * (1 - np.exp(-raw_logs.DRAG * row / 30))
            x, y = place + slid * np.array([np.cos(heading), np.sin(heading)])
            x, y = np.array([x, y]) + raw_logs.NOISE * rng.standard_normal(2)
            time = 5.0 * run + row / 30
            bag.add(time, "/puck", bag.odometry(time, x, y, 0.0))
    bag.write(folder)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_bag(capsys: pytest.CaptureFixture[str]) -> None:
    pushed(Path())
    columns = "x=pose.pose.position.x,y=pose.pose.position.y"
    shape = "--body puck=circle:0.03"
    assert run(f"new --history run {shape} --columns {columns}") == 2
    assert "--topic BODY=/odom" in capsys.readouterr().err
    assert run(f"new --history run {shape} --columns {columns} --topic puck=/puck") == 0
    assert "cut at gaps" in capsys.readouterr().out
    assert run("check scene.toml run -q --no-prior") == 0
    assert run("close-loop scene.toml run --method laplace -q -o out") == 0
    verdict, effects = named("out")
    assert verdict == "effects-added" and "linear_drag" in effects


def test_a_header_is_found_or_not(tmp_path: Path) -> None:
    columns = {"time": 0, "x": 1}
    plain = load("0 1.5\n0.1 2.5\n", tmp_path / "a.txt", columns=columns)
    assert x_of(plain).tolist() == [[1.5, 2.5]]
    headed = load("time;x\n0;1,5\n0,1;2,5\n", tmp_path / "b.csv")
    assert x_of(headed).tolist() == [[1.5, 2.5]]
    tabs = load("0\t1.5\n0.1\t2.5\n", tmp_path / "c.dat", columns=columns, separator="tab")
    assert x_of(tabs).tolist() == [[1.5, 2.5]]
    with pytest.raises(HistoryError, match="no header; say which of its 2 columns is which"):
        load("0,1.5\n0.1,2.5\n", tmp_path / "d.csv")
    with pytest.raises(HistoryError, match="2 columns, numbered from 0; got 2 for x"):
        load("0,1.5\n0.1,2.5\n", tmp_path / "e.csv", columns={"time": 0, "x": 2})


def test_forces_that_a_recording_lacks_are_zero(tmp_path: Path) -> None:
    history = load("time,x\n0,1\n0.1,2\n", tmp_path / "a.csv")
    assert (history.dataset["action"].to_numpy()[:, 0] == 0.0).all()
    (tmp_path / "b.csv").write_text("trajectory,body,time,x\n0,puck,0,1\n0,puck,0.1,2\n")
    with pytest.raises(HistoryError, match="missing column"):  # nothing says that none acted
        History.load(tmp_path / "b.csv", PUCK)


def test_durations_repeated_stamps_and_rows_without_times(tmp_path: Path) -> None:
    rows = "5,1\n100,2\n0,2\n100,3\n"
    with pytest.warns(RecordingWarning, match="1 rows repeat a time and are left out"):
        history = load(
            rows, tmp_path / "a.csv", columns={"duration": 0, "x": 1}, units={"duration": "ms"}
        )
    assert x_of(history).tolist() == [[1.0, 2.0, 3.0]]
    assert np.allclose(np.diff(history.dataset["clock"]), 0.1)
    untimed = load("x\n1\n2\n", tmp_path / "b.csv")
    assert untimed.dataset["clock"].to_numpy().tolist() == [[0.0, 0.1]]


def test_what_was_not_seen_is_missing(tmp_path: Path) -> None:
    rows = "time,x,y\n0,1,1\n0.1,0,0\n0.2,0,1\n"
    history = load(rows, tmp_path / "a.csv", not_seen={"x": 0.0, "y": 0.0})
    assert np.isnan(x_of(history)[0]).tolist() == [False, True, False]
    with pytest.raises(HistoryError, match='not_seen names "theta"'):
        load(rows, tmp_path / "b.csv", not_seen={"theta": 0.0})


def moving(**changes) -> pd.DataFrame:
    """Return three seconds of a puck at 1 m/s."""
    time = np.round(np.arange(30) * 0.1, 9)
    return pd.DataFrame({"time": time, "x": time, "y": 0.0} | changes)


def pieces(frame: pd.DataFrame, **cut: float) -> list[int]:
    """Return the numbers of rows of the pieces of a recording."""
    layout = Recording(cut=cut)
    with pytest.warns(RecordingWarning, match="cut into"):
        history = History.from_dataframe(frame, PUCK, layout=layout)
    return history.dataset["n_rows"].to_numpy().tolist()


def test_cuts() -> None:
    frame = moving()
    assert pieces(frame, every=1.0) == [10, 10, 10]
    assert pieces(frame.drop(index=range(12, 20)), gaps=0.5) == [12, 10]
    unseen = frame.copy()
    unseen.loc[12:19, ["x", "y"]] = np.nan
    assert pieces(unseen, gaps=0.5) == [12, 10]
    bounced = moving(x=1.45 - np.abs(frame["time"] - 1.45))
    first, second = pieces(bounced, jumps=1.0)
    assert first + second >= 27 and first <= 15 and second <= 15  # the rows beside the jump go
    # a saved history that is cut already stays as it is
    history = History.from_dataframe(moving(), PUCK, layout=Recording())
    again = history.to_dataframe()
    assert History.from_dataframe(again, PUCK).dataset["n_rows"].to_numpy().tolist() == [30]


def test_a_recording_without_bodies_or_with_nothing_between_cuts(tmp_path: Path) -> None:
    two = PUCK.replace(
        bodies=(*PUCK.bodies, Body("other", Shape.circle(0.1))), recording=Recording()
    )
    (tmp_path / "a.csv").write_text("time,x\n0,1\n0.1,2\n")
    with pytest.raises(HistoryError, match=r"missing column.s. body"):
        History.load(tmp_path / "a.csv", two)
    with pytest.raises(HistoryError, match="nothing is left between its cuts"):
        load("time,x\n0,1\n0.1,1\n0.2,1\n0.3,1\n", tmp_path / "b.csv", cut={"gaps": 0.05})


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ({"columns": 3}, "columns is 3, expected a table"),
        ({"columns": {"x": [1]}}, "columns of x is \\[1\\], expected a name or a number"),
        ({"units": {"x": 3}}, "units of x is 3, expected text"),
        ({"separator": "pipe"}, "separator is 'pipe', expected one of blank, tab"),
        ({"header": "no"}, "header is 'no', expected true or false"),
        ({"velocities": "guess"}, "velocities is 'guess', expected measured or computed"),
        ({"cut": {"gap": 1.0}}, 'unknown key "gap" in \\[recording\\]: cut; did you mean'),
        ({"cut": {"every": 0.0}}, "expected more than 0"),
        ({"not_seen": {"x": "none"}}, "expected a number"),
    ],
)
def test_a_wrong_layout_is_refused(layout, message) -> None:
    with pytest.raises(SceneError, match=message):
        Recording(**layout)


def test_an_unknown_key_names_the_nearest() -> None:
    text = PUCK.to_toml().replace("[[body]]", "[recording]\ncolum = {}\n\n[[body]]", 1)
    with pytest.raises(SceneError, match=r'unknown key "colum" in .recording.; did you mean "col'):
        Scene.from_toml(text)


def test_velocities_that_were_computed_or_are_estimated(tmp_path: Path) -> None:
    rows = "time,x,vx\n0,1,7\n0.1,2,8\n0.2,3,9\n"
    computed = load(rows, tmp_path / "a.csv", velocities="computed")
    assert computed.dataset["observed"].isnull().to_numpy()[..., 3].all()
    poses = "time,x,y,theta\n0,1,0,0\n0.1,2,0,0\n"
    estimated = load(poses, tmp_path / "b.csv", velocities="estimate")
    assert not estimated.dataset["assumed"].to_numpy().any()
    measured = load(poses, tmp_path / "c.csv")
    assert measured.dataset["assumed"].to_numpy()[:, 3:].all()
