"""Raw recordings: durations, repeated stamps, values for "not seen", and cuts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import find_peaks

from pbrl_ppl.errors import HistoryError, RecordingWarning
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.kinematics import column_noise
from pbrl_ppl.scene import Recording, Scene, nearest
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints

#: Rows of a piece, at least.
_LEAST_ROWS = 3
#: Range of a body at rest, in measurement noises.
_STILL = 8.0
#: Rows on each side of a jump whose slope is the velocity there.
_SIDE = 5


def layout_of(frame: pd.DataFrame, layout: Recording | None) -> Recording | None:
    """Return how a table is laid out; names and units of a history's columns are as they should."""
    if layout is None or not is_history(frame):
        return layout
    return replace(layout, columns=(), units=(), not_seen=())


def is_history(frame: pd.DataFrame) -> bool:
    """Return whether a table has all columns of a history."""
    return {*COLUMNS} - {"step"} <= {str(name).strip() for name in frame.columns}


def numbered(
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
    found: dict[str, str | float] = {}
    for name, column in columns.items():
        text = f"{column:g}" if isinstance(column, int | float) else column
        if text not in frame:
            raise HistoryError(
                f"{source}: it has no header and {len(frame.columns)} columns, numbered from 0; got"
                f" {text} for {name}"
            )
        found[name] = text
    return found


def unseen_emptied(frame: pd.DataFrame, layout: Recording, source: str) -> pd.DataFrame:
    """Return a table without the states of rows that stand for "not seen"."""
    values = dict(layout.not_seen)
    for name in values:
        if name not in frame or name not in STATE:
            raise HistoryError(
                f'{source}: not_seen names "{name}", which is no state column of it'
                f"{nearest(name, [each for each in STATE if each in frame])}"
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


def completed(frame: pd.DataFrame, scene: Scene, layout: Recording, source: str) -> pd.DataFrame:
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
        frame = _cut(frame, dict(layout.cut), source)
        pieces = frame["trajectory"].nunique()
        said.append(f"cut into {pieces} trajectories, {before - len(frame)} rows between them")
    if said:
        warnings.warn(f"{source}: {'; '.join(said)}", RecordingWarning, stacklevel=5)
    return frame


def _cut(frame: pd.DataFrame, cuts: Mapping[str, float], source: str) -> pd.DataFrame:
    """Return a table whose trajectories are cut to pieces."""
    parts, single = [], frame["trajectory"].nunique() == 1
    for label, rows in frame.groupby("trajectory", sort=False):
        numeric = rows.assign(time=pd.to_numeric(rows["time"], errors="coerce"))
        piece = _pieces(numeric, cuts)
        for number in range(piece.max(initial=-1) + 1):
            name = str(number) if single else f"{label}.{number}"
            own = rows[piece == number].assign(trajectory=name)
            parts.append(own.drop(columns="step", errors="ignore"))
    if not parts:
        raise HistoryError(
            f"{source}: nothing is left between its cuts; make [recording] cut less strict"
        )
    joined: pd.DataFrame = pd.concat(parts).reset_index(drop=True)
    return joined


def _pieces(rows: pd.DataFrame, cuts: Mapping[str, float]) -> Ints:
    """Return the piece that each row of a trajectory belongs to, -1 for none, shape (row,)."""
    times, at = np.unique(rows["time"].to_numpy(float), return_inverse=True)
    names = [name for name in STATE[:3] if name in rows]
    table = rows.assign(time=at)[["time", "body", *names]]
    places = table.set_index(["time", "body"])[names].apply(pd.to_numeric, errors="coerce")
    states = places.unstack("body").to_numpy(float)  # (time, name * body)
    kept, begins = np.ones(len(times), dtype=bool), np.zeros(len(times), dtype=bool)
    if "gaps" in cuts:
        seen = np.flatnonzero(np.isfinite(states).any(axis=1))
        kept[: seen[0] if len(seen) else len(times)] = False
        kept[seen[-1] + 1 if len(seen) else 0 :] = False
        for first, last in pairwise(seen):
            if times[last] - times[first] > cuts["gaps"]:
                kept[first + 1 : last] = False
                begins[last] = True
    if "rests" in cuts:
        kept &= ~_at_rest(times, states, cuts["rests"])
    if "jumps" in cuts:
        bodies = states.shape[1] // len(names)
        planar = [i for i, name in enumerate(names) if name in ("x", "y")]
        for body in range(bodies):
            kept &= ~_jumps(times, states[:, [i * bodies + body for i in planar]], cuts["jumps"])
    begins |= kept & ~np.concatenate([[False], kept[:-1]])
    piece = np.where(kept, np.cumsum(begins) - 1, -1)
    if "every" in cuts:
        piece = _every(times, piece, cuts["every"])
    sizes = np.bincount(piece[piece >= 0], minlength=max(piece.max(initial=-1) + 1, 1))
    number = np.cumsum(sizes >= _LEAST_ROWS) - 1
    long = (piece >= 0) & (sizes[piece] >= _LEAST_ROWS)
    return np.asarray(np.where(long, number[piece], -1)[at])


def _every(times: Floats, piece: Ints, length: float) -> Ints:
    """Return pieces cut to equal parts of about this length (s)."""
    out, begin = np.full(len(piece), -1), 0
    for number in range(piece.max(initial=-1) + 1):
        own = np.flatnonzero(piece == number)
        spent = times[own] - times[own[0]]
        parts = max(1, round(spent[-1] / length))
        width = max(spent[-1] / parts, 1e-300)
        out[own] = begin + np.minimum((spent / width + 1e-9).astype(int), parts - 1)
        begin += parts
    return out


def _at_rest(times: Floats, states: Floats, seconds: float) -> Bools:
    """Return the rows that belong to a rest of all bodies of at least this long, shape (time,)."""
    if len(times) < 3:
        return np.zeros(len(times), dtype=bool)
    n = max(2, int(np.ceil(seconds / np.median(np.diff(times)))) + 1)
    still = np.ones(len(times), dtype=bool)
    for column in states.T:
        change = np.abs(np.diff(column, 2))
        change = change[np.isfinite(change)]
        noise = column_noise([column], 2, robust=True)
        steps = change[change > 0]
        tolerance = max(_STILL * noise, steps.min() if len(steps) else 0.0)
        windows = pd.Series(column).rolling(n)
        quiet = (windows.max() - windows.min() <= tolerance).to_numpy()
        own = np.zeros(len(times), dtype=bool)
        for end in np.flatnonzero(quiet):
            own[end - n + 1 : end + 1] = True
        still &= own
    return still


def _jumps(times: Floats, places: Floats, least: float) -> Bools:
    """Return the rows beside changes of the velocity by more than so many m/s, shape (time,)."""
    found = np.zeros(len(times), dtype=bool)
    seen = np.flatnonzero(np.isfinite(places).all(axis=1))
    for peak in peaks(velocity_changes(times[seen], places[seen]), least):
        found[seen[max(peak - 1, 0) : peak + 2]] = True
    return found


def velocity_changes(times: Floats, places: Floats) -> Floats:
    """Return how much the velocity after each row differs from that before, shape (row,), m/s.

    Each is the slope of a few rows on that side, so that noise is averaged; zero near the ends.

    Parameters
    ----------
    times : ndarray
        Rising, shape (row,), s.
    places : ndarray
        Finite positions, shape (row, coordinate), m.
    """
    changes = np.zeros(len(times))
    if len(times) > 2 * _SIDE:
        t = sliding_window_view(times, _SIDE)
        p = sliding_window_view(places, _SIDE, axis=0)
        off = t - t.mean(axis=1, keepdims=True)
        slopes = np.einsum("kt,kct->kc", off, p) / (off**2).sum(axis=1)[:, None]
        change = np.linalg.norm(slopes[_SIDE + 1 :] - slopes[: -_SIDE - 1], axis=1)
        changes[_SIDE : len(times) - _SIDE] = change
    return changes


def peaks(changes: Floats, least: float) -> Ints:
    """Return the rows of the largest changes above ``least``, each the only one nearby."""
    found, _ = find_peaks(changes, height=least, distance=_SIDE)
    return np.asarray(found)
