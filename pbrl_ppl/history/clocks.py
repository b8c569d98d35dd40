"""Times of a recording's rows: units, bursts, clocks that start again, streams on other clocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError, LayoutError
from pbrl_ppl.history.measures import TIME, known_size, numbers, stated_unit, unit_in_name
from pbrl_ppl.history.resampling import held_means
from pbrl_ppl.scene import Recording, column_of
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints

#: Names of columns of times, in lower case.
TIMES = ("time", "t", "stamp", "timestamp", "header.stamp", "secs", "seconds", "sec")
Say = Callable[[str], None]


def likely_unit(stamps: Floats, slowest: float = 2.0) -> str:
    """Return the unit that stamps are likely in: by the year, or by the time between rows.

    Rows further apart than ``slowest`` (s) are believed where the unit is declared only.

    Examples
    --------
    >>> likely_unit(1.7e18 + 1e7 * np.arange(9.0)), likely_unit(20.0 * np.arange(9.0))
    ('ns', 'ms')
    >>> likely_unit(0.02 * np.arange(9.0))
    's'
    """
    stamps = stamps[np.isfinite(stamps)]
    if len(stamps) < 2:
        return "s"
    for unit in ("s", "ms", "us", "ns"):
        if 1e9 < float(np.median(stamps)) * TIME[unit] < 2.1e9:  # 2001 to 2036
            return unit
    # of bursts most steps are tiny, and one of a few is not; between runs there are pauses
    steps = np.sort(np.abs(np.diff(stamps)))
    step = float(steps[: max(1, int(0.9 * len(steps)))].mean())
    if step < slowest:
        return "s"
    return next((unit for unit in ("ms", "us") if step * TIME[unit] <= 0.5), "ns")


def on_one_clock(
    frame: pd.DataFrame, layout: Recording, commands: pd.DataFrame | None, source: str, say: Say
) -> pd.DataFrame:
    """Return a table with ``time`` (s), and with columns of other clocks at its rows' times.

    Parameters
    ----------
    frame : pandas.DataFrame
        The file's columns.
    layout : Recording
        Its ``columns``, ``units``, ``time`` and ``hold`` are used.
    commands : pandas.DataFrame, optional
        Table of the commands, with stamps of its own.
    source : str
        Name of the recording in messages.
    say : callable
        Takes a sentence on what was done.

    Raises
    ------
    LayoutError
        If the unit of the times is not what the numbers say, or they come in bursts.
    HistoryError
        If a column of times is missing or two clocks have no time in common.
    """
    clocks, whole = dict(layout.time), frame
    bare = {unit_in_name(str(column))[0]: column for column in frame.columns}
    columns = {name: bare.get(column, column) for name, column in layout.columns}
    own = {name: clocks[name] for name in clocks if name.rpartition(".")[2] in (*STATE, *WRENCH)}
    own = {name: bare.get(column, column) for name, column in own.items()}
    for name, column in own.items():
        if column not in frame or columns.get(name, name) not in frame:
            raise HistoryError(
                f'{source}: [recording] time has {name} = "{column}", and the file has no such'
                f" column, or none of {name}; it has {', '.join(map(str, frame.columns))}"
            )
    states = [str(column) for key, column in own.items() if key.rpartition(".")[2] in STATE]
    name = str(columns.get("time", "time"))
    name = name if name in frame else [*states, name][0]
    if name in frame:
        if own:  # of a longer column with a clock of its own the rows below are no rows
            frame = frame[frame[name].notna()]
        time = _seconds(frame, name, layout, source)
        if not own:
            frame, time = _of_two_streams(frame, columns, time, layout, say)
    elif "rate" in clocks:
        time = np.zeros(len(frame))
    else:
        return frame
    if "rate" in clocks:
        time = _at_rate(frame, layout, time, source, say)
    elif counted := _bursts(frame, layout, time):
        message, entry = counted
        raise LayoutError(f"{source}: {message}", time=entry)
    frame = frame.assign(time=time)
    for key, column in own.items():
        if column == name:
            continue
        value = columns.get(key, key)
        stamps = _seconds(whole, column, layout, source)
        values = numbers(whole[value])
        hold = key.rpartition(".")[2] in WRENCH and _holds(layout, stamps, values)
        frame = _brought(frame, str(value), stamps, values, say, hold=hold)
    if commands is not None:
        frame = _with_commands(frame, layout, commands, source, say)
    first = float(np.nanmin(frame["time"]))  # s since 1970
    return frame.assign(time=frame["time"] - first) if abs(first) > 1e9 else frame


def _seconds(frame: pd.DataFrame, name: str, layout: Recording, source: str) -> Floats:
    """Return a column of stamps in s: in its unit, or of dates."""
    column, units = frame[name], dict(layout.units)
    stamps = numbers(column)
    if np.isnan(stamps).all() and column.notna().any():
        try:
            dates = pd.to_datetime(column, utc=True, format="ISO8601")
        except (ValueError, TypeError):
            raise HistoryError(
                f"{source}: {name} is {column.dropna().iloc[0]!r}, expected a number or a date such"
                " as 2024-05-28T10:00:00.25"
            ) from None
        since = (dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
        return np.array(since, dtype=float)
    unit = units.get("time", stated_time_unit(frame, name))
    if not unit:
        unit = likely_unit(stamps)
        if unit != "s":
            raise LayoutError(
                f'{source}: the times of column "{name}" rise by'
                f" {np.nanmedian(np.abs(np.diff(stamps))):.4g} a row, which is no time in s: looks"
                f' like {unit}: units = {{ time = "{unit}" }} in [recording] (or --units);'
                ' or units = { time = "s" }',
                units={"time": unit},
            )
    return stamps * known_size("time", unit)


def stated_time_unit(frame: pd.DataFrame, name: str) -> str:
    """Return the unit of time that a file states of a column, or an empty text."""
    stated = stated_unit(frame, name)
    return stated if stated in TIME else ""


def _at_rate(
    frame: pd.DataFrame, layout: Recording, stamps: Floats, source: str, say: Say
) -> Floats:
    """Return the times of rows at an even rate: by their counter, or by their order."""
    clocks = dict(layout.time)
    named = [dict(layout.columns).get(name, name) for name in ("trajectory", "body")]
    keys = [name for name in named if name in frame]
    if "counter" in clocks:
        if clocks["counter"] not in frame:
            raise HistoryError(
                f'{source}: [recording] time has counter = "{clocks["counter"]}", which is no'
                f" column; it has {', '.join(map(str, frame.columns))}"
            )
        count = numbers(frame[clocks["counter"]])
    else:
        order = frame.groupby(keys).cumcount() if keys else np.arange(len(frame))
        count = np.asarray(order, dtype=float)
    time = count / float(clocks["rate"])
    off = (time - stamps) - np.nanmedian(time - stamps)
    if np.isfinite(off).any() and np.ptp(stamps) > 0 and not keys:
        far = float(np.nanmax(np.abs(off)))
        if far > max(0.5, 50.0 / float(clocks["rate"])):
            say(
                f"times of rows at {clocks['rate']:g} Hz are up to {far:.3g} s from their stamps:"
                " rows are missing, or this is not their rate"
            )
    return np.asarray(time)


def _bursts(
    frame: pd.DataFrame, layout: Recording, time: Floats
) -> tuple[str, dict[str, str | float]] | None:
    """Return a message on stamps that come in bursts, with the entry that cures them."""
    whole = np.isfinite(time) & ~frame.duplicated().to_numpy()
    body = column_of(dict(layout.columns).get("body", "body"))
    if body in frame and whole.any():  # rows of several bodies share a stamp
        whole &= (frame[body] == frame[body].iloc[int(whole.argmax())]).to_numpy(dtype=bool)
    rows, seen = np.flatnonzero(whole), time[whole]
    steps = np.diff(seen)
    if len(steps) < 20:
        return None
    starts = np.flatnonzero(np.append(True, steps < -50 * np.median(np.abs(steps))))
    first, last = max(pairwise((*starts, len(seen))), key=lambda run: run[1] - run[0])
    rows, seen = rows[first:last], seen[first:last]
    counters = [name for name in frame.columns if _is_counter(frame[name].iloc[rows])]
    count = frame[counters[0]].iloc[rows].to_numpy(float) if counters else np.arange(len(rows))
    rate = float(np.polyfit(seen, count, 1)[0]) if np.ptp(seen) > 0 else 0.0
    steps = np.diff(seen)
    hair = np.abs(steps) * rate < 0.25
    if not rate > 0 or hair.mean() < 0.4 or not _moves_within(frame, layout, rows, hair):
        return None
    entry: dict[str, str | float] = {"rate": _round_rate(rate)}
    written = f"rate = {entry['rate']:g}"
    if counters:
        entry["counter"] = str(counters[0])
        written += f', counter = "{counters[0]}"'
    return (
        f"the stamps come in bursts, {hair.mean():.0%} of them within"
        f" {np.abs(steps[hair]).max():.2g} s of the row before ({int((steps < 0).sum())} go back):"
        f" they say when rows arrived, not when they were measured; if rows are even,"
        f" [recording] time = {{ {written} }}"
    ), entry


def _moves_within(frame: pd.DataFrame, layout: Recording, rows: Ints, hair: Bools) -> bool:
    """Return whether a state changes as much between rows of nearly one stamp as between others.

    If not, the stamps are true, and rows are twice.
    """
    for name in _present(frame, dict(layout.columns), STATE):
        change = np.abs(np.diff(numbers(frame[name].iloc[rows])))
        if np.nanmedian(change[hair]) > 0.5 * np.nanmedian(change[~hair]):
            return True
    return False


def _is_counter(column: pd.Series) -> bool:
    """Return whether a column counts the rows."""
    values = numbers(column)
    steps = np.diff(values)
    whole = np.isfinite(values).all() and (values == np.round(values)).all()
    return bool(whole and (steps >= 0).all() and (steps == 1).mean() > 0.8)


def _round_rate(rate: float) -> float:
    """Return a rate (Hz) to two digits where that is within 1 % of it, else to four."""
    near = float(f"{rate:.2g}")
    return near if abs(near / rate - 1) < 0.01 else float(f"{rate:.4g}")


def _at_times(times: Floats, stamps: Floats, values: Floats, *, hold: bool) -> Floats:
    """Return values at times: the mean until the next row of what is held, or straight lines.

    Values before the first stamp are the first's where it is held, else NaN.

    Parameters
    ----------
    times : ndarray
        Of the rows, in any order, shape (n,), s.
    stamps, values : ndarray
        Shape (m,), s; those that are not both finite are left out.

    Examples
    --------
    >>> _at_times(np.arange(3.0), np.array([0.0, 1.5]), np.array([1.0, 3.0]), hold=True)
    array([1., 2., 3.])
    """
    seen = np.isfinite(stamps) & np.isfinite(values)
    stamps, at = np.unique(stamps[seen], return_index=True)
    values = values[seen][at]
    if not len(stamps):
        return np.full(len(times), np.nan)
    if not hold:
        return np.asarray(np.interp(times, stamps, values, left=np.nan, right=np.nan))
    rows, back = np.unique(times, return_inverse=True)
    last = values[np.clip(np.searchsorted(stamps, rows[-1:], side="right") - 1, 0, None)]
    return np.append(held_means(rows, stamps, values), last)[back]


def _holds(layout: Recording, stamps: Floats, values: Floats) -> bool:
    """Return whether a command holds until the next, as declared, or as its values look.

    Samples of a smooth signal, most of which change by nearly as much as the one before, do not.
    """
    if layout.hold is not None:
        return layout.hold
    seen = np.isfinite(stamps) & np.isfinite(values)
    steps = np.diff(values[seen][np.argsort(stamps[seen])])
    if len(steps) < 8 or (steps == 0).mean() > 0.3:
        return True
    return bool(np.median(np.abs(np.diff(steps))) > 0.5 * np.median(np.abs(steps)))


def _brought(
    frame: pd.DataFrame, name: str, stamps: Floats, values: Floats, say: Say, *, hold: bool
) -> pd.DataFrame:
    """Return a table with a column of another clock at its rows' times."""
    times = frame["time"].to_numpy(float)
    first = np.nanmin(stamps) - np.nanmin(times)
    how = "held onto" if hold else "interpolated onto"
    say(f"{name}, which begins {first:.4g} s after the rows, is {how} their times")
    return frame.assign(**{name: _at_times(times, stamps, values, hold=hold)})


