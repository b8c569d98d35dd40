"""Figure 4(c) of the paper: plans and rewards in the apartment against observations.

    python analysis/05_apartment.py                 # ten seeds of each agent, in out/apartment
    python analysis/05_apartment.py --resume        # go on where a run was interrupted
    python analysis/05_apartment.py --quick         # one seed and few observations, for CI
    python analysis/05_apartment.py --only oolwr --seeds 2 --workers 1
    python analysis/05_apartment.py --box2d         # the world in another engine than the agents'

Plans: observations are of random actions of the task, any of whose bodies is as likely, in episodes
of 25 from the start; all agents of a seed observe the same. After so many of them an agent learns,
and plans once from the start, with two thirds of the goal's tolerances; its plan is played in the
true world without looking. It is valid if the goal is reached.

Rewards: the paper's axis. Agents act, observe and learn until the goal is reached, in 60 steps at
most.

Each trial of an agent is a process and a file of its own.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from episodes import (
    Episode,
    EpisodeError,
    World,
    processes,
    processors,
    run_episode,
    run_episodes,
)
from experiments import curve, of_episodes, origin, save, share, summary, to_end

import pbrl_ppl as pp

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
from apartment.task import TASK, TRUTH, library

OUT = Path("out") / "apartment"
#: Actions of an exploring episode, and of one in which an agent acts.
LENGTH, STEPS = 25, 60
#: Search for a plan, the same for all agents; the true model's takes 1200 states.
SEARCH = {"weight": 5.0, "nodes": 20_000}
#: Numbers of observations at which agents plan.
COUNTS = {
    "true": (0,),
    "pbrl": (1, 3, 10, 30),
    "continuous": (1, 3, 10, 30),
    "oolwr": (10, 100, 1000),
    "oolwr_by_object": (10, 100, 1000),
}
NAMES = {
    "true": "true model",
    "pbrl": "PBRL, categorical",
    "continuous": "PBRL, continuous",
    "oolwr": "OO-LWR",
    "oolwr_by_object": "OO-LWR, by object",
}
#: Agents that act, in searches of fewer states: there is one a step.
ACTING, ACTING_NODES = ("true", "pbrl", "continuous", "oolwr"), 5_000

#: What a plan must reach in the model: what lies at the rim of the goal there may be outside.
AIM = pp.Goal(
    tuple(
        replace(goal, tolerance=tolerance / 1.5, angle_tolerance=goal.angle_tolerance / 1.5)
        for goal, tolerance in zip(TASK.goal.targets, TASK.goal.tolerances(TASK.scene), strict=True)
    )
)


class Explorer(pp.Agent):
    """Agent that acts at random: it draws a body, then an action on it."""

    name = "random"
    model = None

    def act(self, state: np.ndarray) -> np.ndarray:
        """Return one of the task's actions."""
        pushed = [action.body for action in self.task.actions.actions]
        body = self._rng.choice(sorted(set(pushed)))
        chosen = self._rng.choice([i for i, each in enumerate(pushed) if each == body])
        return self.task.wrenches(state)[chosen]

    def observe(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> None:
        """Learn nothing."""


def agent(name: str, seed: int, **options: object) -> pp.Agent:
    """Return one of the five."""
    if name == "true":
        return pp.TrueModelAgent(TASK, TRUTH, seed=seed, **options)
    if name == "pbrl":
        return pp.LibraryAgent(TASK, library(), seed=seed, **options)
    if name == "continuous":
        return pp.PBRLAgent(TASK, seed=seed, **options)
    contacts = pp.SectorContacts(radius=0.2, by_object=name == "oolwr_by_object")
    return pp.OOLWRAgent(TASK, learner={"relations": (contacts,)}, seed=seed, **options)


def world(sigma: float, box2d: bool) -> World:
    """Return the true apartment, with noise in m, rad, m/s and rad/s."""
    if box2d:
        from episodes.box2d_world import Box2DWorld

        return Box2DWorld(TASK, TRUTH, sigma=sigma, step=0.0025)
    return World(TASK, TRUTH, sigma=sigma)


def explored(count: int, seed: int, sigma: float, box2d: bool) -> list[tuple[np.ndarray, ...]]:
    """Return a given number of observed transitions."""
    found: list[tuple[np.ndarray, ...]] = []
    part = 0
    while len(found) < count:
        # seeds that no other run has
        own = 1000 * seed + part
        data = run_episode(
            Explorer(TASK, seed=own), world(sigma, box2d), steps=LENGTH, seed=own
        ).dataset
        found += zip(
            data["states"].to_numpy()[:-1], data["action"].to_numpy(),
            data["observed"].to_numpy(), strict=True,
        )  # fmt: skip
        part += 1
    return found[:count]


def trial(
    name: str, seed: int, counts: tuple[int, ...], sigma: float, box2d: bool, path: Path
) -> xr.Dataset:
    """Plan after given numbers of observations, execute the plans, and save the results."""
    learner, seen = agent(name, seed), 0
    every = explored(max(counts), seed, sigma, box2d)
    rows = {key: [] for key in ("planned", "valid", "reward", "models", "update", "search")}
    for count in counts:
        for transition in every[seen:count]:
            learner.observe(*transition)
        seen, begin = count, time.monotonic()
        learner.update()
        learned = time.monotonic()
        plan = pp.plan(learner.model, TASK.start, AIM, TASK.actions, **SEARCH)
        searched = time.monotonic()
        valid, reward = False, TASK.reward(TASK.start)
        if plan.reached:
            valid, reward = played(plan.wrenches, box2d)
        # effect models of OO-LWR so far, one a body and condition
        conditions = getattr(learner.model, "conditions", lambda body: ())
        models = sum(len(conditions(body.name)) for body in TASK.scene.dynamic)
        new = (plan.reached, valid, reward, models, learned - begin, searched - learned)
        for key, value in zip(rows, new, strict=True):
            rows[key].append(value)
        print(
            f"{NAMES[name]}, seed {seed}, {count} observations:"
            f" {'valid plan' if valid else 'plan that fails' if plan.reached else 'no plan'},"
            f" {learned - begin:.1f} s to learn, {searched - learned:.1f} s to plan",
            flush=True,
        )
    variables = {key: ("observations", np.array(values)) for key, values in rows.items()}
    attrs = {"agent": name, "seed": seed, "sigma": sigma, "box2d": int(box2d)}
    found = xr.Dataset(variables, {"observations": list(counts)}, attrs | task_attributes())
    save(found, path)
    return found


def task_attributes() -> dict[str, str]:
    """Return the scene and the actions, for a file's attributes."""
    return {"scene": TASK.scene.to_toml(), "actions": str(TASK.actions)}


def played(wrenches: np.ndarray, box2d: bool) -> tuple[bool, float]:
    """Execute a plan in the true world; return whether it succeeds, and the last reward (m)."""
    true = world(0.0, box2d)
    state = true.reset(0)
    for wanted in wrenches:
        # a body's heading is not quite what the plan predicted, and with it the wrench
        each = TASK.wrenches(state)
        outcome = true.step(each[np.argmin(((each - wanted) ** 2).sum(axis=(1, 2)))])
        state = outcome.state
        if outcome.reached:
            return True, outcome.reward
    return False, TASK.reward(state)


def stored(path: Path, counts: tuple[int, ...], options: argparse.Namespace) -> xr.Dataset:
    """Return a trial of an earlier run.

    Raises
    ------
    EpisodeError
        If the file is of another scene or other settings.
    """
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            found = opened.load()
    except Exception as error:  # HDF5 raises many kinds on a damaged file
        raise EpisodeError(f"{path}: this is not a NetCDF file: {error}") from None
    if any(found.attrs.get(key) != value for key, value in task_attributes().items()):
        raise EpisodeError(f"{path}: this is a trial in another scene; give another folder")
    wanted = (counts, options.sigma, options.box2d)
    own = (found["observations"].to_numpy(), found.attrs["sigma"], found.attrs.get("box2d", 0))
    if (tuple(own[0]), *own[1:]) != wanted:
        raise EpisodeError(f"{path}: this is a trial with other settings; give another folder")
    return found


def plans(options: argparse.Namespace, counts: dict[str, tuple[int, ...]]) -> xr.Dataset:
    """Run the trials that are missing; return all of them by agent, seed and observations."""
    folder = options.out / f"sigma_{options.sigma:g}"
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("*.nc")) and not options.resume:
        raise EpisodeError(
            f"{folder}: there are trials; go on with --resume, or give another --out"
        )
    every, left = {}, []
    for seed in range(1, options.seeds + 1):
        for name in options.only:
            path = folder / f"{name}-{seed}.nc"
            if path.is_file():
                every[name, seed] = stored(path, counts[name], options)
            else:
                left.append((name, seed, counts[name], options.sigma, options.box2d, path))
    workers = min(options.workers, len(left))
    if workers < 2:
        every |= {each[:2]: trial(*each) for each in left}
    else:
        with processes(workers) as executor:
            running = {executor.submit(trial, *each): each[:2] for each in left}
            for future in as_completed(running):
                every[running[future]] = future.result()
    seeds = pd.Index(range(1, options.seeds + 1), name="seed")
    agents = [
        xr.concat([every[name, seed].drop_attrs().astype(float) for seed in seeds], seeds)
        for name in options.only
    ]
    return xr.concat(agents, pd.Index(options.only, name="agent"), join="outer").sortby(
        "observations"
    )


