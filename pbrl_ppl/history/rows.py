"""Rows of a history, from a table or from arrays: checks, and conversion to padded arrays."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from pbrl_ppl.errors import HistoryError, printable
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.kinematics import kinematic_bodies
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints

#: How far an interval may be from the scene's time step, as a share of it.
TIME_TOLERANCE = 0.01

#: Labels of trajectories.
Labels = list[int | str]


@dataclass(frozen=True)
class Rows:
    """Rows of a history, one for each (trajectory, step, body), in any order.

    Attributes
    ----------
    labels : list of int or str
        Of the trajectories.
    trajectory, body : ndarray of int
        Position among the labels, and among the scene's moving bodies, shape (row,).
    step : ndarray of int or None
        Steps that are counted in the recording, shape (row,).
    time, state, action : ndarray
        Shape (row,), (row, 6) and (row, 3), SI units; NaN where a state or wrench is missing.
    line : ndarray of int or None
        Number of the row in its file; None of arrays.
    source : str
        Name of the recording in messages.
    cut : bool
        Whether trajectories are pieces of those that the file has.
    """

    labels: Labels
    trajectory: Ints
    body: Ints
    step: Ints | None
    time: Floats
    state: Floats
    action: Floats
    line: Ints | None = None
    source: str = "history"
    cut: bool = False

    def error(self, row: int, message: str) -> HistoryError:
        """Return an error that names the row of the file, or its time."""
        at = f"at {self.time[row]:.6g} s" if self.line is None else f"row {self.line[row]}"
        return HistoryError(f"{self.source} {at}: {message}")

    def trajectory_of(self, row: int) -> str:
        """Return the name of a row's trajectory, for messages; of a cut one, where it begins."""
        if self.cut and self.line is not None:
            first = int(self.line[self.trajectory == self.trajectory[row]].min())
            return f"the piece from row {first} on"
        return f"trajectory {self.labels[self.trajectory[row]]}"


def rows_of_arrays(
    states: npt.ArrayLike,
    scene: Scene,
    actions: npt.ArrayLike | None = None,
    times: npt.ArrayLike | None = None,
    labels: Sequence[int | str] | None = None,
) -> Rows:
    """Return the rows of arrays; arguments and errors as of :meth:`History.of_arrays`."""
    state, k = np.array(states, dtype=np.float64), len(scene.moving)
    if state.ndim != 4 or state.shape[2:] != (k, len(STATE)):
        raise HistoryError(
            f"history: states have shape {state.shape}, expected (trajectory, time, {k},"
            f" {len(STATE)}): {', '.join(STATE)} of {', '.join(b.name for b in scene.moving)}; add"
            " the axes that are missing (states[None] for one trajectory, states[:, :, None] for"
            " one body), NaN where nothing was measured"
        )
    n, length = state.shape[:2]
    action = np.zeros((n, length, k, len(WRENCH)))
    if actions is not None:
        wrenches = np.array(actions, dtype=np.float64)
        whole, intervals = action.shape, action[:, 1:].shape
        if wrenches.shape not in (whole, intervals):
            raise HistoryError(
                f"history: actions have shape {wrenches.shape}, expected {whole}, as the states"
                f" have, or {intervals}: {', '.join(WRENCH)} from each row to the next"
            )
        action[:, : wrenches.shape[1]] = wrenches
    clock = scene.time_step * np.arange(length) if times is None else np.asarray(times, np.float64)
    if clock.shape not in ((length,), (n, length)):
        raise HistoryError(
            f"history: times have shape {clock.shape}, expected {(n, length)} or {(length,)}: one"
            " for each row of a trajectory (s), NaN after its end"
        )
    clock = np.broadcast_to(clock, (n, length))
    names = list(range(n) if labels is None else labels)
    if len({*map(str, names)}) != n:
        raise HistoryError(
            f"history: labels are {names}, expected {n} different ones, one for each trajectory"
        )
    trajectory, step = np.nonzero(~np.isnan(clock))
    rows = Rows(
        names,
        np.repeat(trajectory, k),
        np.tile(np.arange(k), len(step)),
        np.repeat(step, k),
        np.repeat(clock[trajectory, step], k),
        state[trajectory, step].reshape(-1, len(STATE)),
        action[trajectory, step].reshape(-1, len(WRENCH)),
    )
    if empty := {*range(n)} - {*trajectory.tolist()}:
        raise HistoryError(
            f"history: trajectory {names[min(empty)]} has no times; expected at least 2; drop it"
        )
    _check_size(rows, scene)
    return rows


