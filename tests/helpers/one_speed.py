"""Recordings of a sliding box, by Box2D, with two confounded effects."""

from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd

from tests.helpers.free_puck import MASS

#: Of the drags, kg/s and kg/m: at 1 m/s both brake alike.
SIZE = 0.6


def record(
    make_history: ModuleType, start: Any, wrenches: Any, number: int, seed: int, **hidden: Any
) -> pd.DataFrame:
    """Return rows of one trajectory, from a state (6,) under wrenches (time, 3)."""
    setup = make_history.Setup(name="puck", size=(0.4, 0.3), mass=MASS, r=0.1, mu_c=0.3)
    start, wrenches = np.asarray(start, dtype=float), np.asarray(wrenches, dtype=float)
    states = make_history.rollout(setup, start, wrenches, make_history.Effects(**hidden))
    noise = np.random.default_rng([seed, number]).standard_normal(states.shape)
    frame = pd.DataFrame({"trajectory": number, "step": range(len(states))})
    frame["time"] = (frame["step"] * setup.time_step).round(6)
    frame["body"] = setup.name
    frame[["x", "y", "theta", "vx", "vy", "omega"]] = states + noise * np.array(setup.noise)
    frame[["force_x", "force_y", "torque"]] = np.vstack([wrenches, np.full(3, np.nan)])
    return frame


def at_one_speed(make_history: ModuleType, seed: int, **hidden: Any) -> pd.DataFrame:
    """Return six trajectories at about 1 m/s: pushes balance the drag, and some are sideways.

    The latter tell the mass; a torque now and then turns the box.
    """
    rng = np.random.default_rng(seed)
    frames = []
    for number in range(6):
        way, turned = rng.uniform(0.0, 2 * np.pi), rng.uniform(-3.0, 3.0)
        along = np.array([np.cos(way), np.sin(way)])
        across = 0.6 * np.array([1, 1, -1, -1, -1, -1, 1, 1])
        wrenches = np.zeros((8, 3))
        wrenches[:, :2] = SIZE * along + across[:, None] * np.array([-along[1], along[0]])
        wrenches[:, 2] = rng.normal(0.0, 0.05, 8)
        start = [0.0, 0.0, turned, *along, rng.normal()]
        frames.append(record(make_history, start, wrenches.round(6), number, seed, **hidden))
    return pd.concat(frames, ignore_index=True)
