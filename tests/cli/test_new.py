"""``new``: pendulums, double pendulums and pushed blocks, from raw tables and options alone."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.criticism import Loop
from pbrl_ppl.effects import attach
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from tests.helpers.made_up import made_up
from tests.helpers.places import MODELS, ROOT

pytestmark = pytest.mark.one_stack

COLUMNS = "--columns trajectory=swing,time=ms,theta=angle,force_x=0,force_y=0,torque=0"
UNITS = "--units time=ms,theta=deg"
PENDULUM = "--side --body arm=box:0.03x0.4"


@pytest.fixture
def swing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to run in, with the recorded pendulum's angles as a stranger would log them."""
    rows = pd.read_csv(MODELS / "pendulum" / "recorded" / "train.csv")
    table = {
        "swing": rows["trajectory"],
        "ms": 1e3 * rows["time"],
        "angle": np.degrees(rows["theta"]),
        "volts": 0.0,
    }
    monkeypatch.chdir(tmp_path)
    pd.DataFrame(table).to_csv("swing.csv", index=False)
    return tmp_path


def run(text: str) -> int:
    return main(shlex.split(text))


def refused(capsys: pytest.CaptureFixture[str], options: str) -> str:
    """Run ``new`` with these options; expect code 2, one message, and no file."""
    assert run(f"new bad.toml {options}") == 2
    said = capsys.readouterr()
    assert said.out == "" and "Traceback" not in said.err and not Path("bad.toml").exists()
    # typer puts usage errors into a box
    return " ".join(said.err.replace("│", " ").split())


