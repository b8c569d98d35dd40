"""Transitions of pushed bodies, simulated with the package's engine."""

import numpy as np

from pbrl_ppl.planning import Dynamics
from pbrl_ppl.scene import Scene

Transitions = tuple[np.ndarray, np.ndarray, np.ndarray]


def transitions(
    scene: Scene,
    n: int,
    seed: int,
    *,
    low: tuple[float, float],
    high: tuple[float, float],
    force: float = 4.0,
    mass: float = 2.0,
) -> Transitions:
    """Return states (n, body, 6), wrenches (n, body, 3), next states of bodies in a rectangle (m).

    Pushes are those of an action set: none or a force, either way, along x and y.
    """
    rng = np.random.default_rng(seed)
    k = len(scene.moving)
    states = np.empty((n, k, 6))
    states[..., :2] = rng.uniform(low, high, (n, k, 2))
    states[..., 2] = rng.uniform(-np.pi, np.pi, (n, k))
    states[..., 3:] = rng.normal(0.0, (1.2, 1.2, 0.5), (n, k, 3))
    wrenches = np.zeros((n, k, 3))
    wrenches[..., :2] = rng.choice([-force, 0.0, force], (n, k, 2))
    truth = Dynamics(scene, np.full((1, k), mass))
    return states, wrenches, truth.step(states[None], wrenches)[0]
