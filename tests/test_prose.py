"""README and pages of analysis/docs: Python blocks, links and commands."""

import ast
import builtins
import re
import shutil
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import typer

import pbrl_ppl as pp
from pbrl_ppl.cli.app import app, main
from pbrl_ppl.model import problem_in
from pbrl_ppl.posterior import MAX_PARETO_K, MIN_ESS
from tests.helpers.places import MODELS, ROOT

DOCS = ROOT / "analysis" / "docs"
CART = MODELS / "shopping_cart"
#: The README and the pages, in the order of the pages' index.
PROSE = [ROOT / "README.md"] + [
    DOCS / "pages" / name
    for name in re.findall(r"(\S+\.md)$", (DOCS / "mkdocs.yml").read_text(), re.M)
    if (DOCS / "pages" / name).exists()
]


def blocks(path: Path, kind: str) -> list[str]:
    return re.findall(rf"^```{kind}\n(.*?)^```", path.read_text(), re.M | re.S)


BLOCKS = [block for path in PROSE for block in blocks(path, "python")]


def exported(folder: Path) -> None:
    """Write the logs that the pages on logs read, from the recorded cart."""
    pytest.importorskip("rosbags")
    from tests.helpers.bags import Bag

    rows = pd.read_csv(CART / "recorded" / "train.csv")
    mocap = pd.DataFrame({"take": rows.trajectory, "t": 1e3 * rows.time, "px": 1e3 * rows.x})
    mocap = mocap.assign(
        py=1e3 * rows.y, yaw=np.degrees(rows.theta), fx=rows.force_x, fy=rows.force_y
    )
    mocap.to_csv(folder / "mocap.csv", index=False)
    stamp = (1e9 * (100.0 * rows.trajectory + rows.time)).round().astype("int64")
    pose, twist = "field.pose.pose.", "field.twist.twist."
    c, s = np.cos(rows.theta), np.sin(rows.theta)
    pd.DataFrame({
        "field.header.stamp": stamp,
        f"{pose}position.x": rows.x, f"{pose}position.y": rows.y,
        f"{pose}orientation.z": np.sin(rows.theta / 2),
        f"{pose}orientation.w": np.cos(rows.theta / 2),
        f"{twist}linear.x": rows.vx * c + rows.vy * s,
        f"{twist}linear.y": rows.vy * c - rows.vx * s,
        f"{twist}angular.z": rows.omega,
    }).to_csv(folder / "odom.csv", index=False)  # fmt: skip
    pushed = pd.DataFrame({"field.header.stamp": stamp})
    for name, column in (("force.x", "force_x"), ("force.y", "force_y"), ("torque.z", "torque")):
        pushed[f"field.wrench.{name}"] = rows[column]
    pushed.dropna().to_csv(folder / "wrench.csv", index=False)
    bag = Bag("ros1")
    for row in rows.itertuples():
        time = 100.0 * row.trajectory + row.time
        bag.add(time, "/odom", bag.odometry(time, row.x, row.y, row.theta))
        if not np.isnan(row.torque):
            wrench = bag.wrench_stamped(time, row.force_x, row.force_y, row.torque)
            bag.add(time, "/wrench", wrench)
    bag.write(folder)


def loaded(tree: ast.Module) -> Iterator[str]:
    """Yield the names that are read outside functions."""
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


def test_the_tutorial_defines_what_it_uses() -> None:
    """A reader of the tutorial has seen no other page."""
    known = set(dir(builtins))
    for block in blocks(DOCS / "pages" / "tutorial.md", "python"):
        tree = ast.parse(block)
        known |= set(bound(tree))
        assert set(loaded(tree)) <= known, block


def test_the_guide_says_when_an_update_refits() -> None:
    page = (DOCS / "pages" / "guides" / "update.md").read_text()
    assert f"at least {MIN_ESS:.0f} effective draws left, Pareto k at most {MAX_PARETO_K:g}" in page


def test_links_lead_to_files() -> None:
    """Links between files of the repository; `make docs` checks links between pages."""
    assert len(PROSE) > 10
    assert set(PROSE[1:]) == set((DOCS / "pages").rglob("*.md"))
    for path in PROSE:
        for link in re.findall(r"\]\((?![a-z]+:|#)([^)#\s]+)", path.read_text()):
            assert (path.parent / link).exists(), f"{path}: {link}"


def test_scripts_that_are_named_exist() -> None:
    for path in [*PROSE, ROOT / "CHANGELOG.md"]:
        for name in re.findall(r"\banalysis/[\w/]+\.py\b", path.read_text()):
            assert (ROOT / name).is_file(), f"{path}: {name}"


