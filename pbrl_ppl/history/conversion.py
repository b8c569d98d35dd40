"""Tables of other programs: columns renamed, units converted, time steps resampled."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypedDict, Unpack

import numpy as np
import pandas as pd
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from pbrl_ppl.errors import HistoryError, ResamplingWarning
from pbrl_ppl.history.files import COLUMNS, as_table
from pbrl_ppl.history.kinematics import unwrapped
from pbrl_ppl.history.layout import completed, numbered, unseen_emptied
from pbrl_ppl.history.rows import TIME_TOLERANCE, Rows, read_rows, with_clean_names
from pbrl_ppl.scene import Recording, Scene, nearest
from pbrl_ppl.state import STATE, THETA, WRENCH, Bools, Floats, Ints

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
            known = [each for each in _UNITS[name] if "*" not in each]
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
    """Return a table with a history's column names, in SI units, resampled if asked.

    ``layout`` says how it is laid out; what ``reading`` says goes before it.
    """
    columns, units = dict(reading.get("columns") or {}), dict(reading.get("units") or {})
    if layout is not None:
        columns, units = dict(layout.columns) | columns, dict(layout.units) | units
    columns = dict(numbered(frame, columns, source))
    if columns or layout is not None:
        frame = renamed(frame, scene, columns, source)
    if layout is not None:
        frame = unseen_emptied(frame, layout, source)
    if units:
        frame = in_si(frame, units)
    resample = reading.get("resample")
    if layout is not None:
        frame = completed(frame, scene, layout, source)
        resample = resample or layout.resample
    return resampled(frame, scene, source) if resample else frame


#: Time steps that are interpolated across (not a lost sample), and that may be missing at most.
REACH, LONGEST = 1.9, 5.0
#: Mean time steps between samples, at most: with fewer samples than rows, rows are made up.
_COARSEST = 1.1
#: A velocity this near to a difference quotient (a share of its spread) is one.
_QUOTIENT = 1e-3
#: A sample this near to a row's time (in time steps) is taken as it is.
_SAME = 1e-6


@dataclass(frozen=True)
class _Track:
    """One body in one trajectory: time (s), states (time, 6), wrenches (time, 3), rows."""

    time: Floats
    state: Floats
    action: Floats
    row: Ints


def resampled(frame: pd.DataFrame, scene: Scene, source: str) -> pd.DataFrame:
    """Return a table with a row every ``time_step`` of the scene; the same if it has that already.

    Positions are interpolated by cubics (Hermite's, where velocities were measured), velocities
    linearly, both exact for a constant acceleration between samples. A wrench, held until the next
    sample, is averaged over each step, which keeps its impulse. Steps in a gap of more than 1.9
    time steps are left empty.

    Parameters
    ----------
    frame : pandas.DataFrame
        With a history's columns, in SI units.
    scene : Scene
        Its time step and bodies are used.
    source : str
        Name of the table in messages.

    Raises
    ------
    HistoryError
        If time goes back, samples are further apart than the time step, or a gap is longer than 5
        of them.

    Warns
    -----
    ResamplingWarning
        What was done, and what it does to the noise.
    """
    rows, dt = read_rows(frame, scene, source), scene.time_step
    tracks = [_tracks(rows, label, scene) for label in range(len(rows.labels))]
    spacing = np.concatenate([np.diff(track.time) for bodies in tracks for track in bodies])
    if not spacing.size or (np.abs(spacing - dt) <= TIME_TOLERANCE * dt).all():
        return frame
    _check_spacing(rows, tracks, dt)
    quotients = np.array([_quotients(each) for each in zip(*tracks, strict=True)])
    names = np.array([body.name for body in scene.moving], dtype=object)
    parts: list[pd.DataFrame] = []
    weights, empty = [], 0
    for label, bodies in zip(rows.labels, tracks, strict=True):
        begin = max(track.time[0] for track in bodies)
        end = min(track.time[-1] for track in bodies)
        n = int((end - begin) / dt + _SAME) + 1
        if n < 2:
            raise HistoryError(
                f"{source}: trajectory {label} is {end - begin:.3g} s long, less than a time step"
                f" of {dt:g} s; drop it"
            )
        grid = begin + dt * np.arange(n)
        state = np.stack([_states(track, grid, dt) for track in bodies], axis=1)
        measured = np.array([~np.isnan(track.state).all(axis=0) for track in bodies])
        empty += int((np.isnan(state) & measured).any(axis=2).sum())
        state[:, quotients] = np.nan
        action = np.stack([_mean_wrenches(track, grid) for track in bodies], axis=1)
        weights += [_weights(track.time, grid, dt) for track in bodies]
        one = np.array([label], dtype=object)
        parts.append(as_table(one, grid[None], names, state[None], action[None]))
    table = pd.concat(parts)
    message = (
        f"{source}: samples are {spacing.min():.4g} to {spacing.max():.4g} s apart (median"
        f" {np.median(spacing):.4g} s), not {dt:g} s: {len(rows.time)} rows were resampled to"
        f" {len(table)}{_noise_in_words(weights)}"
    )
    if empty:
        message += f"; {empty} rows have empty cells, in gaps of more than {REACH * dt:.4g} s"
    if quotients.any():
        lost = ", ".join(f"{STATE[d]} of {names[body]}" for body, d in np.argwhere(quotients))
        message += (
            f"; {lost}: difference quotients of the positions, no measurements, and left empty"
            " (--estimate-velocities, estimate_velocities=True)"
        )
    warnings.warn(message, ResamplingWarning, stacklevel=4)
    return table.reset_index(drop=True)


def _tracks(rows: Rows, label: int, scene: Scene) -> list[_Track]:
    """Return the rows of a trajectory by body, each with times that rise."""
    tracks = []
    for position, body in enumerate(scene.moving):
        row = np.flatnonzero((rows.trajectory == label) & (rows.body == position))
        if not row.size:
            raise HistoryError(
                f'history: body "{body.name}" has no rows in trajectory {rows.labels[label]}; add'
                " them, or drop the trajectory"
            )
        time, action = rows.time[row], rows.action[row]
        for back in np.flatnonzero(np.diff(time) <= 0):
            at = int(row[back + 1])
            raise rows.error(
                at,
                f"time does not rise in {rows.trajectory_of(at)}: {rows.time[at]:.6g} s after"
                f" {time[back]:.6g} s; sort the rows, drop duplicates",
            )
        missing = np.isnan(action[:-1]).any(axis=1)
        if missing.any() and not body.kinematic:
            at = int(row[missing.argmax()])
            raise rows.error(
                at,
                f"a wrench is empty in {rows.trajectory_of(at)}; expected numbers on every row but"
                " the last; write 0 where nothing pushed",
            )
        tracks.append(_Track(time, rows.state[row], action, row))
    return tracks


def _check_spacing(rows: Rows, tracks: list[list[_Track]], dt: float) -> None:
    """Refuse samples that are too far apart, and gaps that are too long."""
    for track in (track for bodies in tracks for track in bodies if len(track.time) > 1):
        spacing = np.diff(track.time)
        worst, median = int(spacing.argmax()), np.median(spacing)
        row = int(track.row[worst + 1])
        if median > _COARSEST * dt:
            raise rows.error(
                row,
                f"samples of {rows.trajectory_of(row)} are {median:.4g} s apart, more than the time"
                f" step of {dt:g} s, so that resampling would make rows up; give a time step of at"
                f" least {median:.4g} s",
            )
        if spacing[worst] > LONGEST * dt:
            raise rows.error(
                row,
                f"{spacing[worst]:.4g} s since the sample before in {rows.trajectory_of(row)}, more"
                f" than {LONGEST:g} time steps of {dt:g} s; give the rows after the gap a"
                " trajectory of their own",
            )


def _quotients(tracks: tuple[_Track, ...]) -> Bools:
    """Return which velocities of a body are difference quotients of its positions, shape (6,).

    After interpolation at uneven times they would look like independent measurements.
    """
    found = np.zeros(len(STATE), dtype=bool)
    for d in range(3, len(STATE)):
        off: list[list[Floats]] = [[], [], []]
        rates = []
        for track in tracks:
            place, rate = track.state[:, d - 3], track.state[:, d]
            if len(place) < 3 or not np.isfinite([place, rate]).all():
                continue
            place = unwrapped(track.time, place, rate) if d - 3 == THETA else place
            one = np.diff(place) / np.diff(track.time)
            two = (place[2:] - place[:-2]) / (track.time[2:] - track.time[:-2])
            for kind, quotient in enumerate((one[:-1], two, one[1:])):
                off[kind].append(rate[1:-1] - quotient)
            rates.append(rate[1:-1])
        if rates and (spread := float(np.concatenate(rates).std())) > 0:
            # at the ends and in gaps they may be anything
            misfit = min(float(np.quantile(np.abs(np.concatenate(each)), 0.95)) for each in off)
            found[d] = misfit < _QUOTIENT * spread
    return found


def _states(track: _Track, grid: Floats, dt: float) -> Floats:
    """Return the states at the grid's times, shape (step, 6); NaN in gaps."""
    result = np.full((len(grid), len(STATE)), np.nan)
    for d in range(len(STATE)):
        finite = np.flatnonzero(np.isfinite(track.state[:, d]))
        wide = np.flatnonzero(np.diff(track.time[finite]) > REACH * dt) + 1
        for run in np.split(finite, wide):
            if not run.size:
                continue
            time, values = track.time[run], track.state[run, d]
            inside = (grid >= time[0] - _SAME * dt) & (grid <= time[-1] + _SAME * dt)
            rate = track.state[run, d + 3] if d < 3 else None
            if d == THETA:
                values = unwrapped(time, values, track.state[run, 5])
            result[inside, d] = _interpolated(time, values, rate, grid[inside])
    return result


def _interpolated(time: Floats, values: Floats, rate: Floats | None, grid: Floats) -> Floats:
    """Return a run of samples at the grid's times; a position's ``rate`` is used where complete."""
    grid = np.clip(grid, time[0], time[-1])
    if rate is None or len(time) < 2:
        return np.interp(grid, time, values)
    if np.isfinite(rate).all():
        return np.asarray(CubicHermiteSpline(time, values, rate)(grid))
    if len(time) < 4:
        return np.interp(grid, time, values)
    return np.asarray(CubicSpline(time, values)(grid))


def _mean_wrenches(track: _Track, grid: Floats) -> Floats:
    """Return the mean wrench of each step, shape (step, 3); NaN on the last.

    A wrench is held from sample to sample.
    """
    impulse = np.cumsum(track.action[:-1] * np.diff(track.time)[:, None], axis=0)
    impulse = np.concatenate([np.zeros((1, len(WRENCH))), impulse])
    at = np.stack([np.interp(grid, track.time, column) for column in impulse.T], axis=1)
    mean = np.diff(at, axis=0) / np.diff(grid)[:, None]
    return np.concatenate([mean, np.full((1, len(WRENCH)), np.nan)])


def _weights(time: Floats, grid: Floats, dt: float) -> tuple[Floats, Ints]:
    """Return the later sample's share in each interpolated step, and the earlier sample's index."""
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, max(len(time) - 2, 0))
    after = np.minimum(before + 1, len(time) - 1)
    width = np.where(after > before, time[after] - time[before], 1.0)
    share = np.clip((grid - time[before]) / width, 0.0, 1.0)
    share = np.where(np.abs(grid - time[before]) < _SAME * dt, 0.0, share)
    share = np.where(np.abs(grid - time[after]) < _SAME * dt, 1.0, share)
    return share, before.astype(np.int64)


def _noise_in_words(weights: list[tuple[Floats, Ints]]) -> str:
    """Return what interpolation does to the noise, in words."""
    share = np.concatenate([each for each, _ in weights])
    between = (share > 0) & (share < 1)
    remaining = np.sqrt(((1 - share) ** 2 + share**2).mean())
    shared, pairs = 0, 0
    for each, before in weights:
        first, last = before + (each == 1), before + (each > 0)
        shared += int((last[:-1] >= first[1:]).sum())
        pairs += len(before) - 1
    text = ""
    if between.any():
        text += (
            f"; {between.mean():.0%} are interpolated (positions by cubics, velocities linearly;"
            f" wrenches are means), which leaves {remaining:.0%} of the velocities' noise"
        )
    if shared:
        text += (
            f"; {shared / pairs:.0%} of neighbouring rows share a sample: their errors are less"
            " independent than they look, and intervals come out too narrow"
        )
    return text
