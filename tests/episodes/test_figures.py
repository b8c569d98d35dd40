"""The paper's figure 4 at a small size: resumed, refused, and read by the benchmark."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import pytest
import xarray as xr

import pbrl_ppl as pp
from pbrl_ppl.agents import Revision
from tests.helpers.places import ROOT

pytestmark = pytest.mark.first(4)

ANALYSIS = ROOT / "analysis"
#: What the scripts of episodes say on Ctrl-C, and nothing else.
INTERRUPTED = "interrupted: finished episodes are kept; go on with --resume\n"


def ran(folder: Path, script: str, *options: str) -> subprocess.CompletedProcess[str]:
    given = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    command = [sys.executable, str(ANALYSIS / script), *options]
    return subprocess.run(
        command, cwd=folder, env=given, capture_output=True, text=True, check=False
    )


@pytest.fixture
def script(monkeypatch, tmp_path) -> Callable[[str], ModuleType]:
    """A script as a module; what it makes goes into a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(ANALYSIS), *sys.path])  # scripts add to it

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(Path(name).stem, ANALYSIS / name)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, spec.name, module)  # a dataclass looks itself up
        spec.loader.exec_module(module)
        return module

    yield load
    plt.close("all")


def main(module: ModuleType, *options: str) -> int:
    """Run a script here, one thing after the other; its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["script", *options, "--workers", "1"])
        try:
            module.main()
        except SystemExit as left:
            return left.code
    return 0


def pressed(*_: object) -> None:
    """Ctrl-C."""
    raise KeyboardInterrupt


@pytest.mark.slow
def test_shopping_cart(script, capsys) -> None:
    module = script("04_shopping_cart.py")
    assert main(module, "--quick") == 0
    said = capsys.readouterr().out
    assert "8/8 LWR, seed 2" in said and "true model" in said and "return (m)" in said
    out = Path("out") / "shopping_cart_quick"
    assert (out / "figure_4ab.png").stat().st_size > 10_000
    with xr.open_dataset(out / "figure_4b.nc", engine="h5netcdf") as kept:
        assert kept.attrs["sigma"] == 0.25 and kept.sizes["seed"] == 2
        assert kept["reward"].notnull().all()
    assert main(module, "--quick") == 2
    assert "go on with --resume" in capsys.readouterr().err
    (out / "sigma_0" / "lwr-2.nc").unlink()
    assert main(module, "--quick", "--resume") == 0
    assert "7 of 8 episodes are in" in capsys.readouterr().out
    (out / "sigma_0" / "lwr-2.nc").write_text("nothing")
    assert main(module, "--quick", "--resume") == 2
    (broken,) = capsys.readouterr().err.splitlines()
    assert "lwr-2.nc: this is not a NetCDF file" in broken


@pytest.mark.long
def test_wrong_model(tmp_path) -> None:
    """In processes of their own."""
    done = ran(tmp_path, "06_wrong_model.py", "--quick")
    assert done.returncode == 0, done.stderr
    assert "6/6 PBRL" in done.stdout and "not closing it" in done.stdout
    read = ran(tmp_path, "benchmarks/agents.py", "--json", "--results", "out/wrong_model_quick")
    result = json.loads(read.stdout)
    assert 0.5 < result["online_loop_return_ratio"] < 2.0
    assert result["online_loop_step_seconds"] > 0


@pytest.fixture
def wrong_model(script, monkeypatch) -> ModuleType:
    """The script, with agents that learn next to nothing, fast; its own are made and left."""
    module = script("06_wrong_model.py")
    for effect in module.WORLDS:
        made = {kind: module.agent(kind, effect, 1) for kind in module.AGENTS}
        assert [kind for kind, each in made.items() if each.revise] == ["revising"]

    def agent(kind: str, effect: str, seed: int) -> pp.Agent:
        made = pp.LWRAgent(module.TASK, seed=seed, nodes=20)
        if kind == "revising":
            made.added = (Revision(module.EFFECTS[effect].on("cart"), 4, 9.0, 0.5),)
        return made

    monkeypatch.setattr(module, "agent", agent)
    return module


@pytest.mark.one_stack
def test_an_interrupted_wrong_model_goes_on(wrong_model, script, monkeypatch, capsys) -> None:
    with monkeypatch.context() as patch:
        agent = wrong_model.agent
        patch.setattr(wrong_model, "agent", lambda *of: agent(*of) if of[2] == 1 else pressed())
        assert main(wrong_model, "--quick") == 130
    assert capsys.readouterr().err == INTERRUPTED
    assert main(wrong_model, "--quick") == 2
    assert "there are episodes; go on with --resume" in capsys.readouterr().err
    assert main(wrong_model, "--quick", "--resume") == 0
    said, out = capsys.readouterr().out, Path("out") / "wrong_model_quick"
    assert "1 of 6 episodes are in" in said
    assert "added: constant_force after 4; constant_force after 4" in said
    assert (out / "wrong_model.png").stat().st_size > 10_000
    with xr.open_dataset(out / "wrong_model.nc", engine="h5netcdf") as kept:
        assert kept["reward"].sizes == {"world": 2, "agent": 3, "seed": 2, "time": 5}
    keys = script("benchmarks/agents.py").numbers([out])
    # the same agent three times
    assert keys["online_loop_return_ratio"] == keys["online_loop_return_ratio_without"] == 1.0
    assert keys["online_loop_return_ratio_low"] == keys["online_loop_return_ratio_high"] == 1.0
    assert keys["online_loop_return_ratio_constant_force"] == 1.0
    monkeypatch.setitem(wrong_model.WORLDS["constant_force"], "constant_force_force_y", 5.0)
    assert main(wrong_model, "--quick", "--resume") == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "this is an episode in another world" in said


@pytest.mark.one_stack
@pytest.mark.parametrize("name", ["actuator_rotation", "constant_force"])
def test_an_undeclared_effect_is_the_same_in_another_engine(script, name) -> None:
    module = script("06_wrong_model.py")
    ours, its = (module.world(name, 0.0, box2d) for box2d in (False, True))
    worlds = (ours, its, module.World(module.TASK, module.TRUTH, spread=module.SPREAD))
    for place in (0, 8):
        state, *others = (world.reset(1) for world in worlds)
        assert all((other == state).all() for other in others)
        action = module.TASK.wrenches(state)[place]
        one, other, without = (world.step(action).state for world in worlds)
        assert abs(one - other).max() < 0.002  # an interval moves it by centimetres
        assert abs(one - without).max() > 0.02
    assert "Hidden(" in its.description


@pytest.mark.one_stack
def test_an_interrupted_shopping_cart_says_so_once(script, monkeypatch, capsys) -> None:
    module = script("04_shopping_cart.py")
    monkeypatch.setattr(module, "AGENTS", {"true": pressed})
    assert main(module, "--quick") == 130
    assert capsys.readouterr() == ("", INTERRUPTED)


@pytest.mark.slow
@pytest.mark.one_stack
def test_scaling(script) -> None:
    assert main(script("07_scaling.py"), "--quick") == 0
    out = Path("out") / "scaling_quick"
    with xr.open_dataset(out / "scaling.nc", engine="h5netcdf") as kept:
        # a body of one object and four sectors, then two of two objects each
        assert kept["conditions"].values.tolist() == [16.0, 2 * 16.0]
        assert kept["conditions_by_object"].values.tolist() == [16.0, 2 * 256.0]
        met, more = (kept[f"conditions_met{kind}"].values[0] for kind in ("", "_by_object"))
        assert (met > 1).all() and (met <= kept["conditions"].values).all() and (more >= met).all()
        needed = kept["observations_needed"].values[0]
        assert needed[0] <= needed[1] < 50  # each box has to be pushed
    assert (out / "scaling.png").stat().st_size > 10_000


@pytest.mark.one_stack
def test_an_interrupted_scaling_goes_on(script, monkeypatch, capsys) -> None:
    module = script("07_scaling.py")
    monkeypatch.setattr(module, "observations_needed", lambda scene, *_: 3.0 * len(scene.bodies))
    with monkeypatch.context() as patch:
        explore = module.explore
        patch.setattr(module, "explore", lambda n, *rest: explore(n, *rest) if n < 2 else pressed())
        assert main(module, "--quick") == 130
    assert capsys.readouterr().err == (
        "interrupted: finished rooms are kept; go on with --resume\n"
    )
    rooms = Path("out") / "scaling_quick" / "rooms"
    assert [path.name for path in rooms.iterdir()] == ["1-1.nc"]
    assert main(module, "--quick") == 2
    assert "there are rooms; go on with --resume" in capsys.readouterr().err
    assert main(module, "--quick", "--resume") == 0
    assert capsys.readouterr().out.startswith("2 objects, seed 1")
    with xr.open_dataset("out/scaling_quick/scaling.nc", engine="h5netcdf") as kept:
        assert kept["observations_needed"].values.tolist() == [[3.0, 6.0]]
    monkeypatch.setattr(module, "TOLERANCE", 0.1)
    assert main(module, "--quick", "--resume") == 2
    assert "other settings; give another folder" in capsys.readouterr().err


def fast(apartment: ModuleType, monkeypatch) -> ModuleType:
    """The script with short episodes and searches."""
    monkeypatch.setattr(apartment, "SEARCH", {**apartment.SEARCH, "nodes": 500})
    monkeypatch.setattr(apartment, "LENGTH", 2)
    monkeypatch.setattr(apartment, "ACTING_NODES", 100)
    return apartment


@pytest.mark.one_stack
def test_the_apartment_in_another_engine(script, monkeypatch) -> None:
    module = fast(script("05_apartment.py"), monkeypatch)
    assert main(module, "--quick", "--only", "oolwr", "--box2d") == 0
    out = Path("out") / "apartment_box2d_quick"
    with xr.open_dataset(out / "figure_4c.nc", engine="h5netcdf") as kept:
        assert "--box2d" in kept.attrs["command"]
    (ours,), (its,) = (module.explored(1, 1, 0.0, box2d) for box2d in (False, True))
    assert (ours[1] == its[1]).all() and not (ours[2] == its[2]).all()
    out.rename(out.with_name("apartment_quick"))
    assert main(module, "--quick", "--only", "oolwr", "--resume") == 2


@pytest.mark.one_stack
def test_an_interrupted_apartment_goes_on(script, monkeypatch, capsys) -> None:
    module = fast(script("05_apartment.py"), monkeypatch)
    run = ("--quick", "--only", "true", "oolwr")
    with monkeypatch.context() as patch:
        patch.setattr(module, "explored", lambda count, *_: pressed() if count else [])
        assert main(module, *run) == 130
    assert capsys.readouterr().err == (
        "interrupted: finished trials are kept; go on with --resume\n"
    )
    trials = Path("out") / "apartment_quick" / "sigma_0"
    assert [path.name for path in trials.iterdir()] == ["true-1.nc"]
    assert main(module, *run) == 2
    assert "go on with --resume" in capsys.readouterr().err
    assert main(module, *run, "--resume") == 0
    said = capsys.readouterr().out
    assert "true model, seed 1, 0 obs" not in said and "OO-LWR, seed 1, 10 observations" in said
    with xr.open_dataset("out/apartment_quick/figure_4c.nc", engine="h5netcdf") as kept:
        assert kept["models"].sel(agent="oolwr", observations=10).item() >= 11
    options = ("--only", "oolwr", "--resume", "--out", "out/apartment_quick", "--seeds", "1")
    assert main(module, *options) == 2
    assert "other settings; give another folder" in capsys.readouterr().err


@pytest.mark.long
def test_apartment(tmp_path) -> None:
    """In processes of their own."""
    first = ran(tmp_path, "05_apartment.py", "--quick")
    assert first.returncode == 0, first.stderr
    assert "true model, seed 1, 0 observations: valid plan" in first.stdout
    assert "categorical, seed 1, 3" in first.stdout
    assert "OO-LWR, seed 1, 10 observations:" in first.stdout
    out = tmp_path / "out" / "apartment_quick"
    assert (out / "figure_4c.png").stat().st_size > 10_000


@pytest.mark.one_stack
def test_benchmark_reads_what_is_kept(tmp_path) -> None:
    done = ran(tmp_path, "benchmarks/agents.py", "--json")
    assert done.returncode == 0, done.stderr
    keys = json.loads(done.stdout)
    assert keys["pbrl_success"] == 1.0 and keys["step_seconds"] < 2.0
    low, high = (keys[f"pbrl_return_over_true_{end}"] for end in ("low", "high"))
    assert low <= keys["pbrl_return_over_true"] <= high
    assert {"oolwr_steps_over_pbrl", "lwr_plateau", "noisy_pbrl_return_over_true"} <= {*keys}
    assert {f"apartment_{name}_success" for name in ("oolwr", "pbrl", "continuous")} <= {*keys}
    (tmp_path / "figure_4a.nc").write_text("nothing")
    broken = ran(tmp_path, "benchmarks/agents.py", "--results", str(tmp_path))
    assert broken.returncode == 1 and "not a NetCDF file" in broken.stderr
    assert "Traceback" not in broken.stderr
