"""Names from a user's files reach neither a terminal nor a page as anything but text."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.cli import main
from pbrl_ppl.cli.terminal import Progress, Result, in_a_line, table
from pbrl_ppl.errors import printable
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.reporting import render_logs
from pbrl_ppl.scene import Scene
from tests.helpers.html import Page

pytestmark = pytest.mark.one_stack

#: Allowed, for all of it can be printed: HTML, Jinja, Rich's markup and emoji, and mathematics.
PRINTABLE = "<script>alert(1)</script>\"' {{ 7 * 7 }} [/red][bold] :bomb: $\\frac{$ \\x1b"
#: What a terminal would obey: it clears the screen, turns the text, begins a line, ends a text.
OBEYED = ("\x1b[2J", "\u202e", "\r", "\n", "\x00", "\x9b2J", "\x7f", "\u2066")


def files(folder: Path, name: str = "puck", label: str = "1") -> list[str]:
    """Write a scene of a disc with this name, and a recording; return their paths."""
    generator = np.random.default_rng(1)
    rows: list[list[object]] = []
    for trajectory in (label, "2", "3", "4"):
        pose, speed = generator.normal(size=(2, 3))
        for step in range(12):
            force = generator.normal(size=3) * [5.0, 5.0, 0.3]
            noise = 1e-3 * generator.normal(size=6)
            rows.append([trajectory, step, 0.1 * step, name, *np.r_[pose, speed] + noise, *force])
            change = force / [2.0, 2.0, 0.04]
            pose, speed = pose + 0.1 * speed + 0.005 * change, speed + 0.1 * change
    scene = folder / "scene.toml"
    scene.write_text(
        f"[world]\ntime_step = 0.1\n[[body]]\nname = {json.dumps(name)}\n"
        'shape = { kind = "circle", radius = 0.2 }\nknown = { r = 0.5, mu_c = 0.3 }\n'
    )
    pd.DataFrame(rows, columns=[*COLUMNS]).to_parquet(folder / "log.parquet")
    return [str(scene), str(folder / "log.parquet")]


def bare(text: str) -> bool:
    """Return whether a text has nothing that a terminal obeys but ends of lines."""
    return text == printable(text, kept="\n")


@pytest.mark.parametrize("mark", OBEYED)
def test_what_a_terminal_obeys_is_shown_as_text(mark, capsys) -> None:
    """In messages, stages, lines and tables."""
    name = f"cart{mark}x"
    with Progress(quiet=False) as progress:
        progress(f"fitting {name}")
    rows = table(None, {"body": "<"}, [[name]])
    Result({"name": name}, [f"line {name}", rows], warning=f"warned {name}").show(as_json=False)
    shown = capsys.readouterr()
    assert bare(shown.out)
    assert bare(shown.err)
    assert len(shown.out.splitlines()) == 3
    assert len(shown.err.splitlines()) == 2
    assert bare(in_a_line(f"error {name}"))


@pytest.mark.parametrize("mark", OBEYED)
def test_such_names_are_refused(mark, tmp_path, capsys) -> None:
    """Of a body, of a trajectory and of a file, with one message, which is clean itself."""
    wrong = f"cart{mark}x"
    for named, options in (
        ({"name": wrong}, []), ({"label": wrong}, []), ({}, ["--columns", f"x={wrong}"]),
    ):  # fmt: skip
        assert main(["check", *files(tmp_path, **named), *options]) == 2, (named, options)
        shown = capsys.readouterr()
        assert bare(shown.out + shown.err)
        assert shown.err.count("error: ") == 1
    assert main(["report", f"{wrong}.nc"]) == 2
    assert "control characters" in capsys.readouterr().err


def test_check_shows_a_name_as_it_is(tmp_path, capsys) -> None:
    """Rich's markup in it raised, and a word between colons became a picture."""
    assert main(["check", *files(tmp_path, PRINTABLE), "--no-prior"]) == 0
    assert PRINTABLE in " ".join(capsys.readouterr().out.split())


def test_no_name_writes_lines_of_a_scene(tmp_path, capsys) -> None:
    """The new scene quotes a log's columns in comments."""
    table = pd.read_parquet(files(tmp_path)[1])
    table = table[table["trajectory"] == "2"][["time", "x", "y", "theta"]]
    table["spare [mm]\n[[body]]\nname = 'ghost'"] = table["x"] ** 2
    table.to_parquet(tmp_path / "raw.parquet")
    scene = tmp_path / "new.toml"
    argv = ["new", str(scene), "--history", str(tmp_path / "raw.parquet")]
    assert main([*argv, "--body", "puck=circle:0.2", "--columns", "x=x"]) == 0
    assert "ghost" in scene.read_text()
    assert [body.name for body in Scene.load(scene).bodies] == ["puck"]
    assert not any(
        line.startswith("name = 'ghost'") for line in capsys.readouterr().out.split("\n")
    )


@pytest.mark.slow
def test_pages_show_a_name_as_text(tmp_path) -> None:
    """Of a loop, in pictures too, and of a posterior."""
    scene, log = files(tmp_path, PRINTABLE)
    out = tmp_path / "out"
    assert main(["close-loop", scene, log, "-o", str(out), "--method", "laplace", "-q"]) == 0
    assert main(["report", str(out / "after.nc"), "-q"]) == 0
    for path in (out / "report.html", out / "after.html"):
        text = path.read_text()
        assert "<script>alert" not in text
        assert PRINTABLE in Page(text).text


def test_the_page_of_many_logs_shows_names_as_text(tmp_path) -> None:
    """A log's name, its message, warnings and bodies."""
    failed = {"log": PRINTABLE, "verdict": "failed", "added": [], "warnings": [],
              "message": PRINTABLE}  # fmt: skip
    done = failed | {"verdict": "effects-added", "added": [f"spring[{PRINTABLE}]"],
                     "message": "", "warnings": [PRINTABLE]}  # fmt: skip
    text = render_logs([failed, done], PRINTABLE)
    assert "<script>alert" not in text
    assert Page(text).text.count(PRINTABLE) >= 3
