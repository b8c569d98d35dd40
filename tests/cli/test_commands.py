"""The commands beside the loop: new, fit, criticise, simulate, and what all have alike."""

import ast
import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import typer

import pbrl_ppl as pp
from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.cli.app import app
from pbrl_ppl.cli.terminal import Progress, interruptible
from pbrl_ppl.errors import ConvergenceWarning, FitError
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.physics.settings import table1
from pbrl_ppl.posterior import PosteriorRecord, completion, group, load_posterior
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.places import MODELS, ROOT
from tests.helpers.puck import SCENE

HEADER = "trajectory,step,time,body,x,y,theta,vx,vy,omega,force_x,force_y,torque\n"


@pytest.fixture
def puck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a puck of 2 kg that is pushed by 4 N, to run in; errors are a millionth."""
    rng = np.random.default_rng(1)
    rows = []
    for i, force in enumerate((4.0, -2.0, 1.0, 3.0)):
        for step in range(6):
            time, a = 0.1 * step, force / 2.0
            state = np.array([0.5 * a * time**2, 0.0, 0.0, a * time, 0.0, 0.0])
            state += 1e-4 * rng.standard_normal(6)
            wrench = ",," if step == 5 else f"{force},0,0"
            rows.append(
                f"{i},{step},{time:.1f},puck,{','.join(map(repr, state.tolist()))},{wrench}"
            )
    (tmp_path / "train.csv").write_text(HEADER + "\n".join(rows) + "\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def answer(capsys: pytest.CaptureFixture[str], *argv: str, code: int = 0) -> dict[str, Any]:
    """Run with --json, and take what is on stdout, all of it, for one object."""
    assert main([*argv, "--json"]) == code
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def message(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """Run, and expect code 2 with one message and no result."""
    assert main([*argv, "--quiet"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    return captured.err


NAMES = [str(each.name) for each in app.registered_commands]


# what all have alike


def test_every_help_has_an_example_that_parses() -> None:
    group = typer.main.get_command(app)
    assert set(group.commands) >= set(NAMES)
    for name, command in group.commands.items():
        assert command.epilog and command.epilog.startswith("Example: pbrl-ppl "), name
        words = shlex.split(command.epilog.removeprefix("Example: "))
        assert words[1] == name
        command.make_context(name, words[2:])  # raises on what it does not know


def test_every_option_has_its_help() -> None:
    """It stands in a docstring, where a name that is mistyped would lose it."""
    for name, command in typer.main.get_command(app).commands.items():
        for parameter in command.params:
            assert parameter.help or parameter.hidden, (name, parameter.name)


def test_options_are_alike() -> None:
    """All can be quiet and answer in JSON; what is random has a seed."""
    for name, command in typer.main.get_command(app).commands.items():
        options = {option for parameter in command.params for option in parameter.opts}
        if name in NAMES:
            assert {"--json", "--quiet"} <= options, name
        if "--draws" in options:
            assert "--seed" in options, name
    drawing = {
        "check",
        "fit",
        "close-loop",
        "plan",
        "suggest",
        "simulate",
    }
    group = typer.main.get_command(app).commands
    assert {
        name for name in NAMES if any("--draws" in each.opts for each in group[name].params)
    } == drawing


def test_commands_read_recordings_alike() -> None:
    """By the same options, all of them, in place of what the scene says."""
    group = typer.main.get_command(app).commands
    options = {
        name: {option for parameter in group[name].params for option in parameter.opts}
        for name in NAMES
    }
    reading = {"--columns", "--units", "--estimate-velocities", "--trim", "--effect-file"}
    for name in ("check", "criticise", "fit", "close-loop"):
        assert reading | {"--noise", "--substeps", "--time-step"} <= options[name], name
    for name in ("update", "simulate"):
        assert reading | {"--resample"} <= options[name], name


def test_exit_codes_are_documented() -> None:
    readme = (ROOT / "README.md").read_text()
    page = (ROOT / "analysis" / "docs" / "pages" / "explanation" / "reliability.md").read_text()
    for text in (readme, page, app.info.epilog):
        assert "at least one log" in text
    for code in ("0", "1", "2", "3", "130"):
        assert f"| {code} |" in readme
        assert f"{code} " in app.info.epilog or f"{code};" in app.info.epilog


def test_shell_completion() -> None:
    environment = os.environ | {
        "PYTHONPATH": str(ROOT), "_PBRL_PPL_COMPLETE": "complete_bash",
        "COMP_WORDS": "pbrl-ppl cri", "COMP_CWORD": "1",
    }  # fmt: skip
    code = "import sys; from pbrl_ppl.cli import main; sys.exit(main())"
    got = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert got.stdout.split() == ["criticise"], got.stderr


def test_reading_files_does_not_load_pymc() -> None:
    folder = MODELS / "shopping_cart"
    code = (
        "import sys, time; begin = time.process_time(); import pbrl_ppl as pp;"
        " print(time.process_time() - begin);"
        f" scene = pp.Scene.load({str(folder / 'scene.toml')!r});"
        f" pp.History.load({str(folder / 'recorded' / 'test.csv')!r}, scene); print(*sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    seconds, modules = said.stdout.splitlines()
    assert float(seconds) < 1.0
    assert not {"pymc", "pytensor", "arviz", "matplotlib", "numba"} & set(modules.split())


# new


@pytest.mark.usefixtures("puck")
def test_three_commands_from_a_recording_to_criticism(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No scene is there, and no Python; the drag in the recording is not declared."""
    Path("scene.toml").unlink()
    slowed(Path("train.csv"))
    written = answer(
        capsys, "new", "scene.toml", "--history", "train.csv", "--body", "puck=circle:0.1"
    )
    assert written["scene"] == "scene.toml"
    scene = Scene.load("scene.toml")
    assert [body.name for body in scene.moving] == ["puck"] and scene.time_step == 0.1
    contents = answer(capsys, "check", "scene.toml", "train.csv", "--no-prior")
    assert contents["transitions"] == 20 and contents["missing"]["puck"]["x"] == 0
    found = answer(capsys, "criticise", "scene.toml", "train.csv", "--quiet")
    assert found["candidates"][0]["effect"] == "linear_drag"
    # one step from a mode whose mass, 2.6 kg for 2, has taken up a part of it
    assert found["candidates"][0]["estimate"]["coefficient"] == pytest.approx(2.0, rel=0.3)
    assert found["mode"]["mass[puck]"] > 0
    attribute = criticism.attribute
    found_once = []

    def once(*args: Any, **options: Any) -> Any:
        found_once.append(found_once[0] if found_once else attribute(*args, **options))
        return found_once[-1]

    monkeypatch.setattr(criticism, "attribute", once)
    simulated = answer(capsys, "criticise", "scene.toml", "train.csv", "--quiet", "--simulate")
    assert [law["effect"] for law in simulated["laws"]] == ["linear_drag"]
    assert simulated["laws"][0]["estimate"]["coefficient"] == pytest.approx(2.0, rel=0.05)
    assert simulated["before"]["vx"] > 2 * simulated["after"]["vx"]
    assert main(["criticise", "scene.toml", "train.csv", "--quiet", "--simulate"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    shortest = simulated["rungs"][0]
    assert shortest["accepted"] == ["linear_drag on puck"] and simulated["rejected"] == {}
    for said in (
        f"s, intervals: {shortest['rows']} accepted: linear_drag on puck dropped: none",
        "linear_drag puck",
        "simulation error over 0.5 s",
    ):
        assert said in printed


@pytest.mark.usefixtures("puck")
@pytest.mark.parametrize(
    "command", [["check", "--no-prior"], ["criticise"], ["close-loop"], ["fit"]]
)
def test_a_position_in_other_units_than_its_velocity_is_named(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the long work, which is not done here: it would come to an end with an error."""

    def long_work(*args: Any, **options: Any) -> Any:
        raise FitError("the long work")

    for module, name in ((pp, "fit"), (criticism, "close_loop"), (criticism, "criticise")):
        monkeypatch.setattr(module, name, long_work)
    name, *options = command
    output = [] if name in ("check", "criticise") else ["-o", "out.nc"]
    argv = [name, "scene.toml", "train.csv", *options, *output, "--quiet"]
    main(argv)
    assert "units" not in capsys.readouterr().err
    frame = pd.read_csv("train.csv")
    frame.assign(x=1000.0 * frame["x"]).to_csv("train.csv", index=False)
    main(argv)
    said = capsys.readouterr().err
    assert said.startswith("warning: history train.csv: x of puck changes")
    assert "x may be in mm; read it with --units x=mm\n" in said
    if name == "check":
        assert len(answer(capsys, *argv)["unit_mismatches"]) == 1
        assert answer(capsys, *argv, "--units", "x=mm")["unit_mismatches"] == []


def slowed(path: Path) -> None:
    """The puck's recording with a drag of 2 kg/s, a rate of 1/s."""
    lines = []
    for line in path.read_text().splitlines()[1:]:
        cells = line.split(",")
        time, force = float(cells[2]), (4.0, -2.0, 1.0, 3.0)[int(cells[0])]
        noise = 1e-5 * np.sin(37.0 * np.arange(2) + 91.0 * time + force)
        cells[7] = repr(float(force / 2.0 * (1 - np.exp(-time)) + noise[0]))
        cells[4] = repr(float(force / 2.0 * (time - 1 + np.exp(-time)) + noise[1]))
        lines.append(",".join(cells))
    path.write_text(HEADER + "\n".join(lines) + "\n")


@pytest.mark.usefixtures("puck")
def test_new_copies_a_model_with_its_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    assert "exists" in message(capsys, "new", "--from", "pendulum")
    assert Path("scene.toml").read_text() == SCENE
    assert "train.csv: it exists" in message(capsys, "new", "a.toml", "--from", "pendulum")
    assert not Path("a.toml").exists()
    written = answer(capsys, "new", "--from", "pendulum", "--overwrite")["written"]
    assert sorted(written) == ["scene.toml", "test.csv", "train.csv"]
    History.load("train.csv", Scene.load("scene.toml"))
    assert 'did you mean "shopping_cart"' in message(capsys, "new", "b.toml", "--from", "cart")
    assert main(["new", "--from", "pendulum", "--overwrite"]) == 0
    assert "next: pbrl-ppl check scene.toml train.csv" in capsys.readouterr().out
    assert main(["new", "b.toml", "--from", "apartment"]) == 0  # no recording comes with it
    assert "next, with your recording: pbrl-ppl check" in capsys.readouterr().out


@pytest.mark.usefixtures("puck")
def test_new_says_what_it_needs(capsys: pytest.CaptureFixture[str]) -> None:
    said = message(capsys, "new", "a.toml")
    assert "--body NAME=" in said and "--time-step" in said
    assert "not NAME=SHAPE" in message(capsys, "new", "a.toml", "--body", "puck=ball:1")
    options = ("--history", "train.csv", "--body", "pock=circle:0.1")
    assert "has no rows of 'pock'" in message(capsys, "new", "a.toml", *options)
    assert not Path("a.toml").exists()


def test_table_1_is_told_as_it_is() -> None:
    """In the docs and in new scenes."""
    priors = table1(Body("cart", Shape.box(1.0, 0.6)))
    new_scene = (ROOT / "pbrl_ppl" / "cli" / "scene.toml.jinja").read_text()
    page = (ROOT / "analysis" / "docs" / "pages" / "reference" / "formats.md").read_text()
    for name in ("mass", "r", "mu_c"):
        own = priors[name]
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}`"))
        line = next(each for each in new_scene.splitlines() if each.startswith(f"#   {name} "))
        for text in (row, line):
            assert f"mu = {own.mu}" in text and f"sigma = {own.sigma}" in text
        assert ("logarithm" in row.lower()) == (own.family == "log_normal")
    assert priors["mu_x"] == priors["mu_y"] == priors["mu_c"]
    assert priors["w_x"].sigma == 1.0 and priors["w_theta"].kappa == 0.0


# fit and simulate


@pytest.mark.usefixtures("puck")
def test_fit_writes_a_posterior_and_simulate_takes_it(capsys: pytest.CaptureFixture[str]) -> None:
    fit = ("fit", "scene.toml", "train.csv", "-o", "puck.nc", "-q")
    fitted = answer(capsys, *fit, "--method", "laplace", "--draws", "200", "--seed", "3")
    assert fitted["converged"] and fitted["posterior"] == "puck.nc"
    assert fitted["parameters"]["mass[puck]"]["mean"] == pytest.approx(2.0, rel=0.01)
    idata = load_posterior("puck.nc")
    assert idata.attrs["seed"] == 3 and "unexplained_acceleration[vx]" in fitted["parameters"]
    assert "it exists" in message(capsys, *fit)
    simulate = ("simulate", "puck.nc", "train.csv", "-q")
    made = answer(capsys, *simulate, "-o", "again.csv", "--draws", "2", "--noise", "x=1e-9")
    assert made["trajectories"] == 8 and made["transitions"] == 40
    scene = Scene.load("scene.toml")
    measured, again = (History.load(f"{name}.csv", scene) for name in ("train", "again"))
    observed = [each.dataset["observed"].to_numpy() for each in (measured, again)]
    assert np.abs(observed[1][:4] - observed[0]).max() < 1e-2
    # the same from the scene, with twice the mass: half the speed that is gained
    made = answer(capsys, "simulate", "scene.toml", "train.csv", "-o", "b.csv", "--set", "mass=4")
    assert made["parameters"] == {"mass[puck]": [4.0]}
    heavy = History.load("b.csv", scene).dataset["observed"].to_numpy()
    gained = [each[:4, -1, 0, 3] - each[:4, 0, 0, 3] for each in (heavy, observed[0])]
    assert gained[0] == pytest.approx(gained[1] / 2, abs=2e-3)


@pytest.mark.usefixtures("puck")
def test_simulate_leaves_out_what_has_no_state_to_start_from(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = pd.read_csv("train.csv")
    for name, odd in (("x", 0), ("y", 1)):
        table.loc[(table["trajectory"] == 1) & (table["step"] % 2 == odd), name] = np.nan
    table.to_csv("gaps.csv", index=False)
    simulate = ("simulate", "scene.toml", "gaps.csv", "-o", "a.csv", "--set", "mass=4")
    assert main(list(simulate)) == 0
    said = capsys.readouterr()
    assert "no complete state to start from in trajectory 1: left out" in said.err
    assert "(3 trajectories)" in said.out
    table.loc[table["trajectory"] == 1].to_csv("gaps.csv", index=False)
    assert "no trajectory has a complete state" in message(capsys, *simulate, "--overwrite")


@pytest.mark.usefixtures("puck")
def test_simulate_says_what_it_needs(capsys: pytest.CaptureFixture[str]) -> None:
    simulate = ("simulate", "scene.toml", "train.csv", "-o", "a.csv")
    assert "no value for mass[puck]" in message(capsys, *simulate)
    said = message(capsys, *simulate, "--set", "mas=1")
    assert 'no parameter "mas"; did you mean "mass"' in said
    assert "not NAME=VALUE" in message(capsys, *simulate, "--set", "mass")
    assert "expected" in message(capsys, *simulate, "--set", "mass=-1")
    assert "no draws" in message(capsys, *simulate, "--set", "mass=1", "--draws", "3")
    assert not Path("a.csv").exists()


@pytest.mark.usefixtures("puck")
def test_fit_without_convergence_exits_with_3(capsys: pytest.CaptureFixture[str]) -> None:
    # far fewer draws than a summary needs
    fit = ("fit", "scene.toml", "train.csv", "-o", "puck.nc", "--draws", "4", "--method", "laplace")
    assert answer(capsys, *fit, "-q", code=3)["converged"] is False
    assert Path("puck.nc").exists()  # it may be looked at, and gone on with
    assert "one of importance, smc" in message(capsys, *fit[:4], "a.nc", "--method", "metropols")
    said = message(capsys, *fit[:4], "a.nc", "--horizon", "3")
    assert "--likelihood transitions" in said


@pytest.mark.usefixtures("puck")
def test_an_interrupted_fit_gives_one_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = pp.fit

    def cut(*args: Any, **options: Any) -> Any:
        idata = whole(*args, **options)
        idata.attrs["interrupted"] = 1
        return idata

    monkeypatch.setattr(pp, "fit", cut)
    fit = ["fit", "scene.toml", "train.csv", "-o", "puck.nc", "-q", "--method", "map"]
    assert main(fit) == 130
    said = capsys.readouterr().err
    assert said.count("interrupted") == 1 and "kept in puck.nc" in said
    assert "nothing was written" not in said and Path("puck.nc").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("puck")
@pytest.mark.parametrize("seconds", [0.5, 8.0])
def test_an_interrupt_of_the_shell_ends_a_fit(seconds: float) -> None:
    """Before and while chains run; the shell interrupts their processes too."""
    code = "import sys; from pbrl_ppl.cli import main; sys.exit(main())"
    argv = [
        "fit",
        "scene.toml",
        "train.csv",
        "-o",
        "puck.nc",
        "--likelihood",
        "transitions",
        "--draws",
        "100000",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", code, *argv], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
        text=True, start_new_session=True, env=environment,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        assert any("then sampling" in line for line in process.stderr)
        time.sleep(seconds)
        os.killpg(process.pid, signal.SIGINT)
        said = process.stderr.read()
        assert process.wait(60) == 130
    assert "Traceback" not in said and said.count("interrupted; ") == 1
    assert ("kept in puck.nc" in said) == Path("puck.nc").exists()


def test_an_error_that_an_interrupt_caused_is_an_interrupt(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A writer of films raises another error where it is broken off."""
    with pytest.raises(typer.Exit) as caught, interruptible("all is kept"):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            raise IndexError
    assert caught.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted; all is kept\n"


#: Runs machine code for minutes, in which Python handles no signal.
BUSY = """
import hashlib
from pbrl_ppl.cli import terminal
with terminal.interruptible("nothing is kept") as interrupts:
    interrupts.rescue = lambda: "two logs are kept"
    print("begun", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_machine_code(number: signal.Signals) -> None:
    """What was found is written before; a `timeout` sends the second."""
    with subprocess.Popen(
        [sys.executable, "-c", BUSY], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ) as process:  # fmt: skip
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "begun\n"
        time.sleep(1.0)  # until it is in there
        process.send_signal(number)
        assert process.wait(60) == 130
        assert process.stderr.read() == "interrupted; two logs are kept\n"


@pytest.mark.usefixtures("puck")
def test_an_interrupt_that_a_sampler_swallowed_is_none_the_less_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It came when all chains were at their end."""
    whole = pp.fit

    def swallowed(*args: Any, **options: Any) -> Any:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return whole(*args, **options)

    monkeypatch.setattr(pp, "fit", swallowed)
    fit = ["fit", "scene.toml", "train.csv", "-o", "puck.nc", "-q", "--method", "metropolis"]
    assert main([*fit, "--draws", "40", "--tune", "40", "--thin", "1", "--chains", "2"]) == 130
    assert "40 draws of each of 2 chains are kept in puck.nc" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("puck")
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--substeps", "100000"], "substeps is 100000, expected at most 1280"),
        (["--noise", "x=1e308"], "[noise]: x is 1e+308, expected at most 1e+18"),
        (["--noise", "x=1e-300"], "[noise]: x is 1e-300, expected at least 1e-18"),
        (["--time-step", "1e308"], "time_step is 1e+308, expected at most 1e+18"),
    ],
)
@pytest.mark.parametrize("command", ["fit", "criticise", "close-loop"])
def test_absurd_options_are_refused(
    command: str, options: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output = [] if command == "criticise" else ["-o", "out.nc"]
    said = message(capsys, command, "scene.toml", "train.csv", *output, *options)
    assert says in said and said.count("error") == 1


@pytest.mark.usefixtures("puck")
@pytest.mark.parametrize("options", [[], ["--likelihood", "transitions"]])
def test_the_command_fits_what_python_fits(options: list[str]) -> None:
    """The defaults are alike but for one: the command takes whole trajectories."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fit = ["fit", "scene.toml", "train.csv", "-o", "puck.nc", "-q", "--method", "laplace"]
        main([*fit, *options])
        scene = Scene.load("scene.toml")
        history = History.load("train.csv", scene)
        settings = {} if options else {"likelihood": "trajectories"}
        model = physics_model(scene, history, **settings)
        here = pp.fit(model, seed=1, method="laplace", progress=False)
    there = load_posterior("puck.nc")
    for name, values in group(here, "posterior").items():
        np.testing.assert_array_equal(values, group(there, "posterior")[name])


# messages


@pytest.mark.usefixtures("puck")
def test_cures_are_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = Path("train.csv").read_text().splitlines()
    positions = [
        ",".join([*line.split(",")[:7], "", "", "", *line.split(",")[10:]]) for line in text[1:]
    ]
    Path("poses.csv").write_text(HEADER + "\n".join(positions) + "\n")
    fit = ("fit", "scene.toml", "poses.csv", "-o", "a.nc", "--likelihood", "transitions")
    said = message(capsys, *fit)
    assert "fit whole trajectories (the likelihood 'trajectories')" in said
    assert "--estimate-velocities" in said and "=True" not in said
    Path("out").mkdir()
    Path("out/a").touch()
    said = message(capsys, "close-loop", "scene.toml", "train.csv", "-o", "out")
    assert said.strip().endswith("or allow overwriting (overwrite, --overwrite)")


def test_advice_is_of_no_language() -> None:
    """Messages name an argument by its bare word, which is that of the command's option too.

    Excepted are reprs, the code that a report shows, and the messages about effects, which are
    written in Python.
    """
    python = {"criticism/results.py", "reporting/many.py", "reporting/reports.py",
              "effects/effect.py", "physics/trial.py"}  # fmt: skip
    advice = re.compile(r"\b[a-z_]+=(True|False|None|'\w*')?(?=[\s,;.)]|$)")
    package = ROOT / "pbrl_ppl"
    found = [
        (str(path.relative_to(package)), text)
        for path in package.rglob("*.py")
        for text in messages(path)
        if advice.search(text)
    ]
    assert [each for each in found if each[0] not in python] == []
    assert python >= {name for name, _ in found}


def messages(path: Path) -> list[str]:
    """Return the texts of a file, without docstrings; a value put in is left out."""
    tree = ast.parse(path.read_text())
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    documented = [node for node in ast.walk(tree) if isinstance(node, kinds)]
    skipped = {
        id(node.body[0].value)
        for node in documented
        if node.body and isinstance(node.body[0], ast.Expr)
    }
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if id(node) not in skipped and " " in node.value
    ]


@pytest.mark.usefixtures("puck")
def test_convergence_is_judged_as_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene.load("scene.toml")
    model = physics_model(scene, History.load("train.csv", scene))
    idata = pp.fit(model, method="laplace", draws=1000, chains=2)
    expected = {
        (1.0104, 400.0): [],
        (1.0106, 400.0): ["R-hat is 1.011 for m (want <= 1.01);"],
        (1.0, 399.9): ["effective sample size is 399 for m (want >= 400);"],
    }
    for (r_hat, ess), words in expected.items():
        values = {"m": r_hat}, {"m": ess}
        monkeypatch.setattr(completion, "convergence", lambda idata, values=values: values)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            completion.checked(problem_in(model), PosteriorRecord.of(idata), idata)
        said = [str(each.message) for each in caught if each.category is ConvergenceWarning]
        assert len(said) == len(words)
        assert all(f"not converged: {word}" in each for word, each in zip(words, said, strict=True))


@pytest.mark.usefixtures("puck")
@pytest.mark.parametrize("name", ["x" * 300, "/proc/none/report"])
def test_a_folder_that_cannot_be_made_is_refused_at_once(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(criticism, "close_loop", lambda *args, **options: pytest.fail("too late"))
    for logs in (["train.csv"], ["train.csv", "test.csv"]):
        assert "cannot be made" in message(capsys, "close-loop", "scene.toml", *logs, "-o", name)


@pytest.mark.usefixtures("puck")
def test_a_spreadsheet_s_commas_and_semicolons(capsys: pytest.CaptureFixture[str]) -> None:
    before = Path("train.csv").read_text()
    Path("german.csv").write_text(before.replace(",", ";").replace(".", ","))
    scene = Scene.load("scene.toml")
    hashes = {History.load(name, scene).data_sha256 for name in ("train.csv", "german.csv")}
    assert len(hashes) == 1
    Path("short.csv").write_text(before.replace(",", ";").replace(".", ",")[:-20] + "\n")
    assert "cells, expected 13" in message(capsys, "check", "scene.toml", "short.csv")


@pytest.mark.usefixtures("puck")
def test_of_two_commands_with_one_output_one_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    """The other may read and write anything else, and after its end this one."""
    held = "from pathlib import Path; from pbrl_ppl.system.files import only_writer\n"
    held += "with only_writer(Path('puck.nc')): print('begun', flush=True); input()"
    fit = ["fit", "scene.toml", "train.csv", "-q", "--method", "map", "-o"]
    with subprocess.Popen(
        [sys.executable, "-c", held], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ) as other:  # fmt: skip
        assert other.stdout is not None
        assert other.stdout.readline() == "begun\n"
        assert main([*fit, "./puck.nc"]) == 2
        assert "puck.nc: another command is writing to it" in capsys.readouterr().err
        assert main([*fit, "other.nc"]) == 0
        other.communicate("\n")
    assert main([*fit, "puck.nc"]) == 0


def test_a_long_stage_is_not_silent(capfd) -> None:
    """A log shows every minute that it goes on; nothing is written after it, or where quiet."""
    for quiet in (False, True):
        with Progress(quiet, every=0.05) as progress:
            progress("climbing")
            time.sleep(0.3)
        said = capfd.readouterr().err
        assert (said.count("s] climbing: still running\n") >= 2) is not quiet
        time.sleep(0.1)
        assert capfd.readouterr().err == ""
