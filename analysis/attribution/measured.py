"""What the loop makes of measured bodies: errors of forecasts on recordings it never saw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.criticism import revise
from pbrl_ppl.criticism.forecast import forecast
from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.effects import attach
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import find_mode, trajectory_mode

#: The recordings lie beside the project, which holds no copy.
SHARED = Path(__file__).parents[3] / "shared"
SWING = SHARED / "data" / "real" / "pendulum-swing"
ARMS = SHARED / "data" / "real" / "double-pendulum-driven"
PUSHED = SHARED / "contact" / "planar-push"


def pendulum_errors(folder: Path = SWING, seed: int = 0) -> dict[str, float | None]:
    """Root mean square errors of the angle (rad) at the end of 1 s and 2 s; None without the data.

    ``pendulum``: angle and angular velocity as recorded; ``pendulum_angle_only``: the angle alone,
    velocities estimated from it.
    """
    errors: dict[str, float | None] = {}
    for key, angle_only in (("pendulum", False), ("pendulum_angle_only", True)):
        told = _errors(folder, (1, 2), seed, angle_only) if folder.is_dir() else {}
        errors |= {f"{key}_{seconds}s": told.get(seconds) for seconds in (1, 2)}
    return errors


def double_pendulum_errors(folder: Path = ARMS, seed: int = 0) -> dict[str, float | None]:
    """Root mean square error of both arms' angles (rad) at the end of 0.1 s; None without data."""
    told = _errors(folder, (0.1,), seed) if folder.is_dir() else {}
    return {"double_pendulum_01s": told.get(0.1)}


def push_errors(folder: Path = PUSHED, seed: int = 0) -> dict[str, float | None]:
    """Root mean square errors of a pushed block's last pose: mm in the plane, and degrees.

    A push lasts many intervals and is seen at its end alone: forecasts of held-out data end there.
    """
    if not folder.is_dir():
        return {"push_mm": None, "push_deg": None}
    scene = pp.Scene.load(folder / "scene.toml")
    train, test = (pp.History.load(folder / f"{name}.csv", scene) for name in ("train", "test"))
    error = revise(scene, train, test, seed=seed, method="laplace").after.rollout_rmse
    return {
        "push_mm": 1e3 * float(np.hypot(error["x"], error["y"])),
        "push_deg": float(np.degrees(error["theta"])),
    }


#: What can be asked for. Each takes minutes, the loop on its recording (twice for the pendulum).
MEASURED: dict[str, Callable[..., dict[str, float | None]]] = {
    "pendulum": pendulum_errors,
    "double_pendulum": double_pendulum_errors,
    "push": push_errors,
}


def _errors(
    folder: Path, ahead: tuple[float, ...], seed: int, angle_only: bool = False
) -> dict[float, float]:
    """Errors of angles after so many seconds with the effects that the loop adds."""
    scene = pp.Scene.load(folder / "scene.toml")

    def recording(name: str) -> pp.History:
        frame = pd.read_csv(folder / f"{name}.csv")
        if angle_only:
            frame = frame.assign(omega=float("nan"))
        return pp.History.from_dataframe(frame, scene, estimate_velocities=angle_only)

    train, test = recording("train"), recording("test")
    found = revise(scene, train, test, seed=seed, method="laplace")
    by_name = {effect.name: effect for effect in pp.catalogue}
    added = [by_name[each.effect].on(each.body) for each in found.added]
    problem = Problem.of(
        scene, train, attach(scene, added), substeps=found.numerical.substeps_used, threads=2
    )
    mode = trajectory_mode(problem, find_mode(problem, seed=seed).phi)
    held_out = HeldOut(test, seed).problem(mode)
    return {
        seconds: forecast(held_out, mode.phi, mode.sigma, round(seconds / scene.time_step)).rmse()[
            "theta"
        ]
        for seconds in ahead
    }