def _check_size(rows: Rows, scene: Scene, largest: float = 1e18) -> None:
    """Refuse states and wrenches that are infinite or too large."""
    for values, columns in ((rows.state, STATE), (rows.action, WRENCH)):
        for row, column in np.argwhere(np.abs(values) > largest):
            name = f'{columns[column]} of body "{scene.moving[rows.body[row]].name}"'
            raise rows.error(
                row,
                f"{name} is {values[row, column]} in {rows.trajectory_of(row)}; expected a finite"
                f" number of at most {largest:g}; NaN or an empty cell if it was not measured",
            )


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


def with_lines(frame: pd.DataFrame, source: str) -> pd.DataFrame:
    """Return a table with clean names, and the rows' lines in its file as its index.

    Tables that were not read from text count lines as a CSV file of them would: from 2.
    """
    lines = frame.attrs.get("lines", False)
    frame = with_clean_names(frame, source)
    return frame if lines else frame.set_axis(pd.RangeIndex(2, len(frame) + 2))


def rows_of_table(frame: pd.DataFrame, scene: Scene, source: str, *, cut: bool = False) -> Rows:
    """Return a table's rows after a check of the columns' names and of each cell.

    The index of the table is the number of each row in its file.

    Raises
    ------
    HistoryError
        If a column is unknown or missing, or a cell is not what its column needs.
    """
    for name in frame:
        if name not in COLUMNS:
            raise HistoryError(
                f'{source}: unknown column "{name}"{nearest(name, COLUMNS)} '
                f"Rename or drop it; the columns are {', '.join(COLUMNS)}. Of another program's"
                " table say which is which: columns = { time = ... } in [recording], or --columns"
            )
    required = ("trajectory", "time", "body", *WRENCH)
    if missing := [name for name in required if name not in frame]:
        raise HistoryError(
            f"{source}: missing column(s) {', '.join(missing)}; expected {', '.join(COLUMNS)} "
            "(step is optional)"
        )
    blank = (frame.isna() | (frame.astype(object) == "")).to_numpy(dtype=bool).all(axis=1)
    frame = frame.iloc[np.flatnonzero(~blank)]
    line, frame = frame.index.to_numpy(), frame.reset_index(drop=True)
    if not len(frame):
        raise HistoryError(f"{source}: it has no rows; expected one for each body at each step")

    at = [f"{source} row {number}" for number in line]
    labels, trajectory = _trajectories(frame["trajectory"], at)
    body = _bodies(frame["body"], at, scene)
    where = ["" if cut else f"in trajectory {labels[i]}" for i in trajectory]
    number = {name: np.full(len(frame), np.nan) for name in ("time", *STATE, *WRENCH)}
    given = frame.columns.difference(["trajectory", "body"], sort=False)
    number |= {name: _numbers(frame[name], at, where) for name in given}
    for name in ("time", "step"):
        for row in np.flatnonzero(~np.isfinite(number.get(name, np.zeros(0)))):
            value = number[name][row]
            raise HistoryError(
                f"{at[row]}: {name} is {'empty' if np.isnan(value) else value} {where[row]};"
                " expected a number; fill it in or drop the row"
            )
    step = number.get("step", np.zeros(0))
    for row in np.flatnonzero((step != np.round(step)) | (np.abs(step) > 2**53)):
        raise HistoryError(f"{at[row]}: step is {step[row]} {where[row]}; expected a whole number")
    whole = step.astype(np.int64) if "step" in number else None
    state, action = (np.stack([number[name] for name in names], 1) for names in (STATE, WRENCH))
    rows = Rows(labels, trajectory, body, whole, number["time"], state, action, line, source, cut)
    _check_size(rows, scene)
    return rows


def _trajectories(column: pd.Series, at: list[str]) -> tuple[Labels, Ints]:
    """Return the labels in order of appearance (integers where all are) and each row's code."""
    text = [str(cell).strip() for cell in column.astype(object).where(column.notna(), "")]
    if "" in text:
        raise HistoryError(
            f"{at[text.index('')]}: trajectory is empty; expected a number or a name; fill it in"
        )
    for label in dict.fromkeys(text):
        if printable(label) != label:
            raise HistoryError(
                f"{at[text.index(label)]}: trajectory is {label!r}, expected a name without control"
                " characters; rename it"
            )
    whole = [re.fullmatch(r"(-?(?:0|[1-9]\d{0,17}))(?:\.0*)?", label) for label in text]
    labels: Labels = [int(match[1]) for match in whole if match] if all(whole) else [*text]
    codes, unique = pd.factorize(np.array(labels, dtype=object))
    return unique.tolist(), codes.astype(np.int64)


