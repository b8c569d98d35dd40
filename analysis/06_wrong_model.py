"""Misspecification: a cart in worlds with an effect that no one told the agent of.

    python analysis/06_wrong_model.py              # five episodes of each, in out/wrong_model
    python analysis/06_wrong_model.py --quick      # two short ones, for CI
    python analysis/06_wrong_model.py --sigma 0.01  # with noise: hours rather than minutes
    python analysis/06_wrong_model.py --workers 2 --json out/wrong_model/result.json

Three agents with one declared model: PBRL, PBRL that closes the loop online (`revise=True`), and
PBRL that knows the effect, though not its size. The task is the paper's shopping cart, observed
without noise as in its figure 4(a), or with some (m, rad, m/s, rad/s). Episodes that are there are
not run again. Curves are means over episodes with 95 % intervals (bootstrap); the return is the sum
of rewards over all steps. The ratio is the mean return of the agent that closes the loop over that
of the one that knows the effect: 1.1 is 10 % worse.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy import stats

import pbrl_ppl as pp

sys.path.insert(0, str(Path(__file__).parents[1] / "models" / "shopping_cart"))
from task import SPREAD, TASK, TRUTH

EFFECTS = {effect.name: effect for effect in pp.catalogue}
#: The undeclared effects: a handle that pushes 29 degrees off, and a floor that slopes (rad, N).
WORLDS = {
    "actuator_rotation": {"actuator_rotation_angle": 0.5},
    "constant_force": {"constant_force_force_x": 0.0, "constant_force_force_y": 5.0},
}
NODES = 10_000
OUT = Path("out") / "wrong_model"
AGENTS = {
    "declared": "PBRL",
    "revising": "PBRL, closing the loop",
    "informed": "PBRL that knows the effect",
}


def world(name: str, sigma: float) -> pp.World:
    """The cart with an effect, and noise on what is observed."""
    truth = TRUTH | WORLDS[name]
    return pp.World(TASK, truth, (EFFECTS[name],), sigma=sigma, spread=SPREAD)


def agent(kind: str, effect: str, seed: int) -> pp.Agent:
    """One of the three."""
    known = (EFFECTS[effect],) if kind == "informed" else ()
    return pp.PBRLAgent(TASK, seed=seed, nodes=NODES, effects=known, revise=kind == "revising")


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over the first axis, and the ends of its 95 % interval."""
    found = stats.bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(1))
    return values.mean(axis=0), *found.confidence_interval


def ratio(revising: np.ndarray, informed: np.ndarray) -> list[float]:
    """Ratio of mean returns, and its 95 % interval over pairs of episodes of the same seed."""

    def of(one: np.ndarray, other: np.ndarray, axis: int = -1) -> np.ndarray:
        return one.mean(axis=axis) / other.mean(axis=axis)

    found = stats.bootstrap(
        (revising, informed), of, paired=True, method="percentile", rng=np.random.default_rng(1)
    )
    return [float(each) for each in (of(revising, informed), *found.confidence_interval)]


def added(episode: pp.Episode) -> str:
    """Which effect's parameters the agent believed in at the end, and since which step."""
    estimate = episode.dataset["estimate"]
    found = []
    for label in estimate["parameter"].to_numpy():
        effect = next((name for name in EFFECTS if label.startswith(f"{name}_")), None)
        known = np.isfinite(estimate.sel(parameter=label).to_numpy())
        if effect and known[-1]:
            since = len(known) - int(np.argmin(known[::-1])) if not known.all() else 0
            found.append(f"{effect} after {since + 1}")
    return ", ".join(dict.fromkeys(found)) or "nothing"


def summary(kind: str, episodes: list[pp.Episode], steps: int) -> dict[str, object]:
    """A row of the table."""
    total, low, high = interval(np.array([each.rewards(steps).sum() for each in episodes]))
    reached = [episode.steps for episode in episodes if episode.reached]
    seconds = np.concatenate([episode.dataset["seconds"] for episode in episodes])
    return {
        "agent": AGENTS[kind],
        "reached": f"{len(reached)}/{len(episodes)}",
        "steps to goal (median)": f"{np.median(reached):.0f}" if reached else "-",
        "return (m)": f"{total:.0f} [{low:.0f}, {high:.0f}]",
        "s a step (median)": f"{np.median(seconds):.2f}",
    }


