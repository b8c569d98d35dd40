"""How long the loop takes on a recorded cart, in all and to rank the candidates.

    python analysis/benchmarks/loop.py          # a table
    python analysis/benchmarks/loop.py --json   # one JSON object

The history is that of `make demo`: Box2D's cart with an undeclared drag. Seconds are this
machine's; beside them stands how often the likelihood could have been evaluated meanwhile.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import pbrl_ppl as pp
from pbrl_ppl.criticism import loop
from pbrl_ppl.effects import attach, candidates
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import find_mode, trajectory_mode

sys.path.insert(0, str(Path(__file__).parent))
from inference import Row, measure

CART = Path(__file__).parents[2] / "models" / "shopping_cart"


def measure_loop() -> Iterator[Row]:
    """The loop on the demo's history, and its ranking alone."""
    scene = pp.Scene.load(CART / "scene.toml")
    train, test = (
        pp.History.load(CART / "recorded" / f"{name}.csv", scene) for name in ("train", "test")
    )
    problem = Problem.of(scene, train, attach(scene), threads=2)
    mode = trajectory_mode(problem, find_mode(problem, seed=1).phi)
    lacking = candidates(scene, problem.physics.effects)
    loop.rank_candidates(mode, lacking)  # laws are compiled by now, as they are in the loop
    begin = time.perf_counter()
    loop.rank_candidates(mode, lacking)
    rank = time.perf_counter() - begin
    begin = time.perf_counter()
    for _ in range(10):
        problem.residual(mode.phi)
    once = (time.perf_counter() - begin) / 10
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = loop.revise(scene, train, test, seed=1)
    took = time.perf_counter() - begin
    what = f"cart, {train.n_transitions} transitions, {len(lacking)} candidates: "
    yield "loop_seconds", what + "the whole loop (s)", "< 100", took
    yield "loop_evaluations", "the same, in predictions of the history", "", took / once
    yield "rank_seconds", what + "to rank the candidates (s)", "< 5", rank
    yield "loop_rhat", "the same: largest R-hat", "<= 1.05", found.posterior_after.attrs["max_rhat"]
    yield "loop_ess", "the same: least ESS", ">= 100", found.posterior_after.attrs["min_ess"]


if __name__ == "__main__":
    measure({"loop": measure_loop}, __doc__)
