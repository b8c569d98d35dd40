"""Planning on posterior draws compared with planning on the mode, in the true world.

    python analysis/benchmarks/planning.py --only draws bimodal

The true world is the engine with the true parameters; plans see a posterior file alone. Limits are
numbers of nodes, not seconds, so that the figures do not depend on the machine.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

import pbrl_ppl as pp
from pbrl_ppl import Dynamics, Wall
from pbrl_ppl.physics import build_layout
from pbrl_ppl.planning import predicted_path

sys.path.insert(0, str(Path(__file__).parent))
from engine import MODELS
from inference import CART, NOISE, Row, simulate

DRAWS, STARTS, SEED = 16, 20, 0
#: Where the wheel is, forwards (m), and the share of draws that counts where there are two modes.
WHEEL, TAIL = -0.25, 0.25
#: How far off its heading the goal may then be (rad).
AHEAD = np.radians(20.0)
#: States that a plan may generate, each draw's own: as much of the engine's work with the mode as
#: with draws.
NODES = 160_000
#: Intervals that are played of a plan, and in all.
EVERY, INTERVALS = 20, 120
PUSHES = pp.ActionSet.box(
    "cart",
    forces=(-15.0, 0.0, 15.0),
    lateral=(-15.0, 0.0, 15.0),
    torques=(-3.0, 0.0, 3.0),
    durations=(0.2, 0.5),
)


def through_file(idata: object) -> object:
    """Return the posterior, saved and loaded, as a planner gets it."""
    with tempfile.TemporaryDirectory() as folder:
        pp.save_posterior(idata, Path(folder) / "cart.nc")
        return pp.load_posterior(Path(folder) / "cart.nc")


def walled() -> pp.Scene:
    """The shopping cart, and a wall across the middle of its room."""
    scene = pp.Scene.load(MODELS / "shopping_cart" / "scene.toml")
    return scene.replace(walls=(*scene.walls, Wall((0.0, -2.0), (0.0, 2.0))))


def noisy_posterior(n: int = 20) -> object:
    """The fit of noisy transitions on one side of the wall, each from its own start."""
    scene = walled()
    rng = np.random.default_rng(SEED)
    start = rng.normal([-4.0, 0, 0, 0, 0, 0], [1.0, 1.0, 1.5, 1.2, 1.2, 0.8], (n, 1, 6))
    pushes = rng.normal(0, [12.0, 12.0, 2.0], (n, 1, 3))
    phi = build_layout(scene).to_vector(CART)
    history = simulate(scene, phi, start, pushes, NOISE, SEED + 1)
    model = pp.physics_model(scene, history, threads=1)
    return through_file(pp.fit(model, seed=1, progress=False))


class World:
    """True world of the cart, from a pose (3,) at rest."""

    def __init__(self, truth: Dynamics, start: np.ndarray) -> None:
        self.truth, self.state = truth, np.concatenate([start, np.zeros(3)])[None]

    def __call__(self, wrench: np.ndarray) -> np.ndarray:
        """Execute one interval."""
        self.state = self.truth.step(self.state[None, None], wrench[None])[0, 0]
        return self.state


def success(idata: object, starts: np.ndarray, draws: int | None) -> tuple[float, float]:
    """Return the share of starts (n, 3) that reach the goal behind the wall, and seconds per start.

    Plans are made again as they are played.
    """
    truth = Dynamics.known(walled(), CART)
    goal = pp.Goal.of({"cart": (3.0, 0.0, 0.0)})  # 0.1 m, 0.1 rad
    reached, begin = [], time.perf_counter()
    for start in starts:
        world = World(truth, start)
        done = pp.act(
            world, idata, world.state, goal, PUSHES, every=EVERY, intervals=INTERVALS, draws=draws,
            nodes=NODES, weight=5.0,
        )  # fmt: skip
        reached.append(done.reached)
    return float(np.mean(reached)), (time.perf_counter() - begin) / len(starts)


def measure_cart(count: int = STARTS) -> Iterator[Row]:
    """Success with a posterior of 20 transitions, with the noise of motion capture."""
    idata = noisy_posterior()
    rng = np.random.default_rng(SEED)
    starts = rng.uniform([-4.0, -2.0, -np.pi], [-2.0, 2.0, np.pi], (count, 3))
    mode, its = success(idata, starts, None)
    draws, theirs = success(idata, starts, DRAWS)
    what = f"cart, 20 noisy transitions, a wall in the way, {count} starts: share that reaches"
    yield "map_success", f"{what} with the mode ({its:.1f} s a start)", "", mode
    what = f"the same with {DRAWS} draws ({theirs:.1f} s a start)"
    yield "draws_success", what, ">= map_success", draws


# -- two modes -------------------------------------------------------------------------------------


def free_cart() -> pp.Scene:
    """The shopping cart without walls; all is known but where the wheel is along the cart."""
    scene = pp.Scene.load(MODELS / "shopping_cart" / "scene.toml").replace(walls=())
    known = {name: CART[name] for name in ("mass", "r", "mu_c", "mu_x", "mu_y")}
    known |= {"w_y": 0.0, "w_theta": 0.0}
    return scene.replace(bodies=(replace(scene.bodies[0], known=known),))


def bimodal_posterior(n: int = 20, draws: int = 200) -> object:
    """Posterior of a cart pushed sideways before a range finder, which sees y and its speed alone.

    A wheel as far on the other side of the middle gives the mirror image of each motion, of which
    the range finder sees the same, and the prior is symmetric: so the posterior is.
    """
    scene = free_cart()
    rng = np.random.default_rng(SEED)
    start, pushes = np.zeros((n, 1, 6)), np.zeros((n, 1, 3))
    start[..., 4], pushes[..., 1] = rng.normal(0, 0.6, (n, 1)), rng.normal(0, 30.0, (n, 1))
    phi = build_layout(scene).to_vector({"w_x": WHEEL})
    unseen = np.array([np.nan, 0, np.nan, np.nan, 0, np.nan])
    history = simulate(scene, phi, start, pushes, NOISE + unseen, SEED + 1)
    model = pp.physics_model(scene, history, threads=1)
    options = {"draws": draws, "tune": draws, "seed": 1, "progress": False}
    return through_file(pp.fit(model, **options))


def open_loop(idata: object, starts: np.ndarray, draws: int | None, nodes: int) -> np.ndarray:
    """Return whether open-loop plans from starts (n, 3) reach with either true wheel: (n, 2)."""
    goal = pp.Goal.of({"cart": (0.0, 0.0, None)}, tolerance=0.4)
    truths = [Dynamics.known(free_cart(), {"w_x": side * WHEEL}) for side in (1, -1)]
    reached = np.zeros((len(starts), 2), bool)
    for i, start in enumerate(starts):
        plan = pp.plan(
            idata, {"cart": start}, goal, PUSHES, draws=draws, tail=TAIL if draws else 1.0,
            nodes=nodes, weight=1.5,
        )  # fmt: skip
        for j, truth in enumerate(truths):
            end = predicted_path(truth, plan.start, plan.wrenches)[0, -1]
            reached[i, j] = goal.shortfall(truth.scene, end) <= 1.0
    return reached


def compared(
    idata: object, count: int, nodes: int = 640_000
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return which runs reach with the mode and with draws, and the p-value of the difference.

    Starts are 1.5 to 3 m from the goal, which the cart faces within 20 degrees. A turn moves the
    middle about the wheel, whichever that is: 20 degrees move it 0.09 m one way or the other, 90
    degrees 0.35 m. So goals at the side could hardly be reached with both, within the tolerance.

    The chance is that of a sign test over the starts: at each that differs, were the two equally
    good, either would be ahead by the toss of a coin.
    """
    rng = np.random.default_rng(SEED + 3)
    way, angle, off = rng.uniform([1.5, -np.pi, -AHEAD], [3.0, np.pi, AHEAD], (count, 3)).T
    starts = np.stack([way * np.cos(angle), way * np.sin(angle), angle + np.pi + off], axis=1)
    mode, draws = (open_loop(idata, starts, size, nodes) for size in (None, DRAWS))
    ahead = draws.sum(axis=1) - mode.sum(axis=1)
    better, differ = int((ahead > 0).sum()), int((ahead != 0).sum())
    chance = float(binomtest(better, differ, alternative="greater").pvalue) if differ else 1.0
    return mode, draws, chance


def measure_bimodal(count: int = STARTS) -> Iterator[Row]:
    """Success with a bimodal posterior: the wheel in front or at the back."""
    mode, draws, chance = compared(bimodal_posterior(), count)
    what = f"wheel in front or at the back, {count} starts x both in truth, open loop: share that"
    yield "bimodal_map_success", f"{what} reaches with the mode", "", float(mode.mean())
    what = f"the same with {DRAWS} draws, the worst quarter counts (by chance: p = {chance:.1g})"
    yield "bimodal_draws_success", what, "> bimodal_map_success", float(draws.mean())
