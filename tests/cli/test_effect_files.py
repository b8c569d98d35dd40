"""Own effects at the command line: ``--effect-file``."""

import re
from pathlib import Path

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl import criticism, planning, posterior
from pbrl_ppl.cli import main
from pbrl_ppl.cli.options import added_effects, own_effects
from pbrl_ppl.posterior import load_posterior, scene_of
from tests.helpers.histories import simulated_history
from tests.helpers.places import ROOT
from tests.helpers.puck import SCENE

pytestmark = pytest.mark.one_stack

LAWS = """import pbrl_ppl as pp
from pbrl_ppl.effects import catalogue

known = catalogue[0]
size = pp.EffectParameter("stiffness", "N/m", pp.Prior("half_normal", sigma=20.0))


def law(state, command, parameters, wrench):
    wrench[0] -= parameters[0] * state[0]
    wrench[1] -= parameters[0] * state[1]


tether = pp.Effect("tether", (size,), "a pull", "Hooke's law", pp.Force(law))
"""


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, a tethered puck's history and an effect file, to run in."""
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    Path("laws.py").write_text(LAWS)
    scene = pp.Scene.load("scene.toml")
    truth = {"mass": 2.0, "tether_stiffness": 3.0}
    own = own_effects([Path("laws.py")])
    for name, seed in (("train.csv", 1), ("since.csv", 2)):
        simulated_history(scene, truth, seed=seed, trajectories=6, effects=own).save(name)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    capsys.readouterr()  # of earlier commands
    assert main([*argv, "--quiet"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    assert len(captured.err.splitlines()) == 1
    return captured.err


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")
def test_fit_update_and_plan_take_an_own_effect(files, capsys) -> None:
    quick = ["--likelihood", "transitions", "--method", "laplace", "--draws", "200", "--quiet"]
    fitted = ["fit", "scene.toml", "train.csv", "-o", "puck.nc", *quick]
    laws = ["--effect-file", "laws.py"]
    assert main([*fitted, *laws]) in (0, 3)
    idata = load_posterior("puck.nc")
    assert scene_of(idata).bodies[0].effects == ("tether",)
    stiffness = idata.posterior["tether_stiffness"].to_numpy()
    assert abs(stiffness.mean() - 3.0) < 5 * stiffness.std() < 1.0
    since = ["update", "puck.nc", "since.csv", "-o", "new.nc"]
    goal = ["plan", "puck.nc", "--start", "0,0,0", "--goal", "0.2,0,-", "-o", "plan.csv"]
    goal += ["--nodes", "50"]
    for argv in (since, goal):
        without = refused(capsys, *argv)
        assert "effect 'tether', which is not in the catalogue" in without
        assert "with --effect-file" in without
        assert main([*argv, *laws, "--quiet"]) in (0, 1, 3)
    assert Path("new.nc").exists() and Path("plan.csv").exists()


def test_close_loop_adds_own_effects_to_the_catalogue(files, monkeypatch) -> None:
    given = {}

    def close_loop(scene, *histories, **settings):
        given.update(settings)
        raise pp.errors.FitError("enough")

    monkeypatch.setattr(criticism, "close_loop", close_loop)
    run = ["close-loop", "scene.toml", "train.csv", "-o", "report", "--quiet"]
    assert main([*run, "--effect-file", "laws.py"]) == 2
    *known, tether = given["catalogue"]
    assert tuple(known) == pp.catalogue and tether.name == "tether"
    given.clear()
    assert main(run) == 2
    assert given["catalogue"] == pp.catalogue


def test_commands_look_effects_up_in_the_file(files, monkeypatch, capsys) -> None:
    given = {}

    def take(*args, **settings):
        given.update(settings)
        raise pp.errors.FitError("enough")

    for module, name in (
        (criticism, "criticise"),
        (criticism, "attribute"),
        (planning, "suggest_actions"),
    ):
        monkeypatch.setattr(module, name, take)
    monkeypatch.setattr(posterior, "load_posterior", lambda path: None)
    monkeypatch.setattr(posterior, "scene_of", lambda idata: pp.Scene.load("scene.toml"))
    names = ["--effect", "tether", "--effect", "spring"]
    for command in (
        ["criticise", "scene.toml", "train.csv"],
        ["criticise", "scene.toml", "train.csv", "--simulate"],
        ["suggest", "puck.nc", "-o", "next.csv", *names],
    ):
        given.clear()
        assert "enough" in refused(capsys, *command, "--effect-file", "laws.py")
        assert [each.name for each in given["catalogue"]][-1] == "tether"
    # a scene that declares it by name
    Path("tied.toml").write_text(SCENE + 'effects = ["tether"]\n')
    known = ["--set", "mass=2", "--set", "tether_stiffness=3"]
    for command in (["check", "--no-prior"], ["simulate", "-o", "made.csv", *known]):
        argv = [command[0], "tied.toml", "train.csv", *command[1:], "--quiet"]
        assert main([*argv, "--effect-file", "laws.py"]) == 0
    made, measured = (pp.History.load(f"{name}.csv", pp.Scene.load("scene.toml")) for name in
                      ("made", "train"))  # fmt: skip
    off = (made.dataset["observed"] - measured.dataset["observed"]).sel(state=["x", "y"])
    assert float(abs(off).max()) < 0.05


@pytest.mark.slow
def test_a_law_of_an_effect_file_is_found_in_two_logs(files, capsys) -> None:
    """Each in a process of its own, which reads the file again."""
    argv = ["close-loop", "scene.toml", "train.csv", "since.csv", "-o", "out", "--each"]
    options = ["--jobs", "2", "--effect-file", "laws.py", "--method", "laplace", "--quiet"]
    assert main([*argv, *options]) == 0
    assert "tether[puck]: since, train" in capsys.readouterr().out
    assert all(Path("out", name, "report.html").is_file() for name in ("train", "since"))


def test_an_own_effect_that_the_scene_declares_acts_there_alone(files) -> None:
    body = pp.Scene.load("scene.toml").bodies[0]
    scene = pp.Scene(
        time_step=0.1,
        bodies=(
            pp.Body("a", body.shape, effects=("linear_drag", "tether")),
            pp.Body("b", body.shape),
        ),
    )
    own = own_effects([Path("laws.py")])
    bare, added = added_effects(scene, own)
    assert [each.effects for each in bare.bodies] == [("linear_drag",), ()]
    assert added == (own[0].on("a"),)
    assert added_effects(bare, own) == (bare, own)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, r"effect file own\.py: it cannot be read \(No such file or directory\)"),
        ("x = 1\n", r"effect file own\.py: it has no Effect at module level"),
        ("x = 1\n\ny = 1 / 0\n", r"effect file own\.py, line 3: ZeroDivisionError: division"),
        ("x = 1\ny = (\n", r"effect file own\.py, line 2: SyntaxError"),
        (LAWS.replace('"tether"', '"spring"'), r"own\.py: effect spring: the catalogue has anot"),
        (LAWS + LAWS, r"own\.py: there are two effects tether; rename one"),
        (LAWS.replace("half_normal", "halfnormal"), r"own\.py, line 5: .*did you mean 'half_norm"),
    ],
)
@pytest.mark.parametrize("command", ["fit", "close-loop"])
def test_bad_effect_files(files, capsys, command, text, said) -> None:
    if text == LAWS + LAWS:  # the second hides the first in one file
        text = LAWS + 'again = pp.Effect("tether", (size,), "a pull", "-", pp.Force(law))\n'
    if text is not None:
        Path("own.py").write_text(text)
    output = "x.nc" if command == "fit" else "x"
    argv = [command, "scene.toml", "train.csv", "-o", output, "--effect-file", "own.py"]
    assert re.search(said, refused(capsys, *argv))
    assert not Path(output).exists()


def test_the_guide_s_effect_file_is_read(tmp_path) -> None:
    page = (ROOT / "analysis/docs/pages/guides/own_effect.md").read_text()
    (block,) = re.findall(r"^```python\n(# laws\.py.*?)^```", page, re.M | re.S)
    (tmp_path / "laws.py").write_text(block)
    (tether,) = own_effects([tmp_path / "laws.py"])
    wrench = np.zeros(3)
    tether.stage.law(np.array([2.0, 0, 0, 0, 0, 0]), np.zeros(3), np.array([3.0]), wrench)
    assert wrench.tolist() == [-6.0, 0.0, 0.0]
