"""Simulation-based calibration of the cart: the prior, the likelihood and the sampler together.

    python analysis/benchmarks/calibration.py FOLDER                    # Eq. 11, 12 transitions
    python analysis/benchmarks/calibration.py FOLDER --trajectories     # whole trajectories, 32

The design is the beginning of the demo's recording; start states are measured with an error where
whole trajectories are whitened. Each replication is kept in the folder, where the same command
goes on. ``--json`` prints one object.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.state import WRENCH

RECORDED = Path(__file__).parents[2] / "models" / "shopping_cart" / "recorded" / "train.csv"
PRIOR = {
    "mass": {"mu": 1.8, "sigma": 0.3},
    "w_x": {"mu": -0.25, "sigma": 0.05},
    "w_y": {"mu": 0.0, "sigma": 0.05},
    "w_theta": {"mu": 0.1, "kappa": 10.0},
    "mu_x": {"mu": 0.1, "sigma": 0.1},
    "mu_y": {"mu": 0.5, "sigma": 0.15},
}


def design(trajectories: int, intervals: int) -> tuple[pp.Scene, pp.History]:
    """Return the scene, and the first intervals of the first trajectories."""
    known = {"r": 0.2, "mu_c": 0.3}
    cart = pp.Body("cart", pp.Shape.box(0.9, 0.55), wheel=True, known=known, prior=PRIOR)
    scene = pp.Scene(time_step=0.1, normal_gravity=9.81, substeps=5, bodies=(cart,))
    rows = pd.read_csv(RECORDED)
    rows = rows[(rows["trajectory"] < trajectories) & (rows["step"] <= intervals)].copy()
    rows.loc[rows["step"] == intervals, list(WRENCH)] = np.nan  # the last row's
    return scene, pp.History.from_dataframe(rows, scene)


def main() -> None:
    """Run the replications and print whether the ranks are uniform."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trajectories", action="store_true")
    parser.add_argument("--replications", type=int, default=210)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    scene, history = design(*((4, 8) if asked.trajectories else (3, 4)))
    with ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool:
        result = pp.calibrate(
            scene, history, trajectories=asked.trajectories, replications=asked.replications,
            seed=4, draws=800, tune=400, chains=2, folder=asked.folder, executor=pool,
            progress=not asked.json,
        )  # fmt: skip
    table = result.table()
    if not asked.json:
        print(table.to_string())
    figures = {
        "passed": result.passed,
        "replications": int(result.dataset.sizes["replication"]),
        "failures": len(result.failures),
        "least_p_holm": float(table["p_holm"].min()),
        "coverage_50": [float(table["coverage_50"].min()), float(table["coverage_50"].max())],
        "coverage_90": [float(table["coverage_90"].min()), float(table["coverage_90"].max())],
        "max_rhat": float(table["r_hat"].max()),
    }
    print(json.dumps(figures) if asked.json else figures)


if __name__ == "__main__":
    main()
