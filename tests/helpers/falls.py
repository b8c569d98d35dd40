"""Measured falls in closed form: positions alone, with correlated errors."""

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene, Shape

GRAVITY, MASS = 9.81, 0.06  # m/s^2, kg
BALL = Scene(
    time_step=1 / 30, gravity=(0.0, -GRAVITY), normal_gravity=0.0,
    bodies=(Body("ball", Shape.circle(0.05), known={"mass": MASS, "r": 0.2, "mu_c": 0.2}),),
)  # fmt: skip


def fall(
    seed: int,
    *,
    terminal: float | None = None,
    trajectories: int = 1,
    rows: int = 45,
    sd: float = 0.01,
    memory: float = 0.9,
) -> History:
    """Return falls from rest, with quadratic drag if there is a terminal speed (m/s).

    The errors of measuring are AR(1) with standard deviation ``sd`` (m). The drag coefficient is
    ``MASS * GRAVITY / terminal**2`` (kg/m).
    """
    rng, time = np.random.default_rng(seed), np.arange(rows) / 30
    drop = 0.5 * GRAVITY * time**2
    if terminal is not None:
        drop = terminal**2 / GRAVITY * np.log(np.cosh(GRAVITY * time / terminal))
    frames = []
    for number in range(trajectories):
        white = np.sqrt(1 - memory**2) * rng.standard_normal(rows + 200)
        error = sd * lfilter([1.0], [1.0, -memory], white)[200:]
        frame = pd.DataFrame({"trajectory": number, "step": range(rows), "time": time.round(9)})
        frame["body"] = "ball"
        frame[["x", "theta", "vx", "vy", "omega"]] = np.nan
        frame["y"] = error - drop
        frame[["force_x", "force_y", "torque"]] = 0.0
        frame.loc[rows - 1, ["force_x", "force_y", "torque"]] = np.nan
        frames.append(frame)
    return History.from_dataframe(pd.concat(frames), BALL)
