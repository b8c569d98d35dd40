"""``close-loop`` on many logs, and the options of tables that have names and units of their own."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.cli.close_loop import Each, LoopSettings
from pbrl_ppl.cli.options import FolderOutput, SceneReading
from pbrl_ppl.criticism import FILES, Loop
from tests.helpers.made_up import made_up
from tests.helpers.processes import Dies

SCENE = """
[world]
time_step = 0.1

[[body]]
name = "puck"
shape = { kind = "circle", radius = 0.1 }
"""
HEADER = "trajectory,time,body,x,y,theta,vx,vy,omega,force_x,force_y,torque\n"


@pytest.fixture
def seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A folder of logs whose loops take no time, here; the transitions of those that were closed.

    That of two transitions is adequate, of three has a drag, of four makes the loop crash.
    """
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    Path("logs").mkdir()
    for name, count in {"blue": 2, "red": 3, "Red 2": 3, "wild": 4}.items():
        rows = (f"1,{0.1 * i:g},puck,{i},0,0,1,0,0,0,0,0\n" for i in range(count + 1))
        Path(f"logs/{name}.csv").write_text(HEADER + "".join(rows))
    Path("logs/bad.csv").write_text("time,x\n1,2\n")
    Path("logs/notes.md").write_text("no log")
    closed: list[int] = []

    def close_loop(scene: Any, train: Any, *test: Any, **options: Any) -> Loop:
        closed.append(train.n_transitions)
        assert options["seed"] == 7 and options["method"] == "laplace"
        if train.n_transitions == 4:
            raise ZeroDivisionError("by zero")
        if train.n_transitions == 2:
            warnings.warn("rows were\nresampled", UserWarning, stacklevel=2)
        return made_up("adequate" if train.n_transitions == 2 else "effects-added")

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    monkeypatch.setattr("pbrl_ppl.reporting.render", lambda *args, **options: "a page")
    monkeypatch.setattr(Each, "apart", Each.close)
    return closed


OPTIONS = ("--each", "-o", "out", "--seed", "7", "--method", "laplace")


