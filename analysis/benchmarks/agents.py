"""Benchmark of the agents: numbers of figure 4 and of the wrong model, from what is kept.

    python analysis/benchmarks/agents.py              # the table of README.md
    python analysis/benchmarks/agents.py --json       # one JSON object
    python analysis/benchmarks/agents.py --results out/shopping_cart out/apartment   # of own runs

The runs themselves are `analysis/04_shopping_cart.py`, `05_apartment.py` and `06_wrong_model.py`.
What there is no result of is null.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import stats

KEPT = Path(__file__).parents[1] / "results"
#: True values of what two steps can tell (mu_y is open until the wheel slides sideways).
TRUTH = {"mass[cart]": 8.0, "w_x[cart]": -0.25, "mu_x[cart]": 0.04}
#: Steps after which parameters are looked at, and how near is right (a share).
LEARNED, RIGHT = 2, 0.03


def found(folders: list[Path], name: str) -> xr.Dataset | None:
    """Results of a name, from the first folder that has them."""
    for folder in folders:
        path = folder / f"{name}.nc"
        if path.is_file():
            try:
                with xr.open_dataset(path, engine="h5netcdf") as opened:
                    return opened.load()
            except Exception as error:  # HDF5 raises many kinds on a damaged file
                sys.exit(f"error: {path}: this is not a NetCDF file: {error}")
    return None


def cart(data: xr.Dataset, prefix: str = "") -> dict[str, float]:
    """Numbers of figure 4(a) or 4(b)."""
    reward = data["reward"].transpose("agent", "seed", "time")
    last = -reward.isel(time=-1)
    total = reward.sum("time")
    limit = data.sizes["step"]
    # an agent that did not arrive needs more than all steps
    steps = data["seconds"].notnull().sum("step").where(data["reached"] > 0, limit)
    bumps = data["bumped"].sum("step").mean("seed")
    gap = (last.sel(agent="pbrl") - last.sel(agent="true")).to_numpy()
    low, high = stats.bootstrap((gap,), np.mean, rng=np.random.default_rng(1)).confidence_interval
    out = {
        "pbrl_over_true": ratio(last.mean("seed"), "pbrl", "true"),
        "pbrl_minus_true_low": float(low),
        "pbrl_minus_true_high": float(high),
        "pbrl_return_over_true": ratio(total.mean("seed"), "pbrl", "true"),
        "pbrl_steps_over_true": ratio(steps.median("seed"), "pbrl", "true"),
        "oolwr_steps_over_pbrl": ratio(steps.median("seed"), "oolwr", "pbrl"),
        "oolwr_bumps_over_pbrl": ratio(bumps, "oolwr", "pbrl"),
        "lwr_plateau": median_of_lost(last, data["reached"]),
    }
    out |= {f"{name}_success": float(data["reached"].sel(agent=name).mean()) for name in NAMES}
    return {f"{prefix}{key}": value for key, value in out.items()}


NAMES = ("true", "pbrl", "oolwr", "lwr")


def ratio(values: xr.DataArray, one: str, other: str) -> float:
    """Value of an agent over that of another."""
    return float(values.sel(agent=one) / values.sel(agent=other))


def median_of_lost(last: xr.DataArray, reached: xr.DataArray) -> float:
    """Where LWR ends in the episodes in which it does not reach the goal (m)."""
    return float(last.where(reached == 0).sel(agent="lwr").median())


def right_after_two(data: xr.Dataset) -> float:
    """Share of episodes in which PBRL has the parameters right after two steps."""
    estimate = data["estimate"].sel(agent="pbrl", step=LEARNED)
    right = [
        abs(estimate.sel(parameter=name) / value - 1.0) <= RIGHT for name, value in TRUTH.items()
    ]
    return float(np.logical_and.reduce([each.to_numpy() for each in right]).mean())


def apartment(data: xr.Dataset, agent: str) -> float | None:
    """Share of valid plans after the most observations."""
    if agent not in data["agent"].to_numpy():
        return None
    valid = data["valid"].sel(agent=agent).dropna("observations", how="all")
    return float(valid.isel(observations=-1).mean())


#: Of the agent that closes the loop online, over the one that knows the undeclared effect.
ONLINE = tuple(f"online_loop_{each}" for each in (
    "return_ratio", "return_ratio_low", "return_ratio_high", "return_ratio_without", "step_seconds",
))  # fmt: skip


def online(data: xr.Dataset) -> dict[str, float]:
    """Ratios of mean returns over all worlds, their 95 % interval, and the same by world."""
    returns = data["reward"].sum("time").transpose("agent", "world", "seed")
    closing, without, informed = (
        returns.sel(agent=name).to_numpy() for name in ("revising", "declared", "informed")
    )

    def of(one: np.ndarray, other: np.ndarray, axis: int = -1) -> np.ndarray:
        return one.mean(axis=axis) / other.mean(axis=axis)

    # episodes of a seed are a pair: they begin at the same place
    low, high = stats.bootstrap(
        (closing.ravel(), informed.ravel()), of, paired=True, method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval  # fmt: skip
    seconds = float(np.nanmedian(data["seconds"].sel(agent="revising")))
    whole = [of(each.ravel(), informed.ravel()) for each in (closing, without)]
    values = (whole[0], low, high, whole[1], seconds)
    keys = {key: float(value) for key, value in zip(ONLINE, values, strict=True)}
    for i, world in enumerate(data["world"].to_numpy()):
        keys[f"{ONLINE[0]}_{world}"] = float(of(closing[i], informed[i]))
        keys[f"{ONLINE[3]}_{world}"] = float(of(without[i], informed[i]))
    return keys


def numbers(folders: list[Path]) -> dict[str, float | None]:
    """All keys."""
    keys: dict[str, float | None] = {}
    free, noisy, rooms = (found(folders, f"figure_4{panel}") for panel in "abc")
    wrong = found(folders, "wrong_model")
    if free is not None:
        keys |= cart(free) | {"pbrl_right_after_two": right_after_two(free)}
        seconds = free["seconds"].sel(agent="pbrl").to_numpy()
        keys["step_seconds"] = float(np.nanmedian(seconds))
        keys["step_seconds_mean"] = float(np.nanmean(seconds))
    if noisy is not None:
        keys |= cart(noisy, "noisy_")
        keys["noisy_step_seconds"] = float(np.nanmedian(noisy["seconds"].sel(agent="pbrl")))
    agents = {"oolwr": "oolwr", "pbrl": "pbrl", "continuous": "continuous", "true": "true"}
    for name, agent in agents.items():
        keys[f"apartment_{name}_success"] = None if rooms is None else apartment(rooms, agent)
    if rooms is not None:
        models = rooms["models"].sel(agent="oolwr").dropna("observations", how="all")
        keys["apartment_oolwr_models"] = float(models.isel(observations=-1).mean())
        for agent in ("oolwr", "pbrl", "continuous"):
            if agent in rooms["agent"].to_numpy():
                tried = rooms["valid"].sel(agent=agent).dropna("observations", how="all")
                keys[f"apartment_{agent}_seeds"] = int(tried.notnull().any("observations").sum())
    return keys | (dict.fromkeys(ONLINE) if wrong is None else online(wrong))


def main() -> None:
    """Print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, nargs="+", default=[KEPT], help="folders")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args()
    keys = numbers(options.results)
    if options.json:
        print(json.dumps(keys, indent=1))
        return
    for key, value in keys.items():
        print(f"{key:52} {'-' if value is None else f'{value:.3g}'}")


if __name__ == "__main__":
    main()
