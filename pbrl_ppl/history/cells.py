"""Columns of a history's table: names, labels and numbers, each cell checked by itself."""

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
