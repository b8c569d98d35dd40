"""The README's Python blocks run one after the other, in one session."""

import ast
import builtins
import re
import shutil
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import pbrl_ppl as pp
from tests.helpers.places import MODELS, ROOT

BLOCKS = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)


def loaded(tree: ast.Module) -> Iterator[str]:
    """Names that are read outside of functions."""
    for statement in tree.body:
        if not isinstance(statement, ast.FunctionDef):
            for node in ast.walk(statement):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                    yield node.id


def bound(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name


def test_each_name_is_made_before_it_is_used() -> None:
    assert len(BLOCKS) > 8
    known = set(dir(builtins))
    for block in BLOCKS:
        tree = ast.parse(block)
        known |= set(bound(tree))
        assert set(loaded(tree)) <= known, block
        for name in re.findall(r"\bpp\.(\w+)", block):
            assert hasattr(pp, name)


@pytest.mark.long
def test_blocks_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At small size: Gaussian approximations, short searches and a short episode."""
    shutil.copytree(MODELS, tmp_path / "models")
    monkeypatch.chdir(tmp_path)
    whole, loop, plan, episode = pp.fit, pp.close_loop, pp.plan, pp.run_episode

    def fit(model: Any, **options: Any) -> Any:
        small = {} if model.problem.library is not None else {"method": "laplace"}
        return whole(model, **small, **options, draws=100, chains=2, progress=False)

    def planned(model: Any, *given: Any, draws: int | None = None, **options: Any) -> Any:
        return plan(model, *given, draws=draws and 2, nodes=2000, **options)

    def episodes(*given: Any, steps: int, **options: Any) -> Any:
        return episode(*given, steps=2, **options)

    monkeypatch.setattr(pp, "fit", fit)
    monkeypatch.setattr(pp, "close_loop", partial(loop, method="laplace", draws=100))
    monkeypatch.setattr(pp, "plan", planned)
    monkeypatch.setattr(pp, "run_episode", episodes)
    names: dict[str, Any] = {"__name__": "__main__"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # too few draws, of course
        for block in BLOCKS:
            exec(compile(block, block, "exec"), names)
    assert Path("report.html").exists() and Path("episode.nc").exists()
    assert pp.joint_probabilities(names["found"])["joint1"]["none"] > 0.9
    assert names["loop"].added[0].effect == "angular_drag"
