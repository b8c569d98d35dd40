"""Number of conditions of the baselines and observations of PBRL against the number of objects.

    python analysis/07_scaling.py            # one to eight objects, five seeds, in out/scaling
    python analysis/07_scaling.py --resume   # go on where a run was interrupted
    python analysis/07_scaling.py --quick    # one and two objects, a seed, for CI

Boxes on casters stand in a square room, close together: one of them is pushed at a time, at random.
Left: OO-LWR has a model for each condition of each body. There are 2^(|O| n_s) of them where a
condition tells what touches a sector (section 3.1.3 of the paper), 2^n_s where it tells only that
something does; shown are both bounds, and how many 1000 observations have met. Right: how many
observations PBRL needs until the mass of every box is known to 5 % (the mode of the posterior
against the truth, noise as of a motion capture). Each room is a process and a file of its own, all
of them are in scaling.nc.
"""

from __future__ import annotations

import argparse
import warnings
from concurrent.futures import as_completed
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from episodes import EpisodeError, processes, processors
from experiments import origin, save, to_end
from matplotlib.axes import Axes

import pbrl_ppl as pp
from pbrl_ppl import Body, Physics, Scene, Shape, Wall
from pbrl_ppl.model import problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.physics import Simulator, build_layout
from pbrl_ppl.state import STATE, WRENCH

OUT = Path("out") / "scaling"
#: Errors of measuring: m, m, rad, m/s, m/s, rad/s.
NOISE = np.array([0.001, 0.001, 0.002, 0.005, 0.005, 0.01])
#: Side of a box, and space between two (m).
SIDE, GAP = 0.5, 0.3
OBSERVED = 1000
#: Observations of an episode, each from the start.
LENGTH = 25
TOLERANCE = 0.05
CONTACTS = {
    "": pp.SectorContacts(radius=0.2),
    "_by_object": pp.SectorContacts(radius=0.2, by_object=True),
}