def main() -> None:
    """Run what is missing, print the tables, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--sigma", type=float, default=0.0, help="noise (m, rad, m/s, rad/s)")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--quick", action="store_true", help="two episodes of 4 steps, for CI")
    options = parser.parse_args()
    episodes, steps = (2, 4) if options.quick else (options.episodes, options.steps)
    if episodes < 2:
        parser.error("--episodes: an interval needs at least 2")
    if steps < 1 or options.workers < 1:
        parser.error("--steps and --workers: expected 1 or more")
    if not 0 <= options.sigma < np.inf:
        parser.error("--sigma: expected a finite number from 0 up")
    out = OUT.with_name("wrong_model_quick") if options.quick else OUT
    out = out / f"sigma_{options.sigma:g}"
    figure, axes = plt.subplots(
        1, len(WORLDS), figsize=(10, 3.6), sharey=True, layout="constrained"
    )
    result: dict[str, dict[str, object]] = {}
    seconds = []
    for name, axis in zip(WORLDS, axes, strict=True):
        agents = {kind: partial(agent, kind, name) for kind in AGENTS}
        run = partial(
            pp.run_episodes, agents, world(name, options.sigma), range(1, episodes + 1), out / name,
            steps=steps, progress=partial(print, flush=True),
        )  # fmt: skip
        if options.workers > 1:
            with ProcessPoolExecutor(options.workers) as executor:
                done = run(executor=executor)
        else:
            done = run()
        print(f"\n{name} undeclared, {episodes} episodes of at most {steps} steps")
        rows = [summary(kind, each, steps) for kind, each in done.items()]
        print(pd.DataFrame(rows).to_string(index=False))
        returns = {
            kind: np.array([each.rewards(steps).sum() for each in own])
            for kind, own in done.items()
        }
        what = [added(episode) for episode in done["revising"]]
        print("added:", "; ".join(what))
        value, low, high = ratio(returns["revising"], returns["informed"])
        without = float(returns["declared"].mean() / returns["informed"].mean())
        print(f"ratio of returns {value:.2f} [{low:.2f}, {high:.2f}]; not closing {without:.2f}")
        result[name] = {
            "return_ratio": value,
            "return_ratio_interval": [low, high],
            "return_ratio_without": without,
            "returns": {kind: own.tolist() for kind, own in returns.items()},
            "added": what,
        }
        seconds += [episode.dataset["seconds"].to_numpy() for episode in done["revising"]]
        for kind, own in done.items():
            mean, low_, high_ = interval(np.array([episode.rewards(steps) for episode in own]))
            (line,) = axis.plot(mean, label=AGENTS[kind])
            axis.fill_between(
                np.arange(len(mean)), low_, high_, color=line.get_color(), alpha=0.2, linewidth=0
            )
        axis.set_title(f"{name.replace('_', ' ')} undeclared", loc="left", fontsize=10)
        axis.set_xlabel("steps")
    axes[0].set_ylabel("reward: minus the distance to the goal (m)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.savefig(out / "wrong_model.png", dpi=120)
    step = float(np.median(np.concatenate(seconds)))
    every = [
        np.concatenate([each["returns"][kind] for each in result.values()])  # type: ignore[index]
        for kind in ("revising", "informed")
    ]
    value, low, high = ratio(*every)
    print(
        f"\nonline_loop_return_ratio {value:.3f} [{low:.3f}, {high:.3f}], step_seconds {step:.2f}"
    )
    print(out / "wrong_model.png")
    if options.json:
        said = {
            "online_loop_return_ratio": value,
            "online_loop_return_ratio_interval": [low, high],
            "step_seconds": step,
            "worlds": result,
            "episodes": episodes,
            "steps": steps,
            "sigma": options.sigma,
        }
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(said, indent=1) + "\n")


if __name__ == "__main__":
    main()
