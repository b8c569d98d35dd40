"""``pbrl-ppl demo``: the cart's loop from the package's own files, in any folder."""

import json
from pathlib import Path
from typing import Any

import pytest

from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from tests.helpers.made_up import made_up


@pytest.mark.slow
def test_the_demo_runs_in_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    said = capsys.readouterr().out
    assert "Verdict: effects-added." in said and "angular drag" in said
    page = tmp_path / "pbrl-ppl-demo" / "report.html"
    assert f"Report: {page.relative_to(tmp_path)}" in said and "pbrl-ppl demo" in page.read_text()
    found = json.loads(page.with_name("report.json").read_text())
    assert [added["effect"] for added in found["added"]] == ["angular_drag"]
    # what is there is kept
    assert main(["demo", "--quiet"]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_the_demo_takes_the_files_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[Any] = []

    def close_loop(*given: Any, **options: Any) -> Any:
        seen.append((*given, options))
        return made_up()

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    monkeypatch.setattr("pbrl_ppl.reporting.render", lambda *args, **options: "a page")
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "-o", "here", "--method", "metropolis", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["report"] == str(Path("here", "report.html"))
    ((scene, train, test, options),) = seen
    assert [body.name for body in scene.moving] == ["cart"] and "angular_drag" not in str(scene)
    assert train.n_trajectories > 1 and test.n_trajectories > 1
    assert options["method"] == "metropolis" and options["seed"] == 1
    assert main(["demo", "-o", "again", "--quiet"]) == 0
    assert seen[1][3]["method"] == "laplace"
    said = capsys.readouterr()
    assert said.err == "" and said.out.startswith("Verdict:")


def test_the_demo_says_where_the_models_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pbrl_ppl.cli.new._MODELS", (tmp_path / "nowhere",))
    assert main(["demo", "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert "the models are not installed with this package" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
