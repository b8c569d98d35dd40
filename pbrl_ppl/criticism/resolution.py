"""Prediction horizon and engine substeps, chosen from the data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pbrl_ppl.modes import Mode, find_mode, with_start_noise

#: A doubling of the substeps may move predictions by this share of the noise.
SMALL_SHIFT = 0.1
MOST_SUBSTEPS = 640
#: A start state's noise may spread to this many times the noise of the measured end.
LARGEST_SPREAD = 3.0
HORIZONS = (1, 2, 5, 10, 20, 50, 100)


def noisy(mode: Mode, rounds: int = 2) -> Mode:
    """Account for start-state noise and refit; from scratch twice, for it depends on the fit."""
    for _ in range(rounds):
        mode = find_mode(with_start_noise(mode.problem, mode), initial=mode.phi)
    return mode


def choose_horizon(mode: Mode) -> Mode:
    """Shortest horizon at which the start state's noise does not drown the prediction."""
    longest = int(mode.problem.data.history.dataset["n_rows"].min()) - 1
    tried: list[tuple[float, Mode]] = []
    for horizon in HORIZONS:
        if horizon > max(1, longest // 2):
            break
        problem = mode.problem.with_data(horizon=horizon)
        mode = noisy(mode if horizon == 1 else find_mode(problem, initial=mode.phi))
        noise = mode.problem.noise.start
        gain = noise.gain if noise else np.ones((1, 1))
        cells = len(mode.problem.scene.moving) * len(mode.sigma)  # of the last interval
        spread = np.sqrt(np.maximum(gain[:, -cells:] ** 2 - 1.0, 0.0))
        worst = float(np.median(spread, axis=0).max())
        tried.append((worst, mode))
        if worst <= LARGEST_SPREAD:
            break
    return min(tried, key=lambda pair: pair[0])[1]


def with_enough_substeps(mode: Mode, say: Callable[[str], None]) -> Mode:
    """Double the substeps until that no longer moves predictions, and refit."""
    begin = mode.problem.physics.substeps
    while shift(mode) > SMALL_SHIFT and mode.problem.physics.substeps < MOST_SUBSTEPS:
        finer = mode.problem.with_physics(substeps=2 * mode.problem.physics.substeps)
        mode = replace(mode, problem=finer)
    if mode.problem.physics.substeps == begin:
        return mode
    say(f"using {mode.problem.physics.substeps} engine steps an interval")
    return noisy(mode, rounds=1)


def shift(mode: Mode) -> float:
    """Root mean square change of predictions in noise units if the substeps are doubled."""
    problem = mode.problem
    finer = problem.with_physics(substeps=2 * problem.physics.substeps)
    change = (problem.residual(mode.phi) - finer.residual(mode.phi)) / mode.sigma
    if problem.noise.start is not None:
        change = change / problem.noise.start.gain.reshape(change.shape)
    return float(np.sqrt(np.nanmean(change**2, axis=(0, 1, 2)).max()))