def acting(options: argparse.Namespace, steps: int) -> dict[str, list[Episode]]:
    """Run the episodes that are missing; return all of them by agent."""
    search = {**SEARCH, "nodes": ACTING_NODES}
    return run_episodes(
        {name: partial(agent, name, **search) for name in ACTING if name in options.only},
        world(options.sigma, options.box2d), range(1, options.seeds + 1),
        options.out / f"acting_{options.sigma:g}", steps=steps, workers=options.workers,
        progress=partial(print, flush=True),
    )  # fmt: skip


def draw(data: xr.Dataset, done: dict[str, list[Episode]], steps: int, path: Path) -> None:
    """Draw the share of valid plans against observations, and rewards against steps."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
    colours = {name: f"C{i}" for i, name in enumerate(NAMES)}
    for name in data["agent"].to_numpy():
        valid = data["valid"].sel(agent=name).dropna("observations", how="all")
        found = np.array([share(hits) for hits in valid.transpose("observations", "seed").values])
        mean, low, high = found.T
        at = valid["observations"].to_numpy() * 1.06 ** list(NAMES).index(name)  # side by side
        axes[0].errorbar(
            at, mean, [mean - low, high - mean], marker="o", capsize=2, label=NAMES[name],
            color=colours[name],
        )  # fmt: skip
    axes[0].set_xscale("symlog", linthresh=1)
    axes[0].set(xlabel="observations", ylabel="share of valid plans", ylim=(-0.03, 1.03))
    for name, episodes in done.items():
        rewards = np.array([episode.rewards(steps) for episode in episodes])
        curve(axes[1], rewards, NAMES[name], color=colours[name])
    axes[1].set(xlabel="steps", ylabel="reward: minus the distance to the goal (m)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.savefig(path, dpi=120)


def run() -> None:
    """Run what is missing, print the tables, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--sigma", type=float, default=0.0, help="noise of the observations")
    parser.add_argument("--only", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument("--workers", type=int, default=processors(), help="trials at a time")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--resume", action="store_true", help="go on with what is in the folder")
    parser.add_argument("--box2d", action="store_true", help="the world in Box2D")
    parser.add_argument("--quick", action="store_true", help="one seed, few observations, for CI")
    options = parser.parse_args()
    counts, steps = COUNTS, STEPS
    if options.box2d:
        options.out = options.out.with_name(options.out.name + "_box2d")
    if options.quick:
        counts, steps = {"true": (0,), "pbrl": (3,), "oolwr": (3, 10)}, 3
        options.only = [name for name in options.only if name in counts]
        options.seeds, options.out = 1, options.out.with_name(options.out.name + "_quick")
    if options.seeds < 1 or options.workers < 1:
        parser.error("--seeds and --workers: expected 1 or more")
    data, done = plans(options, counts), acting(options, steps)
    command = f"05_apartment.py --sigma {options.sigma:g}" + " --box2d" * options.box2d
    command += f" --seeds {options.seeds} --only {' '.join(options.only)}"
    about = origin(command) | task_attributes() | {"sigma": options.sigma}
    about |= {"start": TASK.reward(TASK.start), "nodes": SEARCH["nodes"]}
    save(data.assign_attrs(about), options.out / "figure_4c.nc")
    kept = of_episodes(done, steps, ("bumped", "planned", "seconds"))
    save(kept.assign_attrs(about), options.out / "figure_4c_acting.nc")
    draw(data, done, steps, options.out / "figure_4c.png")
    print(data["valid"].mean("seed").to_pandas().to_string(na_rep="-"))
    rows = [summary(NAMES[name], episodes, steps) for name, episodes in done.items()]
    print(pd.DataFrame(rows).to_string(index=False))
    print(f"\n{options.out / 'figure_4c.nc'}, figure_4c_acting.nc, figure_4c.png")


def main() -> None:
    """Run the experiment."""
    to_end(run, "trials")


if __name__ == "__main__":
    main()