def test_commands_and_their_options_exist() -> None:
    commands = typer.main.get_command(app).commands
    lines = "".join(block for path in PROSE for block in blocks(path, "sh")).replace("\\\n", " ")
    shown = re.findall(r"^pbrl-ppl .*", lines, re.M)
    assert len(shown) > 10
    for line in shown:
        name, *words = line.partition("#")[0].split()[1:]
        assert name in commands, line
        options = {
            flag for each in commands[name].params for flag in (*each.opts, *each.secondary_opts)
        }
        assert {word for word in words if re.match("--?[a-z]", word)} <= options, line


def test_the_tutorial_has_the_files_that_it_names(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, *rest = "".join(blocks(DOCS / "pages" / "tutorial.md", "sh")).splitlines()
    assert main([*first.split()[1:], "--quiet"]) == 0
    given = [word for line in rest for word in line.split() if word.endswith((".csv", ".toml"))]
    made = {"plan.csv"}
    assert len(given) > 4 and set(given) - made <= {path.name for path in tmp_path.iterdir()}


def test_logs_of_others_are_the_same_recording(tmp_path, monkeypatch) -> None:
    """Motion capture and a ROS bag's topics, made of the cart's recording; MuJoCo's arrays."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    exported(tmp_path)
    scene = pp.Scene.load(CART / "scene.toml")
    whole = pp.History.load(CART / "recorded" / "train.csv", scene).dataset
    names: dict[str, Any] = {"pp": pp, "scene": scene}
    for block in blocks(DOCS / "pages" / "guides" / "own_log.md", "python"):
        exec(compile(block, block, "exec"), names)
    driven, mocap = names["driven"].dataset, names["mocap"].dataset
    turn = (driven["observed"] - whole["observed"]).sel(state="theta")
    np.testing.assert_allclose(np.sin(turn), 0.0, atol=1e-9)
    rest = ["x", "y", "vx", "vy", "omega"]
    np.testing.assert_allclose(
        driven["observed"].sel(state=rest), whole["observed"].sel(state=rest), atol=1e-9
    )
    np.testing.assert_allclose(driven["action"], whole["action"], atol=1e-9)
    place = ["x", "y", "theta"]
    np.testing.assert_allclose(
        mocap["observed"].sel(state=place), whole["observed"].sel(state=place), atol=1e-9
    )
    assert mocap["observed"].sel(state="vx").isnull().all()
    assert names["slid"].dataset.sizes["time"] == 21


def test_bags_and_models_of_robots(tmp_path, monkeypatch) -> None:
    """The bag holds the cart's recording; blocks with a posterior run with all others."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    exported(tmp_path)
    scene = pp.Scene.load(CART / "scene.toml")
    whole = pp.History.load(CART / "recorded" / "train.csv", scene).dataset
    names: dict[str, Any] = {"pp": pp, "scene": scene, "np": np}
    for block in blocks(DOCS / "pages" / "guides" / "robots.md", "python"):
        if "idata" not in block:
            exec(compile(block, block, "exec"), names)
    bag = names["from_bag"].dataset
    place = ["x", "y"]
    np.testing.assert_allclose(
        bag["observed"].sel(state=place), whole["observed"].sel(state=place), atol=1e-5
    )
    turn = (bag["observed"] - whole["observed"]).sel(state="theta")
    np.testing.assert_allclose(np.sin(turn), 0.0, atol=1e-5)
    np.testing.assert_allclose(bag["action"], whole["action"], atol=1e-9)
    assert names["arm_log"].dataset.sizes["time"] == 51


@pytest.mark.long
def test_blocks_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At small size: Gaussian approximations, and short searches."""
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copy(CART / "scene.toml", tmp_path / "cart.toml")  # as `pbrl-ppl new --from` does
    shutil.copy(CART / "recorded" / "train.csv", tmp_path)
    exported(tmp_path)
    monkeypatch.chdir(tmp_path)
    whole, loop, plan = pp.fit, pp.close_loop, pp.plan

    def fit(model: Any, **options: Any) -> Any:
        small = {} if problem_in(model).library is not None else {"method": "laplace"}
        return whole(model, **small, **options, draws=100, chains=2, progress=False)

    def planned(model: Any, *given: Any, draws: int | None = None, **options: Any) -> Any:
        return plan(model, *given, draws=draws and 2, nodes=2000, **options)

    monkeypatch.setattr(pp, "fit", fit)
    monkeypatch.setattr(pp, "close_loop", partial(loop, method="laplace", draws=100))
    monkeypatch.setattr(pp, "plan", planned)
    monkeypatch.setattr(pp, "PBRLAgent", partial(pp.PBRLAgent, nodes=2000))
    names: dict[str, Any] = {"__name__": "__main__"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # too few draws
        for kind in (DeprecationWarning, FutureWarning, RuntimeWarning):  # from ArviZ
            warnings.simplefilter("ignore", kind)
        for block in BLOCKS:
            exec(compile(block, block, "exec"), names)
    assert Path("report.html").exists() and Path("learned.nc").exists()
    assert pp.joint_probabilities(names["found"])["joint1"]["none"] > 0.9
    assert names["loop"].added[0].effect == "angular_drag"
