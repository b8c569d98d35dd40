"""Rows of a history to arrays: every rule that a table of measurements must keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.cells import Floats, Ints, Rows, read_rows
from pbrl_ppl.history.paths import check_paths, kinematic_bodies
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH

TIME_TOLERANCE = 0.01
"""How far an interval may be from the scene's time step, as a share of it."""


@dataclass(frozen=True)
class Arrays:
    """A history as padded arrays: n trajectories, at most T steps, k bodies."""

    labels: list[Any]
    n_rows: Ints
    clock: Floats
    state: Floats
    action: Floats


def arrays(frame: pd.DataFrame, scene: Scene, source: str) -> Arrays:
    """Return a table's rows as checked arrays.

    Parameters
    ----------
    frame : pandas.DataFrame
        One row for each (trajectory, step, body).
    scene : Scene
        The bodies and the time step that are expected.
    source : str
        What to call the table in messages about the whole of it.

    Raises
    ------
    HistoryError
        At the first row that breaks a rule.
    """
    rows = read_rows(frame, scene, source)
    # Trajectories may alternate in the file; inside each one, the file's order counts.
    order = np.argsort(rows.trajectory, kind="stable")
    first, position = _steps(rows, order, scene)
    k = len(scene.moving)
    starts = np.flatnonzero(first)
    n_rows = np.zeros(len(rows.labels), dtype=np.int64)
    np.maximum.at(n_rows, rows.trajectory, position + 1)
    _complete(rows, scene, position, n_rows)
    check_paths(rows, scene)
    shape = (len(rows.labels), int(n_rows.max()), k)
    state = np.full((*shape, 6), np.nan)
    action = np.full((*shape, 3), np.nan)
    clock = np.full(shape[:2], np.nan)
    where = (rows.trajectory, position, rows.body)
    state[where] = rows.state
    action[where] = rows.action
    head = order[starts]
    clock[rows.trajectory[head], position[head]] = rows.time[head]
    # What a last row commands belongs to an interval that was not measured.
    action[np.arange(len(n_rows)), n_rows - 1] = np.nan
    return Arrays(rows.labels, n_rows, clock, state, action)


def _steps(rows: Rows, order: Ints, scene: Scene) -> tuple[npt.NDArray[np.bool_], Ints]:
    """Return where a step begins (in ``order``), and each row's step counted from 0."""
    dt = scene.time_step
    tolerance = TIME_TOLERANCE * dt
    time, trajectory = rows.time[order], rows.trajectory[order]
    begins = np.ones(len(order), dtype=bool)
    begins[1:] = trajectory[1:] != trajectory[:-1]
    change = np.diff(time, prepend=time[0])
    if rows.step is None:
        first = begins | (np.abs(change) > tolerance)
        jump = np.where(first, 1, 0)
    else:
        step = rows.step[order]
        jump = np.diff(step, prepend=step[0])
        first = begins | (jump != 0)
    inside = ~begins
    group = np.cumsum(first) - 1
    pair = group * len(scene.moving) + rows.body[order]
    again = np.ones(len(order), dtype=bool)
    again[np.unique(pair, return_index=True)[1]] = False
    # In the order of the cures: rows out of order or twice look like gaps further on.
    problems = {
        "back": inside & (change < np.where(first, 0.0, -tolerance)),
        "again": again,
        "step back": inside & (jump < 0),
        "skip": inside & (jump > 1),
        "two times": inside & ~first & (change > tolerance),
        "unequal": inside & first & (np.abs(change - dt) > tolerance),
    }
    for kind, broken in problems.items():
        if broken.any():
            places = np.flatnonzero(broken)
            place = int(places[np.argmin(order[places])])
            row = int(order[place])
            _raise_time(rows, row, kind, float(change[place]), int(jump[place]), scene)
    start = np.maximum.accumulate(np.where(begins, group, 0))
    position = np.empty(len(order), dtype=np.int64)
    position[order] = group - start
    return first, position


def _raise_time(rows: Rows, row: int, kind: str, change: float, jump: int, scene: Scene) -> None:
    at, of = rows.at(row), rows.of(row)
    step = 0 if rows.step is None else int(rows.step[row])
    moment = f"time {rows.time[row]:.6g} s" if rows.step is None else f"step {step}"
    name = scene.moving[rows.body[row]].name
    dt = scene.time_step
    messages = {
        "back": f"time goes back by {-change:.6g} s in {of}; sort the rows or drop the duplicate",
        "again": f'a second row of body "{name}" at {moment} in {of}; expected one; drop the '
        "duplicate",
        "step back": f"step goes back from {step - jump} to {step} in {of}; sort the rows",
        "skip": f"step skips from {step - jump} to {step} in {of}; expected {step - jump + 1}; "
        "record every step, or give the rows after the gap a trajectory of their own",
        "two times": f"step {step} has two times, {change:.6g} s apart, in {of}; expected one; "
        "give every body the same time at a step",
        "unequal": f"{change:.6g} s since the step before in {of}; expected {dt:.6g} s, the "
        "scene's time_step, within 1 %; correct time_step, or have the history resampled "
        "(resample=True, --time-step)",
    }
    raise HistoryError(f"{at}: {messages[kind]}")


def _complete(rows: Rows, scene: Scene, position: Ints, n_rows: Ints) -> None:
    """Check that each body is there at each step, with an action before the last."""
    names = [body.name for body in scene.moving]
    k = len(names)
    offset = np.cumsum(n_rows) - n_rows
    cell = (offset[rows.trajectory] + position) * k + rows.body
    for i in np.flatnonzero(n_rows < 2):
        row = int(np.flatnonzero(rows.trajectory == i)[0])
        raise HistoryError(
            f"{rows.at(row)}: {rows.of(row)} has 1 step; expected at least 2, a state and the one "
            "after it; drop the trajectory"
        )
    if len(cell) < n_rows.sum() * k:
        gap = int(np.setdiff1d(np.arange(n_rows.sum() * k), cell)[0])
        row = int(np.flatnonzero(cell // k == gap // k)[0])
        raise HistoryError(
            f'{rows.at(row)}: body "{names[gap % k]}" has no row at time {rows.time[row]:.6g} s in '
            f"{rows.of(row)}; expected one of each body at each step; add it, with empty cells for "
            "what was not measured"
        )
    pushed = ~kinematic_bodies(scene)[rows.body]  # a kinematic body's path is its action
    before_last = position < n_rows[rows.trajectory] - 1
    empty = np.isnan(rows.action) & (before_last & pushed)[:, None]
    if empty.any():
        row, column = (int(i) for i in np.argwhere(empty)[0])
        raise HistoryError(
            f'{rows.at(row)}: {WRENCH[column]} of body "{names[rows.body[row]]}" is empty in '
            f"{rows.of(row)}; expected a number on every row but the last; write 0 where nothing "
            "pushed"
        )
