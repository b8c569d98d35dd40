"""Tables of other programs: columns renamed, units converted."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError, RecordingWarning, warn
from pbrl_ppl.history.cuts import cut
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.rows import with_clean_names
from pbrl_ppl.scene import Recording, Scene, nearest
from pbrl_ppl.state import STATE, WRENCH

_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "in": 0.0254, "ft": 0.3048}
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "rev": 2 * np.pi}
_FORCE = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": 4.4482216152605}


def _rates(units: Mapping[str, float]) -> dict[str, float]:
    return {f"{a}/{b}": size / time for a, size in units.items() for b, time in _TIME.items()}


#: What each column may be measured in, in SI units.
_UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("time", "duration"), _TIME),
    **dict.fromkeys(("x", "y"), _LENGTH),
    "theta": _ANGLE,
    **dict.fromkeys(("vx", "vy"), _rates(_LENGTH)),
    "omega": _rates(_ANGLE) | {"rpm": 2 * np.pi / 60},
    **dict.fromkeys(("force_x", "force_y"), _FORCE),
    "torque": {
        f"{a}{mark}{b}": force * length
        for a, force in _FORCE.items()
        for b, length in _LENGTH.items()
        for mark in (" ", "", "*")
    },
}


def renamed(
    frame: pd.DataFrame, scene: Scene, columns: Mapping[str, str | float], source: str
) -> pd.DataFrame:
    """Return a table with a history's column names; others are left out.

    Parameters
    ----------
    frame : pandas.DataFrame
        Any columns.
    scene : Scene
        Names the bodies; with one that moves, the body's column may be missing.
    columns : mapping of str to str or float
        From a history's column to the table's, such as ``{"x": "pos_x"}``, or to a number that
        holds on all rows, such as ``{"force_x": 0.0}``. With several bodies side by side in a row,
        from a body's column, such as ``{"cart.x": "cart_px"}``. Columns that have a history's name
        already need not be named; without a trajectory's column, there is one trajectory.
    source : str
        Name of the table in messages.

    Raises
    ------
    HistoryError
        If a column or a body is unknown, or one body of several has no columns.
    """
    frame = with_clean_names(frame, source)
    names = [body.name for body in scene.moving]
    shared: dict[str, str | float] = {name: name for name in COLUMNS if name in frame}
    by_body: dict[str, dict[str, str | float]] = {}
    for key, column in columns.items():
        body, dot, name = key.rpartition(".")
        if name not in (*COLUMNS, "duration") or (dot and name not in (*STATE, *WRENCH)):
            raise HistoryError(
                f'columns: "{key}" is no column of a history{nearest(name, COLUMNS)}'
                f" expected {', '.join(COLUMNS)}, duration in place of time, or one of a body such"
                f" as {names[0]}.x"
            )
        if dot and body not in names:
            raise HistoryError(f'columns: "{key}": the scene has {", ".join(names)}')
        constant = not isinstance(column, str) or (name == "body" and column in names)
        if not constant and column not in frame:
            raise HistoryError(
                f'{source}: it has no column "{column}" for {key}'
                f"{nearest(column, list(frame.columns))} It has {', '.join(frame.columns)}"
            )
        (by_body.setdefault(body, {}) if dot else shared)[name] = column
    shared.setdefault("trajectory", 0)
    if by_body:
        if lacking := [name for name in names if name not in by_body]:
            raise HistoryError(
                f"columns: {lacking[0]} has none, and {next(iter(by_body))} has; name each body's"
            )
        shared.pop("body", None)
        parts = [_picked(frame, shared | by_body[name]).assign(body=name) for name in names]
        # side by side in a row is one below the other in a history
        return pd.concat(parts).sort_index(kind="stable").reset_index(drop=True)
    if len(names) == 1:
        shared.setdefault("body", names[0])
    return _picked(frame, shared)


def _picked(frame: pd.DataFrame, columns: Mapping[str, str | float]) -> pd.DataFrame:
    """Return the columns by their new names; other values are the same on all rows."""
    frame = frame.reset_index(drop=True)
    return pd.DataFrame(
        {
            name: frame[column] if isinstance(column, str) and column in frame else column
            for name, column in columns.items()
        },
        index=frame.index,
    )


def in_si(frame: pd.DataFrame, units: Mapping[str, str]) -> pd.DataFrame:
    """Return a history's table in SI units.

    Parameters
    ----------
    frame : pandas.DataFrame
        With a history's column names.
    units : mapping of str to str
        What columns are measured in, such as ``{"x": "mm", "theta": "deg"}``; the others are in SI
        units.

    Raises
    ------
    HistoryError
        If a column or a unit is unknown.

    Examples
    --------
    >>> in_si(pd.DataFrame({"x": [1500.0], "omega": [180.0]}), {"x": "mm", "omega": "deg/s"})
         x     omega
    0  1.5  3.141593
    """
    frame = frame.copy()
    for name, unit in units.items():
        if name not in _UNITS:
            raise HistoryError(f'units: "{name}" has none{nearest(name, _UNITS)}')
        if unit not in _UNITS[name]:
            known = [known_unit for known_unit in _UNITS[name] if "*" not in known_unit]
            raise HistoryError(
                f'units: "{unit}" is none of {name}; expected one of {", ".join(known[:12])}'
            )
        if name not in frame:
            raise HistoryError(f'units: "{name}" is in {unit}, and the table has no such column')
        values = pd.to_numeric(frame[name], errors="coerce")
        # non-numbers are kept, for the message that names them
        frame[name] = (values * _UNITS[name][unit]).where(values.notna(), frame[name])
    return frame


class Reading(TypedDict, total=False):
    """Options of :meth:`History.load` for tables of other programs.

    Attributes
    ----------
    columns : mapping of str to str or float
        The table's own column names, ``{"x": "pos_x"}``, or a number that holds on all rows,
        ``{"force_x": 0.0}``; ``{"cart.x": "cart_px"}`` with several bodies in a row. Columns that
        are neither named here nor a history's are left out.
    units : mapping of str to str
        What columns are measured in, if not SI units: ``{"x": "mm", "theta": "deg"}``.
    resample : bool
        Whether uneven samples are interpolated every ``time_step`` of the scene, with a
        `ResamplingWarning` that says what this does to the noise.
    """

    columns: Mapping[str, str | float] | None
    units: Mapping[str, str] | None
    resample: bool


def as_history(
    frame: pd.DataFrame,
    scene: Scene,
    source: str,
    layout: Recording | None = None,
    **reading: Unpack[Reading],
) -> pd.DataFrame:
    """Return a table with a history's column names, in SI units.

    ``layout`` says how it is laid out; what ``reading`` says goes before it.
    """
    columns, units = dict(reading.get("columns") or {}), dict(reading.get("units") or {})
    if layout is not None:
        columns, units = dict(layout.columns) | columns, dict(layout.units) | units
    columns = dict(_numbered(frame, columns, source))
    if columns or layout is not None:
        frame = renamed(frame, scene, columns, source)
    if layout is not None:
        frame = _unseen_emptied(frame, layout, source)
    if units:
        frame = in_si(frame, units)
    return frame if layout is None else _completed(frame, scene, layout, source)


def layout_of(frame: pd.DataFrame, layout: Recording | None) -> Recording | None:
    """Return how a table is laid out; names and units of a history's columns are as they should."""
    if layout is None or not is_history(frame):
        return layout
    return replace(layout, columns=(), units=(), not_seen=())


