"""``close-logs`` and the options of tables that have names and units of their own."""

import os
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.cli.close_loop import OneProcessEach
from pbrl_ppl.reporting import many
from pbrl_ppl.reporting.logs import Settings, close_log, settle
from tests.helpers.fleet import made_logs, pretend
from tests.helpers.processes import dies

SCENE = """
[world]
time_step = 0.1

[[body]]
name = "puck"
shape = { kind = "circle", radius = 0.1 }
"""


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Settings]:
    """A folder with a manifest of logs that take no time; the settings they were run with."""
    made = made_logs(tmp_path, red="linear_drag", blue="")
    rows = [f"{log.name},{log.scene.name},{log.train.name}\n" for log in made]
    (tmp_path / "logs.csv").write_text("name,scene,train\n" + "".join(rows))
    monkeypatch.chdir(tmp_path)
    seen: list[Settings] = []

    def settled(log: Any, folder: Any, settings: Settings, inputs: str, run: Any) -> Any:
        assert run is close_log
        seen.append(settings)
        return settle(log, folder, settings, inputs, pretend)

    monkeypatch.setattr(many, "settle", settled)
    return seen


def test_many(logs: list[Settings], capsys: pytest.CaptureFixture[str]) -> None:
    options = (
        "--seed 7 --draws 300 --substeps 5 --noise x=0.1 --columns x=px,force_y=0 --columns time=t"
        " --units x=mm,theta=deg --time-step 0.2 --estimate-velocities --method laplace"
    )
    argv = ["close-logs", "logs.csv", "-o", "out"]
    assert main([*argv, *options.split()]) == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [
        "linear_drag[cart]: red",
        "1 adequate, 1 effects-added",
        "page: out/index.html",
    ]
    assert "2/2 blue: adequate" in captured.err
    # the page says what makes it again
    page = Path("out/index.html").read_text()
    assert "pbrl-ppl close-logs" in page and "logs.csv" in page and "--units x=mm" in page
    assert (
        logs
        == [
            Settings(
                scene={"noise": {"x": 0.1}, "substeps": 5, "time_step": 0.2},
                recording={
                    "estimate_velocities": True,
                    "columns": {"x": "px", "force_y": 0.0, "time": "t"},
                    "units": {"x": "mm", "theta": "deg"},
                    "trim": False,
                },
                loop={"seed": 7, "draws": 300, "method": "laplace", "most_transitions": 3000},
            )
        ]
        * 2
    )
    Path("blue.csv").write_text("fail")
    assert main([*argv, "-q"]) == 1
    captured = capsys.readouterr()
    assert "1 effects-added, 1 failed" in captured.out and captured.err == ""
    Path("blue.csv").write_text("interrupt")
    assert main([*argv, "-q"]) == 130
    message = "interrupted; finished logs are in out; the same command goes on\n"
    assert capsys.readouterr().err == message
    assert main(argv) == 130
    assert capsys.readouterr().err.count("interrupted") == 1
    assert Path("out/red/report.html").is_file() and not Path("out/blue/report.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("nope.csv", "nope.csv: there is no such file"),
        ("scene.toml", 'unknown column "a scene"'),
        ("scene.toml red.csv", "unexpected extra argument"),
        ("", "Missing argument 'MANIFEST'"),
        ("logs.csv --columns x", "is not NAME=VALUE, such as x=pos_x"),
        ("logs.csv --units x=", "is not NAME=VALUE, such as x=mm"),
        ("logs.csv --scheduler tcp://127.0.0.1:9", "no Dask scheduler answers there"),
    ],
)
def test_bad_usage(
    options: str, message: str, logs: list[Settings], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    distributed = pytest.importorskip("distributed")

    def nobody(address: str, timeout: float) -> None:
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", nobody)
    assert main(["close-logs", "-o", "out", *options.split()]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    # typer puts usage errors into a box
    assert message in " ".join(captured.err.replace("│", " ").split())
    assert not logs and not Path("out").exists()


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


def test_a_process_that_dies_takes_no_other_with_it(tmp_path: Path) -> None:
    folders = [tmp_path / f"{times}" for times in range(3)]
    for folder in folders:
        folder.mkdir()
    with OneProcessEach(2) as executor:
        never, once, twice = (
            executor.submit(dies, str(folder), times) for times, folder in enumerate(folders)
        )
        assert never.result() != os.getpid() != once.result()
        with pytest.raises(BrokenProcessPool):
            twice.result()
    assert [len(list(folder.iterdir())) for folder in folders] == [1, 2, 2]
