"""``pbrl-ppl rehearse``: its table, its files, and what it refuses."""

import json
from pathlib import Path

import pytest

from pbrl_ppl.cli import main
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene
from tests.helpers.puck import SCENE

pytestmark = pytest.mark.one_stack


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a scene, to run in."""
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)


def test_proposed_commands_are_written_and_taken_again(capsys: pytest.CaptureFixture[str]) -> None:
    noise = ("--noise", "x=0.002,y=0.002,theta=0.002", "-q")
    assert main(["rehearse", "scene.toml", "-o", "play.csv", "--set", "mass=2", *noise]) == 0
    table = capsys.readouterr().out
    assert "linear_drag" in table and "% " in table and "written: play.csv" in table
    assert "unseen, " in table
    played = History.load("play.csv", Scene.load("scene.toml"))
    assert played.n_trajectories == 4
    again = ["rehearse", "scene.toml", "play.csv", "--set", "mass=2", *noise]
    assert main([*again, "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["versions"]["pbrl_ppl"] and written["parameters"] == {"mass[puck]": 2.0}
    assert written["noise"] == {"x": 0.002, "y": 0.002, "theta": 0.002}
    (drag,) = (law for law in written["laws"] if law["effect"] == "linear_drag")
    assert drag["named"] == "linear_drag" and drag["units"] == {"coefficient": "kg/s"}
    assert 0 < drag["sizes"]["coefficient"] < 1
    assert main([*again, "-o", "play.csv"]) == 2 and "it exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("missing.toml",), "no such file"),
        (("scene.toml", "missing.csv"), "missing.csv"),
        (("scene.toml", "--set", "mas=2"), 'did you mean "mass"'),
        (("scene.toml", "--set", "mass=-2"), "expected"),
        (("scene.toml", "--noise", "z=1"), "z"),
        (("scene.toml", "-o", "laws.html"), ".csv"),
    ],
)
def test_bad_input_is_one_message(words, why, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rehearse", *words, "-q"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    assert len(captured.err.strip().splitlines()) == 1 and why in captured.err
