"""``pbrl-ppl demo``: the cart's loop from the package's own files, in any folder."""

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import pytest

from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene
from tests.helpers.made_up import made_up
from tests.helpers.places import MODELS
from tests.helpers.similar import factor, similar, similar_history


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder that the demo wrote, in one that was empty, and what it said."""
    said = io.StringIO()
    with contextlib.chdir(tmp_path_factory.mktemp("any")), contextlib.redirect_stdout(said):
        assert main(["demo"]) == 0
        return Path("pbrl-ppl-demo").absolute(), said.getvalue()


@pytest.mark.slow
def test_the_demo_runs_in_any_folder(
    demo: tuple[Path, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, said = demo
    monkeypatch.chdir(folder.parent)
    assert "Verdict: effects-added." in said and "angular drag" in said
    page = folder / "report.html"
    assert f"Report: {page.relative_to(folder.parent)}" in said
    assert "pbrl-ppl demo" in page.read_text()
    found = json.loads(page.with_name("report.json").read_text())
    assert [added["effect"] for added in found["added"]] == ["angular_drag"]
    # what is there is kept
    assert main(["demo", "--quiet"]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the likelihood is linearised where it does not hold")
def test_the_loop_of_a_ship_is_that_of_the_cart(demo: tuple[Path, str]) -> None:
    """The demo's recording: the same name, and its size within 1 %; as a ship, and as it is.

    Modes differ by friction's grain, and with them how well 16 draws are linearised: 0.5 nats at
    one of them, 2.9 at one that is 1.7 nats higher.
    """
    scales = (100.0, 1e6, 10.0)
    cart = MODELS / "shopping_cart"
    scene = Scene.load(cart / "scene.toml")
    files = [cart / "recorded" / f"{part}.csv" for part in ("train", "test")]
    histories = (similar_history(History.load(file, scene), scene, *scales) for file in files)
    ship = criticism.close_loop(similar(scene, *scales), *histories, seed=1, method="laplace")
    found = []
    for report, rig in (
        (json.loads((demo[0] / "report.json").read_text()), (1.0, 1.0, 1.0)),
        (ship.to_dict(), scales),
    ):
        (added,) = report["added"]
        (estimate,) = added["parameters"].values()
        size = estimate["mean"] / factor(estimate["unit"], *rig)
        error = report["error"]["after"]["normalised_rmse"]
        found.append((report["verdict"], added["effect"], size, error))
    here, there = found
    assert here[:2] == there[:2] == ("effects-added", "angular_drag")
    assert there[2:] == pytest.approx(here[2:], rel=0.01)


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
    assert main(["demo", "-o", "here", "--method", "smc", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["report"] == str(Path("here", "report.html"))
    ((scene, train, test, options),) = seen
    assert [body.name for body in scene.moving] == ["cart"] and "angular_drag" not in str(scene)
    assert train.n_trajectories > 1 and test.n_trajectories > 1
    assert options["method"] == "smc" and options["seed"] == 1
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
