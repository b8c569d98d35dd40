"""Pucks that slide freely: a box by Box2D, and a disc in closed form with known noise."""

from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
from simulated_data import with_measurements

from pbrl_ppl.criticism import DEFAULT, Criteria, Search
from pbrl_ppl.criticism.search import SearchResult
from pbrl_ppl.effects import candidates
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, along_trajectories
from pbrl_ppl.modes import Mode, find_mode, trajectory_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import COLUMNS, NOISE

#: The box: its mass alone is unknown, 2 kg in the data.
BOX = Scene(
    time_step=0.1,
    normal_gravity=9.81,
    bodies=(Body("puck", Shape.box(0.4, 0.3), known={"r": 0.1, "mu_c": 0.3}),),
)
#: The disc; 2 kg too.
DISC = Scene(
    time_step=0.1,
    normal_gravity=9.81,
    substeps=10,
    bodies=(Body("puck", Shape.circle(0.2), known={"r": 0.1, "mu_c": 0.3}),),
)
MASS, RADIUS = 2.0, 0.2


def box2d(
    make_history: ModuleType,
    seed: int,
    *,
    trajectories: int = 8,
    intervals: int = 15,
    near: bool = False,
    **hidden: Any,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return train and test rows of the box; ``near`` starts it within 1 m of the middle."""
    setup = make_history.Setup(
        name="puck", size=(0.4, 0.3), mass=MASS, r=0.1, mu_c=0.3, wrench_sd=(4.0, 4.0, 0.1),
        n_train=trajectories, n_intervals=intervals,
    )  # fmt: skip
    if near:
        setup = replace(setup, start_range=(1.0, 1.0, 3.14159))
    return make_history.simulate(seed, setup, **hidden)


def searched(mode: Mode, catalogue: Any, criteria: Criteria = DEFAULT) -> SearchResult:
    """What the loop's search finds missing."""
    scene = mode.problem.scene
    return Search(lambda now: candidates(scene, now.problem.physics.effects, catalogue), criteria)(
        mode
    )


def fitted(scene: Scene, history: History | pd.DataFrame, effects: Any = ()) -> Mode:
    """Mode of a model along trajectories, as the loop begins with."""
    if not isinstance(history, History):
        history = History.from_dataframe(history, scene)
    problem = Problem.of(Physics.declare(scene, effects, threads=2), history)
    return trajectory_mode(problem, find_mode(problem, seed=3).phi)


@dataclass(frozen=True)
class Disc:
    """Recordings of a disc that is pushed about: what it does is known in closed form.

    Parameters
    ----------
    trajectories, intervals : int
        How many.
    scene : Scene
        The declared one.
    drag : float
        Of the truth, kg/s.
    hold : int
        Intervals that a push is held for.
    seed : int
        Of the pushes.
    """

    trajectories: int = 4
    intervals: int = 10
    scene: Scene = DISC
    drag: float = 0.0
    hold: int = 1
    seed: int = 11

    @cached_property
    def pushes(self) -> np.ndarray:
        """Forces (N) and torques (N m), shape (trajectory, interval, 3), the same each time."""
        rng = np.random.default_rng(self.seed)
        count = -(-self.intervals // self.hold)
        drawn = rng.normal(0.0, (5.0, 5.0, 0.2), (self.trajectories, count, 3))
        return np.repeat(drawn, self.hold, axis=1)[:, : self.intervals]

    def measured(self, rng: np.random.Generator, pushed: Any = 0.0) -> np.ndarray:
        """States with noise, shape (trajectory, time, 6); ``pushed`` adds accelerations."""
        dt, inertia = self.scene.time_step, MASS * RADIUS**2 / 2
        acceleration = self.pushes / (MASS, MASS, inertia) + pushed
        states = np.empty((self.trajectories, self.intervals + 1, 6))
        states[:, 0] = rng.normal(size=(self.trajectories, 6))
        rate = np.array([self.drag / MASS] * 2 + [0.0])
        fade = np.exp(-rate * dt)
        # integrals of the fading over the interval; their limits where nothing drags
        once = np.where(rate > 0, (1 - fade) / np.where(rate > 0, rate, 1), dt)
        twice = np.where(rate > 0, (dt - once) / np.where(rate > 0, rate, 1), dt**2 / 2)
        for k in range(self.intervals):
            place, velocity = states[:, k, :3], states[:, k, 3:]
            states[:, k + 1, :3] = place + velocity * once + acceleration[:, k] * twice
            states[:, k + 1, 3:] = velocity * fade + acceleration[:, k] * once
        return np.asarray(states + rng.normal(0.0, NOISE, states.shape))

    def frame(self, rng: np.random.Generator, **options: Any) -> pd.DataFrame:
        """Rows in the history format."""
        states, dt = self.measured(rng, **options), self.scene.time_step
        unpushed = np.full((self.trajectories, 1, 3), np.nan)
        pushes = np.concatenate([self.pushes, unpushed], axis=1)
        rows = [
            [t, i, i * dt, "puck", *states[t, i], *pushes[t, i]]
            for t in range(self.trajectories)
            for i in range(self.intervals + 1)
        ]
        return pd.DataFrame(rows, columns=COLUMNS)

    @cached_property
    def problem(self) -> Problem:
        """Of whole trajectories; data sets share its priors and commands."""
        history = History.from_dataframe(self.frame(np.random.default_rng(1)), self.scene)
        problem = Problem.of(Physics.declare(self.scene), history)
        return along_trajectories(problem, self.truth)

    @property
    def truth(self) -> np.ndarray:
        """The mass, and the drag if that is declared."""
        declared = any(body.effects for body in self.scene.bodies)
        return np.array([MASS, self.drag] if declared else [MASS])

    def mode(self, rng: np.random.Generator, pushed: Any = 0.0) -> Mode:
        """Mode for a new data set, which begins at the truth."""
        observed = self.measured(rng, pushed)[:, :, None]
        return trajectory_mode(with_measurements(self.problem, observed), self.truth)
