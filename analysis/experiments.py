"""Shared code of the paper's experiments 04 to 07: intervals, curves, files with their origin."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from episodes import Episode, EpisodeError
from matplotlib.axes import Axes
from scipy import stats

from pbrl_ppl.system.files import write_atomically


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean over the first axis and the ends of its 95 % interval (bootstrap)."""
    if len(values) < 2:
        return values.mean(axis=0), values.mean(axis=0), values.mean(axis=0)
    found = stats.bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(1))
    return values.mean(axis=0), *found.confidence_interval


def share(hits: np.ndarray) -> tuple[float, float, float]:
    """Return the share of hits and the ends of its 95 % interval (Wilson)."""
    found = stats.binomtest(int(hits.sum()), len(hits)).proportion_ci(method="wilson")
    return float(hits.mean()), float(found.low), float(found.high)


def curve(axis: Axes, values: np.ndarray, label: str, color: str | None = None) -> None:
    """Draw the mean of curves, shape (seed, step), with its interval."""
    mean, low, high = interval(values)
    (line,) = axis.plot(mean, label=label, color=color)
    axis.fill_between(
        np.arange(len(mean)), low, high, color=line.get_color(), alpha=0.2, linewidth=0
    )


def origin(command: str) -> dict[str, str]:
    """Return the command, the versions and the commit that made a result, for its attributes."""
    packages = ("pbrl_ppl", "pymunk", "pymc", "numpy")
    said = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--exclude", "*"],
        cwd=Path(__file__).parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return {
        "command": f"python analysis/{command}",
        "versions": ", ".join(f"{name} {version(name)}" for name in packages),
        "commit": said.stdout.strip() or "unknown",
    }


def of_episodes(
    done: Mapping[str, list[Episode]], steps: int, variables: tuple[str, ...]
) -> xr.Dataset:
    """Return rewards and some variables of all episodes, NaN by step after the goal is reached."""
    agents = []
    for episodes in done.values():
        every = []
        for episode in episodes:
            own = episode.dataset[list(variables)].astype(float)
            own = own.assign_coords(interval=np.arange(1, episode.steps + 1))
            own = own.reindex(interval=np.arange(1, steps + 1)).rename(interval="step")
            own["reward"] = ("time", episode.rewards(steps))
            own["reached"] = float(episode.reached)
            own["added"] = added(episode)
            every.append(own.drop_attrs())
        seeds = pd.Index([episode.seed for episode in episodes], name="seed")
        agents.append(xr.concat(every, seeds, join="outer"))
    return xr.concat(agents, pd.Index(list(done), name="agent"), join="outer").drop_encoding()


def added(episode: Episode) -> str:
    """Return the effects that an agent had added at the end, and after how many transitions."""
    found = [f"{each['effect']} after {each['transitions']}" for each in episode.added]
    return ", ".join(found) or "nothing"


def summary(name: str, episodes: list[Episode], steps: int) -> dict[str, object]:
    """Return a row of the table of an experiment's agents."""
    rewards = np.array([episode.rewards(steps) for episode in episodes])
    reached = [episode.steps for episode in episodes if episode.reached]
    total, low, high = interval(rewards.sum(axis=1))
    seconds = np.concatenate([episode.dataset["seconds"] for episode in episodes])
    return {
        "agent": name,
        "reached": f"{len(reached)}/{len(episodes)}",
        "steps to goal (median)": f"{np.median(reached):.0f}" if reached else "-",
        "bumps (mean)": f"{np.mean([episode.bumps for episode in episodes]):.1f}",
        "return (m)": f"{total:.0f} [{low:.0f}, {high:.0f}]",
        "final reward (m)": f"{rewards[:, -1].mean():.2f}",
        "s a step (median)": f"{np.median(seconds):.2f}",
    }


def save(data: xr.Dataset, path: Path) -> None:
    """Write a small NetCDF file atomically."""
    packed = {name: {"zlib": True} for name in data if data[name].dtype.kind == "f"}
    write_atomically(path, lambda to: data.to_netcdf(to, engine="h5netcdf", encoding=packed))


def to_end(run: Callable[[], None], kept: str = "episodes") -> None:
    """Run an experiment; exit with 2 and one message on a bad input, with 130 on Ctrl-C."""
    try:
        run()
    except EpisodeError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"interrupted: finished {kept} are kept; go on with --resume", file=sys.stderr)
        sys.exit(130)
