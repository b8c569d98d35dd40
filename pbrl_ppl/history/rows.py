"""Rows of a history's table: checks of names, cells and times, and conversion to arrays."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.kinematics import kinematic_bodies
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints

#: How far an interval may be from the scene's time step, as a share of it.
TIME_TOLERANCE = 0.01
#: Largest absolute value of a state or wrench, in SI units.
_LARGEST = 1e18
_INTEGER = re.compile(r"(-?(?:0|[1-9]\d{0,17}))(?:\.0*)?")


@dataclass(frozen=True)
class Rows:
    """Columns of a table without its blank rows; ``line`` is each row's number in the file."""

    line: Ints
    labels: list[Any]
    trajectory: Ints
    body: Ints
    step: Ints | None
    time: Floats
    state: Floats
    action: Floats

    def error(self, row: int, message: str) -> HistoryError:
        """Return an error that names the row of the file."""
        return HistoryError(f"history row {self.line[row]}: {message}")

    def trajectory_of(self, row: int) -> str:
        """Return the name of a row's trajectory, for messages."""
        return f"trajectory {self.labels[self.trajectory[row]]}"


def with_clean_names(frame: pd.DataFrame, source: str) -> pd.DataFrame:
    """Return a table with a named index as columns, and names that are different text.

    Raises
    ------
    HistoryError
        If a name is there twice.
    """
    if any(name is not None for name in frame.index.names):
        frame = frame.reset_index()
    frame = frame.set_axis([str(name).strip() for name in frame.columns], axis=1)
    if frame.columns.has_duplicates:
        name = frame.columns[frame.columns.duplicated()][0]
        raise HistoryError(f'{source}: column "{name}" is there twice; drop one')
    return frame


def read_rows(frame: pd.DataFrame, scene: Scene, source: str) -> Rows:
    """Return a table's rows after a check of the columns' names and of each cell.

    Raises
    ------
    HistoryError
        If a column is unknown or missing, or a cell is not what its column needs.
    """
    frame = with_clean_names(frame, source)
    for name in frame:
        if name not in COLUMNS:
            raise HistoryError(
                f'{source}: unknown column "{name}"{nearest(name, COLUMNS)} '
                f"Rename or drop it; the columns are {', '.join(COLUMNS)}"
            )
    required = ("trajectory", "time", "body", *WRENCH)
    if missing := [name for name in required if name not in frame]:
        raise HistoryError(
            f"{source}: missing column(s) {', '.join(missing)}; expected {', '.join(COLUMNS)} "
            "(step is optional)"
        )
    blank = (frame.isna() | (frame.astype(object) == "")).to_numpy(dtype=bool).all(axis=1)
    filled = np.flatnonzero(~blank)
    line, frame = filled + 2, frame.iloc[filled].reset_index(drop=True)
    if not len(frame):
        raise HistoryError(f"{source}: it has no rows; expected one for each body at each step")

    labels, trajectory = _trajectories(frame["trajectory"], line)
    body = _bodies(frame["body"], line, scene)
    where = [f"in trajectory {labels[i]}" for i in trajectory]
    number = {name: np.full(len(frame), np.nan) for name in ("time", *STATE, *WRENCH)} | {
        name: _numbers(frame[name], line, where)
        for name in frame.columns.difference(["trajectory", "body"], sort=False)
    }
    for name in ("time", "step"):
        if np.isnan(number.get(name, 0.0)).any():
            row = int(np.isnan(number[name]).argmax())
            raise HistoryError(
                f"history row {line[row]}: {name} is empty {where[row]}; expected a number; fill it"
                " in or drop the row"
            )
    step = number.get("step")
    if step is not None and (broken := (step != np.round(step)) | (np.abs(step) > 2**53)).any():
        row = int(broken.argmax())
        raise HistoryError(
            f"history row {line[row]}: step is {step[row]} {where[row]}; expected a whole number"
        )
    whole = None if step is None else step.astype(np.int64)
    state, action = (np.stack([number[name] for name in names], 1) for names in (STATE, WRENCH))
    return Rows(line, labels, trajectory, body, whole, number["time"], state, action)


