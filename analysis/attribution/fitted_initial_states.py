"""Forecasts from initial states that the model fits to a few rows, as those of independent fits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl import History
from pbrl_ppl.criticism.held_out import rollout
from pbrl_ppl.likelihood import Problem, first_states, observed_coordinates
from pbrl_ppl.scene import state_sizes
from pbrl_ppl.state import STATE, THETA, wrapped

Floats = NDArray[np.float64]

#: Steps of a fit (Levenberg-Marquardt); a relative gain below this is the last.
_STEPS, _GAIN = 30, 1e-6
#: Step of derivatives, as a share of a coordinate's typical size.
_STEP = 1e-4


def forecast_errors(
    problem: Problem, phi: Floats, history: History, rows: int, intervals: int
) -> dict[str, float]:
    """Return root mean square errors at the end of forecasts, by measured state dimension.

    Initial states are fitted to so many rows, and the forecast begins at the last of them.
    Forecasts are half a forecast apart; none where trajectories are too short.

    Parameters
    ----------
    problem : Problem
        The model.
    phi : ndarray
        Its parameters, shape (p,).
    history : History
        Held-out trajectories.
    rows, intervals : int
        Rows of a fit, and intervals of a forecast.
    """
    problem = problem.with_data(history=history, states=first_states(history), horizon=1)
    segments, length = problem.segments, rows - 1 + intervals
    observed = history.dataset["observed"].to_numpy()
    last = history.dataset["n_rows"].to_numpy()[segments.trajectory] - 1
    begins = (segments.step % max(1, intervals // 2) == 0) & (segments.step + length <= last)
    at = np.flatnonzero(begins)
    if not len(at):
        return {}
    inputs = problem.inputs[at[:, None] + np.arange(length), 0]
    row = segments.step[at, None] + np.arange(length + 1)
    measured = observed[segments.trajectory[at, None], row]
    start = _fitted(problem, phi, segments.start[at], inputs[:, : rows - 1], measured[:, :rows])
    ends = rollout(problem, phi, start, inputs)[:, -1]
    error = _difference(measured[:, -1], np.where(np.isnan(ends), np.inf, ends))
    seen = np.isfinite(measured[:, -1])
    return {
        name: float(np.sqrt((error[..., d][seen[..., d]] ** 2).mean()))
        for d, name in enumerate(STATE)
        if seen[..., d].any()
    }


def _fitted(problem: Problem, phi: Floats, start: Floats, inputs: Floats, rows: Floats) -> Floats:
    """Return the initial states that fit measured rows best, shape (n, body, 6).

    ``inputs`` has shape (n, rows - 1, body, 3 or 9), ``rows`` (n, rows, body, 6).
    """
    coordinates = observed_coordinates(problem.scene, problem.data.history)
    steps, n, c = _STEP * coordinates.sizes(problem.scene), len(start), len(coordinates.places)
    weight = 1.0 / state_sizes(problem.scene)
    start = coordinates.completed(problem.scene, start.copy())

    def moved(change: Floats) -> Floats:
        """Return initial states (k, n, body, 6) moved by (k, n, cell)."""
        states = np.tile(start, (len(change), 1, 1, 1))
        states.reshape(len(change), n, -1)[..., coordinates.places] += change
        return coordinates.completed(problem.scene, states)

    def residuals(states: Floats) -> Floats:
        """Return weighted residuals (k, n, row) of states (k, n, body, 6)."""
        flat = states.reshape(-1, *states.shape[2:])
        ends = rollout(problem, phi, flat, np.tile(inputs, (len(states), 1, 1, 1)))
        path = np.concatenate([flat[:, None], ends], axis=1).reshape(len(states), *rows.shape)
        z = np.nan_to_num(_difference(rows, np.nan_to_num(path, nan=1e9))) * weight
        return z.reshape(len(states), n, -1)

    damping = np.full(n, 1e-3)
    cost = (residuals(start[None])[0] ** 2).sum(axis=-1)
    for _ in range(_STEPS):
        each = np.eye(c)[:, None] * steps
        tried = residuals(moved(np.concatenate([each, -each, np.zeros((1, 1, c))]).repeat(n, 1)))
        slope = np.moveaxis(tried[:c] - tried[c:-1], 0, -1) / (2 * steps)
        square = np.swapaxes(slope, 1, 2) @ slope
        scale = np.diagonal(square, axis1=1, axis2=2)
        scale = scale + 1e-12 * scale.max(axis=1, keepdims=True) + 1e-300
        against = (np.swapaxes(slope, 1, 2) @ tried[-1][..., None])[..., 0]
        damped = square + np.eye(c) * (damping[:, None] * scale)[:, None]
        better = moved(-np.linalg.solve(damped, against[..., None])[None, ..., 0])
        costs = (residuals(better)[0] ** 2).sum(axis=-1)
        gain = cost - costs
        start = np.where((gain > 0)[:, None, None], better[0], start)
        damping = np.clip(damping * np.where(gain > 0, 0.1, 10.0), 1e-9, 1e9)
        done = (gain >= 0) & (gain <= _GAIN * cost)
        cost = np.where(gain > 0, costs, cost)
        if done.all():
            break
    return start


def _difference(measured: Floats, predicted: Floats) -> Floats:
    """Return measured minus predicted states (..., 6), angles wrapped."""
    difference = measured - predicted
    angle = difference[..., THETA]
    difference[..., THETA] = np.where(np.isfinite(angle), wrapped(np.nan_to_num(angle)), angle)
    return np.asarray(difference)
