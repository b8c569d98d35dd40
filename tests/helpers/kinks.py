"""Histories of motion along a line with impacts, blows, dry friction and fast swings."""

from collections.abc import Callable
from functools import cache

import numpy as np
import numpy.typing as npt
import pandas as pd

from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.histories import COLUMNS

Floats = npt.NDArray[np.float64]
Law = Callable[[float, float], float]
#: What an impact or a blow makes of a position (m or rad), a velocity and a time (s).
Impact = Callable[[float, float, float], tuple[float, float]]
RADIUS = 0.05
MOTIONS = ("bounce", "walls", "struck", "dry friction", "swing", "spring and friction")
RATES = (10, 30, 100, 500)


def _dry(p: float, v: float) -> float:
    """Return dry friction of 3 m/s^2, smoothed within a few milliseconds of rest."""
    return -3.0 * np.clip(v / 0.01, -1.0, 1.0)


def motion(name: str, rng: np.random.Generator, dt: float, rows: int) -> Floats:
    """Return position and velocity of one trajectory, shape (time, 2): SI units, no noise."""
    restitution, blow = rng.uniform(0.3, 1.0), rng.uniform(0.1, 0.9) * rows * dt
    kick, start, speed = rng.normal(0.0, 3.0), rng.uniform(1.0, 3.0), rng.normal(0.0, 2.0)

    def floor(p: float, v: float, t: float) -> tuple[float, float]:
        return (-p, -restitution * v) if p < 0.0 else (p, v)

    def walls(p: float, v: float, t: float) -> tuple[float, float]:
        return (np.sign(p) * 2.0 - p, -restitution * v) if abs(p) > 1.0 else (p, v)

    def struck(p: float, v: float, t: float) -> tuple[float, float]:
        return p, v + kick * (t <= blow < t + step)

    def nothing(p: float, v: float, t: float) -> tuple[float, float]:
        return p, v

    laws: dict[str, tuple[Law, tuple[float, float], Impact]] = {
        "bounce": (lambda p, v: -9.81, (start / 2, 0.0), floor),
        "walls": (lambda p, v: -0.1 * v, (0.0, 2.0 * speed), walls),
        "struck": (lambda p, v: -0.3 * v, (0.0, speed / 4), struck),
        "dry friction": (_dry, (0.0, speed), nothing),
        "swing": (lambda p, v: -40.0 * np.sin(p) - 0.1 * v, (start, 0.0), nothing),
        "spring and friction": (lambda p, v: _dry(p, v) - 30.0 * p, (speed, 0.0), nothing),
    }
    law, (p, v), impact = laws[name]
    sub = max(10, int(2000 * dt))
    step, states = dt / sub, []
    for row in range(rows):
        states.append((p, v))
        for i in range(sub):
            v += step * law(p, v)
            p += step * v
            p, v = impact(p, v, row * dt + i * step)
    return np.array(states)


@cache
def states(name: str, rate: int, seed: int, trajectories: int) -> Floats:
    """Positions and velocities without noise, shape (trajectory, time, 2)."""
    rng, rows = np.random.default_rng(seed), int(np.clip(1.5 * rate, 40, 120))
    return np.array([motion(name, rng, 1.0 / rate, rows) for _ in range(trajectories)])


def kinked(
    name: str,
    rate: int,
    seed: int,
    *,
    trajectories: int = 4,
    noise: float = 0.0,
    quantum: float = 0.0,
) -> tuple[History, Scene]:
    """Trajectories of a motion and its scene; the swing is an angle, the others are in x.

    ``noise`` in m (rad), five times that of the velocity; ``quantum`` rounds both.
    """  # fmt: skip
    rng, dt, table = np.random.default_rng(seed), 1.0 / rate, []
    for trajectory, clean in enumerate(states(name, rate, seed, trajectories)):
        rows = len(clean)
        state = clean + noise * rng.standard_normal(clean.shape) * (1.0, 5.0)
        state = np.round(state / quantum) * quantum if quantum else state
        for i, (p, v) in enumerate(state):
            wrench = [0.0] * 3 if i < rows - 1 else [np.nan] * 3
            turn = [0.0, 0.0, np.angle(np.exp(1j * p)), 0.0, 0.0, v]
            cells = turn if name == "swing" else [p, 0.0, 0.0, v, 0.0, 0.0]
            table.append([trajectory, i, i * dt, "puck", *cells, *wrench])
    walls = {"bounce": (-RADIUS,), "walls": (-1.0 - RADIUS, 1.0 + RADIUS)}.get(name, ())
    scene = Scene(
        gravity=(-9.81, 0.0) if name == "bounce" else (0.0, 0.0),
        time_step=dt,
        bodies=(Body("puck", Shape.circle(RADIUS)),),
        walls=tuple(Wall((x, -9.0), (x, 9.0)) for x in walls),
    )
    return History.from_dataframe(pd.DataFrame(table, columns=COLUMNS), scene), scene