def is_history(frame: pd.DataFrame) -> bool:
    """Return whether a table has all columns of a history."""
    return {*COLUMNS} - {"step"} <= {str(name).strip() for name in frame.columns}


def _numbered(
    frame: pd.DataFrame, columns: Mapping[str, str | float], source: str
) -> Mapping[str, str | float]:
    """Return the columns of a table by name; of one without header they are numbered from 0.

    Raises
    ------
    HistoryError
        If the table has no header, and a number is none of its columns'.
    """
    if not frame.attrs.get("headerless"):
        return columns
    if not columns:
        raise HistoryError(
            f"{source}: it has no header; say which of its {len(frame.columns)} columns is which,"
            f" from 0 (--columns time=0,x=1, or columns = {{ time = 0, x = 1 }} in [recording])"
        )
    names: dict[str, str | float] = {}
    for name, column in columns.items():
        text = f"{column:g}" if isinstance(column, int | float) else column
        if text not in frame:
            raise HistoryError(
                f"{source}: it has no header and {len(frame.columns)} columns, numbered from 0; got"
                f" {text} for {name}"
            )
        names[name] = text
    return names


def _unseen_emptied(frame: pd.DataFrame, layout: Recording, source: str) -> pd.DataFrame:
    """Return a table without the states of rows that stand for "not seen"."""
    values = dict(layout.not_seen)
    for name in values:
        if name not in frame or name not in STATE:
            raise HistoryError(
                f'{source}: not_seen names "{name}", which is no state column of it'
                f"{nearest(name, [column for column in STATE if column in frame])}"
            )
    if not values:
        return frame
    unseen = np.all(
        [pd.to_numeric(frame[name], errors="coerce") == value for name, value in values.items()],
        axis=0,
    )
    frame = frame.copy()
    frame.loc[unseen, [name for name in STATE if name in frame]] = np.nan
    return frame


def _completed(frame: pd.DataFrame, scene: Scene, layout: Recording, source: str) -> pd.DataFrame:
    """Return a table with times, wrenches and trajectories as its layout says.

    Parameters
    ----------
    frame : pandas.DataFrame
        With a history's column names, in SI units.
    scene : Scene
        Its time step is that of rows without a time.
    layout : Recording
        The layout.
    source : str
        Name of the table in messages.

    Warns
    -----
    RecordingWarning
        How many rows are left out, and why.
    """
    frame, by_body = frame.copy(), ["trajectory", "body"]
    if not {*by_body} <= {*frame} or frame[by_body].isna().any(axis=None):
        return frame  # which is an error, and said where rows are read
    if "duration" in frame:
        duration = pd.to_numeric(frame.pop("duration"), errors="coerce").fillna(0.0)
        frame["time"] = duration.groupby([frame[name] for name in by_body]).cumsum()
    elif "time" not in frame:
        frame["time"] = frame.groupby(by_body).cumcount() * scene.time_step
    if not set(WRENCH) & set(frame):
        frame[list(WRENCH)] = 0.0
    if layout.velocities == "computed":
        frame = frame.drop(columns=[name for name in STATE[3:] if name in frame])
    repeated = frame.duplicated([*by_body, "time"])
    said = [f"{repeated.sum()} rows repeat a time and are left out"] if repeated.any() else []
    frame = frame[~repeated].reset_index(drop=True)
    if layout.cut:
        before = len(frame)
        frame = cut(frame, dict(layout.cut), source)
        pieces = frame["trajectory"].nunique()
        said.append(f"cut into {pieces} trajectories, {before - len(frame)} rows between them")
    if said:
        warn(f"{source}: {'; '.join(said)}", RecordingWarning)
    return frame
