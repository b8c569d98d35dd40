"""The public names: all resolve, each at its first use."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pbrl_ppl


def test_every_name_resolves() -> None:
    assert {"Scene", "History", "physics_model", "fit", "close_loop", "plan"} <= {*pbrl_ppl.__all__}
    for name in pbrl_ppl.__all__:
        assert getattr(pbrl_ppl, name) is not None
    assert {*pbrl_ppl.__all__} <= {*dir(pbrl_ppl)}
    with pytest.raises(AttributeError, match="nonsense"):
        pbrl_ppl.nonsense  # noqa: B018


def test_star_import() -> None:
    names: dict[str, object] = {}
    exec("from pbrl_ppl import *", names)
    assert {*pbrl_ppl.__all__} <= {*names}


def test_modules_and_commands_import_without_a_warning(tmp_path: Path) -> None:
    """With an empty home folder, for ArviZ 0.23 warns where it has not done so today."""
    code = """if True:
        import importlib, pkgutil
        import pbrl_ppl
        for each in pkgutil.walk_packages(pbrl_ppl.__path__, "pbrl_ppl."):
            if not each.name.startswith("pbrl_ppl.models."):
                importlib.import_module(each.name)
        print(pbrl_ppl.cli.main(["check", "--help"]))
    """
    home = os.environ | {"HOME": str(tmp_path)}
    argv = [sys.executable, "-W", "error", "-c", code]
    said = subprocess.run(argv, capture_output=True, text=True, env=home)
    assert not said.returncode and not said.stderr, said.stderr
    assert said.stdout.endswith("0\n")


def test_import_is_quick() -> None:
    """The first name that needs PyMC loads it."""
    code = "import sys, pbrl_ppl; print(*sys.modules); pbrl_ppl.Scene; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    at_once, with_scene = (set(line.split()) for line in said.stdout.splitlines())
    assert "pbrl_ppl" in at_once
    assert not {"pymc", "arviz", "numpy", "pbrl_ppl.scene"} & at_once
    assert "pbrl_ppl.scene" in with_scene
    assert not {"pymc", "arviz"} & with_scene


@pytest.mark.parametrize("first", ["pbrl_ppl.close_loop", "from pbrl_ppl.planning import plan"])
def test_the_core_loads_neither_pymc_nor_matplotlib(first) -> None:
    """The main call and planning load PyMC and matplotlib where they need them, not before."""
    code = f"import sys, pbrl_ppl; {first}; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pbrl_ppl.physics" in said.stdout.split()
    assert not {"pymc", "pytensor", "arviz", "matplotlib"} & set(said.stdout.split())


def test_commands_load_no_engine_before_they_run() -> None:
    """So that ``pbrl-ppl --help`` and usage errors answer at once."""
    code = "import sys, pbrl_ppl.cli; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert not {"numba", "scipy", "pymunk", "pymc", "arviz"} & set(done.stdout.split())
