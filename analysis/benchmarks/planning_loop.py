"""Plans with the model before and after closing the loop, executed in Box2D.

    python analysis/benchmarks/planning.py --only loop

The world is models/shopping_cart/make_history.py's, at steps of 1 ms, and has a drag that the
scene does not declare. The history is recorded in it, with noise; plans see the posterior files
that the closed loop saves, and are played open loop.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

import pbrl_ppl as pp

sys.path.insert(0, str(Path(__file__).parent))
from engine import MODELS
from inference import Row
from planning_draws import PUSHES

DRAG, STARTS, SEED = 3.0, 20, 0  # kg/s
NODES = 500_000
GOAL = pp.Goal.of({"cart": (3.0, 0.0, 0.0)})


def box2d() -> ModuleType:
    """Return the generator of histories.

    Raises
    ------
    ImportError
        If Box2D is not installed.
    """
    path = MODELS / "shopping_cart" / "make_history.py"
    spec = importlib.util.spec_from_file_location("make_history", path)
    if spec is None or spec.loader is None:
        raise ImportError(path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


def closed(trajectories: int = 4, **options: int) -> pp.Loop:
    """Return the loop closed on trajectories of 30 transitions; half as many are held out."""
    world = box2d()
    setup = replace(world.CART, n_train=trajectories, n_test=max(1, trajectories // 2))
    scene = pp.Scene.load(MODELS / "shopping_cart" / "scene.toml")
    train, test = (
        pp.History.from_dataframe(rows, scene)
        for rows in world.simulate(SEED, setup, linear_drag=DRAG)
    )
    return pp.close_loop(scene, train, test, seed=SEED, **options)


def final_distances(posterior: Path, starts: np.ndarray) -> np.ndarray:
    """Return final distances (m) from the goal of open-loop plans from poses (n, 3) at rest."""
    world = box2d()
    idata = pp.load_posterior(posterior)
    effects = world.Effects(linear_drag=DRAG)
    found = []
    for start in starts:
        state = np.concatenate([start, np.zeros(3)])
        plan = pp.plan(idata, state[None], GOAL, PUSHES, nodes=NODES)
        end = world.rollout(world.CART, state, plan.wrenches[:, 0], effects)[-1]
        found.append(float(GOAL.distance(plan.scene, end[None])))
    return np.array(found)


def before_and_after(loop: pp.Loop, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return final distances (m) with the declared and the revised model, from the same starts."""
    rng = np.random.default_rng(SEED)
    starts = rng.uniform([-4.0, -2.0, -np.pi], [-2.0, 2.0, np.pi], (count, 3))
    with tempfile.TemporaryDirectory() as folder:
        saved = loop.save(Path(folder) / "loop")
        before, after = (
            final_distances(saved / f"{name}.nc", starts) for name in ("before", "after")
        )
    return before, after


def measure_loop(count: int = STARTS) -> Iterator[Row]:
    """Measure median final distances and their ratio."""
    try:
        loop = closed(draws=400)
    except ImportError as error:
        print(f"final_distance_ratio is left out: {error}", file=sys.stderr)
        return
    named = ", ".join(added.effect for added in loop.added) or "nothing"
    before, after = (float(np.median(distances)) for distances in before_and_after(loop, count))
    what = f"undeclared drag of {DRAG:g} kg/s in Box2D, {count} starts: median final distance (m)"
    yield "final_distance_before", f"{what}, declared model", "", before
    yield "final_distance_after", f"the same, revised model (added: {named})", "", after
    yield "final_distance_ratio", "revised / declared", "<= 0.5", after / before
