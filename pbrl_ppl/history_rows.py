"""Rows of a history to arrays: every rule that a table of measurements must keep."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history_files import COLUMNS, STATE, WRENCH
from pbrl_ppl.scene import Scene
from pbrl_ppl.scene_checks import nearest

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

TIME_TOLERANCE = 0.01
"""How far an interval may be from the scene's time step, as a share of it."""

_INTEGER = re.compile(r"(-?(?:0|[1-9]\d{0,17}))(?:\.0*)?")


@dataclass(frozen=True)
class Arrays:
    """A history as padded arrays: n trajectories, at most T steps, k bodies."""

    labels: list[Any]
    n_rows: Ints
    clock: Floats
    state: Floats
    action: Floats


@dataclass(frozen=True)
class _Rows:
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
        return f"history row {self.line[row]}"

    def of(self, row: int) -> str:
        return f"trajectory {self.labels[self.trajectory[row]]}"


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
    rows = _columns(frame, scene, source)
    # Trajectories may alternate in the file; inside each one, the file's order counts.
    order = np.argsort(rows.trajectory, kind="stable")
    first, position = _steps(rows, order, scene)
    k = len(scene.dynamic)
    starts = np.flatnonzero(first)
    n_rows = np.zeros(len(rows.labels), dtype=np.int64)
    np.maximum.at(n_rows, rows.trajectory, position + 1)
    _complete(rows, scene, position, n_rows)
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


def _columns(frame: pd.DataFrame, scene: Scene, source: str) -> _Rows:
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
    known = [body.name for body in scene.dynamic]
    body = _bodies(frame["body"], line, known, scene)

    def numbers(name: str) -> Floats:
        if name not in names:
            return np.full(len(frame), np.nan)
        return _numbers(frame[name], name, line, [labels[i] for i in trajectory])

    time = numbers("time")
    step = numbers("step") if "step" in names else None
    for name, column in (("time", time), ("step", step)):
        if column is not None and np.isnan(column).any():
            row = int(np.flatnonzero(np.isnan(column))[0])
            raise HistoryError(
                f"history row {line[row]}: {name} is empty in trajectory "
                f"{labels[trajectory[row]]}; expected a number; fill it in or drop the row"
            )
    broken = [] if step is None else np.flatnonzero((step != np.round(step)) | (abs(step) > 2**53))
    if step is not None and len(broken):
        row = int(broken[0])
        raise HistoryError(
            f"history row {line[row]}: step is {step[row]} in trajectory "
            f"{labels[trajectory[row]]}; expected a whole number"
        )
    state = np.stack([numbers(name) for name in STATE], axis=1)
    action = np.stack([numbers(name) for name in WRENCH], axis=1)
    whole = None if step is None else step.astype(np.int64)
    return _Rows(line, labels, trajectory, body, whole, time, state, action)


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
    codes = position.to_numpy(dtype=np.int64)
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
    values = coerced.to_numpy(dtype=np.float64, na_value=np.nan).copy()
    suspect = np.isnan(values) & column.notna().to_numpy(dtype=bool)
    for row, cell in zip(np.flatnonzero(suspect), column[suspect].tolist(), strict=True):
        if str(cell).strip().lower() not in ("", "nan"):
            raise HistoryError(
                f"history row {line[row]}: {name} is {str(cell)!r} in trajectory "
                f"{trajectory[row]}; expected a number or an empty cell; correct it"
            )
    infinite = np.flatnonzero(np.isinf(values))
    if infinite.size:
        row = int(infinite[0])
        raise HistoryError(
            f"history row {line[row]}: {name} is {values[row]} in trajectory {trajectory[row]}; "
            "expected a finite number; empty the cell if it was not measured"
        )
    return values


