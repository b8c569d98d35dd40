"""Fixtures that many tests share."""

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import settings

from tests.helpers.places import RECORDED, ROOT

# Where each tensor was made is a fiftieth of the tests' time, and what the C compiler makes quick
# is never run for long. pytensor reads this when imported.
os.environ.setdefault("PYTENSOR_FLAGS", "traceback__limit=0,gcc__cxxflags=-O0")
# a worker a processor: threads of linear algebra would wait for each other; read with numpy
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# the same examples everywhere, and no test that fails because a machine is slow
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

#: Rooms that import neither PyMC nor ArviZ: their tests are the same whatever generation is there,
#: but for those in which something is fitted.
WITHOUT_PYMC = (
    "scene", "parameters", "history", "effects", "physics", "modes", "planning", "oomdp",
)  # fmt: skip
FITTED = (
    "modes/test_index_priors.py",
    "modes/test_joints.py",
    "planning/test_planning_files.py",
    "planning/test_planning_modes.py",
)
#: Of a room that does import them, files whose tests stand on modes or on samplers of our own, and
#: those that look at pages in a browser.
ON_MODES = (
    "agents/test_box2d_world.py",
    "agents/test_library_agent.py",
    "agents/test_revision.py",
    "criticism/test_criticism.py",
    "criticism/test_cross_validation.py",
    "criticism/test_misfit.py",
    "criticism/test_remainder.py",
    "criticism/test_resolution.py",
    "criticism/test_scan.py",
    "criticism/test_selection.py",
    "criticism/test_structure_search.py",
    "likelihood/test_contact_noise.py",
    "likelihood/test_trajectories.py",
    "modes/test_configurations.py",
    "report/test_pages.py",
    "sampling/test_emulator.py",
)
#: Files that workers begin with: the longest first, and they fill up with the short ones. The
#: second runs no engine, while the other worker compiles it for both.
LONGEST = (
    "criticism/test_revision.py",
    "sampling/test_metropolis.py",
    "test_notebooks.py",
    "sampling/test_updating.py",
    "modes/test_configurations.py",
    "sampling/test_whole_trajectories.py",
    "sampling/test_fitting.py",
    "criticism/test_criticism.py",
    "agents/test_figures.py",
    "posterior/test_updated_prior.py",
    "criticism/test_remainder.py",
    "planning/test_experiments.py",
    "modes/test_joint_search.py",
    "sampling/test_calibration.py",
    "model/test_gradients.py",
    "planning/test_planning.py",
)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what one generation is enough for, and put the longest files first."""
    tests = ROOT / "tests"

    def name_of(item: pytest.Item) -> str:
        return item.path.relative_to(tests).as_posix() if tests in item.path.parents else ""

    def place(item: pytest.Item) -> int:
        name = name_of(item)
        return LONGEST.index(name) if name in LONGEST else len(LONGEST)

    for item in items:
        name = name_of(item)
        if name in ON_MODES or (name.split("/")[0] in WITHOUT_PYMC and name not in FITTED):
            item.add_marker("one_stack")
    items.sort(key=place)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of recorded histories beside the project; tests on it are skipped where it is not."""
    if not RECORDED.is_dir():
        pytest.skip(f"no recorded histories at {RECORDED}")
    return RECORDED


@pytest.fixture(scope="session")
def make_history() -> ModuleType:
    """The Box2D generator, models/shopping_cart/make_history.py, as a module."""
    path = ROOT / "models" / "shopping_cart" / "make_history.py"
    spec = importlib.util.spec_from_file_location("make_history", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def benchmarks(monkeypatch):
    """Modules of analysis/benchmarks can be imported, as they import each other."""
    monkeypatch.syspath_prepend(str(ROOT / "analysis" / "benchmarks"))