@pytest.mark.usefixtures("swing")
def test_three_commands_from_a_raw_table_to_a_verdict(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its own names, milliseconds and degrees are said once; the scene file keeps them."""
    seen: list[Any] = []

    def close_loop(scene: Any, train: Any, *rest: Any, **options: Any) -> Loop:
        seen.append((scene, train))
        return made_up()

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    monkeypatch.setattr("pbrl_ppl.reporting.render", lambda *args, **options: "a page")
    assert run(f"new --history swing.csv {COLUMNS} {UNITS} {PENDULUM}") == 0
    said = capsys.readouterr().out
    assert "only the angle of arm was measured: hung by the upper end" in said
    advised = said.partition("next: pbrl-ppl ")[2].strip()
    assert advised == "check scene.toml swing.csv"
    # what the comments and the guess ask for
    text = Path("scene.toml").read_text()
    for before, after in (
        ("anchor_a = [0.0, 0.2] ", "anchor_a = [0.0, 0.18]"),
        ("# known = { mass = 6.0 }", "known = { mass = 0.5 }"),
        ('# effects = ["linear_drag"]', 'effects = ["inertia_scale"]'),
    ):
        assert text.count(before) == 1
        text = text.replace(before, after)
    Path("scene.toml").write_text(text)
    declared = Scene.load(MODELS / "pendulum" / "scene.toml")
    assert Scene.load("scene.toml").replace(recording=None) == declared.replace(substeps=10)
    assert run(f"{advised} --no-prior --json -q") == 0
    assert '"transitions"' in capsys.readouterr().out
    assert run(f"close-loop {advised.removeprefix('check ')} -o out -q") == 0
    ((scene, train),) = seen
    rows = pd.read_csv(MODELS / "pendulum" / "recorded" / "train.csv")
    assert [body.name for body in scene.dynamic] == ["arm"] and scene.time_step == 0.02
    measured = train.dataset["observed"].to_numpy()[0, :, 0, 2]
    np.testing.assert_allclose(measured, rows[rows["trajectory"] == 0]["theta"], atol=1e-12)


@pytest.mark.usefixtures("swing")
@pytest.mark.parametrize(
    ("head", "found"),
    [
        ("t,position,velocity", {"x": "position", "vx": "velocity"}),
        ("t,position [deg],velocity [deg/s]",
         {"theta": "position [deg]", "omega": "velocity [deg/s]"}),
        ("t,angle,speed", {"theta": "angle", "omega": "speed"}),
        ("t,x,y,speed", {}),  # which has no direction
        ("t,position,target position,motor speed [rad/s]",
         {"x": "position", "omega": "motor speed [rad/s]"}),
        ("t,qpos,qvel", {"theta": "qpos", "omega": "qvel"}),
        ("t,speed [rad/s],torque", {"omega": "speed [rad/s]"}),
    ],
)  # fmt: skip
def test_columns_by_name_and_unit(head: str, found: dict[str, str]) -> None:
    width = len(head.split(","))
    rows = "".join(f"{0.1 * i:g}{f',{i * i + 1}' * (width - 1)}\n" for i in range(20))
    Path("log.csv").write_text(f"{head}\n{rows}")
    assert run("new --history log.csv --body wheel=circle:0.1 -q --overwrite") == 0
    scene = Scene.load("scene.toml")
    assert scene.recording is not None
    columns = dict(scene.recording.columns)
    assert {key: columns[key] for key in columns if key not in ("time", "torque")} == found
    assert run("check scene.toml log.csv --no-prior -q") == 0
    # an angle alone: a wheel on a hinge at its centre
    turns = {*found} <= {"theta", "omega"} and bool(found)
    assert [joint.anchor_a for joint in scene.joints] == [(0.0, 0.0)] * turns


@pytest.mark.usefixtures("swing")
@pytest.mark.parametrize("command", ["cmd/left", "throttle", "duty", "current [A]"])
def test_commands_by_their_names(command: str) -> None:
    rows = "".join(f"{0.1 * i:g},{i},{i % 5}\n" for i in range(20))
    Path("log.csv").write_text(f"t,x,{command}\n{rows}")
    assert run("new --history log.csv --body car=circle:0.1 -q --overwrite") == 0
    (actuator,) = Scene.load("scene.toml").actuators
    assert (actuator.column or actuator.name) == command


@pytest.mark.usefixtures("swing")
@pytest.mark.parametrize(
    ("head", "guess"),
    [
        ("time,ch1 [V],pwm,note\n", "it has time 0..1.9, ch1 [V] -9..10 V, pwm 0..4, note text;"),
        ("millis,ch1,pwm,note\n", "such as --columns time=millis,theta=ch1,"),
        ("t,ch1,ch2,note\n", "such as --columns time=t,x=ch1,y=ch2,"),
        ("", "such as --columns time=0,x=1,y=2,"),
    ],
)
def test_a_log_without_a_pose_or_a_speed_is_refused(
    head: str, guess: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message lists the columns with their ranges, and proposes which is which."""
    note = ",up" if "note" in head else ""
    rows = "".join(f"{0.1 * i:g},{10 - i},{i % 5}{note}\n" for i in range(20))
    Path("log.csv").write_text(head + rows)
    said = refused(capsys, "--history log.csv")
    assert "no column is known as a pose or a speed of a body" in said and guess in said


@pytest.mark.usefixtures("swing")
def test_a_folder_of_logs(capsys: pytest.CaptureFixture[str]) -> None:
    """With title lines and tabs: one history, which is not cut."""
    Path("flights").mkdir()
    for number in range(1, 6):
        rows = "".join(f"{0.1 * i:.4f}\t{i}\t{i * i}\n" for i in range(90))
        Path(f"flights/{number}.txt").write_text(f"\tball\t\nt\tx\ty\n{rows}")
    assert run("new --history flights --body ball=circle:0.1") == 0
    said = capsys.readouterr().out
    assert said.count("columns by their names: time = t") == 1 and "cut" not in said
    assert said.splitlines()[-1] == "next: pbrl-ppl check scene.toml flights"
    assert run("check scene.toml flights --no-prior -q --json") == 0
    assert '"trajectories": 5' in capsys.readouterr().out
    files = "--history flights/1.txt --history flights/2.txt"
    assert run(f"new two.toml {files} --body ball=circle:0.1") == 0
    said = capsys.readouterr().out
    assert "next: pbrl-ppl check two.toml flights/1.txt flights/2.txt" in said


@pytest.mark.usefixtures("swing")
def test_a_double_pendulum_side_by_side_in_a_row(capsys: pytest.CaptureFixture[str]) -> None:
    rows = ["t,q1,q2,tau", "0,0.1,0.2,0", "0.0101,0.1,0.2,0", "0.03,0.1,0.2,0", "0.04,0.1,0.2,0"]
    Path("arm.csv").write_text("\n".join(rows))
    columns = "time=t,upper.theta=q1,lower.theta=q2,upper.torque=tau,lower.torque=0"
    columns += ",force_x=0,force_y=0"
    bodies = "--body upper=box:0.05x0.2 --body lower=box:0.05x0.3"
    assert run(f"new --history arm.csv --columns {columns} --side {bodies}") == 0
    scene = Scene.load("scene.toml")
    assert scene.gravity == (0.0, -9.81)
    assert [joint.bodies for joint in scene.joints] == [("upper", "world"), ("lower", "upper")]
    assert [joint.anchor_a for joint in scene.joints] == [(0.0, 0.1), (0.0, 0.15)]
    assert [joint.anchor_b for joint in scene.joints] == [(0.0, 0.0), (0.0, -0.1)]
    # its samples are uneven: later commands interpolate them
    said = capsys.readouterr().out
    assert "rows are not 0.0101 s apart: interpolated every 0.0101 s" in said
    assert scene.recording is not None and scene.recording.resample


@pytest.mark.usefixtures("swing")
def test_a_pushed_block_beside_a_wall() -> None:
    rows = ["object,trajectory,time,x,vx", *(f"{b},0,{t},0,0" for t in (0, 1) for b in "ab")]
    Path("push.csv").write_text("\n".join(rows).replace("a,", "block,").replace("b,", "finger,"))
    block = "--body block=polygon:-0.05,-0.05/0.1,-0.05/-0.05,0.1"
    options = f"--columns body=object --time-step 0.1 {block} --body finger=circle:1e-3"
    assert run(f"new --history push.csv {options}") == 0
    before, middle, after = Path("scene.toml").read_text().partition('name = "finger"')
    after = after.replace("# kinematic = true", "kinematic = true").replace("wheel = false", "")
    Path("scene.toml").write_text(before + middle + uncommented(after, "[[wall]]"))
    scene = Scene.load("scene.toml")
    assert scene.time_step == 0.1 and scene.normal_gravity == 9.81
    assert scene.body("block").shape.vertices == ((-0.05, -0.05), (0.1, -0.05), (-0.05, 0.1))
    assert scene.body("finger").kinematic
    assert [(wall.start, wall.end) for wall in scene.walls] == [((-2.0, -1.0), (2.0, -1.0))]


def uncommented(text: str, table: str) -> str:
    """Return a scene's text with an example of it declared."""
    begin, end = text.index(f"# {table}"), text.find("\n\n", text.index(f"# {table}"))
    example = text[begin:] if end < 0 else text[begin:end]
    return text.replace(example, example.replace("\n# ", "\n").removeprefix("# "))


@pytest.mark.usefixtures("swing")
def test_what_a_new_scene_has_as_comments_is_valid() -> None:
    assert run("new --body arm=box:0.03x0.4 --time-step 0.02 -q") == 0
    text = Path("scene.toml").read_text()
    assert not Scene.from_toml(text).joints
    for table in ("[noise]", "[[wall]]", "[[joint]]"):
        text = uncommented(text, table)
    for line in re.findall(r"^# ((?:known|prior|effects) =.*)", text, re.M):
        text = text.replace(f"# {line}", line)
    # what is known has no prior
    scene = Scene.from_toml(text.replace("known = { mass = 6.0 }", "known = { r = 0.5 }"))
    assert scene.walls and scene.noise and attach(scene)[0].effect.name == "linear_drag"
    assert scene.joints[0].bodies == ("arm", "world") and scene.joints[0].anchor_a == (0.0, 0.1)
    assert run("new rail.toml --body cart=box:0.3x0.1 --time-step 0.02 -q") == 0
    text = Path("rail.toml").read_text()
    rail = Scene.from_toml(uncommented(text, "[[joint]]                # a cart"))
    assert rail.joints[0].kind == "slider" and rail.joints[0].axis == (1.0, 0.0)


@pytest.mark.parametrize(
    ("radius", "mass"), [(0.1, 2 * 0.0021 / 0.1**2), (np.sqrt(2 * 0.0021 / 0.42), 0.42)]
)
def test_known_moments_of_inertia(radius: float, mass: float) -> None:
    """A wheel of 0.0021 kg m^2 on a hinge at its centre, as the scene's comments declare it."""
    known = {"mass": mass, "r": 0.0, "mu_c": 0.0}
    wheel = Body("wheel", Shape.circle(radius), known=known)
    hinge = Joint("hinge", ("wheel", "world"), (0.0, 0.0), (0.0, 0.0))
    scene = Scene(time_step=0.1, gravity=(0.0, -9.81), bodies=(wheel,), joints=(hinge,))
    wrench = np.zeros((1, 1, 1, 3))
    wrench[..., 2] = 0.03
    omega = Physics(scene).predict(np.zeros(0), np.zeros((1, 1, 6)), wrench)[0, 0, 0, 5]
    np.testing.assert_allclose(omega, 0.03 * 0.1 / 0.0021, rtol=1e-9)


@pytest.mark.usefixtures("swing")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--body arm=box:1x1", "--body: 'arm' is given twice"),
        ("--body b=polygon:0,0/1,0", "expected at least 3"),
        ("--body b=polygon:0,0/1,0/0,1", "subtract (0.333333333, 0.333333333) from every vertex"),
        ("--body b=polygon:0,0/1", "is not NAME=SHAPE"),
        ("--from pendulum", "--from copies a model as it is"),
        ("--columns x=px", "add --history"),
        ("--history swing.csv", "it has no column time; say which it is"),
        ("--history swing.csv --columns time=sec", 'no column "sec" for time'),
        (f"--history swing.csv {COLUMNS} --units time=day", '"day" is none of time'),
        ("--history swing.csv --columns time=volts", "its times do not rise"),
    ],
)
def test_bad_options(options: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    recording = "" if "--history" in options else "--time-step 0.02"
    assert message in refused(capsys, f"--body arm=box:0.03x0.4 {recording} {options}")


@pytest.mark.usefixtures("swing")
def test_a_table_that_names_no_body(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, f"--history swing.csv {COLUMNS}")
    assert "give --body NAME=SHAPE for one body, --columns body=COLUMN" in said


def test_the_page_on_own_logs_writes_scenes_that_load(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its examples of ``new``, on short tables of the columns that they name."""
    monkeypatch.chdir(tmp_path)
    Path("pole.txt").write_text("0.00 1.0\n0.05 1.1\n")
    Path("swing.csv").write_text("swing,ms,angle\n0,0,1\n0,20,2\n")
    angles = "run,t,q1,dq1,tau1,q2,dq2,tau2"
    Path("arm.csv").write_text(f"{angles}\n0,0,0,0,0,0,0,0\n0,0.01,0,0,0,0,0,0\n")
    rows = [f"0,{time},{body},0" for time in (0, 0.1) for body in ("block", "finger")]
    Path("push.csv").write_text("\n".join(["trajectory,time,object,x", *rows]))
    Path("flights").mkdir()
    for name in ("a", "b"):
        Path(f"flights/{name}.txt").write_text("t\tx\ty\n0\t0\t0\n0.1\t1\t0\n")
    page = (ROOT / "analysis" / "docs" / "pages" / "guides" / "own_log.md").read_text()
    lines = page.replace("\\\n", " ").splitlines()
    commands = [line for line in lines if line.startswith("pbrl-ppl new")]
    kinds = []
    for command in commands:
        assert run(f"{command.removeprefix('pbrl-ppl ')} --overwrite -q") == 0
        scene = Scene.load("scene.toml")
        kinds.append((len(scene.dynamic), len(scene.moving), len(scene.joints), len(scene.walls)))
    assert kinds == [(1, 1, 1, 0), (1, 1, 0, 0), (1, 1, 1, 0), (2, 2, 2, 0), (2, 2, 0, 0)]