def command_stamps(commands: pd.DataFrame, layout: Recording, source: str = "history") -> Floats:
    """Return the times of the rows of a table of commands (s).

    Raises
    ------
    HistoryError
        If it has no column of times.
    """
    columns, clocks = dict(layout.columns), dict(layout.time)
    plain = {str(name): unit_in_name(str(name))[0].lower() for name in commands.columns}
    named = (n for n, text in plain.items() if n == columns.get("time") or text in TIMES)
    time = clocks.get("commands") or next(named, None)
    if time not in commands:
        raise HistoryError(
            f"{source}: {layout.commands} has no column of times; say which it is: [recording]"
            f' time = {{ commands = "..." }}; it has {", ".join(plain)}'
        )
    numeric = numbers(commands[time])
    unit = stated_time_unit(commands, str(time)) or likely_unit(numeric)
    return np.asarray(numeric * TIME[unit] + float(clocks.get("offset", 0.0)))


def command_step(commands: pd.DataFrame, layout: Recording) -> float:
    """Return the median time between commands (s), to two digits where that is within 1 %."""
    return 1.0 / _round_rate(1.0 / float(np.median(np.diff(command_stamps(commands, layout)))))


def _with_commands(
    frame: pd.DataFrame, layout: Recording, commands: pd.DataFrame, source: str, say: Say
) -> pd.DataFrame:
    """Return a table with the commands of another file at its rows."""
    rows, stamps = frame["time"].to_numpy(float), command_stamps(commands, layout, source)
    wanted = _present(commands, dict(layout.columns), WRENCH)
    if not wanted:
        raise HistoryError(
            f"{source}: {layout.commands} has no column of a wrench; say which it is: columns ="
            f' {{ torque = "..." }}; it has {", ".join(map(str, commands.columns))}'
        )
    if np.nanmin(stamps) > np.nanmax(rows) or np.nanmax(stamps) < np.nanmin(rows):
        raise HistoryError(
            f"{source}: commands run from {np.nanmin(stamps):.6g} to {np.nanmax(stamps):.6g} s and"
            f" the rows from {np.nanmin(rows):.6g} to {np.nanmax(rows):.6g} s, so that they have no"
            " time in common; [recording] time = { offset = ... } adds seconds to the commands'"
        )
    if (np.diff(rows[np.isfinite(rows)]) < -1.0).any():
        raise HistoryError(
            f"{source}: its clock starts again, and commands in a file of their own need one clock"
            " throughout; write a file for each start"
        )
    for name in wanted:
        values = numbers(commands[name])
        hold = _holds(layout, stamps, values)
        frame = _brought(frame, name, stamps, values, say, hold=hold)
    return frame


