"""Figure 4(c) of the paper: valid plans in the apartment against observations.

    python analysis/05_apartment.py                 # ten seeds of each agent, in out/apartment
    python analysis/05_apartment.py --resume        # go on where a run was interrupted
    python analysis/05_apartment.py --quick         # one seed and few observations, for CI
    python analysis/05_apartment.py --only oolwr --seeds 2 --workers 1
    python analysis/05_apartment.py --box2d         # the world in another engine than the agents'

Each trial of an agent is a process and a file of its own.
Observations are of random actions of the task, any of whose bodies is as likely, in episodes of 25
from the start. After so many of them an agent learns, and plans once from the start, with two
thirds of the goal's tolerances; its plan is played in the true world without looking. It is valid
if the goal is reached. The reward is that of the last state (m), of the start where there is no
plan.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from scipy import stats

import pbrl_ppl as pp
from pbrl_ppl.agents.processes import processes, processors
from pbrl_ppl.errors import EpisodeError
from pbrl_ppl.history import write_atomically

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
from apartment.task import TASK, TRUTH, library, world

OUT = Path("out") / "apartment"
#: Actions of an exploring episode.
LENGTH = 25
#: Search for a plan, the same for all agents; the true model's takes 3500 states.
SEARCH = {"weight": 5.0, "nodes": 20_000}
#: Numbers of observations at which agents plan; what is enough for PBRL need not be repeated.
COUNTS = {
    "true": (0,),
    "pbrl": (1, 3, 10, 30),
    "continuous": (30,),
    "oolwr": (10, 100, 1000),
}
NAMES = {
    "true": "true model",
    "pbrl": "PBRL, categorical",
    "continuous": "PBRL, continuous",
    "oolwr": "OO-LWR",
}


#: What a plan must reach in the model: what lies at the rim of the goal there may be outside.
AIM = pp.Goal(
    tuple(
        replace(goal, tolerance=goal.tolerance / 1.5, angle_tolerance=goal.angle_tolerance / 1.5)
        for goal in TASK.goal.targets
    )
)


class Explorer(pp.Agent):
    """Acts at random: first which body, then how."""

    name = "random"
    model = None

    def act(self, state: np.ndarray) -> np.ndarray:
        """One of the task's actions."""
        pushed = [action.body for action in self.task.actions.actions]
        body = self._rng.choice(sorted(set(pushed)))
        chosen = self._rng.choice([i for i, each in enumerate(pushed) if each == body])
        return self.task.wrenches(state)[chosen]

    def observe(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> None:
        """Learn nothing."""


def agent(name: str, seed: int) -> pp.Agent:
    """One of the four."""
    if name == "true":
        return pp.TrueModelAgent(TASK, TRUTH, seed=seed)
    if name == "pbrl":
        return pp.LibraryAgent(TASK, library(), seed=seed)
    kinds = {"continuous": partial(pp.PBRLAgent, sigma="scalar"), "oolwr": pp.OOLWRAgent}
    return kinds[name](TASK, seed=seed)


def explored(count: int, seed: int, sigma: float, box2d: bool) -> list[tuple[np.ndarray, ...]]:
    """Observed transitions."""
    found: list[tuple[np.ndarray, ...]] = []
    part = 0
    while len(found) < count:
        # seeds that no other run has
        own = 1000 * seed + part
        data = pp.run_episode(
            Explorer(TASK, seed=own), world(sigma, box2d=box2d), steps=LENGTH, seed=own
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
    """Plans of one agent after so many observations, and where they lead; kept in a file."""
    learner, seen = agent(name, seed), 0
    every = explored(max(counts), seed, sigma, box2d)
    rows = {key: [] for key in ("foreseen", "valid", "reward", "models", "update", "search")}
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
        # of OO-LWR: effect models so far, one a body and condition
        bodies = [body.name for body in TASK.scene.dynamic]
        models = (
            sum(len(learner.model.conditions(body)) for body in bodies) if name == "oolwr" else 0
        )
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
    attrs["scene"] = TASK.scene.to_toml()
    found = xr.Dataset(variables, {"observations": list(counts)}, attrs)
    write_atomically(path, lambda to: found.to_netcdf(to, engine="h5netcdf"))
    return found


def played(wrenches: np.ndarray, box2d: bool) -> tuple[bool, float]:
    """Whether a plan reaches the goal in the true world, and the last reward."""
    true = world(box2d=box2d)
    state = true.reset(0)
    for wanted in wrenches:
        # a body's heading is not quite what the plan foretold, and with it the wrench
        each = TASK.wrenches(state)
        outcome = true.step(each[np.argmin(((each - wanted) ** 2).sum(axis=(1, 2)))])
        state = outcome.state
        if outcome.reached:
            return True, outcome.reward
    return False, TASK.reward(state)


def stored(path: Path, counts: tuple[int, ...], options: argparse.Namespace) -> xr.Dataset:
    """A trial of an earlier run.

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
    if found.attrs.get("scene") != TASK.scene.to_toml():
        raise EpisodeError(f"{path}: this is a trial in another scene; give another folder")
    wanted = (counts, options.sigma, options.box2d)
    own = (found["observations"].to_numpy(), found.attrs["sigma"], found.attrs.get("box2d", 0))
    if (tuple(own[0]), *own[1:]) != wanted:
        raise EpisodeError(f"{path}: this is a trial with other settings; give another folder")
    return found


def run(options: argparse.Namespace, counts: dict[str, tuple[int, ...]]) -> xr.Dataset:
    """Run what is missing; all trials."""
    folder = options.out / f"sigma_{options.sigma:g}"
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("*.nc")) and not options.resume:
        raise EpisodeError(
            f"{folder}: there are trials; go on with --resume, or give another --out"
        )
    every, left = [], []
    for seed in range(1, options.seeds + 1):
        for name in options.only:
            path = folder / f"{name}-{seed}.nc"
            if path.is_file():
                every.append(stored(path, counts[name], options))
            else:
                left.append((name, seed, counts[name], options.sigma, options.box2d, path))
    workers = min(options.workers, len(left))
    if workers < 2:
        every += [trial(*each) for each in left]
    else:
        with processes(workers) as executor:
            running = [executor.submit(trial, *each) for each in left]
            every += [future.result() for future in as_completed(running)]
    return joined(every, options)


def joined(every: list[xr.Dataset], options: argparse.Namespace) -> xr.Dataset:
    """All trials in one small dataset: agent, seed, observations."""
    rows = [
        each.assign_coords(agent=each.attrs["agent"], seed=each.attrs["seed"])
        .expand_dims(["agent", "seed"])
        .drop_attrs()
        .astype(float)
        for each in every
    ]
    whole = xr.combine_by_coords(rows, combine_attrs="drop", join="outer")
    # a dataset may come back without a name
    whole = whole if isinstance(whole, xr.Dataset) else whole.to_dataset()
    command = f"python analysis/05_apartment.py --sigma {options.sigma:g}"
    command += " --box2d" * options.box2d
    return whole.assign_attrs(
        command=f"{command} --seeds {options.seeds} --only {' '.join(options.only)}",
        sigma=options.sigma, nodes=SEARCH["nodes"], start=TASK.reward(TASK.start),
        versions=", ".join(f"{p} {version(p)}" for p in ("pbrl_ppl", "pymunk", "pymc", "numpy")),
        scene=TASK.scene.to_toml(),
    )  # fmt: skip


def draw(data: xr.Dataset, path: Path) -> None:
    """Rewards and the share of valid plans against observations."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for name in data["agent"].to_numpy():
        own = data.sel(agent=name).dropna("observations", how="all")
        n = own["observations"].to_numpy()
        rewards = own["reward"].transpose("seed", "observations").to_numpy()
        low = high = mean = np.nanmean(rewards, axis=0)
        if len(rewards) > 1:
            ends = stats.bootstrap(
                (rewards,), np.mean, method="percentile", rng=np.random.default_rng(1)
            )
            low, high = ends.confidence_interval
        axes[0].errorbar(n, mean, [mean - low, high - mean], marker="o", label=NAMES[name])
        axes[1].plot(n, own["valid"].mean("seed"), marker="o")
    axes[0].set_ylabel("reward where the plan ends (m)")
    axes[1].set_ylabel("share of valid plans")
    for axis in axes:
        axis.set_xscale("symlog", linthresh=1)
        axis.set_xlabel("observations")
    figure.legend(loc="outside right center", frameon=False)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run what is missing, say what came out, draw."""
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
    counts = COUNTS
    if options.box2d:
        options.out = options.out.with_name(options.out.name + "_box2d")
    if options.quick:
        # the continuous prior of eleven bodies takes a minute
        counts = {"true": (0,), "pbrl": (3,), "oolwr": (3, 10)}
        options.only = [name for name in options.only if name in counts]
        options.seeds, options.out = 1, options.out.with_name(options.out.name + "_quick")
    if options.seeds < 1 or options.workers < 1:
        parser.error("--seeds and --workers: expected 1 or more")
    try:
        data = run(options, counts)
    except EpisodeError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print("interrupted: finished trials are kept; go on with --resume", file=sys.stderr)
        sys.exit(130)
    write_atomically(options.out / "figure_4c.nc", lambda to: data.to_netcdf(to, engine="h5netcdf"))
    draw(data, options.out / "figure_4c.png")
    print(data["valid"].mean("seed").to_pandas().to_string(na_rep="-"))
    print(f"\n{options.out / 'figure_4c.nc'}, figure_4c.png")


if __name__ == "__main__":
    main()
