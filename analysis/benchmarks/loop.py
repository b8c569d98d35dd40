"""Time of the loop on a recording, from its files to the report.

    python analysis/benchmarks/loop.py                     # a table of the demo's cart
    python analysis/benchmarks/loop.py --json              # one JSON object
    python analysis/benchmarks/loop.py --only pair real    # minutes each; long: far more

`loop`, the default, is `make demo`'s history: Box2D's cart with an undeclared drag; `first` the
command itself with an empty cache of compiled code; `pair` two bodies that touch; `long` a hundred
thousand transitions; `real` the measured recordings. Pair and measurements lie beside the project
and are left out where they do not. Seconds are this machine's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import pbrl_ppl as pp
from pbrl_ppl import Physics
from pbrl_ppl.criticism import closing, score
from pbrl_ppl.effects import candidates
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import find_mode, trajectory_mode
from pbrl_ppl.reporting import render

sys.path.insert(0, str(Path(__file__).parent))
from engine import MODELS
from inference import Row, measure

CART = MODELS / "shopping_cart"
#: Recordings beside the project, which holds no copy.
SHARED = Path(__file__).parents[3] / "shared"
PAIR = SHARED / "data" / "pair-linear-drag"
REAL, PUSHED = SHARED / "data" / "real", SHARED / "contact" / "planar-push"
LONG = 100_000


def closed(scene_file: Path, folder: Path) -> tuple[float, pp.Loop]:
    """Return the seconds from the files to the report, and the loop."""
    begin = time.perf_counter()
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as out:
        warnings.simplefilter("ignore")
        scene = pp.Scene.load(scene_file)
        train, test = (pp.History.load(folder / f"{name}.csv", scene) for name in ("train", "test"))
        found = pp.close_loop(scene, train, test, seed=1)
        found.save(Path(out) / "loop", page=render(found))
    return time.perf_counter() - begin, found


def told(found: pp.Loop) -> str:
    """Return a sentence on a loop's recording and findings."""
    names = ", ".join(f"{one.effect} on {one.body}" for one in found.added) or "nothing"
    count = found.provenance["transitions"]
    return f"{count} transitions; {found.verdict}, added: {names}"


def there(key: str, *folders: Path) -> bool:
    """Return whether the recordings of a key exist; print a message if not."""
    missing = [str(folder) for folder in folders if not folder.is_dir()]
    if missing:
        print(f"{key} is left out: nothing at {' or '.join(missing)}", file=sys.stderr)
    return not missing


def measure_loop() -> Iterator[Row]:
    """The loop on the demo's history, and its ranking alone."""
    scene = pp.Scene.load(CART / "scene.toml")
    train, test = (
        pp.History.load(CART / "recorded" / f"{name}.csv", scene) for name in ("train", "test")
    )
    problem = Problem.of(Physics.declare(scene, threads=2), train)
    mode = trajectory_mode(problem, find_mode(problem, seed=1).phi)
    lacking = candidates(scene, problem.physics.effects)
    score.rank_candidates(mode, lacking)  # laws are compiled by now, as they are in the loop
    begin = time.perf_counter()
    score.rank_candidates(mode, lacking)
    rank = time.perf_counter() - begin
    begin = time.perf_counter()
    for _ in range(10):
        problem.residual(mode.phi)
    once = (time.perf_counter() - begin) / 10
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = closing.close_loop(scene, train, test, seed=1)
    took = time.perf_counter() - begin
    what = f"cart, {train.n_transitions} transitions, {len(lacking)} candidates: "
    yield "loop_seconds", what + "the whole loop (s)", "<= 25", took
    yield "loop_evaluations", "the same, in predictions of the history", "", took / once
    yield "rank_seconds", what + "to rank the candidates (s)", "< 5", rank
    yield "loop_rhat", "the same: largest R-hat", "<= 1.01", found.posterior_after.attrs["max_rhat"]
    yield "loop_ess", "the same: least ESS", ">= 400", found.posterior_after.attrs["min_ess"]


def measure_first() -> Iterator[Row]:
    """`make demo` after installation, nothing compiled before."""
    with tempfile.TemporaryDirectory() as empty:
        begin = time.perf_counter()
        data = CART / "recorded"
        subprocess.run(
            [
                Path(sys.executable).with_name("pbrl-ppl"), "close-loop", CART / "scene.toml",
                data / "train.csv", "--test", data / "test.csv", "-o", Path(empty) / "out",
            ],
            env=os.environ | {"NUMBA_CACHE_DIR": str(Path(empty) / "cache")},
            capture_output=True,
            check=True,
        )  # fmt: skip
        took = time.perf_counter() - begin
    yield "first_seconds", "make demo, nothing compiled before (s)", "<= 45", took


def measure_pair() -> Iterator[Row]:
    """The loop on two bodies that touch, of which one has an undeclared drag."""
    if there("pair_seconds", PAIR):
        took, found = closed(PAIR / "scene.toml", PAIR)
        yield "pair_seconds", f"two bodies that touch, {told(found)} (s)", "<= 90", took


def measure_long(transitions: int = LONG) -> Iterator[Row]:
    """The loop on a long recording, in a process of its own: its memory counts."""
    script = Path(__file__).with_name("long_loop.py")
    ran = subprocess.run(
        [sys.executable, str(script), str(transitions)], stdout=subprocess.PIPE, check=True
    )
    got = json.loads(ran.stdout)
    yield "long_loop_seconds", f"cart, {got['told']} (s)", "<= 1200", got["seconds"]
    yield "long_loop_gigabytes", "the same: most memory (GB)", "<= 4", got["gigabytes"]


def measure_real() -> Iterator[Row]:
    """The loops on the measured recordings, and the longest of them."""
    if not there("real_seconds_max", REAL, PUSHED):
        return
    longest = 0.0
    for folder in (*sorted(path.parent for path in REAL.glob("*/scene.toml")), PUSHED):
        took, found = closed(folder / "scene.toml", folder)
        longest = max(longest, took)
        yield (
            f"{folder.name.replace('-', '_')}_seconds",
            f"{folder.name}, {told(found)} (s)",
            "<= 40" if folder.name == "pendulum-swing" else "<= 120",
            took,
        )
    yield "real_seconds_max", "the longest of the measured recordings (s)", "< 300", longest


PARTS = {
    "loop": measure_loop,
    "first": measure_first,
    "pair": measure_pair,
    "long": measure_long,
    "real": measure_real,
}

if __name__ == "__main__":
    measure(PARTS, __doc__, usual=["loop"])
