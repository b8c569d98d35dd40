"""Simulation-based calibration of everything that samples: prior, likelihood and sampler together.

    python analysis/benchmarks/calibration_cases.py                  # the cart: Eq. 11
    python analysis/benchmarks/calibration_cases.py --case pair      # two discs that collide

Each case is a small design: initial states, actions, and which coordinates are measured; the runner
is ``analysis/calibration.py``. ``--json`` prints one object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl import Transition
from pbrl_ppl.history import from_segments
from pbrl_ppl.state import STATE, WRENCH

sys.path.insert(0, str(Path(__file__).parents[1]))
from calibration import calibrate, table

RECORDED = Path(__file__).parents[2] / "models" / "shopping_cart" / "recorded" / "train.csv"
PRIOR = {
    "mass": {"mu": 1.8, "sigma": 0.3},
    "w_x": {"mu": -0.25, "sigma": 0.05},
    "w_y": {"mu": 0.0, "sigma": 0.05},
    "w_theta": {"mu": 0.1, "kappa": 10.0},
    "mu_x": {"mu": 0.1, "sigma": 0.1},
    "mu_y": {"mu": 0.5, "sigma": 0.15},
}
#: Errors of measuring a design's states (m, m, rad, m/s, m/s, rad/s): its velocities are no
#: derivatives of its positions.
NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)
#: How much is sampled; few draws suffice for 100 ranks.
USUAL, FEW = {"draws": 800, "tune": 400}, {"draws": 300, "tune": 300}
Design = tuple[pp.Scene, pp.History]


def cart(trajectories: int = 3, intervals: int = 4) -> Design:
    """Return a wheeled cart: the first intervals of the demo's first trajectories."""
    known = {"r": 0.2, "mu_c": 0.3}
    body = pp.Body("cart", pp.Shape.box(0.9, 0.55), wheel=True, known=known, prior=PRIOR)
    scene = pp.Scene(time_step=0.1, normal_gravity=9.81, substeps=5, bodies=(body,))
    rows = pd.read_csv(RECORDED)
    rows = rows[(rows["trajectory"] < trajectories) & (rows["step"] <= intervals)].copy()
    rows.loc[rows["step"] == intervals, list(WRENCH)] = np.nan  # the last row's
    return scene, pp.History.from_dataframe(rows, scene)


def pair() -> Design:
    """Return two discs that collide within each of 14 transitions, off centre and turning."""
    prior = {"mass": {"mu": 0.0, "sigma": 0.4}, "mu_c": {"mu": 0.3, "sigma": 0.2}}
    bodies = (
        pp.Body("a", pp.Shape.circle(0.1), prior={**prior, "r": {"mu": -1.0, "sigma": 0.5}}),
        # the engine multiplies both bodies' restitutions, and both frictions
        pp.Body("b", pp.Shape.circle(0.1), known={"r": 1.0, "mu_c": 1.0}, prior=prior_of("mass")),
    )
    scene = pp.Scene(time_step=0.1, substeps=5, bodies=bodies)
    rng = np.random.default_rng(1)
    start, actions = np.zeros((14, 2, 6)), rng.normal(0.0, 3.0, (14, 1, 2, 3)) * [1.0, 1.0, 0.02]
    aside = rng.uniform(-0.12, 0.12, 14)
    gap = rng.uniform(0.02, 0.06, 14)
    start[:, 1, 0], start[:, 1, 1] = np.sqrt((0.2 + gap) ** 2 - aside**2), aside
    start[:, 0, 3], start[:, 1, 3] = 1.0, -1.0
    start[:, :, 5] = rng.normal(0.0, 6.0, (14, 2))
    truth = {"mass": [1.0, 1.5], "r": 0.4, "mu_c": 0.3}
    return scene, simulated(scene, truth, start, actions)


def prior_of(*names: str) -> dict[str, dict[str, float]]:
    """Return the prior of these parameters of small bodies."""
    every = {
        "mass": {"mu": 0.0, "sigma": 0.4},
        "linear_drag_coefficient": {"mu": 1.5, "sigma": 0.5},
    }
    return {name: every[name] for name in names}