def _bodies(column: pd.Series, at: list[str], scene: Scene) -> Ints:
    """Return each row's position among the scene's moving bodies."""
    known = [body.name for body in scene.moving]
    names = [str(name).strip() for name in column.astype(object).where(column.notna(), "")]
    for row, name in enumerate(names):
        if name not in known:
            cure = f"the scene has {', '.join(known)}{nearest(name, known)}"
            if name in [body.name for body in scene.bodies]:
                cure = "it is static there; drop its rows or set static = false"
            raise HistoryError(f'{at[row]}: body "{name}" does not move in the scene; {cure}')
    for name in known:
        if name not in names:
            raise HistoryError(
                f'history: body "{name}" of the scene has no rows; record it, or drop it from the '
                "scene or make it static"
            )
    return np.array([known.index(name) for name in names], dtype=np.int64)


def _numbers(column: pd.Series, at: list[str], where: list[str]) -> Floats:
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
                f"{at[row]}: {column.name} is {str(column[row])!r} {where[row]};"
                " expected a number or an empty cell; correct it"
            )
    return values


def padded(rows: Rows, scene: Scene) -> tuple[Ints, Floats, Floats, Floats]:
    """Return rows as checked arrays, NaN after a trajectory's end.

    Parameters
    ----------
    rows : Rows
        One for each (trajectory, step, body).
    scene : Scene
        The bodies and the time step that are expected.

    Returns
    -------
    n_rows, clock, state, action : ndarray
        Steps of each trajectory, shape (trajectory,); times, shape (trajectory, time), s; states
        and wrenches, shape (trajectory, time, body, 6 or 3), SI units.

    Raises
    ------
    HistoryError
        At the first row that breaks a rule.
    """
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
    return n_rows, clock, state, action


def _steps(rows: Rows, order: Ints, scene: Scene) -> tuple[Bools, Ints]:
    """Return where a step begins (in ``order``), and each row's step counted from 0."""
    dt, k = scene.time_step, len(scene.moving)
    tolerance = TIME_TOLERANCE * dt
    inside = np.diff(rows.trajectory[order], prepend=-1) == 0
    time = rows.time[order]
    change = np.diff(time, prepend=time[0])
    apart = ~inside | (np.abs(change) > tolerance)
    step = np.cumsum(apart) if rows.step is None else rows.step[order]
    jump = np.diff(step, prepend=step[0])
    first = ~inside | (jump != 0)
    group = np.cumsum(first) - 1
    again = pd.Series(group * k + rows.body[order]).duplicated().to_numpy()
    moment = "time {time:.6g} s" if rows.step is None else "step {step}"
    # in the order of the cures: rows out of order or twice look like gaps further on
    for broken, message, cure in (
        (
            inside & (change < np.where(first, 0.0, -tolerance)),
            "time goes back by {back:.6g} s",
            "sort the rows or drop the duplicate",
        ),
        (again, f'a second row of body "{{body}}" at {moment}', "expected one; drop the duplicate"),
        (inside & (jump < 0), "step goes back from {before} to {step}", "sort the rows"),
        (
            inside & (jump > 1),
            "step skips from {before} to {step}",
            "expected {after}; record every step, or give the rows after the gap a trajectory of"
            " their own",
        ),
        (
            inside & ~first & (change > tolerance),
            "step {step} has two times, {change:.6g} s apart,",
            "expected one; give every body the same time at a step",
        ),
        (
            inside & first & (np.abs(change - dt) > tolerance),
            "{change:.6g} s since the step before",
            f"expected {dt:.6g} s, the scene's time_step, within 1 %; correct time_step, or have"
            " the history resampled (resample, --time-step)",
        ),
    ):
        if broken.any():
            i = min(np.flatnonzero(broken), key=order.__getitem__)  # the first in the file
            row, before = int(order[i]), step[i] - jump[i]
            words = {"time": time[i], "change": change[i], "back": -change[i]}
            words |= {"step": step[i], "before": before, "after": before + 1}
            words |= {"body": scene.moving[rows.body[row]].name}
            said, cure = message.format(**words), cure.format(**words)
            raise rows.error(row, f"{said} in {rows.trajectory_of(row)}; {cure}")
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
    moment = (np.cumsum(n_rows) - n_rows)[rows.trajectory] + position
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
    pushed = (position < n_rows[rows.trajectory] - 1) & ~kinematic
    empty = (
        "on every row but the last; write 0 where nothing pushed, or declare [recording], by which"
        " an empty cell holds the command before"
    )
    for values, required, columns, cure in (
        (rows.action, pushed, WRENCH, empty),
        (
            rows.state[:, :3],
            kinematic,
            STATE,
            "on every row: the body is kinematic and follows its path; fill it in (theta of a round"
            " body may be 0 throughout)",
        ),
    ):
        for row, column in np.argwhere(np.isnan(values) & required[:, None]):
            raise rows.error(
                row,
                f'{columns[column]} of body "{names[rows.body[row]]}" is empty in '
                f"{rows.trajectory_of(row)}; expected a number {cure}",
            )
