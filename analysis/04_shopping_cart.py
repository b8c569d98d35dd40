"""Figures 4(a) and 4(b) of the paper: four agents learn to push a shopping cart.

    python analysis/04_shopping_cart.py            # ten episodes of each, in out/shopping_cart
    python analysis/04_shopping_cart.py --quick    # two short ones, for CI
    python analysis/04_shopping_cart.py --workers 1   # not in processes of their own
    python analysis/04_shopping_cart.py --resume   # go on where a run was interrupted
    python analysis/04_shopping_cart.py --box2d    # the world in another engine than the agents'

A step is one action of 0.25 s. Curves are means over episodes with 95 % intervals (bootstrap); a
cart that has reached the goal stays there. The return is the sum of rewards over all steps,
likewise. The cart has nothing to touch but walls, so that conditions of OO-LWR by object are the
same as without. What the figure and `benchmarks/agents.py` need of the episodes is kept in
figure_4a.nc and figure_4b.nc.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from episodes import EpisodeError, World, run_episodes
from experiments import curve, of_episodes, origin, save, summary, to_end

import pbrl_ppl as pp

sys.path.insert(0, str(Path(__file__).parents[1] / "models" / "shopping_cart"))
from task import SPREAD, TASK, TRUTH

SIGMAS = {"a": 0.0, "b": 0.25}
OUT = Path("out") / "shopping_cart"
#: States that a search generates at most, for all agents; the true model's plan takes 3500.
NODES = 10_000
NAMES = {
    "true": "true model",
    "pbrl": "PBRL",
    "oolwr": "OO-LWR",
    "lwr": "LWR",
}


def agent(name: str, seed: int) -> pp.Agent:
    """Return one of the four: PBRL with the MAP, OO-LWR and LWR with Table 2's parameters."""
    options = {"seed": seed, "nodes": NODES}
    if name == "true":
        return pp.TrueModelAgent(TASK, TRUTH, **options)
    kinds = {"pbrl": pp.PBRLAgent, "oolwr": pp.OOLWRAgent, "lwr": pp.LWRAgent}
    return kinds[name](TASK, **options)


AGENTS = {name: partial(agent, name) for name in NAMES}


def world(sigma: float, box2d: bool) -> World:
    """Return the true cart, with noise in m, rad, m/s and rad/s."""
    if box2d:
        from episodes.box2d_world import Box2DWorld

        return Box2DWorld(TASK, TRUTH, sigma=sigma, spread=SPREAD)
    return World(TASK, TRUTH, sigma=sigma, spread=SPREAD)


def run() -> None:
    """Run what is missing, print the table, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--workers", type=int, help="processes; all processors by default")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--resume", action="store_true", help="go on with what is in the folder")
    parser.add_argument("--box2d", action="store_true", help="the world in Box2D")
    parser.add_argument("--quick", action="store_true", help="two episodes of 4 steps, for CI")
    options = parser.parse_args()
    episodes, steps = (2, 4) if options.quick else (options.episodes, options.steps)
    if episodes < 2:
        parser.error("--episodes: an interval needs at least 2")
    kind = ("_box2d" if options.box2d else "") + ("_quick" if options.quick else "")
    out = options.out.with_name(options.out.name + kind)
    if any(out.glob("*/*.nc")) and not options.resume:
        raise EpisodeError(f"{out}: there are episodes; go on with --resume, or give another --out")
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True, layout="constrained")
    command = f"04_shopping_cart.py --episodes {episodes} --steps {steps}"
    for (panel, sigma), axis in zip(SIGMAS.items(), axes, strict=True):
        done = run_episodes(
            AGENTS, world(sigma, options.box2d), range(1, episodes + 1),
            out / f"sigma_{sigma:g}", steps=steps, workers=options.workers,
            progress=partial(print, flush=True),
        )  # fmt: skip
        kept = of_episodes(done, steps, ("bumped", "planned", "seconds", "estimate"))
        about = origin(command + " --box2d" * options.box2d)
        save(
            kept.assign_attrs(sigma=sigma, scene=TASK.scene.to_toml(), **about),
            out / f"figure_4{panel}.nc",
        )
        rows = [summary(NAMES[name], each, steps) for name, each in done.items()]
        print(f"\n4({panel}), sigma {sigma:g}, {episodes} episodes of at most {steps} steps")
        print(pd.DataFrame(rows).to_string(index=False), flush=True)
        for name, each in done.items():
            curve(axis, np.array([episode.rewards(steps) for episode in each]), NAMES[name])
        noise = f"noise of {sigma:g}" if sigma else "without noise"
        axis.set_title(f"4({panel}) {noise}", loc="left", fontsize=10)
        axis.set_xlabel("steps")
    axes[0].set_ylabel("reward: minus the distance to the goal (m)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.savefig(out / "figure_4ab.png", dpi=120)
    print(f"\n{out / 'figure_4ab.png'}")


def main() -> None:
    """Run the experiment."""
    to_end(run)


if __name__ == "__main__":
    main()
