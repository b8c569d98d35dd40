"""Tables of other programs: from columns as they are named to a history's, step by step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypedDict, Unpack

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError, RecordingWarning, warn
from pbrl_ppl.history.clocks import (
    Say,
    in_order,
    on_one_clock,
    stated_time_unit,
    with_later_commands,
)
from pbrl_ppl.history.cuts import cut, without_lost_rows
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.guesses import with_derived
from pbrl_ppl.history.measures import (
    in_si,
    numbers,
    stated_units,
    unit_in_name,
    with_whole_counts,
    with_zeros,
)
from pbrl_ppl.scene import Recording, Scene, column_of, nearest
from pbrl_ppl.state import STATE, WRENCH


class TableReading(TypedDict, total=False):
    """Options of :meth:`History.load`, most of them for tables of other programs.

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
    estimate_velocities : bool
        Whether single transitions (Eq. 11) may start from velocities that were never measured,
        as estimated from positions by a local polynomial. Whole trajectories need no estimate.
    """

    columns: Mapping[str, str | float] | None
    units: Mapping[str, str] | None
    resample: bool
    estimate_velocities: bool


def as_history(
    frame: pd.DataFrame,
    scene: Scene,
    source: str,
    layout: Recording | None = None,
    *,
    commands: pd.DataFrame | None = None,
    **reading: Unpack[TableReading],
) -> pd.DataFrame:
    """Return a table with a history's column names, in SI units, one step after the other.

    Parameters
    ----------
    frame : pandas.DataFrame
        As the file has it. Its index is kept: the rows' lines in the file.
    scene : Scene
        Names the bodies, and has the hinges that give angles their zero.
    source : str
        Name of the table in messages.
    layout : Recording, optional
        How the table is laid out; without one, and without columns in ``reading``, it must be a
        history's.
    commands : pandas.DataFrame, optional
        The table of ``layout.commands``.
    **reading
        Goes before what ``layout`` says.

    Raises
    ------
    HistoryError
        If a column, a body, a unit or a time is not what is expected.

    Warns
    -----
    RecordingWarning
        What was repaired or left out.
    """
    columns, units = reading.get("columns") or {}, reading.get("units") or {}
    frame, sent = with_commands(frame, scene)
    if layout is None and not (columns or sent):
        frame, said = in_si(frame, units), list[str]()
        if scene.actuators and {"trajectory", "body"} <= {*frame}:
            frame = _held(frame, scene, said.append)
        return _warned(frame, source, said)
    columns = {**sent, **columns}
    layout = (layout or Recording()).with_entries(columns=columns, units=units)
    said = list(frame.attrs.get("said", ()))
    say = said.append
    clocks = tuple(entry for entry in layout.time if commands is None or entry[0] != "offset")
    if is_history(frame):
        return _repaired(frame, scene, replace(layout, time=clocks), source, said)
    known = _numbered(frame, dict(layout.columns), source)
    layout = replace(layout, columns=tuple(known.items()))
    frame = with_derived(frame, say)
    frame = on_one_clock(frame, layout, commands, source, say)
    if "time" in frame and "duration" not in known:
        known["time"] = "time"  # in s by now
    named = renamed(frame, scene, known, source)
    named = with_whole_counts(_unseen_emptied(named, layout, source), say)
    stated = stated_units(frame, known)
    units = stated | {name: unit for name, unit in layout.units if name != "time"}
    named = with_zeros(in_si(named, units), scene, layout, source)
    return _repaired(named, scene, replace(layout, time=clocks), source, said)


def with_commands(frame: pd.DataFrame, scene: Scene) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return a table whose actuators' columns are those of wrenches, or which are to be so named.

    An actuator of a body takes the place of ``force_x``, the second that of ``force_y``, the third
    that of the torque; a history that was saved has them there already.
    """
    slots = {
        (body.name, wrench): actuator.column or actuator.name
        for body in scene.dynamic
        for wrench, actuator in zip(WRENCH, scene.actuators_of(body.name), strict=False)
    }
    missing = [column for column in slots.values() if column not in frame]
    if not slots or (missing and not {*WRENCH}.isdisjoint(frame)):
        return frame, {}
    if "body" not in frame or missing:
        alone = len(scene.moving) == 1
        return frame, {(w if alone else f"{b}.{w}"): c for (b, w), c in slots.items()}
    frame = frame.assign(**{w: frame.get(w, 0.0) for w in WRENCH})
    for (body, wrench), column in slots.items():
        frame[wrench] = frame[wrench].where(frame["body"] != body, frame[column])
    return frame.drop(columns=list(slots.values())), {}


