"""What the loop makes of a measured pendulum: errors of forecasts on a recording it never saw."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.criticism import revise
from pbrl_ppl.criticism.forecast import forecast
from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.effects import attach
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import find_mode, trajectory_mode

#: The recording lies beside the project, which holds no copy.
SWING = Path(__file__).parents[3] / "shared" / "data" / "real" / "pendulum-swing"


def pendulum_errors(folder: Path = SWING, seed: int = 0) -> dict[str, float | None]:
    """Root mean square errors of the angle (rad) at the end of 1 s and 2 s; None without the data.

    ``pendulum``: angle and angular velocity as recorded; ``pendulum_angle_only``: the angle alone,
    velocities estimated from it.
    """
    errors: dict[str, float | None] = {}
    for key, angle_only in (("pendulum", False), ("pendulum_angle_only", True)):
        told = _errors(folder, angle_only, seed) if folder.is_dir() else {}
        errors |= {f"{key}_{seconds}s": told.get(seconds) for seconds in (1, 2)}
    return errors


def _errors(folder: Path, angle_only: bool, seed: int) -> dict[int, float]:
    """Errors after so many seconds with the effects that the loop adds."""
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
        for seconds in (1, 2)
    }