def push() -> Design:
    """Return a block with friction on its support that a finger pushes, in 12 transitions."""
    block = pp.Body(
        "block", pp.Shape.box(0.2, 0.1), known={"r": 0.0}, effects=("sliding_friction",),
        prior={
            **prior_of("mass"), "mu_c": {"mu": 0.5, "sigma": 0.2},
            "sliding_friction_mu": {"mu": 0.3, "sigma": 0.1},
            "sliding_friction_radius": {"mu": np.log(0.06), "sigma": 0.3},
        },
    )  # fmt: skip
    known = {"r": 0.0, "mu_c": 1.0}
    finger = pp.Body("finger", pp.Shape.circle(0.02), kinematic=True, known=known)
    scene = pp.Scene(time_step=0.1, normal_gravity=9.81, substeps=5, bodies=(block, finger))
    n, rng = 12, np.random.default_rng(2)
    start, actions = np.zeros((n, 2, 6)), np.zeros((n, 1, 2, 3))
    start[:, 1, 0] = -0.1 - 0.02 - rng.uniform(0.0, 0.01, n)  # beside the short side
    start[:, 1, 1] = rng.uniform(-0.03, 0.03, n)
    actions[:, 0, 1, 0] = rng.uniform(0.3, 0.6, n)
    actions[:, 0, 1, 1] = rng.uniform(-0.4, 0.4, n)  # it slides along, or drags the side
    start[:, 1, 3:] = actions[:, 0, 1]
    start[:, 0, 3:] = rng.normal(0.0, [0.2, 0.2, 1.0], (n, 3))
    actions[:, 0, 0] = rng.normal(0.0, [4.0, 4.0, 0.2], (n, 3))
    truth = {"mass": 1.0, "mu_c": 0.4, "sliding_friction_mu": 0.3, "sliding_friction_radius": 0.06}
    return scene, simulated(scene, truth, start, actions)


def hinge() -> Design:
    """Return a driven pendulum whose pivot has viscous and dry friction, in 16 transitions."""
    rod = pp.Body(
        "rod", pp.Shape.box(0.4, 0.02), known={"r": 0.0, "mu_c": 0.0},
        effects=("pivot_damping", "pivot_friction"),
        prior={
            **prior_of("mass"),
            "pivot_damping_coefficient": {"mu": 0.1, "sigma": 0.04},
            "pivot_friction_torque": {"mu": 0.2, "sigma": 0.08},
        },
    )  # fmt: skip
    joint = pp.Joint("hinge", ("rod", "world"), (-0.2, 0.0), (0.0, 0.0))
    scene = pp.Scene(
        time_step=0.05, gravity=(0.0, -9.81), substeps=5, bodies=(rod,), joints=(joint,)
    )
    n, rng = 16, np.random.default_rng(3)
    # it turns little in a transition: an error of more than a turn is no Gaussian one
    angle, rate = rng.uniform(-np.pi, np.pi, n), rng.normal(0.0, 3.0, n)
    start, actions = np.zeros((n, 1, 6)), np.zeros((n, 1, 1, 3))
    start[:, 0, 0], start[:, 0, 1] = 0.2 * np.cos(angle), 0.2 * np.sin(angle)
    start[:, 0, 3], start[:, 0, 4] = -rate * start[:, 0, 1], rate * start[:, 0, 0]
    start[:, 0, 2], start[:, 0, 5] = angle, rate
    actions[:, 0, 0, 2] = rng.normal(0.0, 2.0, n)
    truth = {"mass": 1.0, "pivot_damping_coefficient": 0.1, "pivot_friction_torque": 0.2}
    history = simulated(scene, truth, start, actions)
    return scene, without(history, scene, "x", "y", "vx", "vy")


