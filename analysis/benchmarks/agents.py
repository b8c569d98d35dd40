"""Benchmark of the agents: the numbers of the paper's experiments, from stored results.

    python analysis/benchmarks/agents.py              # a table, with the bounds
    python analysis/benchmarks/agents.py --json       # one JSON object
    python analysis/benchmarks/agents.py --results out/paper   # of own runs

The runs themselves are `analysis/04_shopping_cart.py` to `07_scaling.py`, all of them `make paper`.
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
#: What is to be reached: at most (-1) or at least (1).
BOUNDS = {
    "pbrl_return_over_true": (-1, 1.15),
    "oolwr_steps_over_pbrl": (1, 1.5),
    "step_seconds_mean": (-1, 1.5),
    "noisy_step_seconds_mean": (-1, 1.5),
    "apartment_pbrl_success": (1, 0.9),
    "apartment_continuous_success": (1, 0.9),
    "apartment_oolwr_success": (-1, 0.1),
    "online_loop_return_ratio": (-1, 1.1),
}
APARTMENT = ("true", "pbrl", "continuous", "oolwr", "oolwr_by_object")


def found(folders: list[Path], name: str) -> xr.Dataset | None:
    """Return the results of a name, from the first folder that has them."""
    for folder in folders:
        path = folder / f"{name}.nc"
        if path.is_file():
            try:
                with xr.open_dataset(path, engine="h5netcdf") as opened:
                    return opened.load()
            except Exception as error:  # HDF5 raises many kinds on a damaged file
                sys.exit(f"error: {path}: this is not a NetCDF file: {error}")
    return None


def ratio(one: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """Return the ratio of the means of two agents' values, its 95 % interval and a p-value.

    Episodes of a seed are a pair, for they begin at the same place: the interval is a bootstrap of
    pairs, and the p-value that of a permutation test of no difference, which swaps pairs.
    """

    def of(one: np.ndarray, other: np.ndarray, axis: int = -1) -> np.ndarray:
        return one.mean(axis=axis) / other.mean(axis=axis)

    def difference(one: np.ndarray, other: np.ndarray, axis: int = -1) -> np.ndarray:
        return (one - other).mean(axis=axis)

    keys = {"": float(of(one, other))}
    if len(one) < 2 or np.array_equal(one, other):
        return keys | {"_low": keys[""], "_high": keys[""], "_p_value": 1.0}
    pair = (one, other)
    low, high = stats.bootstrap(
        pair, of, paired=True, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    test = stats.permutation_test(
        pair, difference, permutation_type="samples", rng=np.random.default_rng(1)
    )
    return keys | {"_low": float(low), "_high": float(high), "_p_value": float(test.pvalue)}


def cart(data: xr.Dataset, prefix: str = "") -> dict[str, float]:
    """Return the numbers of figure 4(a) or 4(b)."""
    last, total = -data["reward"].isel(time=-1), data["reward"].sum("time")
    # an agent that did not arrive needs more than all steps
    steps = data["seconds"].notnull().sum("step").where(data["reached"] > 0, data.sizes["step"])
    bumps = data["bumped"].sum("step").mean("seed")
    names = data["agent"].to_numpy()

    def over(values: xr.DataArray, one: str, other: str) -> float:
        return float(values.sel(agent=one) / values.sel(agent=other))

    pbrl, true = (total.sel(agent=name).to_numpy() for name in ("pbrl", "true"))
    out = {f"pbrl_return_over_true{key}": value for key, value in ratio(pbrl, true).items()}
    out["pbrl_steps_over_true"] = over(steps.median("seed"), "pbrl", "true")
    out["oolwr_steps_over_pbrl"] = over(steps.median("seed"), "oolwr", "pbrl")
    out["oolwr_bumps_over_pbrl"] = over(bumps, "oolwr", "pbrl")
    out["lwr_plateau"] = float(last.where(data["reached"] == 0).sel(agent="lwr").median())
    out |= {f"{name}_success": float(data["reached"].sel(agent=name).mean()) for name in names}
    seconds = data["seconds"].sel(agent="pbrl").to_numpy()
    out["step_seconds"] = float(np.nanmedian(seconds))
    out["step_seconds_mean"] = float(np.nanmean(seconds))
    out["episodes"] = data.sizes["seed"]
    return {f"{prefix}{key}": value for key, value in out.items()}


def right_after_two(data: xr.Dataset) -> float:
    """Return the share of episodes in which PBRL has the parameters right after two steps."""
    estimate = data["estimate"].sel(agent="pbrl", step=LEARNED)
    right = [
        abs(estimate.sel(parameter=name) / value - 1.0) <= RIGHT for name, value in TRUTH.items()
    ]
    return float(np.logical_and.reduce([each.to_numpy() for each in right]).mean())


def apartment(data: xr.Dataset) -> dict[str, float]:
    """Return the share of valid plans after the most observations, with Wilson intervals."""
    keys: dict[str, float] = {}
    for name in APARTMENT:
        if name in data["agent"].to_numpy():
            valid = data["valid"].sel(agent=name).dropna("observations", how="all")
            hits = valid.isel(observations=-1).dropna("seed").to_numpy()
            ends = stats.binomtest(int(hits.sum()), len(hits)).proportion_ci(method="wilson")
            values = (hits.mean(), ends.low, ends.high, len(hits))
            for key, value in zip(("", "_low", "_high", "_seeds"), values, strict=True):
                kind = "seeds" if key == "_seeds" else f"success{key}"
                keys[f"apartment_{name}_{kind}"] = float(value)
            if name.startswith("oolwr"):
                models = data["models"].sel(agent=name).dropna("observations", how="all")
                keys[f"apartment_{name}_models"] = float(models.isel(observations=-1).mean())
    return keys


def acting(data: xr.Dataset) -> dict[str, float]:
    """Return what the agents of the apartment reach while they act."""
    total, keys = data["reward"].sum("time"), {}
    for name in data["agent"].to_numpy():
        keys[f"apartment_acting_{name}_reached"] = float(data["reached"].sel(agent=name).mean())
        if name != "true":
            one, true = (total.sel(agent=each).to_numpy() for each in (name, "true"))
            for key, value in ratio(one, true).items():
                keys[f"apartment_acting_{name}_return_over_true{key}"] = value
    return keys


def online(data: xr.Dataset, prefix: str = "online_loop_") -> dict[str, float]:
    """Return ratios of returns to that of the agent that knows the effect, over all worlds."""
    returns = data["reward"].sum("time").transpose("agent", "world", "seed")
    closing, without, informed = (
        returns.sel(agent=name).to_numpy() for name in ("revising", "declared", "informed")
    )
    keys = {}
    for key, one in (("return_ratio", closing), ("return_ratio_without", without)):
        whole = ratio(one.ravel(), informed.ravel())
        keys |= {f"{key}{end}": value for end, value in whole.items()}
        for i, world in enumerate(data["world"].to_numpy()):
            keys[f"{key}_{world}"] = ratio(one[i], informed[i])[""]
    keys["step_seconds"] = float(np.nanmedian(data["seconds"].sel(agent="revising")))
    keys["episodes"] = data.sizes["seed"]
    return {f"{prefix}{key}": value for key, value in keys.items()}


def scaling(data: xr.Dataset) -> dict[str, float]:
    """Return what one object and the most need: medians over seeds."""
    keys = {}
    for objects in (data["objects"].min().item(), data["objects"].max().item()):
        for name in ("conditions_met", "conditions_met_by_object", "observations_needed"):
            value = data[name].sel(objects=objects).median("seed")
            keys[f"scaling_{name}_{objects}"] = float(value)
    return keys


def numbers(folders: list[Path]) -> dict[str, float | None]:
    """Return all keys."""
    keys: dict[str, float | None] = dict.fromkeys(BOUNDS)
    for name, of in (
        ("figure_4a", lambda data: cart(data) | {"pbrl_right_after_two": right_after_two(data)}),
        ("figure_4b", lambda data: cart(data, "noisy_")),
        ("figure_4c", apartment),
        ("figure_4c_acting", acting),
        ("wrong_model", online),
        ("wrong_model_box2d", lambda data: online(data, "box2d_online_loop_")),
        ("scaling", scaling),
    ):
        data = found(folders, name)
        if data is not None:
            keys |= of(data)
    return keys


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
        sign, bound = BOUNDS.get(key, (0, 0.0))
        missed = sign and (value is None or sign * (value - bound) < 0)
        wanted = f"{'<=' if sign < 0 else '>='} {bound:g}{', missed' if missed else ''}"
        print(f"{key:54} {'-' if value is None else f'{value:.3g}':9} {wanted if sign else ''}")


if __name__ == "__main__":
    main()