def _steps(rows: _Rows, order: Ints, scene: Scene) -> tuple[npt.NDArray[np.bool_], Ints]:
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
    # The order of the rules is the order of the cures: sort first, then look for gaps.
    back = inside & (change < np.where(first, 0.0, -tolerance))
    problems = [
        (back, "back"),
        (inside & (jump < 0), "step back"),
        (inside & (jump > 1), "skip"),
        (inside & ~first & (change > tolerance), "two times"),
        (inside & first & (np.abs(change - dt) > tolerance), "unequal"),
    ]
    bad = [
        (int(order[np.flatnonzero(mask)[0]]), i)
        for i, (mask, _) in enumerate(problems)
        if mask.any()
    ]
    if bad:
        row, which = min(bad, key=lambda item: (rows.line[item[0]], item[1]))
        place = int(np.flatnonzero(order == row)[0])
        _raise_time(rows, row, problems[which][1], float(change[place]), int(jump[place]), scene)
    group = np.cumsum(first) - 1
    start = np.maximum.accumulate(np.where(begins, group, 0))
    position = np.empty(len(order), dtype=np.int64)
    position[order] = group - start
    return first, position


def _raise_time(rows: _Rows, row: int, kind: str, change: float, jump: int, scene: Scene) -> None:
    at, of = rows.at(row), rows.of(row)
    step = 0 if rows.step is None else int(rows.step[row])
    dt = scene.time_step
    messages = {
        "back": f"time goes back by {-change:.6g} s in {of}; sort the rows or drop the duplicate",
        "step back": f"step goes back from {step - jump} to {step} in {of}; sort the rows",
        "skip": f"step skips from {step - jump} to {step} in {of}; expected {step - jump + 1}; "
        "record every step, or give the rows after the gap a trajectory of their own",
        "two times": f"step {step} has two times, {change:.6g} s apart, in {of}; expected one; "
        "give every body the same time at a step",
        "unequal": f"{change:.6g} s since the step before in {of}; expected {dt:.6g} s, the "
        "scene's time_step, within 1 %; resample the history evenly, or correct time_step",
    }
    raise HistoryError(f"{at}: {messages[kind]}")


def _complete(rows: _Rows, scene: Scene, position: Ints, n_rows: Ints) -> None:
    """Check that each body is there once at each step, with an action before the last."""
    names = [body.name for body in scene.dynamic]
    k = len(names)
    offset = np.cumsum(n_rows) - n_rows
    cell = (offset[rows.trajectory] + position) * k + rows.body
    seen, where = np.unique(cell, return_index=True)
    if len(seen) < len(cell):
        extra = np.ones(len(cell), dtype=bool)
        extra[where] = False
        row = int(np.flatnonzero(extra)[0])
        raise HistoryError(
            f'{rows.at(row)}: a second row of body "{names[rows.body[row]]}" at time '
            f"{rows.time[row]:.6g} s in {rows.of(row)}; expected one a step; drop the duplicate"
        )
    for i in np.flatnonzero(n_rows < 2):
        row = int(np.flatnonzero(rows.trajectory == i)[0])
        raise HistoryError(
            f"{rows.at(row)}: {rows.of(row)} has 1 step; expected at least 2, a state and the one "
            "after it; drop the trajectory"
        )
    if len(seen) < n_rows.sum() * k:
        gap = int(np.setdiff1d(np.arange(n_rows.sum() * k), seen)[0])
        row = int(np.flatnonzero(cell // k == gap // k)[0])
        raise HistoryError(
            f'{rows.at(row)}: body "{names[gap % k]}" has no row at time {rows.time[row]:.6g} s in '
            f"{rows.of(row)}; expected one of each body at each step; add it, with empty cells for "
            "what was not measured"
        )
    empty = np.isnan(rows.action) & (position < n_rows[rows.trajectory] - 1)[:, None]
    if empty.any():
        row, column = (int(i) for i in np.argwhere(empty)[0])
        raise HistoryError(
            f'{rows.at(row)}: {WRENCH[column]} of body "{names[rows.body[row]]}" is empty in '
            f"{rows.of(row)}; expected a number on every row but the last; write 0 where nothing "
            "pushed"
        )
