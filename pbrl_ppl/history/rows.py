"""Rows of a history's table: cells, names and times checked, then arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.kinematics import kinematic_bodies
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import STATE, WRENCH

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Nothing that a body does is larger than this, in SI units.
_LARGEST = 1e9
_INTEGER = re.compile(r"(-?(?:0|[1-9]\d{0,17}))(?:\.0*)?")


@dataclass(frozen=True)
class Rows:
    """Columns of a table without its blank rows; ``line`` is the row in the file."""

    line: Ints
    labels: list[Any]
    trajectory: Ints
    body: Ints
    step: Ints | None
    time: Floats
    state: Floats
    action: Floats

    def at(self, row: int) -> str:
        """Return where a row is in the file, for messages."""
        return f"history row {self.line[row]}"

    def of(self, row: int) -> str:
        """Return which trajectory a row belongs to, for messages."""
        return f"trajectory {self.labels[self.trajectory[row]]}"


def read_rows(frame: pd.DataFrame, scene: Scene, source: str) -> Rows:
    """Check names and single cells."""
    if any(name is not None for name in frame.index.names):
        frame = frame.reset_index()
    names = [str(name).strip() for name in frame.columns]
    for name in names:
        if name not in COLUMNS:
            raise HistoryError(
                f'{source}: unknown column "{name}"{nearest(name, COLUMNS)} '
                f"Rename or drop it; the columns are {', '.join(COLUMNS)}"
            )
        if names.count(name) > 1:
            raise HistoryError(f'{source}: column "{name}" is there twice; drop one')
    required = ("trajectory", "time", "body", *WRENCH)
    missing = [name for name in required if name not in names]
    if missing:
        raise HistoryError(
            f"{source}: missing column(s) {', '.join(missing)}; expected {', '.join(COLUMNS)} "
            "(step is optional)"
        )
    frame = frame.set_axis(names, axis=1)
    blank = np.ones(len(frame), dtype=bool)
    for name in names:
        column = frame[name]
        blank &= (column.isna() | (column.astype(object) == "")).to_numpy(dtype=bool)
    line = np.flatnonzero(~blank) + 2
    frame = frame[~blank].reset_index(drop=True)
    if not len(frame):
        raise HistoryError(f"{source}: it has no rows; expected one for each body at each step")

    labels, trajectory = _trajectories(frame["trajectory"], line)
    known = [body.name for body in scene.moving]
    body = _bodies(frame["body"], line, known, scene)

    def numbers(name: str) -> Floats:
        if name not in names:
            return np.full(len(frame), np.nan)
        return _numbers(frame[name], name, line, [labels[i] for i in trajectory])

    time = numbers("time")
    step = numbers("step") if "step" in names else None
    for name, values in (("time", time), ("step", step)):
        if values is not None and np.isnan(values).any():
            row = int(np.flatnonzero(np.isnan(values))[0])
            raise HistoryError(
                f"history row {line[row]}: {name} is empty in trajectory "
                f"{labels[trajectory[row]]}; expected a number; fill it in or drop the row"
            )
    if step is not None and ((step != np.round(step)) | (np.abs(step) > 2**53)).any():
        row = int(np.flatnonzero((step != np.round(step)) | (np.abs(step) > 2**53))[0])
        raise HistoryError(
            f"history row {line[row]}: step is {step[row]} in trajectory "
            f"{labels[trajectory[row]]}; expected a whole number"
        )
    state = np.stack([numbers(name) for name in STATE], axis=1)
    action = np.stack([numbers(name) for name in WRENCH], axis=1)
    whole = None if step is None else step.astype(np.int64)
    return Rows(line, labels, trajectory, body, whole, time, state, action)


def _trajectories(column: pd.Series, line: Ints) -> tuple[list[Any], Ints]:
    """Return the labels in order of appearance (integers where all are) and each row's code."""
    text = [str(cell).strip() for cell in column.astype(object).where(column.notna(), "")]
    if "" in text:
        row = text.index("")
        raise HistoryError(
            f"history row {line[row]}: trajectory is empty; expected a number or a name; fill it in"
        )
    codes, labels = pd.factorize(np.array(text, dtype=object))
    matches = [_INTEGER.fullmatch(label) for label in labels]
    if all(matches):
        whole = np.array([int(match[1]) for match in matches if match])
        again, unique = pd.factorize(whole)
        return [int(label) for label in unique], again[codes].astype(np.int64)
    return [str(label) for label in labels], codes.astype(np.int64)


def _bodies(column: pd.Series, line: Ints, known: Sequence[str], scene: Scene) -> Ints:
    """Return each row's position among the scene's dynamic bodies."""
    names = column.astype(object).where(column.notna(), "").map(lambda name: str(name).strip())
    position = names.map({name: i for i, name in enumerate(known)})
    wrong = position.isna().to_numpy(dtype=bool)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        name = names.iloc[row]
        static = [body.name for body in scene.bodies if body.static]
        if name in static:
            cure = "it is static there; drop its rows or set static = false"
        else:
            cure = f"the scene has {', '.join(known)}{nearest(name, known)}"
        raise HistoryError(
            f'history row {line[row]}: body "{name}" does not move in the scene; {cure}'
        )
    codes = np.asarray(position.to_numpy(), dtype=np.int64)
    for i, name in enumerate(known):
        if not (codes == i).any():
            raise HistoryError(
                f'history: body "{name}" of the scene has no rows; record it, or drop it from the '
                "scene or make it static"
            )
    return codes


def _numbers(column: pd.Series, name: str, line: Ints, trajectory: Sequence[Any]) -> Floats:
    """Return a column as floats, NaN where empty."""
    if column.dtype.kind in "bmMc":
        coerced = pd.Series(np.nan, index=column.index)
    else:
        coerced = pd.to_numeric(column, errors="coerce")
    values = np.array(coerced.to_numpy(dtype=np.float64, na_value=np.nan), dtype=np.float64)
    suspect = np.isnan(values) & column.notna().to_numpy(dtype=bool)
    for row, cell in zip(np.flatnonzero(suspect).tolist(), column[suspect].tolist(), strict=True):
        if str(cell).strip().lower() not in ("", "nan"):
            raise HistoryError(
                f"history row {line[row]}: {name} is {str(cell)!r} in trajectory "
                f"{trajectory[row]}; expected a number or an empty cell; correct it"
            )
    limit = np.inf if name in ("time", "step") else _LARGEST
    absurd = np.flatnonzero(np.isinf(values) | (np.abs(values) > limit))
    if absurd.size:
        row = int(absurd[0])
        raise HistoryError(
            f"history row {line[row]}: {name} is {values[row]} in trajectory {trajectory[row]}; "
            f"expected a finite number of at most {_LARGEST:g}; empty the cell if it was not"
            " measured"
        )
    return values


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


def check_paths(rows: Rows, scene: Scene) -> None:
    """Raise `HistoryError` where a kinematic body's pose is missing on a row."""
    follows = kinematic_bodies(scene)[rows.body]
    empty = np.isnan(rows.state[:, :3]) & follows[:, None]
    if empty.any():
        row, column = (int(i) for i in np.argwhere(empty)[0])
        raise HistoryError(
            f"{rows.at(row)}: {STATE[column]} of body"
            f' "{scene.moving[rows.body[row]].name}" is empty in {rows.of(row)}; the body is'
            " kinematic and goes where its path leads: expected a number on every row; fill it in"
            " (theta of a round body may be 0 throughout)"
        )