def _present(frame: pd.DataFrame, columns: Mapping[str, object], names: Sequence[str]) -> list[str]:
    """Return the columns of a table that are of these names of a history, each once."""
    every = {key: column_of(columns.get(key, key)) for key in (*columns, *names)}
    found = (column for key, column in every.items() if key.rpartition(".")[2] in names)
    return [column for column in dict.fromkeys(found) if column in frame]


def _falls_back(time: Floats, far: float) -> Bools:
    """Return after which rows the clock falls back by more than so many rows' time."""
    steps = np.diff(time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return np.asarray(steps < -far * usual)


def _of_two_streams(
    frame: pd.DataFrame, columns: Mapping[str, object], time: Floats, layout: Recording, say: Say
) -> tuple[pd.DataFrame, Floats]:
    """Return the rows that have a state, with the commands of the others, and their times (s).

    The others are rows of commands alone, as of topics that were merged: they have no state, but
    something that next to no row with a state has.
    """
    states = _present(frame, columns, STATE)
    posed = frame[states].notna().any(axis=1).to_numpy(dtype=bool)
    named = {key: column for key, column in columns.items() if key.rpartition(".")[2] in WRENCH}
    sent = [name for name in map(column_of, named.values()) if name in frame]
    sent = sent or [str(name) for name in frame if name not in states]
    others = frame[sent].notna().to_numpy(dtype=bool)
    rare = others[posed].sum(axis=0) < 0.1 * others.sum(axis=0)
    alone = ~posed & others[:, rare].any(axis=1)
    if not posed.any() or not alone.any():
        return frame, time
    run = np.append(0, np.cumsum(_falls_back(time, 50.0)))
    brought = {}
    for name in _present(frame, columns, WRENCH):
        values = numbers(frame[name])
        hold, at_rows = _holds(layout, time, values), np.full(len(frame), np.nan)
        for number in np.unique(run[~alone]):
            here = run == number
            rows = here & ~alone
            at_rows[rows] = _at_times(time[rows], time[here], values[here], hold=hold)
        brought[name] = at_rows[~alone]
    say(f"{int(alone.sum())} rows hold commands and no state: read as a stream of their own")
    return frame[~alone].assign(**brought), time[~alone]


def with_later_commands(frame: pd.DataFrame, offset: float) -> pd.DataFrame:
    """Return a history's table whose commands are so many seconds later than their rows."""
    time, moved = numbers(frame["time"]), {name: numbers(frame[name]) for name in WRENCH}
    for rows in frame.groupby(["trajectory", "body"], sort=False).indices.values():
        for values in moved.values():
            values[rows] = _at_times(time[rows], time[rows] + offset, values[rows], hold=True)
    return frame.assign(**moved)


def in_order(frame: pd.DataFrame, say: Say, *, far: float = 5.0) -> pd.DataFrame:
    """Return rows in the order of their times; a clock that falls back begins a new trajectory.

    Parameters
    ----------
    frame : pandas.DataFrame
        With ``trajectory``, ``body`` and ``time`` (s).
    say : callable
        Takes a sentence on each repair.
    far : float
        A clock that falls back by more than so many rows' time starts again; rows that are out of
        order by less are sorted.
    """
    time = numbers(frame["time"])
    run = np.zeros(len(frame), dtype=int)
    groups = frame.groupby(["trajectory", "body"], sort=False, dropna=False).indices
    swapped, resets = 0, 0
    for rows in groups.values():
        starts = _falls_back(time[rows], far)
        run[rows] = np.append(0, np.cumsum(starts))
        swapped += int(((np.diff(time[rows]) < 0) & ~starts).sum())
        resets += int(starts.sum())
    if resets:
        say(f"the clock falls back {resets} times: a new trajectory begins there each time")
        text = frame["trajectory"].astype(str) + "."
        prefix = "" if frame["trajectory"].nunique() == 1 else text
        frame = frame.assign(trajectory=prefix + pd.Series(run, frame.index).astype(str))
    if swapped:
        say(f"{swapped} rows are out of order by less than {far:g} rows: sorted by time")
    # bodies one below the other are brought side by side
    frame = frame.iloc[np.lexsort((time, run, pd.factorize(frame["trajectory"])[0]))]
    keys = ["trajectory", "body", "time"]
    again = frame.duplicated(keys) & frame["time"].notna()
    if again.any():
        other = int((again & ~frame.duplicated()).sum())
        words = f", {other} of them with other values" if other else ""
        say(f"{int(again.sum())} rows repeat a time and are left out{words}")
    return frame[~again]