def renamed(
    frame: pd.DataFrame, scene: Scene, columns: Mapping[str, object], source: str
) -> pd.DataFrame:
    """Return a table with a history's column names; others are left out.

    Parameters
    ----------
    frame : pandas.DataFrame
        Any columns.
    scene : Scene
        Names the bodies; with one that moves, the body's column may be missing.
    columns : mapping of str to str, float or table
        From a history's column to the table's, such as ``{"x": "pos_x"}``, or to a number that
        holds on all rows, such as ``{"force_x": 0.0}``. With several bodies side by side in a row,
        from a body's column, such as ``{"cart.x": "cart_px"}``; also as of `Recording.columns`.
        Columns that have a history's name already need not be named; without a trajectory's column,
        there is one trajectory.
    source : str
        Name of the table in messages.

    Raises
    ------
    HistoryError
        If a column or a body is unknown, or one body of several has no columns.
    """
    bare = {unit_in_name(str(name))[0]: name for name in frame.columns}
    names = [body.name for body in scene.moving]
    shared: dict[str, object] = {name: frame[name] for name in COLUMNS if name in frame}
    by_body: dict[str, dict[str, object]] = {}
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
        value = column  # a number, or a body's name, holds on all rows
        if not (isinstance(column, int | float) or (name == "body" and column in names)):
            title, sign, zero = parts_of(column)
            title = title if title in frame else bare.get(title, title)
            if title not in frame:
                raise HistoryError(
                    f'{source}: it has no column "{title}" for {key}'
                    f"{nearest(title, list(frame.columns))} It has {', '.join(frame.columns)}"
                )
            value = frame[title]
            if (sign, zero) != (1.0, 0.0):
                value = sign * (numbers(value) - zero)
        (by_body.setdefault(body, {}) if dot else shared)[name] = value
    shared.setdefault("trajectory", 0)
    if by_body:
        if lacking := [name for name in names if name not in by_body]:
            raise HistoryError(
                f"columns: {lacking[0]} has none, and {next(iter(by_body))} has; name each body's"
            )
        picked = [shared | by_body[name] | {"body": name} for name in names]
        parts = [pd.DataFrame(values, index=frame.index) for values in picked]
        # side by side in a row is one below the other in a history
        order = np.arange(len(frame) * len(parts)).reshape(len(parts), -1).T.ravel()
        return pd.concat(parts).iloc[order]
    if len(names) == 1:
        shared.setdefault("body", names[0])
    return pd.DataFrame(shared, index=frame.index)


def parts_of(column: object) -> tuple[str, float, float]:
    """Return a column's name, its sign, and the number that it has where the coordinate is 0.

    Examples
    --------
    >>> parts_of("-heading"), parts_of((("column", "knee"), ("zero", 90.0)))
    (('heading', -1.0, 0.0), ('knee', 1.0, 90.0))
    """
    table: dict[str, Any] = dict(column) if isinstance(column, tuple) else {"column": column}
    name, zero = str(table["column"]), table.get("zero", 0.0)
    sign = -1.0 if name.startswith("-") else 1.0
    return name.removeprefix("-"), sign, 0.0 if isinstance(zero, str) else float(zero)


def present_units(frame: pd.DataFrame, layout: Recording) -> dict[str, str]:
    """Return the units in which columns of a table are read, if not SI units."""
    columns = dict(layout.columns)
    time = stated_time_unit(frame, column_of(columns.get("time", "time")))
    stated = stated_units(frame, columns) | ({"time": time} if time else {})
    return stated | dict(layout.units)


def is_history(frame: pd.DataFrame) -> bool:
    """Return whether a table has all columns of a history."""
    return {*COLUMNS} - {"step"} <= {str(name).strip() for name in frame.columns}


def _numbered(frame: pd.DataFrame, columns: dict[str, object], source: str) -> dict[str, object]:
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
    names: dict[str, object] = {}
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
    unseen = np.all([numbers(frame[name]) == value for name, value in values.items()], axis=0)
    return frame.assign(**{name: frame[name].mask(unseen) for name in STATE if name in frame})


def _repaired(
    frame: pd.DataFrame, scene: Scene, layout: Recording, source: str, said: list[str]
) -> pd.DataFrame:
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
    said : list of str
        What was repaired before.

    Warns
    -----
    RecordingWarning
        What was repaired or left out.
    """
    frame, by_body = frame.copy(), ["trajectory", "body"]
    if not {*by_body} <= {*frame} or frame[by_body].isna().any(axis=None):
        return frame  # which is an error, and said where rows are read
    if "duration" in frame:
        frame["time"] = np.nan_to_num(numbers(frame.pop("duration")))
        frame["time"] = frame.groupby(by_body)["time"].cumsum()
    elif "time" not in frame:
        frame["time"] = frame.groupby(by_body).cumcount() * scene.time_step
    if layout.velocities == "computed":
        frame = frame.drop(columns=[name for name in STATE[3:] if name in frame])
    frame = in_order(frame, said.append)
    frame = without_lost_rows(frame, scene, said.append)
    frame = _held(frame, scene, said.append)
    if offset := float(dict(layout.time).get("offset", 0.0)):
        frame = with_later_commands(frame, offset)
    if layout.cut:
        before = len(frame)
        frame = cut(frame, dict(layout.cut), source)
        pieces = frame["trajectory"].nunique()
        said.append(f"cut into {pieces} trajectories, {before - len(frame)} rows between them")
    single = frame.groupby("trajectory")["time"].transform("nunique") < 2
    if single.any() and not single.all():
        left = frame.loc[single, "trajectory"].nunique()
        said.append(f"{left} trajectories of one step are left out")
        frame = frame[~single]
    return _warned(frame, source, said)


def _warned(frame: pd.DataFrame, source: str, said: list[str]) -> pd.DataFrame:
    """Return a table, after a warning of what was repaired, if anything was."""
    if said:
        warn(f"{source}: {'; '.join(said)}", RecordingWarning)
    return frame


def _held(frame: pd.DataFrame, scene: Scene, say: Say) -> pd.DataFrame:
    """Return a table with wrenches on all rows: zero where there are none, held where empty."""
    follows = {body.name for body in scene.moving if body.kinematic}
    pushed = ~frame["body"].isin(follows)
    last = ~frame.duplicated(["trajectory", "body"], keep="last")
    for name in WRENCH:
        if name not in frame:
            frame[name] = 0.0
        empty = frame[name].isna() & pushed
        if not empty.any():
            continue
        groups = frame[name].groupby([frame["trajectory"], frame["body"]])
        held = groups.transform(lambda column: column.ffill().bfill()).fillna(0.0)
        given = groups.transform("count") > 0  # else the file has no such column of this body
        frame[name] = frame[name].where(~empty, held)
        if between := int((empty & ~last & given).sum()):
            say(f"{name} is empty in {between} rows: the command before holds")
    return frame