def test_a_folder_of_logs(seen: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    """Each has a report, one page lists all, and those that fail do not stop the others."""
    assert main(["close-loop", "scene.toml", "logs", *OPTIONS]) == 1
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [
        "linear_drag[cart]: Red 2, red",
        "1 adequate, 2 effects-added, 2 failed",
        "page: out/index.html",
    ]
    assert "2/5 blue: adequate" in captured.err and "warning" not in captured.err
    assert "5/5 wild: ZeroDivisionError: by zero" in captured.err
    for name in ("Red 2", "blue", "red"):
        assert sorted(path.name for path in Path("out", name).iterdir()) == sorted(FILES)
    assert sorted(path.name for path in Path("out").iterdir()) == [
        "Red 2", "blue", "index.html", "red",
    ]  # fmt: skip
    page = Path("out/index.html").read_text()
    for words in ('href="Red%202/report.html"', "linear drag[cart]", "missing column(s)",
                  "rows were resampled", "pbrl-ppl close-loop scene.toml logs -o out"):  # fmt: skip
        assert words in page
    assert 'href="bad' not in page


def test_logs_are_one_history_without_each(
    seen: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder, or several files: as training and as test recordings."""
    Path("logs/bad.csv").unlink()
    alone = [*OPTIONS[1:], "-q", "--overwrite"]
    assert main(["close-loop", "scene.toml", "logs", *alone]) == 0
    files = ["logs/red.csv", "logs/wild.csv"]
    assert main(["close-loop", "scene.toml", *files, "--test", "logs/blue.csv", *alone]) == 0
    assert main(["close-loop", "scene.toml", *files, "--test", "logs", *alone]) == 0
    assert seen == [2 + 3 + 3 + 4, 3 + 4, 3 + 4]
    assert not Path("out/index.html").exists()
    capsys.readouterr()
    assert main(["check", "scene.toml", *files, "--no-prior", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["trajectories"] == 2
    assert main(["close-loop", "scene.toml", "logs", "--jobs", "2", *alone]) == 2
    assert "add --each" in capsys.readouterr().err


def test_several_logs_are_run_again(seen: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["close-loop", "scene.toml", "logs/blue.csv", "logs/red.csv", *OPTIONS, "-q"]
    assert main(argv) == 0
    assert capsys.readouterr().err == ""
    assert main(argv) == 2
    assert "it is not empty" in capsys.readouterr().err
    assert main([*argv, "--overwrite", "--json"]) == 0
    assert sorted(seen) == [2, 2, 3, 3]
    told = json.loads(capsys.readouterr().out)
    assert told["page"] == "out/index.html"
    assert [(row["log"], row["verdict"]) for row in told["logs"]] == [
        ("blue", "adequate"),
        ("red", "effects-added"),
    ]
    assert told["logs"][0]["warnings"] == ["rows were resampled"]
    assert told["logs"][1]["error_before"] > told["logs"][1]["error_after"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("logs/blue.csv nope.csv", "nope.csv: there is no such file"),
        ("logs Blue.txt", '2 have the name "blue"'),
        ("logs --test logs/blue.csv", "--test is given with --each"),
        ("empty", "the folder has no log; expected files that end in .csv"),
        ("logs --columns x", "is not NAME=VALUE, such as x=pos_x"),
        ("logs --units x=", "is not NAME=VALUE, such as x=mm"),
        ("logs --noise speed=1", "speed"),
        ("logs --effect-file nope.py", "nope.py"),
        ("logs --jobs 0", "--jobs"),
    ],
)
def test_bad_usage(
    given: str, message: str, seen: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    """What is wrong for all logs is said before any of them."""
    Path("empty").mkdir()
    Path("Blue.txt").write_text("time x\n1 2\n")
    assert main(["close-loop", "scene.toml", *given.split(), *OPTIONS]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    # typer puts usage errors into a box
    assert message in " ".join(captured.err.replace("│", " ").split())
    assert not seen and not Path("out").exists()


def test_a_process_that_dies_takes_no_other_with_it(tmp_path: Path) -> None:
    scene, to = tmp_path / "scene.toml", FolderOutput(tmp_path / "out")
    each = Dies(scene, SceneReading(), LoopSettings(), to, "pbrl-ppl close-loop")
    assert each.apart("lives", tmp_path)["verdict"] == "adequate"
    row = each.apart("dies", tmp_path)
    assert row["verdict"] == "failed" and "BrokenProcessPool" in row["message"]


@pytest.mark.filterwarnings("default::pbrl_ppl.errors.ResamplingWarning")
def test_own_tables_of_one_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    time = np.array([0.0, 0.09, 0.21, 0.3, 0.41])
    rows = [f"{1e3 * t:g},{500 * t:g},0,{10 * i},7" for i, t in enumerate(time)]
    Path("capture.csv").write_text("\n".join(["t,px,py,yaw,marker", *rows]) + "\n")
    seen: list[Any] = []

    def stop(scene: Any, train: Any, *rest: Any, **options: Any) -> None:
        seen.append((scene, train))
        raise KeyboardInterrupt

    monkeypatch.setattr(criticism, "close_loop", stop)
    argv = ["close-loop", "scene.toml", "capture.csv", "-o", "out", "--estimate-velocities"]
    own = ["--columns", "time=t,x=px,y=py,theta=yaw,force_x=0,force_y=0,torque=0"]
    own += ["--units", "time=ms,x=mm,theta=deg"]
    assert main([*argv, *own, "-q"]) == 2
    assert "resample" in capsys.readouterr().err
    assert main([*argv, *own, "--time-step", "0.15", "-q"]) == 130
    assert "warning: history capture.csv: samples are 0.09 to 0.12 s" in capsys.readouterr().err
    scene, train = seen[0]
    assert scene.time_step == 0.15
    observed = train.dataset["observed"].to_numpy()[0, :, 0]
    np.testing.assert_allclose(observed[:, 0], 0.5 * 0.15 * np.arange(3), atol=1e-12)


@pytest.mark.filterwarnings("default::pbrl_ppl.errors.ResamplingWarning")
def test_every_command_that_reads_a_recording_takes_own_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    rows = [f"{90 * i},{45 * i},500,0" for i in range(5)]
    Path("capture.csv").write_text("\n".join(["t,px,vx,yaw", *rows]) + "\n")
    columns = "time=t,x=px,y=0,theta=yaw,vx=vx,vy=0,omega=0,force_x=0,force_y=0,torque=0"
    own = ["--columns", columns, "--units", "time=ms,x=mm,vx=mm/s"]
    files = ["scene.toml", "capture.csv"]
    assert main(["check", *files, *own, "--time-step", "0.09", "--no-prior", "--json"]) == 0
    assert '"transitions": 4' in capsys.readouterr().out
    for command in (["fit", *files, "-o", "new.nc"], ["criticise", *files],
                    ["update", "a.nc", files[1], "-o", "b.nc"],
                    ["simulate", *files, "-o", "new.csv"]):  # fmt: skip
        assert main([*command, "--columns", "x"]) == 2, command
        assert "is not NAME=VALUE" in " ".join(capsys.readouterr().err.replace("│", " ").split())
    simulated = ["simulate", *files, *own, "--resample", "-o", "new.csv", "--set", "mass=1"]
    assert main([*simulated, "--set", "r=0.1", "--set", "mu_c=0.1"]) == 0
    assert Path("new.csv").is_file()