def _trajectories(column: pd.Series, line: Ints) -> tuple[list[Any], Ints]:
    """Return the labels in order of appearance (integers where all are) and each row's code."""
    text = [str(cell).strip() for cell in column.astype(object).where(column.notna(), "")]
    if "" in text:
        raise HistoryError(
            f"history row {line[text.index('')]}: trajectory is empty; expected a number or a name;"
            " fill it in"
        )
    whole = [_INTEGER.fullmatch(label) for label in text]
    labels: list[Any] = [int(match[1]) for match in whole if match] if all(whole) else text
    codes, unique = pd.factorize(np.array(labels, dtype=object))
    return unique.tolist(), codes.astype(np.int64)


def _bodies(column: pd.Series, line: Ints, scene: Scene) -> Ints:
    """Return each row's position among the scene's moving bodies."""
    known = [body.name for body in scene.moving]
    names = [str(name).strip() for name in column.astype(object).where(column.notna(), "")]
    for row, name in enumerate(names):
        if name not in known:
            if name in [body.name for body in scene.bodies]:
                cure = "it is static there; drop its rows or set static = false"
            else:
                cure = f"the scene has {', '.join(known)}{nearest(name, known)}"
            raise HistoryError(
                f'history row {line[row]}: body "{name}" does not move in the scene; {cure}'
            )
    for name in known:
        if name not in names:
            raise HistoryError(
                f'history: body "{name}" of the scene has no rows; record it, or drop it from the '
                "scene or make it static"
            )
    return np.array([known.index(name) for name in names], dtype=np.int64)


def _numbers(column: pd.Series, line: Ints, where: list[str]) -> Floats:
    """Return a column as floats, NaN where empty."""
    if column.dtype.kind in "bmMc":
        values = np.full(len(column), np.nan)
    else:
        numeric = pd.to_numeric(column, errors="coerce")
        values = np.array(numeric.to_numpy(dtype=np.float64, na_value=np.nan))
    suspect = np.isnan(values) & column.notna().to_numpy(dtype=bool)
    for row in np.flatnonzero(suspect):
        if str(column[row]).strip().lower() not in ("", "nan"):
            raise HistoryError(
                f"history row {line[row]}: {column.name} is {str(column[row])!r} {where[row]};"
                " expected a number or an empty cell; correct it"
            )
    limit = np.inf if column.name in ("time", "step") else _LARGEST
    for row in np.flatnonzero(np.isinf(values) | (np.abs(values) > limit)):
        raise HistoryError(
            f"history row {line[row]}: {column.name} is {values[row]} {where[row]}; expected a"
            f" finite number of at most {_LARGEST:g}; empty the cell if it was not measured"
        )
    return values


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
        Name of the table in messages about the whole of it.

    Raises
    ------
    HistoryError
        At the first row that breaks a rule.
    """
    rows = read_rows(frame, scene, source)
    # Trajectories may alternate in the file; inside each one, the file's order counts.
    order = np.argsort(rows.trajectory, kind="stable")
    first, position = _steps(rows, order, scene)
    n_rows = np.zeros(len(rows.labels), dtype=np.int64)
    np.maximum.at(n_rows, rows.trajectory, position + 1)
    _check_complete(rows, scene, position, n_rows)
    shape = (len(n_rows), int(n_rows.max()), len(scene.moving))
    state, action = (np.full((*shape, len(names)), np.nan) for names in (STATE, WRENCH))
    clock = np.full(shape[:2], np.nan)
    state[rows.trajectory, position, rows.body] = rows.state
    action[rows.trajectory, position, rows.body] = rows.action
    head = order[first]
    clock[rows.trajectory[head], position[head]] = rows.time[head]
    # A last row's wrench acts in an interval that was not measured.
    action[np.arange(len(n_rows)), n_rows - 1] = np.nan
    return Arrays(rows.labels, n_rows, clock, state, action)


def _steps(rows: Rows, order: Ints, scene: Scene) -> tuple[Bools, Ints]:
    """Return where a step begins (in ``order``), and each row's step counted from 0."""
    dt = scene.time_step
    tolerance = TIME_TOLERANCE * dt
    time, trajectory = rows.time[order], rows.trajectory[order]
    inside = np.diff(trajectory, prepend=-1) == 0
    change = np.diff(time, prepend=time[0])
    if rows.step is None:
        first = ~inside | (np.abs(change) > tolerance)
        jump = first.astype(np.int64)
    else:
        jump = np.diff(rows.step[order], prepend=rows.step[order[0]])
        first = ~inside | (jump != 0)
    group = np.cumsum(first) - 1
    again = pd.Series(group * len(scene.moving) + rows.body[order]).duplicated().to_numpy()
    # In the order of the cures: rows out of order or twice look like gaps further on.
    rules = {
        "time goes back by {back:.6g} s in {where}; sort the rows or drop the duplicate": inside
        & (change < np.where(first, 0.0, -tolerance)),
        'a second row of body "{body}" at {moment} in {where}; expected one; drop the'
        " duplicate": again,
        "step goes back from {before} to {step} in {where}; sort the rows": inside & (jump < 0),
        "step skips from {before} to {step} in {where}; expected {next}; record every step, or give"
        " the rows after the gap a trajectory of their own": inside & (jump > 1),
        "step {step} has two times, {change:.6g} s apart, in {where}; expected one; give every body"
        " the same time at a step": inside & ~first & (change > tolerance),
        "{change:.6g} s since the step before in {where}; expected {dt:.6g} s, the scene's"
        " time_step, within 1 %; correct time_step, or have the history resampled (resample=True,"
        " --time-step)": inside & first & (np.abs(change - dt) > tolerance),
    }
    for message, broken in rules.items():
        if not broken.any():
            continue
        places = np.flatnonzero(broken)
        place = int(places[np.argmin(order[places])])
        row = int(order[place])
        step = 0 if rows.step is None else int(rows.step[row])
        before = step - int(jump[place])
        words = {"where": rows.trajectory_of(row), "body": scene.moving[rows.body[row]].name}
        words["moment"] = f"time {time[place]:.6g} s" if rows.step is None else f"step {step}"
        numbers = {"change": change[place], "back": -change[place], "dt": dt}
        steps = {"step": step, "before": before, "next": before + 1}
        raise rows.error(row, message.format(**words, **numbers, **steps))
    position = np.empty(len(order), dtype=np.int64)
    position[order] = group - np.maximum.accumulate(np.where(inside, 0, group))
    return first, position


