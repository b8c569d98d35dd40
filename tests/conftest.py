"""Fixtures that many tests share."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import settings

from tests.helpers.places import RECORDED, ROOT

# the same examples everywhere, and no test that fails because a machine is slow
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")


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
