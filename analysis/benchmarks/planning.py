"""Speed of the planner, and success of its plans in the true world.

    python analysis/benchmarks/planning.py                    # a table
    python analysis/benchmarks/planning.py --json             # one JSON object
    python analysis/benchmarks/planning.py --only cart python # some of it

Seconds are this machine's; the ratio compares both sides in one run.
"""

from __future__ import annotations

import heapq
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.planning.astar import TimeToGo, astar
from pbrl_ppl.planning.search import SearchTask

sys.path.insert(0, str(Path(__file__).parent))
from engine import naive
from inference import CART, Row, measure
from planning_draws import PUSHES, measure_bimodal, walled
from planning_draws import measure_cart as measure_draws
from planning_loop import measure_loop

STARTS = 20
GOAL = pp.Goal.of({"cart": (3.0, 0.0, 0.0)})


def starts(seed: int = 0) -> Iterator[dict[str, tuple[float, float, float]]]:
    """Return random poses on the far side of the wall, at rest."""
    rng = np.random.default_rng(seed)
    for _ in range(STARTS):
        place = rng.uniform([-4.0, -2.0, -np.pi], [-1.0, 2.0, np.pi])
        yield {"cart": tuple(place)}


def measure_cart() -> Iterator[Row]:
    """A* with the true parameters, around the wall."""
    dynamics = pp.Dynamics.known(walled(), CART)
    plans = [pp.plan(dynamics, start, GOAL, PUSHES) for start in starts()]
    took = np.array([plan.seconds for plan in plans])
    what = f"cart around a wall, {STARTS} starts, A*: "
    yield (
        "cart_success",
        what + "share that reach 0.1 m, 0.1 rad",
        "1",
        np.mean([plan.reached for plan in plans]),
    )
    yield "cart_seconds_max", "the same: longest search (s)", "<= 60", took.max()
    yield "cart_seconds_median", "the same: median search (s)", "", float(np.median(took))
    rate = sum(plan.nodes for plan in plans) / took.sum()
    yield "nodes_per_second", "the same: states generated per second", "", rate


def python_astar(start: np.ndarray, nodes: int) -> float:
    """Naive baseline of A*: one node and one action at a time, pymunk from Python.

    Returns states generated a second, with the same heuristic, actions and cells.
    """
    scene = walled()
    dynamics = pp.Dynamics.known(scene, CART)
    to_go = TimeToGo(dynamics, GOAL, PUSHES, start)
    shape, counts = scene.body("cart").shape, PUSHES.intervals(scene)
    cells = np.array([0.4, 0.4, 0.5, 0.8, 0.8, 1.0])
    closed, generated, begin = {}, 1, time.perf_counter()
    queue = [(0.0, 0, 0.0, start)]
    while queue and generated < nodes:
        _, _, cost, node = heapq.heappop(queue)
        for action in range(len(PUSHES.actions)):
            state = node[None]
            for interval in range(1, counts[-1] + 1):
                wrench = PUSHES.wrenches(scene, np.array([action]), state[..., 2])
                state = naive(state, wrench[:, None], CART, shape, scene.walls)[:, 0]
                generated += 1
                if GOAL.shortfall(scene, state[0]) <= 1.0:
                    return generated / (time.perf_counter() - begin)
                if interval not in counts:
                    continue
                far = np.clip(GOAL.distance(scene, state[0]), 0.25, 2.0)
                key = tuple(np.floor(state[0, 0] / (cells * 2.0 ** np.floor(np.log2(far)))))
                after = cost + interval * scene.time_step
                if after < closed.get(key, np.inf):
                    closed[key] = after
                    ahead = float(to_go(state[None])[0, 0])
                    heapq.heappush(queue, (after + 3.0 * ahead, generated, after, state[0]))
    return generated / (time.perf_counter() - begin)


def measure_python() -> Iterator[Row]:
    """States a second, ours over the Python loop's, in turn in one run."""
    dynamics = pp.Dynamics.known(walled(), CART)
    ratios = []
    for start, _ in zip(starts(), range(5), strict=False):
        state = np.array([[*start["cart"], 0.0, 0.0, 0.0]])
        found = astar(SearchTask(dynamics, state, GOAL, PUSHES, nodes=100_000))
        ratios.append(found.nodes / found.seconds / python_astar(state, 3000))
    yield (
        "over_python_loop",
        "states per second / those of A* on a Python loop over pymunk",
        ">= 8",
        float(np.median(ratios)),
    )


PARTS = {
    "cart": measure_cart,
    "python": measure_python,
    "draws": measure_draws,
    "bimodal": measure_bimodal,
    "loop": measure_loop,
}


if __name__ == "__main__":
    measure(PARTS, __doc__)
