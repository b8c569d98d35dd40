"""Figures 4(a) and 4(b) of the paper: four agents learn to push a shopping cart.

    python analysis/04_shopping_cart.py            # ten episodes of each, in out/shopping_cart
    python analysis/04_shopping_cart.py --quick    # two short ones, for CI
    python analysis/04_shopping_cart.py --workers 1   # not in processes of their own
    python analysis/04_shopping_cart.py --resume   # go on where a run was interrupted
    python analysis/04_shopping_cart.py --box2d    # the world in another engine than the agents'

A step is one action of 0.25 s. Curves are means over episodes with 95 % intervals (bootstrap); a
cart that has reached the goal stays there. The return is the sum of rewards over all steps,
likewise. What the figure and `benchmarks/agents.py` need of the episodes is kept in figure_4a.nc
and figure_4b.nc.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

import pbrl_ppl as pp
from pbrl_ppl.errors import EpisodeError
from pbrl_ppl.history import write_atomically

sys.path.insert(0, str(Path(__file__).parents[1] / "models" / "shopping_cart"))
from task import TASK, TRUTH, world

SIGMAS = {"a": 0.0, "b": 0.25}
OUT = Path("out") / "shopping_cart"
#: States that a search generates at most, for all agents; the true model's plan takes 3500.
NODES = 10_000


def agent(name: str, seed: int) -> pp.Agent:
    """One of the four: PBRL with the MAP, OO-LWR and LWR with Table 2's parameters."""
    if name == "true":
        return pp.TrueModelAgent(TASK, TRUTH, seed=seed, nodes=NODES)
    kinds = {"pbrl": pp.PBRLAgent, "oolwr": pp.OOLWRAgent, "lwr": pp.LWRAgent}
    return kinds[name](TASK, seed=seed, nodes=NODES)


AGENTS = {name: partial(agent, name) for name in ("true", "pbrl", "oolwr", "lwr")}


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over the first axis, and the ends of its 95 % interval."""
    found = stats.bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(1))
    return values.mean(axis=0), *found.confidence_interval


def summary(episodes: list[pp.Episode], steps: int) -> dict[str, object]:
    """A row of the table."""
    rewards = np.array([episode.rewards(steps) for episode in episodes])
    reached = [episode.steps for episode in episodes if episode.reached]
    total, low, high = interval(rewards.sum(axis=1))
    seconds = np.concatenate([episode.dataset["seconds"] for episode in episodes])
    return {
        "agent": episodes[0].agent,
        "reached": f"{len(reached)}/{len(episodes)}",
        "steps to goal (median)": f"{np.median(reached):.0f}" if reached else "-",
        "bumps (mean)": f"{np.mean([episode.bumps for episode in episodes]):.1f}",
        "return (m)": f"{total:.0f} [{low:.0f}, {high:.0f}]",
        "final reward (m)": f"{rewards[:, -1].mean():.2f}",
        "s a step (median)": f"{np.median(seconds):.2f}",
    }


def kept(done: Mapping[str, list[pp.Episode]], steps: int, **attrs: object) -> xr.Dataset:
    """What is kept of all episodes: rewards, and by step what is NaN after the goal is reached."""
    agents = []
    for episodes in done.values():
        every = []
        for episode in episodes:
            data = episode.dataset
            own = data[["bumped", "planned", "seconds", "estimate"]].astype(float)
            own = own.assign_coords(interval=np.arange(1, episode.steps + 1))
            own = own.reindex(interval=np.arange(1, steps + 1)).rename(interval="step")
            own["reward"] = ("time", episode.rewards(steps))
            own["reached"] = float(episode.reached)
            every.append(own.drop_attrs())
        seeds = pd.Index([episode.seed for episode in episodes], name="seed")
        agents.append(xr.concat(every, seeds, join="outer"))
    whole = xr.concat(agents, pd.Index(list(done), name="agent"), join="outer")
    said = {"versions": ", ".join(f"{p} {version(p)}" for p in ("pbrl_ppl", "pymunk", "pymc"))}
    return whole.drop_encoding().assign_attrs(scene=TASK.scene.to_toml(), **said, **attrs)


def main() -> None:
    """Run what is missing, print the table, draw."""
    try:
        run()
    except EpisodeError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted: finished episodes are kept; go on with --resume", file=sys.stderr)
        sys.exit(130)


def run() -> None:
    """All of it; errors are the caller's."""
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
        parser.error(f"{out}: there are episodes; go on with --resume, or give another --out")
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True, layout="constrained")
    for (panel, sigma), axis in zip(SIGMAS.items(), axes, strict=True):
        done = pp.run_episodes(
            AGENTS, world(sigma, box2d=options.box2d), range(1, episodes + 1),
            out / f"sigma_{sigma:g}", steps=steps, workers=options.workers,
            progress=partial(print, flush=True),
        )  # fmt: skip
        engine = " --box2d" if options.box2d else ""
        command = f"python analysis/04_shopping_cart.py --episodes {episodes} --steps {steps}"
        small = kept(done, steps, sigma=sigma, command=command + engine)
        write_atomically(
            out / f"figure_4{panel}.nc",
            lambda to, small=small: small.to_netcdf(
                to, engine="h5netcdf", encoding={name: {"zlib": True} for name in small}
            ),
        )
        rows = [summary(each, steps) for each in done.values()]
        print(f"\n4({panel}), sigma {sigma:g}, {episodes} episodes of at most {steps} steps")
        print(pd.DataFrame(rows).to_string(index=False), flush=True)
        for each in done.values():
            mean, low, high = interval(np.array([episode.rewards(steps) for episode in each]))
            (line,) = axis.plot(mean, label=each[0].agent)
            steps_done = np.arange(len(mean))
            axis.fill_between(steps_done, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        noise = f"noise of {sigma:g}" if sigma else "without noise"
        axis.set_title(f"4({panel}) {noise}", loc="left", fontsize=10)
        axis.set_xlabel("steps")
    axes[0].set_ylabel("reward: minus the distance to the goal (m)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.savefig(out / "figure_4ab.png", dpi=120)
    print(f"\n{out / 'figure_4ab.png'}")


if __name__ == "__main__":
    main()