def room(objects: int) -> tuple[Scene, np.ndarray]:
    """Return a room with boxes in rows, and their poses, shape (body, 3)."""
    side = int(np.ceil(np.sqrt(objects)))
    half = 0.5 * side * (SIDE + GAP) + 0.5
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    walls = tuple(Wall(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
    # where the wheel is, and what contacts are like, is known: what is left is a mass a body
    known = {
        "r": 0.2,
        "mu_c": 0.3,
        "w_x": 0.0,
        "w_y": 0.0,
        "w_theta": 0.0,
        "mu_x": 0.05,
        "mu_y": 0.3,
    }
    bodies = tuple(
        Body(f"box{i + 1}", Shape.box(SIDE, SIDE), wheel=True, known=known) for i in range(objects)
    )
    place = np.arange(side) - 0.5 * (side - 1)
    grid = np.array([(x, y, 0.0) for y in place for x in place])[:objects]
    grid[:, :2] *= SIDE + GAP
    scene = Scene(normal_gravity=9.81, time_step=0.25, substeps=10, bodies=bodies, walls=walls)
    return scene, grid


def explore(
    objects: int, observations: int, seed: int
) -> tuple[Scene, dict[str, float], pd.DataFrame]:
    """Push boxes at random, one at a time; return scene, true masses and observations."""
    rng = np.random.default_rng([seed, objects])
    scene, grid = room(objects)
    layout = build_layout(scene)
    masses = rng.uniform(5.0, 20.0, objects)
    simulator = Simulator(Physics(scene, substeps=100))
    rows: list[dict[str, object]] = []
    for episode in range(-(-observations // LENGTH)):
        state = np.zeros((objects, 6))
        state[:, :3] = grid
        for step in range(min(LENGTH, observations - episode * LENGTH) + 1):
            last = step == min(LENGTH, observations - episode * LENGTH)
            wrench = np.zeros((objects, 3))
            wrench[rng.integers(objects)] = rng.normal(0.0, (25.0, 25.0, 2.0))
            seen = state + NOISE * rng.standard_normal(state.shape)
            for i, body in enumerate(scene.moving):
                row = {"trajectory": episode, "step": step, "time": 0.25 * step, "body": body.name}
                row |= dict(zip(STATE, seen[i], strict=True))
                row |= dict(zip(WRENCH, np.full(3, np.nan) if last else wrench[i], strict=True))
                rows.append(row)
            if not last:
                (state,) = simulator(masses, state[None], wrench[None, None])[:, 0]
    return scene, dict(zip(layout.labels, masses, strict=True)), pd.DataFrame(rows)


def conditions_met(scene: Scene, seen: pd.DataFrame, contacts: pp.SectorContacts) -> int:
    """Count pairs of a body and a condition, among states from which something was pushed."""
    pushed = seen[seen["force_x"].notna()]
    poses = pushed[["x", "y", "theta"]].to_numpy().reshape(-1, len(scene.moving), 3)
    found = contacts.conditions(scene, poses)
    return len({(i, condition) for state in found for i, condition in enumerate(state)})


def observations_needed(scene: Scene, masses: dict[str, float], seen: pd.DataFrame) -> float:
    """Return the smallest number of observations whose mode has every mass to 5 %, by doubling."""
    history = pp.History.from_dataframe(seen, scene)
    truth = np.array(list(masses.values()))

    def known(count: int) -> bool:
        whole, rest = divmod(count, LENGTH)
        frame = seen[
            (seen["trajectory"] < whole) | ((seen["trajectory"] == whole) & (seen["step"] <= rest))
        ]
        if rest == 0:
            frame = frame[frame["trajectory"] < whole]
        frame = frame.copy()
        ends = frame.groupby("trajectory")["step"].transform("max") == frame["step"]
        frame.loc[ends, list(WRENCH)] = np.nan
        part = pp.History.from_dataframe(frame, scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mode = find_mode(problem_in(pp.physics_model(scene, part)), seed=1)
        return bool((np.abs(mode.phi / truth - 1.0) < TOLERANCE).all())

    low, high = 0, 1
    while not known(high):
        low, high = high, 2 * high
        if high > history.n_transitions:
            return float("nan")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if known(middle) else (middle, high)
    return float(high)


def measured(objects: int, seed: int, observed: int, path: Path) -> xr.Dataset:
    """Measure a room, save the results in a file and return them."""
    scene, masses, seen = explore(objects, observed, seed)
    met = {
        f"conditions_met{kind}": float(conditions_met(scene, seen, contacts))
        for kind, contacts in CONTACTS.items()
    }
    needed = observations_needed(scene, masses, seen)
    values = met | {"observations_needed": needed}
    found = xr.Dataset(
        {name: (("seed", "objects"), [[value]]) for name, value in values.items()},
        {"seed": [seed], "objects": [objects]},
        {"observations": observed, "tolerance": TOLERANCE},
    )
    save(found, path)
    print(
        f"{objects} objects, seed {seed}: {met['conditions_met']:.0f} conditions"
        f" ({met['conditions_met_by_object']:.0f} by object), {needed:.0f} observations",
        flush=True,
    )
    return found


def stored(path: Path, observed: int) -> xr.Dataset:
    """Return the stored results of a room, if any.

    Raises
    ------
    EpisodeError
        If the file is damaged, or of other settings.
    """
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            found = opened.load()
    except Exception as error:  # HDF5 raises many kinds on a damaged file
        raise EpisodeError(f"{path}: this is not a NetCDF file: {error}") from None
    if found.attrs != {"observations": observed, "tolerance": TOLERANCE}:
        raise EpisodeError(f"{path}: this is a room with other settings; give another folder")
    return found


def measured_all(options: argparse.Namespace, counts: list[int], observed: int) -> xr.Dataset:
    """Measure the missing rooms; return the data of the figure."""
    folder = options.out / "rooms"
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("*.nc")) and not options.resume:
        raise EpisodeError(f"{folder}: there are rooms; go on with --resume, or give another --out")
    every, left = [], []
    for objects in counts:
        for seed in range(1, options.seeds + 1):
            path = folder / f"{objects}-{seed}.nc"
            if path.is_file():
                every.append(stored(path, observed))
            else:
                left.append((objects, seed, observed, path))
    workers = min(options.workers, len(left))
    if workers < 2:
        every += [measured(*each) for each in left]
    else:
        with processes(workers) as executor:
            running = [executor.submit(measured, *each) for each in left]
            every += [future.result() for future in as_completed(running)]
    whole = xr.combine_by_coords(every, combine_attrs="override")
    bodies, sectors = np.array(counts), CONTACTS[""].sectors
    bounds = {
        "conditions": ("objects", bodies * 2.0**sectors),
        "conditions_by_object": ("objects", bodies * 2.0 ** (bodies * sectors)),  # others and walls
    }
    return whole.assign(bounds).assign_attrs(origin(f"07_scaling.py --seeds {options.seeds}"))


def drawn(found: xr.Dataset, path: Path) -> None:
    """Draw the two panels."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    objects = found["objects"]
    observed = found.attrs["observations"]
    for kind, colour, bound, told in (
        ("_by_object", "#D55E00", "$|O|\\,2^{|O| n_s}$", "with what"),
        ("", "#E69F00", "$|O|\\,2^{n_s}$", "that something touches"),
    ):
        bounds = found[f"conditions{kind}"]
        left.semilogy(objects, bounds, "--", color=colour, label=f"possible: {bound}")
        bars(left, found[f"conditions_met{kind}"], colour, f"met in {observed}: {told}")
    bars(right, found["observations_needed"], "#0072B2", "PBRL, every mass to 5 %")
    left.set(xlabel="objects", ylabel="models of OO-LWR")
    right.set(xlabel="objects", ylabel="observations", ylim=(0, None))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)


def bars(axes: Axes, values: xr.DataArray, colour: str, label: str) -> None:
    """Draw the median over seeds, and the range."""
    middle, low, high = values.median("seed"), values.min("seed"), values.max("seed")
    axes.errorbar(
        values["objects"], middle, [middle - low, high - middle], fmt="o-", color=colour,
        capsize=3, label=label,
    )  # fmt: skip


def run() -> None:
    """Measure, save and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--workers", type=int, default=processors(), help="rooms at a time")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--resume", action="store_true", help="go on with what is in the folder")
    parser.add_argument("--quick", action="store_true", help="one and two objects, a seed")
    options = parser.parse_args()
    counts, observed = [1, 2, 3, 4, 6, 8], OBSERVED
    if options.quick:
        counts, observed, options.seeds = [1, 2], 50, 1
        options.out = options.out.with_name(options.out.name + "_quick")
    if options.seeds < 1 or options.workers < 1:
        parser.error("--seeds and --workers: expected 1 or more")
    found = measured_all(options, counts, observed)
    save(found, options.out / "scaling.nc")
    drawn(found, options.out / "scaling.png")
    print(f"figure: {options.out / 'scaling.png'}")


def main() -> None:
    """Run the experiment."""
    to_end(run, "rooms")


if __name__ == "__main__":
    main()
