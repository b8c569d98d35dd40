"""Navigation among movable obstacles, one of which turns out to be bolted to the floor.

    python analysis/02_namo.py           # what happens, in words, and out/namo.png

The paper's Fig. 5. The robot knows itself, but has touched neither the table nor the couch, and
plans through the table; in the real rooms that does not move. The posterior is brought up to date
with the failed push, saved, loaded, and the robot plans again. The real rooms are pbrl_ppl's own
engine with parameters that the model does not know (`models/namo/world.py`): what is shown is
planning and learning, not that the engine is right.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.errors import UninformedWarning
from pbrl_ppl.reporting.scene_plots import draw_goal, draw_motion, draw_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "models" / "namo"))
from world import GOAL, SCENE, World, at_rest, follow, go_round, movable, pushes

SEED = 1
OUT = Path("out")
BEGIN = time.monotonic()


def say(text: str) -> None:
    """Print an event with its time."""
    print(f"{time.monotonic() - BEGIN:4.0f} s  {text}", flush=True)


def beliefs(idata: object) -> str:
    """Return the probabilities that table and couch move."""
    return ", ".join(f"{name} {movable(idata, name):.0%}" for name in ("table", "couch"))


def opening(states: np.ndarray) -> str:
    """Return the opening through which the robot goes, if any."""
    crossed = np.flatnonzero(states[:, 0, 0] > 0)
    if not len(crossed):
        return "neither opening"
    return "the table's opening" if states[crossed[0], 0, 1] > 0 else "the couch's opening"


def way(states: np.ndarray, name: str) -> float:
    """Return the distance that a body is moved (m)."""
    i = [body.name for body in SCENE.dynamic].index(name)
    return float(np.hypot(*(states[-1] - states[0])[i, :2]))


def told(states: np.ndarray) -> str:
    """Return a sentence about a motion."""
    moved = ", ".join(f"{name} moved by {way(states, name):.2f} m" for name in ("table", "couch"))
    return f"the robot goes through {opening(states)}; {moved}"


def main() -> None:
    """Plan, fail, update and replan; print and draw."""
    # that nothing is known of the furniture is the point of it
    warnings.simplefilter("ignore", UninformedWarning)
    OUT.mkdir(exist_ok=True)
    world = World(SEED)

    seen = go_round(world)
    before = pp.fit(
        pp.physics_model(SCENE, seen.history()),
        seed=SEED, draws=500, tune=300, chains=2, cores=1, progress=False,
    )  # fmt: skip
    pp.save_posterior(before, OUT / "namo_before.nc")
    before = pp.load_posterior(OUT / "namo_before.nc")
    say(f"fitted to {len(seen.wrenches)} transitions of the robot alone")
    say(f"can be moved: {beliefs(before)}")

    first = pp.plan(before, at_rest(seen.states[-1]), GOAL, pushes(), seed=SEED)
    expected = first.predicted["predicted"].mean("draw").to_numpy()
    say(f"first plan: {first.in_words()}")
    say(f"            {told(expected)}")

    failed = follow(world, seen.states[-1], first.wrenches, expected)
    say(f"played in the real rooms, given up after {len(failed.wrenches)} intervals")
    say(f"            {told(failed.states)}")

    after = pp.update(before, failed.history(), seed=SEED, progress=False)
    pp.save_posterior(after, OUT / "namo_after.nc")
    after = pp.load_posterior(OUT / "namo_after.nc")
    did = json.loads(after.attrs["updates"])[-1]["did"]
    say(f"the posterior is {did}")
    say(f"can be moved: {beliefs(after)}")

    done = pp.act(world, after, at_rest(failed.states[-1]), GOAL, pushes(), every=10, seed=SEED)
    say(f"second plan, made again every second ({done.plans} times): {told(done.states)}")
    say(f"the goal is {'' if done.reached else 'not '}reached, {done.distance:.2f} m from it")

    figure, axes = plt.subplots(2, 2, figsize=(10, 7.4), layout="constrained")
    for panel, title in zip(
        axes.flat,
        (
            "1. What the robot sees",
            f"2. First plan: table movable with P = {movable(before, 'table'):.2f}",
            "3. Played in the real rooms: the table is bolted to the floor",
            f"4. P = {movable(after, 'table'):.2f} after the update: the new plan, played",
        ),
        strict=True,
    ):
        panel.set_title(title, fontsize=10, loc="left")
        draw_goal(panel, SCENE, GOAL)
    draw_scene(axes[0, 0], SCENE, seen.states[-1], names=True)
    for panel, states in zip(axes.flat[1:], (expected, failed.states, done.states), strict=True):
        draw_motion(panel, SCENE, states)
    figure.savefig(OUT / "namo.png", dpi=100)
    say(str(OUT / "namo.png"))


if __name__ == "__main__":
    main()
