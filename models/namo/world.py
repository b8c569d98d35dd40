"""The real rooms, which the model does not know: there the table is bolted to the floor.

The truth is pbrl_ppl's own engine with other parameters than the model believes; what is measured
has Gaussian noise.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

import pbrl_ppl as pp

SCENE = pp.Scene.load(Path(__file__).parent / "scene.toml")
GOAL = pp.Goal.of({"robot": (2.4, 0.9, None)}, tolerance=0.2)
FORCE = 120.0  # N, the most that the robot's motors give
#: A table of two tonnes on rough feet does not move; a couch is somewhat heavier than is believed.
TRUTH = {
    "mass": {"robot": 20.0, "table": 2000.0, "couch": 24.0},
    "mu_x": {"table": 1.0, "couch": 0.35},
    "mu_y": {"table": 1.0, "couch": 0.35},
    "linear_drag_coefficient": {"robot": 100.0},
}
NOISE = np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])  # m, m, rad, m/s, m/s, rad/s
#: So far from where a plan expects the robot, it gives up (m).
LOST = 0.5


class World:
    """The real rooms: wrenches in, measured states out.

    Parameters
    ----------
    seed : int
        Of the measurement noise.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        truth = {name: list(of.values()) for name, of in TRUTH.items()}  # in the scene's order
        self._truth = pp.Dynamics.known(SCENE, truth, threads=1)
        self.states = np.zeros((len(SCENE.dynamic), 6))
        self.states[:, :3] = [body.pose for body in SCENE.dynamic]

    def observe(self) -> np.ndarray:
        """Measured states, shape (body, 6), SI units."""
        return self.states + NOISE * self._rng.standard_normal(self.states.shape)

    def __call__(self, wrenches: np.ndarray) -> np.ndarray:
        """Play one sampling interval of wrenches (body, 3), N and N m, and measure."""
        self.states = self._truth.step(self.states[None, None], wrenches[None])[0, 0]
        return self.observe()


def at_rest(states: np.ndarray) -> np.ndarray:
    """Measured states (body, 6) to plan from: speeds within three sigma of the noise become 0.

    Nothing resists a couch's turning about its one wheel, so a plan would have it turn for ever.
    """
    states = states.copy()
    slow = abs(states[:, 3:]) < 3 * NOISE[3:]
    states[:, 3:][slow] = 0.0
    return states


def pushes() -> pp.ActionSet:
    """What the robot can do: go in one of eight directions of the world."""
    angles = np.arange(8) * np.pi / 4
    forces = FORCE * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return pp.ActionSet(
        tuple(pp.Action("robot", tuple(force), frame="world") for force in forces),
        durations=(0.3, 0.6),
    )


def follow(
    world: World, start: np.ndarray, wrenches: np.ndarray, expected: np.ndarray | None = None
) -> pp.Acted:
    """Play wrenches to their end, or until the robot is not where it is expected to be.

    Parameters
    ----------
    world : World
        Where.
    start : ndarray
        Measured states, shape (body, 6), SI units.
    wrenches : ndarray
        Shape (time, body, 3), N and N m.
    expected : ndarray, optional
        States, shape (time + 1, body, 6).

    Returns
    -------
    Acted
        What was measured.
    """
    states = [start]
    for i, wrench in enumerate(wrenches, start=1):
        states.append(world(wrench))
        if expected is not None and math.dist(states[-1][0, :2], expected[i, 0, :2]) > LOST:
            break
    measured, last = np.array(states), states[-1]
    there = bool(GOAL.shortfall(SCENE, last) <= 1)
    far = float(GOAL.distance(SCENE, last))
    return pp.Acted(SCENE, measured, wrenches[: len(states) - 1], there, far, 1)


def go_round(world: World) -> pp.Acted:
    """The robot goes round in a circle for 4 s, and touches nothing."""
    phase = 2 * np.pi * SCENE.time_step * np.arange(40) / 2.0
    wrenches = np.zeros((len(phase), len(SCENE.dynamic), 3))
    wrenches[:, 0, :2] = FORCE * np.stack([-np.sin(phase), np.cos(phase)], axis=1)
    return follow(world, world.observe(), wrenches)


def movable(idata: Any, body: str, draws: int = 200) -> float:
    """Probability that a body moves when the robot leans on it for 1 s, by a posterior's draws."""
    dynamics = pp.Dynamics.of(idata, draws, threads=1)
    i = [mover.name for mover in SCENE.dynamic].index(body)
    start = np.zeros((len(SCENE.dynamic), 6))
    start[:, :3] = [mover.pose for mover in SCENE.dynamic]
    reach = SCENE.body("robot").shape.radius - SCENE.body(body).shape.bounds[0]
    start[0, :2] = start[i, :2] - [reach, 0.0]
    wrenches = np.zeros((10, len(start), 3))
    wrenches[:, 0, 0] = FORCE
    way = dynamics.rollout(start, wrenches)[:, -1, i, :2] - start[i, :2]
    return float((np.hypot(*way.T) > 0.05).mean())
