"""The command line: results on success, one message and exit code 2 on bad input."""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.criticism import FILES, Loop
from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import ConvergenceWarning, HistoryError
from tests.helpers.made_up import made_up
from tests.helpers.places import ROOT

SCENE = """
[world]
time_step = 0.1
substeps = 4

[[body]]
name = "puck"
shape = { kind = "circle", radius = 0.1 }
"""
HEADER = "trajectory,step,time,body,x,y,theta,vx,vy,omega,force_x,force_y,torque\n"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene and histories, to run in; its paths are short in messages."""
    (tmp_path / "scene.toml").write_text(SCENE)
    rows = [
        f"{i},{step},{0.1 * step},puck,{step},{'' if step == 1 else 0},0,1,0,0,"
        + (",," if step == 2 else "0,0,0")
        for i in range(2)
        for step in range(3)
    ]
    for name in ("train.csv", "test.csv"):
        (tmp_path / name).write_text(HEADER + "\n".join(rows) + "\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Any, Any, dict[str, Any]]]:
    """What the long work was called with; it is over at once."""
    seen: list[tuple[Any, Any, Any, dict[str, Any]]] = []

    def close_loop(scene: Any, train: Any, test: Any = None, **options: Any) -> Loop:
        options.pop("progress")("fitting [all] of it")
        seen.append((scene, train, test, options))
        return made_up()

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    monkeypatch.setattr("pbrl_ppl.reporting.render", lambda *args, **options: "a page")
    return seen


def fails(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """Run, expect code 2 and one line that begins with error, and return that."""
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    messages = [line for line in captured.err.splitlines() if not line.startswith("[")]
    assert len(messages) == 1, captured.err
    assert messages[0].startswith("error: ")
    assert "Traceback" not in captured.err
    return messages[0]


def test_close_loop(files: Path, calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["close-loop", "scene.toml", "train.csv", "--test", "test.csv", "-o", "a/out"])
    captured = capsys.readouterr()
    assert code == 0
    assert captured.out.splitlines() == [
        "Verdict: effects-added. Linear drag or quadratic drag on the cart: held-out error 2.40 ->"
        " 1.02 times the noise; only noise remains.",
        "  linear drag on the cart (a force against the motion that grows with the speed):"
        " coefficient 3.00 kg/s (94 % interval 2.81 to 3.19); these data cannot tell it from"
        " quadratic drag",
        "Held-out error of x 2.00 s ahead: 0.0192 -> 0.00816 m, 57.5 % less (noise floor"
        " 0.00800 m).",
        "  The revised model passes all 2 tests of its residual.",
        "Next: pbrl-ppl suggest a/out/after.nc -o next.csv: a recording that tells these effects"
        " apart.",
        "Report: a/out/report.html; posteriors before.nc and after.nc beside it.",
    ]
    # the time elapsed and the stage, no guess of the time remaining
    assert all(re.fullmatch(r"\[ *\d+\.\d s\] .+", line) for line in captured.err.splitlines())
    stages = [line.partition("] ")[2] for line in captured.err.splitlines()]
    assert "fitting [all] of it" in stages
    assert stages[-1] == "writing the report"
    assert sorted(p.name for p in (files / "a" / "out").iterdir()) == sorted(FILES)
    scene, train, test, options = calls[0]
    assert scene.substeps == 4
    assert train.n_transitions == test.n_transitions == 4
    assert options.pop("catalogue") == catalogue
    assert options == {"seed": 1, "draws": None, "method": "importance", "most_transitions": 3000}


@pytest.mark.parametrize(("chosen", "unusual"), [("common", False), ("all", True)])
def test_close_loop_chooses_the_laws(files: Path, calls: list[Any], chosen, unusual) -> None:
    """Common laws alone, or all of them as if they were common."""
    argv = ["close-loop", "scene.toml", "train.csv", "-o", "a/out", "-q", "--catalogue", chosen]
    assert main(argv) == 0
    given = calls[0][-1]["catalogue"]
    assert not any(effect.unusual for effect in given)
    names = [effect.name for effect in catalogue if unusual or not effect.unusual]
    assert [effect.name for effect in given] == names


@pytest.mark.usefixtures("files")
def test_close_loop_options(calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    options = "--seed 7 --substeps 20 --draws 300 --method laplace --quiet --estimate-velocities"
    argv = ["close-loop", "scene.toml", "train.csv", "-o", "out", *options.split()]
    assert main(argv) == 0
    assert capsys.readouterr().err == ""
    scene, _, test, given = calls[0]
    assert scene.substeps == 20
    assert test is None
    assert given.items() >= {"seed": 7, "draws": 300, "method": "laplace"}.items()
    assert main(argv) == 2
    assert "is not empty" in capsys.readouterr().err
    assert len(calls) == 1
    assert main([*argv, "--overwrite"]) == 0
    assert main([*argv, "--overwrite", "--method", "nuts"]) == 2
    assert "'importance', 'smc', 'laplace'" in capsys.readouterr().err


@pytest.mark.usefixtures("files")
def test_close_loop_states_the_noise(calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["close-loop", "scene.toml", "train.csv", "-o", "out", "-q", "--overwrite"]
    assert main([*argv, "--noise", "x=0.002", "--noise", "omega=0.1"]) == 0
    assert calls[0][0].noise == (("x", 0.002), ("omega", 0.1))
    assert main([*argv, "--noise", "x"]) == 2
    assert "NAME=VALUE" in capsys.readouterr().err
    assert main([*argv, "--noise", "omga=0.1"]) == 2
    assert 'did you mean "omega"' in capsys.readouterr().err
    assert main([*argv, "--noise", "x=-1"]) == 2
    assert "expected more than 0" in capsys.readouterr().err
    assert len(calls) == 1


@pytest.mark.usefixtures("files", "calls")
def test_close_loop_without_a_verdict_exits_with_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stuck = made_up("not-converged")
    monkeypatch.setattr(criticism, "close_loop", lambda *args, **options: stuck)
    assert main(["close-loop", "scene.toml", "train.csv", "-o", "out", "-q"]) == 3
    assert "No verdict" in capsys.readouterr().out
    assert Path("out/report.html").exists()  # what there is may be looked at


@pytest.mark.usefixtures("files")
def test_absurd_numbers_are_refused_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    text = Path("train.csv").read_text()
    Path("train.csv").write_text(text.replace("puck,2,", "puck,1e300,"))
    assert 'history train.csv row 4: x of body "puck" is 1e+300' in fails(
        capsys, "check", "scene.toml", "train.csv"
    )
    Path("train.csv").write_text(text)
    argv = ("close-loop", "scene.toml", "train.csv", "-o", "out", "--substeps", "100000000")
    assert "expected at most 1280" in fails(capsys, *argv)


@pytest.mark.usefixtures("files")
def test_missing_files(calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    loop = ("close-loop", "-o", "out")
    assert "nope.toml" in fails(capsys, *loop, "nope.toml", "train.csv")
    assert "nope.csv" in fails(capsys, *loop, "scene.toml", "nope.csv")
    assert "nope.nc" in fails(capsys, *loop, "scene.toml", "train.csv", "--test", "nope.nc")
    assert "nope.toml" in fails(capsys, "check", "nope.toml", "train.csv")
    assert not calls
    assert not Path("out").exists()


def test_bad_files(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "scene.toml").write_text(SCENE.replace("substeps", "subteps"))
    message = fails(capsys, "check", "scene.toml", "train.csv")
    assert "subteps" in message and "substeps" in message and "[world]" in message
    (files / "scene.toml").write_text(SCENE + "bounce = [[[\n")
    fails(capsys, "check", "scene.toml", "train.csv")
    (files / "scene.toml").write_bytes(b"\xff\xfe")
    fails(capsys, "check", "scene.toml", "train.csv")
    # the puck moves along y = 0
    (files / "scene.toml").write_text(SCENE + "[[wall]]\nfrom = [-9, 0]\nto = [9, 0]\n")
    message = fails(capsys, "check", "scene.toml", "train.csv")
    assert 'history trajectory 0, step 0: body "puck" and the wall' in message
    (files / "scene.toml").write_text(SCENE)
    (files / "train.csv").write_text("")
    fails(capsys, "check", "scene.toml", "train.csv")
    fails(capsys, "check", "scene.toml", "scene.toml")
    fails(capsys, "check", "scene.toml", ".")
    fails(capsys, "check", ".", "test.csv")


def test_output_in_the_way(
    files: Path, calls: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    loop = ("close-loop", "scene.toml", "train.csv", "-o")
    assert "is a file" in fails(capsys, *loop, "train.csv")
    assert "is a file" in fails(capsys, *loop, "train.csv/below/it", "--overwrite")
    assert "is not empty" in fails(capsys, *loop, ".")
    assert not calls
    assert sorted(p.name for p in files.iterdir()) == ["scene.toml", "test.csv", "train.csv"]


@pytest.mark.parametrize(
    "argv",
    [
        ["close-loop", "scene.toml"],
        ["close-loop", "scene.toml", "train.csv"],
        ["close-loop", "scene.toml", "train.csv", "-o", "out", "--substeps", "0"],
        ["close-loop", "scene.toml", "train.csv", "-o", "out", "--seed", "x"],
        ["check", "scene.toml", "train.csv", "--overwite"],
        ["close_the_loop"],
    ],
)
def test_bad_usage(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err
    assert "Traceback" not in captured.err


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("problem", [HistoryError("one\nmessage"), KeyboardInterrupt()])
def test_trouble_in_the_long_work(
    problem: BaseException,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def close_loop(*args: Any, **options: Any) -> Loop:
        raise problem

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    code = main(["close-loop", "scene.toml", "train.csv", "-o", "out", "-q"])
    interrupted = isinstance(problem, KeyboardInterrupt)
    assert code == (130 if interrupted else 2)
    expected = "interrupted; nothing was written" if interrupted else "error: one message"
    assert capsys.readouterr().err.strip().startswith(expected)
    assert not Path("out").exists()


@pytest.fixture
def interrupted_search(monkeypatch: pytest.MonkeyPatch, files: Path) -> None:
    """The loop is interrupted after it has named a law."""

    def close_loop(*args: Any, progress: Any, **options: Any) -> Loop:
        progress("simulations name linear_drag on cart")
        raise KeyboardInterrupt

    monkeypatch.setattr(criticism, "close_loop", close_loop)


@pytest.mark.usefixtures("interrupted_search")
def test_an_interrupt_of_the_search_says_what_was_found(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["close-loop", "scene.toml", "train.csv", "-o", "out", "-q"]) == 130
    said = capsys.readouterr().err
    assert "report.html has what was found: simulations name linear_drag on cart; " in said
    page = Path("out/report.html").read_text()
    assert "interrupted: no verdict" in page and "simulations name linear_drag on cart" in page
    assert "--method laplace, --catalogue common, --most-transitions" in page


@pytest.mark.usefixtures("interrupted_search")
def test_advice_is_not_what_was_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    """And a report that is there is kept."""
    Path("out").mkdir()
    Path("out/report.html").write_text("an older one")
    argv = ["close-loop", "scene.toml", "train.csv", "-o", "out", "--overwrite", "-q"]
    assert main([*argv, "--method", "laplace", "--catalogue", "common"]) == 130
    assert "nothing was written; --most-transitions" in capsys.readouterr().err
    assert Path("out/report.html").read_text() == "an older one"


@pytest.mark.usefixtures("files")
def test_an_interrupt_of_the_sampler_ends_with_a_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def close_loop(*args: Any, **options: Any) -> Loop:
        raise criticism.LoopInterrupted(made_up)

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    monkeypatch.setattr("pbrl_ppl.reporting.render", lambda *args, **options: "a page")
    assert main(["close-loop", "scene.toml", "train.csv", "-o", "out", "-q"]) == 130
    assert "linear drag on the cart" in capsys.readouterr().out
    assert Path("out/report.html").read_text() == "a page"


@pytest.mark.usefixtures("files")
def test_warnings_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def close_loop(*args: Any, **options: Any) -> Loop:
        with warnings.catch_warnings():
            warnings.simplefilter("always")  # the test run makes errors of them
            warnings.warn("w_y did\nnot converge", ConvergenceWarning, stacklevel=2)
        return made_up()

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    monkeypatch.setattr("pbrl_ppl.reporting.render", lambda *args, **options: "a page")
    assert main(["close-loop", "scene.toml", "train.csv", "-o", "out", "-q"]) == 0
    assert capsys.readouterr().err.strip() == "warning: w_y did not converge"


@pytest.mark.usefixtures("files")
def test_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "scene.toml", "train.csv"]) == 0
    out = capsys.readouterr().out
    for words in ("puck", "2", "4 (2 in a trajectory)", "0.1 s, 4 engine steps", "2 of 6", "none"):
        assert words in out
    assert "default priors" not in out
    assert main(["check", "scene.toml", "train.csv", "--no-prior", "--verbose"]) == 0
    out = capsys.readouterr().out
    # default priors, from the recording, in SI units
    (line,) = (line for line in out.splitlines() if "linear_drag_coefficient" in line)
    assert re.search(r"half-normal, [0-9.]+ kg/s", line)
    assert out.count("normal, ") > 20


@pytest.mark.usefixtures("files")
def test_check_says_what_close_loop_needs(capsys: pytest.CaptureFixture[str]) -> None:
    lines = Path("train.csv").read_text().splitlines()
    one = [line for line in lines if not line.startswith("1,")]
    Path("one.csv").write_text("\n".join(one))
    for name, said in (("train.csv", False), ("one.csv", True)):
        assert main(["check", "scene.toml", name, "--no-prior"]) == 0
        assert (
            "one trajectory: close-loop holds out whole ones" in capsys.readouterr().out
        ) is said


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"pbrl-ppl \d+\.\d+\.\d+", line)
    for argv in (["--version", "-v"], ["-v", "--version"]):
        assert main(argv) == 0
        first, *shown = capsys.readouterr().out.splitlines()
        assert first == line and "engine       compiled, works" in shown
        found = dict(each.split(maxsplit=1) for each in shown)
        assert {"python", "pymc", "numpy", "platform", "folder"} <= {*found}
    assert main(["close-loop", "--help"]) == 0
    assert "--overwrite" in capsys.readouterr().out


def run(*argv: str) -> list[str]:
    code = "import sys; from pbrl_ppl.cli import main; sys.exit(main())"
    return [sys.executable, "-c", code, *argv]


@pytest.mark.usefixtures("files")
def test_process() -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    got = subprocess.run(
        run("check", "scene.toml", "nope.csv"), capture_output=True, text=True, env=environment
    )
    assert got.returncode == 2
    assert got.stdout == ""
    assert got.stderr.count("\n") == 1 and got.stderr.startswith("error: ")
