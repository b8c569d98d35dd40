"""Settings, the order of the test files, and fixtures shared by several test files."""

import importlib.util
import math
import os
import signal
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import settings

from tests.helpers.places import RECORDED, ROOT

# Programs that the tests start must receive interrupts, even where this process was started with
# interrupts ignored, as by nohup or in the background of a script: children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# Traces of each tensor's origin cost 2 % of the tests' time, and no test runs long enough for
# optimised C code to pay off. PyTensor reads this when it is imported.
os.environ.setdefault("PYTENSOR_FLAGS", "traceback__limit=0,gcc__cxxflags=-O0")
# One pytest worker per processor: BLAS threads would wait for each other. NumPy reads this when it
# is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The same examples on every machine, and no failure because a machine is slow. The suite tries 25
# examples of a property, `make test-properties` four times as many.
settings.register_profile("project", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("long", deadline=None, derandomize=True, max_examples=100)
settings.load_profile("project")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files marked `first` first: workers fill up with the short ones afterwards."""

    def rank(item: pytest.Item) -> float:
        marker = item.get_closest_marker("first")
        return marker.args[0] if marker else math.inf

    items.sort(key=rank)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of recorded histories beside the project, or skip the test without it."""
    if not RECORDED.is_dir():
        pytest.skip(f"no recorded histories at {RECORDED}")
    return RECORDED


@pytest.fixture(scope="session")
def make_history() -> ModuleType:
    """Return the Box2D generator models/shopping_cart/make_history.py as a module."""
    path = ROOT / "models" / "shopping_cart" / "make_history.py"
    spec = importlib.util.spec_from_file_location("make_history", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def benchmarks(monkeypatch):
    """Put analysis/benchmarks on the import path: its modules import each other."""
    monkeypatch.syspath_prepend(str(ROOT / "analysis" / "benchmarks"))