def _check_complete(rows: Rows, scene: Scene, position: Ints, n_rows: Ints) -> None:
    """Refuse a history that lacks a body's row, a wrench before the last row, or a path's pose."""
    names = [body.name for body in scene.moving]
    for i in np.flatnonzero(n_rows < 2):
        row = int((rows.trajectory == i).argmax())
        raise rows.error(
            row,
            f"{rows.trajectory_of(row)} has 1 step; expected at least 2, a state and the one after"
            " it; drop the trajectory",
        )
    offset = np.cumsum(n_rows) - n_rows
    moment = offset[rows.trajectory] + position
    cell = moment * len(names) + rows.body
    for gap in np.setdiff1d(np.arange(n_rows.sum() * len(names)), cell):
        row = int((moment == gap // len(names)).argmax())
        raise rows.error(
            row,
            f'body "{names[gap % len(names)]}" has no row at time {rows.time[row]:.6g} s in '
            f"{rows.trajectory_of(row)}; expected one of each body at each step; add it, with empty"
            " cells for what was not measured",
        )
    kinematic = kinematic_bodies(scene)[rows.body]
    before_last = position < n_rows[rows.trajectory] - 1
    needed = (
        (
            rows.action,
            before_last & ~kinematic,
            WRENCH,
            "on every row but the last; write 0 where nothing pushed",
        ),
        (
            rows.state[:, :3],
            kinematic,
            STATE,
            "on every row: the body is kinematic and follows its path; fill it in (theta of a round"
            " body may be 0 throughout)",
        ),
    )
    for values, required, columns, cure in needed:
        for row, column in np.argwhere(np.isnan(values) & required[:, None]):
            raise rows.error(
                row,
                f'{columns[column]} of body "{names[rows.body[row]]}" is empty in '
                f"{rows.trajectory_of(row)}; expected a number {cure}",
            )
