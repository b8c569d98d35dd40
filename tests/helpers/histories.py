"""Histories simulated with the package's engine."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from pbrl_ppl.effects import attach
from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics, Simulator, build_layout
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, WRENCH

COLUMNS = ["trajectory", "step", "time", "body", *STATE, *WRENCH]
NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)  # m, m, rad, m/s, m/s, rad/s


def simulated_history(
    scene: Scene,
    truth: Mapping[str, object],
    *,
    seed: int,
    trajectories: int = 4,
    intervals: int = 10,
    effects: Iterable = (),
    noise: float | tuple[float, ...] = NOISE,
    wrench_sd: tuple[float, float, float] = (12.0, 12.0, 2.0),
    start_sd: tuple[float, ...] = (1.0, 1.0, 1.5, 1.0, 1.0, 0.8),
    poses: Any = None,
    substeps: int = 40,
) -> History:
    """Return a history simulated with the package's engine.

    The bodies start 4 m apart, or at rest in these poses (body, 3).
    """
    rng = np.random.default_rng(seed)
    attached = attach(scene, effects)
    layout = build_layout(scene, attached)
    simulator = Simulator(Physics(scene, attached, substeps=substeps))
    names = [body.name for body in scene.dynamic]
    k = len(names)
    start = rng.normal(0.0, start_sd, (trajectories, k, 6))
    start[..., 0] += 4.0 * np.arange(k)
    if poses is not None:
        start[..., :3], start[..., 3:] = poses, 0.0
    actions = rng.normal(0.0, wrench_sd, (trajectories, intervals, k, 3))
    # as in state.INPUT: the wrench, the one before, and when
    previous = np.concatenate([np.zeros_like(actions[:, :1]), actions[:, :-1]], axis=1)
    when = np.empty_like(actions)
    when[..., 0] = np.arange(trajectories)[:, None, None]
    when[..., 1] = scene.time_step * np.arange(intervals)[:, None]
    when[..., 2] = when[..., 1] + scene.time_step
    inputs = np.concatenate([actions, previous, when], axis=-1)
    states = simulator(layout.to_vector(truth), start, inputs)
    states = np.concatenate([start[:, None], states], axis=1)
    states += rng.standard_normal(states.shape) * noise
    rows = [
        {
            "trajectory": t,
            "time": i * scene.time_step,
            "body": name,
            **dict(zip(STATE, states[t, i, j], strict=True)),
            **(dict(zip(WRENCH, actions[t, i, j], strict=True)) if i < intervals else {}),
        }
        for t in range(trajectories)
        for i in range(intervals + 1)
        for j, name in enumerate(names)
    ]
    return History.from_dataframe(pd.DataFrame(rows), scene)