def disc(trajectories: int, intervals: int) -> Design:
    """Return a disc with linear drag, which forces push about."""
    body = pp.Body(
        "disc", pp.Shape.circle(0.2), known={"r": 0.0, "mu_c": 0.0}, effects=("linear_drag",),
        prior=prior_of("mass", "linear_drag_coefficient"),
    )  # fmt: skip
    scene = pp.Scene(time_step=0.1, substeps=2, bodies=(body,))
    rng = np.random.default_rng(4)
    # it turns little: an error of more than a turn is no Gaussian one
    start = rng.normal(0.0, [1.0, 1.0, 0.1, 1.0, 1.0, 0.1], (trajectories, 1, 6))
    actions = rng.normal(0.0, [6.0, 6.0, 0.002], (trajectories, intervals, 1, 3))
    truth = {"mass": 1.0, "linear_drag_coefficient": 1.5}
    return scene, simulated(scene, truth, start, actions)


def positions() -> Design:
    """Return the disc with its pose alone measured, in 3 trajectories of 8 intervals."""
    scene, history = disc(3, 8)
    return scene, without(history, scene, "vx", "vy", "omega")


def simulated(scene: pp.Scene, truth: Mapping[str, Any], start: Any, actions: Any) -> pp.History:
    """Return a history from these initial states, one trajectory each."""
    states = Transition(scene, truth).predict(start, actions)
    states += NOISE * np.random.default_rng(5).standard_normal(states.shape)
    return from_segments(scene, start, actions, states)


def without(history: pp.History, scene: pp.Scene, *columns: str) -> pp.History:
    """Return the history with these state dimensions not measured."""
    rows = history.to_dataframe()
    rows[[*set(columns) & set(STATE)]] = np.nan
    return pp.History.from_dataframe(rows, scene)


@dataclass(frozen=True)
class Case:
    """A design and how it is fitted.

    Parameters
    ----------
    design : callable
        Returns the scene and the history.
    options : dict
        Arguments of ``calibrate``.
    likelihood : str
        As of :func:`pbrl_ppl.physics_model`.
    """

    design: Callable[[], Design]
    options: dict[str, Any] = field(default_factory=dict)
    likelihood: str = "transitions"


CASES = {
    "cart": Case(cart),
    "trajectories": Case(lambda: cart(4, 8), likelihood="trajectories"),
    "pair": Case(pair, FEW),
    "push": Case(push, FEW),
    "hinge": Case(hinge),
    "positions": Case(positions, FEW, "trajectories"),
    "simulation": Case(lambda: disc(3, 30), {"colour": 0.8, **FEW}, "simulation"),
    "laplace": Case(lambda: disc(6, 10), {"method": "laplace"}),
}


def main() -> None:
    """Run the simulations and print whether the ranks are uniform."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", choices=[*CASES], default="cart")
    parser.add_argument("--simulations", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    case = CASES[asked.case]
    model = pp.physics_model(*case.design(), likelihood=case.likelihood)
    began = time.perf_counter()
    with ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool:
        options = {"seed": 4, "chains": 2, **USUAL, **case.options}
        data = calibrate(model, simulations=asked.simulations, run=pool.map, **options)
    seconds, rows = time.perf_counter() - began, table(data)
    if not asked.json:
        print(rows.to_string())
    judged = rows[rows["judged"]]
    figures = {
        "case": asked.case,
        "passed": bool(judged["passed"].all()),
        "simulations": asked.simulations,
        "least_p": float(judged["p_corrected"].min()),
        "coverage_50": [float(judged["coverage_50"].min()), float(judged["coverage_50"].max())],
        "coverage_90": [float(judged["coverage_90"].min()), float(judged["coverage_90"].max())],
        "max_rhat": float(rows["r_hat"].max()),
        "redrawn": data.attrs["redrawn"],
        # of one process, its start included
        "seconds_each": round(seconds * asked.jobs / asked.simulations, 1),
    }
    print(json.dumps(figures) if asked.json else figures)


if __name__ == "__main__":
    main()
