"""Cases: bodies, starts, commands and noises drawn by a seed, and their recordings."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd
from numpy.typing import NDArray

import pbrl_ppl as pp
from pbrl_ppl.state import STATE, WRENCH
from recordings.laws import LAWS, Array, Body, G

Rng = np.random.Generator

FALL, PENDULUM, SLIDER = "fall", "pendulum", "slider"
WORLDS = (FALL, PENDULUM, SLIDER)
RATES = (10, 30, 100, 500)
#: Trajectories to fit, held-out trajectories, and rows of each.
SHAPES = {"one": (1, 1, 40), "twelve": (12, 4, 30)}
WHITE, QUANTISED, OUTLIERS = "white", "quantised", "outliers"
NOISES = (WHITE, QUANTISED, OUTLIERS)
CLEAN = "clean"
#: What is measured of each world's body.
MEASURED = {FALL: ("x", "y"), PENDULUM: ("theta",), SLIDER: ("x",)}
#: What never changes, and is logged as 0.
STILL = {FALL: ("theta",), PENDULUM: (), SLIDER: ("y", "theta")}
#: Standard deviation of the noise: video (m), encoder (rad), linear encoder or tracking (m).
_NOISE = {FALL: (1e-3, 5e-3), PENDULUM: (1e-4, 1e-3), SLIDER: (1e-4, 2e-3)}
#: Share of rows that are outliers, and how far off they are in standard deviations.
OUTLYING, FAR = 0.02, 30.0


@dataclass(frozen=True, eq=False)
class Recording:
    """Positions of several trajectories.

    Parameters
    ----------
    time : ndarray
        Times (s), shape (row,).
    start : ndarray
        True initial states, shape (trajectory, state).
    force : ndarray
        Known force along x (N), shape (trajectory, row - 1).
    measured : ndarray
        Noisy positions, shape (trajectory, row, coordinate).
    good : ndarray of bool
        Rows that are no outliers, shape (trajectory, row).
    """

    time: Array
    start: Array
    force: Array
    measured: Array
    good: NDArray[np.bool_]


@dataclass(frozen=True)
class Case:
    """A case of the benchmark.

    Parameters
    ----------
    world, shape, noise : str
        One of `WORLDS`, of `SHAPES` and of `NOISES`.
    rate : int
        Samples a second (Hz).
    effect : str
        The law that the oracle fits, one of `LAWS`.
    size : float
        A realistic coefficient of it: the true one unless the case is clean.
    clean : bool
        Whether the effect is absent.
    body : Body
        What moves.
    sd : float
        Standard deviation of the noise (m or rad); of quantisation, the step over sqrt(12).
    driven : bool
        Whether a slider is commanded by a known force.
    seed : int
        Makes the recordings.
    """

    world: str
    rate: int
    shape: str
    noise: str
    effect: str
    size: float
    clean: bool
    body: Body
    sd: float
    driven: bool
    seed: int

    @property
    def name(self) -> str:
        """Return the unique name of the case."""
        return named(self.world, self.rate, self.shape, self.noise, self.clean)

    @property
    def truth(self) -> float:
        """Return the true coefficient."""
        return 0.0 if self.clean else self.size

    @property
    def answers(self) -> dict[str, tuple[str, float] | None]:
        """Return the correct effects, each with the true value of its parameter, if any.

        Linear and quadratic drag are both right for a ball; about a hinge, drag of the rod is
        friction in the hinge.
        """
        if self.world == FALL:
            return {
                name: ("coefficient", self.truth) if name == self.effect else None
                for name in ("linear_drag", "quadratic_drag")
            }
        if self.world == PENDULUM:
            about_hinge = ("coefficient", self.truth)
            return {
                "pivot_damping": about_hinge,
                "angular_drag": about_hinge,
                "linear_drag": ("coefficient", self.truth / self.body.hinge**2),
            }
        return {"sliding_friction": ("mu", self.truth)}

    @property
    def scene(self) -> pp.Scene:
        """Return the declared scene: the body's outline and mass, gravity, and the rod's hinge."""
        known = {"mass": self.body.mass}
        dt = 1.0 / self.rate
        if self.world == FALL:
            body = pp.Body("ball", pp.Shape.circle(*self.body.size), known=known)
            return pp.Scene(time_step=dt, gravity=(0.0, -G), bodies=(body,))
        if self.world == PENDULUM:
            body = pp.Body("rod", pp.Shape.box(*self.body.size), known=known)
            hinge = pp.Joint(
                "hinge", ("rod", "world"), anchor_a=(0.0, self.body.hinge), anchor_b=(0.0, 0.0)
            )
            return pp.Scene(time_step=dt, gravity=(0.0, -G), bodies=(body,), joints=(hinge,))
        body = pp.Body("block", pp.Shape.box(*self.body.size), known=known)
        return pp.Scene(time_step=dt, normal_gravity=G, bodies=(body,))  # a top view

    def recordings(self) -> tuple[Recording, Recording]:
        """Return the training and the test recording, with the same law and noise."""
        rng = np.random.default_rng(self.seed)
        train, test, _ = SHAPES[self.shape]
        return self._recorded(train, rng), self._recorded(test, rng)

    def _recorded(self, count: int, rng: Rng) -> Recording:
        rows = SHAPES[self.shape][2]
        time = np.arange(rows) / self.rate
        force = np.zeros((count, rows - 1))
        if self.driven:
            pushes = int(rng.integers(3, 7))  # each held for some rows
            least = self.size * self.body.mass * G
            drawn = rng.choice([-1.0, 1.0], (count, pushes)) * rng.uniform(1.2, 4.0, pushes) * least
            force = np.repeat(drawn, math.ceil((rows - 1) / pushes), axis=1)[:, : rows - 1]
        start = _STARTS[self.world](self, count, float(time[-1]), rng)
        places = LAWS[self.effect](self.body, self.truth, start, time, force)
        return Recording(time, start, force, *self._noisy(places, rng))

    def _noisy(self, places: Array, rng: Rng) -> tuple[Array, NDArray[np.bool_]]:
        good = np.ones(places.shape[:2], dtype=bool)
        if self.noise == QUANTISED:
            step = math.sqrt(12.0) * self.sd
            return step * np.round(places / step), good
        measured = places + self.sd * rng.standard_normal(places.shape)
        if self.noise == OUTLIERS:
            bad = rng.choice(good.size, max(1, round(OUTLYING * good.size)), replace=False)
            good.flat[bad] = False
            away = rng.standard_normal((len(bad), places.shape[2]))
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            measured[~good] += FAR * self.sd * away
        return measured, good

    def history(self, recording: Recording, bare: bool = False) -> pp.History:
        """Return a recording as a history; ``bare`` leaves out coordinates that never change."""
        frame = self.frame(recording, bare)
        return pp.History.from_dataframe(frame, self.scene, estimate_velocities=True)

    def frame(self, recording: Recording, bare: bool = False) -> pd.DataFrame:
        """Return the rows of a log: velocities and unmeasured coordinates are empty."""
        count, rows = recording.good.shape
        table = pd.DataFrame({
            "trajectory": np.repeat(np.arange(count), rows),
            "step": np.tile(np.arange(rows), count),
            "time": np.tile(recording.time, count),
            "body": self.scene.bodies[0].name,
        })  # fmt: skip
        table[list(STATE)] = np.nan
        table[list(MEASURED[self.world])] = recording.measured.reshape(count * rows, -1)
        if not bare:
            table[list(STILL[self.world])] = 0.0
        table[list(WRENCH)] = 0.0
        table["force_x"] = np.pad(recording.force, ((0, 0), (0, 1))).ravel()
        table.loc[table["step"] == rows - 1, list(WRENCH)] = np.nan
        return table


def _falling(case: Case, count: int, lasts: float, rng: Rng) -> Array:
    """Draw falls of 2 to 10 m: a part of one, or a throw upwards that lasts longer than one."""
    height = rng.uniform(2.0, 10.0, count)
    spare = np.sqrt(2 * height / G) - lasts
    already = -G * np.clip(spare, 0.0, None) * rng.uniform(0.0, 1.0, count)
    thrown = np.clip(G * lasts / 2 - height / lasts, 0.0, None)
    most = _terminal(case)  # nobody throws a shuttlecock faster
    vy = np.clip(np.where(spare > 0.0, already, thrown), -most, most)
    return np.stack([rng.normal(0.0, 0.1, count), height, rng.normal(0.0, 0.5, count), vy], axis=1)


def _terminal(case: Case) -> float:
    """Return the terminal speed of a ball (m/s)."""
    weight = case.body.mass * G / case.size
    return weight if case.effect == "linear_drag" else math.sqrt(weight)


def _swinging(case: Case, count: int, lasts: float, rng: Rng) -> Array:
    sign = rng.choice([-1.0, 1.0], count)
    return np.stack([sign * rng.uniform(0.3, 1.5, count), rng.normal(0.0, 0.5, count)], axis=1)


def _sliding(case: Case, count: int, lasts: float, rng: Rng) -> Array:
    """Draw starts from rest under a command, or with a speed that friction uses up about."""
    x = rng.normal(0.0, 0.1, count)
    if case.driven:
        return np.stack([x, np.zeros(count)], axis=1)
    speed = np.clip(rng.uniform(0.5, 1.5, count) * case.size * G * lasts, 0.3, 3.0)
    return np.stack([x, rng.choice([-1.0, 1.0], count) * speed], axis=1)


_STARTS = {FALL: _falling, PENDULUM: _swinging, SLIDER: _sliding}


def named(world: str, rate: int, shape: str, noise: str, clean: bool) -> str:
    """Return the name of a case."""
    return f"{world}-{rate}Hz-{shape}-{noise}-{CLEAN if clean else 'drag'}"


def all_cases(seed: int = 0) -> list[Case]:
    """Return the 144 cases of a seed."""
    every = product(WORLDS, RATES, SHAPES, NOISES, (False, True))
    return [drawn(*which, seed) for which in every]


def drawn(world: str, rate: int, shape: str, noise: str, clean: bool, seed: int) -> Case:
    """Draw the body, the size of the effect and of the noise of a case."""
    name = named(world, rate, shape, noise, clean)
    rng = np.random.default_rng((seed, zlib.crc32(name.encode())))

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    sd = between(*_NOISE[world])
    driven = False
    if world == FALL:
        body = Body(between(0.003, 0.6), (between(0.02, 0.12),))
        effect = str(rng.choice(["linear_drag", "quadratic_drag"]))
        speed = between(5.0, 30.0)
        size = body.mass * G / (speed if effect == "linear_drag" else speed**2)
    elif world == PENDULUM:
        length = between(0.3, 1.0)
        body = Body(between(0.1, 2.0), (0.03, length), hinge=length * rng.uniform(0.35, 0.5))
        effect = "pivot_damping"
        own = math.sqrt(body.mass * G * body.hinge / body.inertia)
        size = 2 * between(0.003, 0.05) * own * body.inertia  # by the share of critical damping
    else:
        body = Body(between(0.1, 5.0), (between(0.05, 0.3), between(0.05, 0.2)))
        effect, size = "sliding_friction", between(0.02, 0.4)
        driven = bool(rng.integers(2))
    own_seed = int(rng.integers(2**31))
    return Case(world, rate, shape, noise, effect, size, clean, body, sd, driven, own_seed)
