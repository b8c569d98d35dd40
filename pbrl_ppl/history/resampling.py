"""Irregular time stamps: a table resampled to even steps, and what that does to it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from pbrl_ppl.errors import HistoryError, ResamplingWarning
from pbrl_ppl.history.kinematics import unwrapped
from pbrl_ppl.history.rows import TIME_TOLERANCE, Rows, read_rows
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA, WRENCH

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Time steps that are interpolated across (not a lost sample), and that may be unseen at most.
REACH, LONGEST = 1.9, 5.0
#: Time steps that samples may be apart in the mean: with fewer samples than rows, rows are made up.
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
        Says the time step and the bodies.
    source : str
        What to call the table in messages.

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
    tracks = _tracks(rows, scene)
    spacing = np.concatenate([np.diff(track.time) for track in tracks.values()])
    if not spacing.size or (np.abs(spacing - dt) <= TIME_TOLERANCE * dt).all():
        return frame
    _check(rows, tracks, dt)
    quotients = _quotients(tracks, scene)
    parts: list[pd.DataFrame] = []
    weights, empty = [], 0
    for label in range(len(rows.labels)):
        own = {body: tracks[label, body] for body in range(len(scene.moving))
               if (label, body) in tracks}  # fmt: skip
        begin = max(track.time[0] for track in own.values())
        end = min(track.time[-1] for track in own.values())
        n = int((end - begin) / dt + _SAME) + 1
        if n < 2:
            raise HistoryError(
                f"{source}: trajectory {rows.labels[label]} is {end - begin:.3g} s long, less than"
                f" a time step of {dt:g} s; drop it"
            )
        grid = begin + dt * np.arange(n)
        bodies = []
        for body, track in own.items():
            state = _states(track, grid, dt)
            measured = ~np.isnan(track.state).all(axis=0)
            empty += int(np.isnan(state[:, measured]).any(axis=1).sum())
            state[:, quotients[body]] = np.nan
            weights.append(_weights(track.time, grid, dt))
            bodies.append(
                pd.DataFrame(
                    {
                        "trajectory": rows.labels[label],
                        "step": np.arange(n),
                        "time": grid,
                        "body": scene.moving[body].name,
                        **dict(zip(STATE, state.T, strict=True)),
                        **dict(zip(WRENCH, _held(track, grid).T, strict=True)),
                    }
                )
            )
        parts.append(pd.concat(bodies).sort_values("step", kind="stable"))
    table = pd.concat(parts)
    lost = [f"{STATE[d]} of {scene.moving[b].name}" for b, d in zip(*np.nonzero(quotients),
            strict=True)]  # fmt: skip
    message = _in_words(source, spacing, dt, len(rows.time), len(table), weights, empty, lost)
    warnings.warn(message, ResamplingWarning, stacklevel=4)
    return table.reset_index(drop=True)


def _tracks(rows: Rows, scene: Scene) -> dict[tuple[int, int], _Track]:
    """Rows by trajectory and body, each with times that rise."""
    tracks = {}
    for label in range(len(rows.labels)):
        for body in range(len(scene.moving)):
            row = np.flatnonzero((rows.trajectory == label) & (rows.body == body))
            if not row.size:
                raise HistoryError(
                    f'history: body "{scene.moving[body].name}" has no rows in trajectory'
                    f" {rows.labels[label]}; add them, or drop the trajectory"
                )
            time = rows.time[row]
            back = np.flatnonzero(np.diff(time) <= 0)
            if back.size:
                at = int(row[back[0] + 1])
                raise HistoryError(
                    f"{rows.at(at)}: time does not rise in {rows.of(at)}: {rows.time[at]:.6g} s"
                    f" after {time[back[0]]:.6g} s; sort the rows, drop duplicates"
                )
            action = rows.action[row]
            if not scene.moving[body].kinematic and np.isnan(action[:-1]).any():
                at = int(row[np.isnan(action[:-1]).any(axis=1).argmax()])
                raise HistoryError(
                    f"{rows.at(at)}: a wrench is empty in {rows.of(at)}; expected numbers on every"
                    " row but the last; write 0 where nothing pushed"
                )
            tracks[label, body] = _Track(time, rows.state[row], action, row)
    return tracks


def _check(rows: Rows, tracks: dict[tuple[int, int], _Track], dt: float) -> None:
    """Refuse what would have to be made up."""
    for track in tracks.values():
        if len(track.time) < 2:
            continue
        spacing = np.diff(track.time)
        worst = int(spacing.argmax())
        row = int(track.row[worst + 1])
        if np.median(spacing) > _COARSEST * dt:
            raise HistoryError(
                f"{rows.at(row)}: samples of {rows.of(row)} are {np.median(spacing):.4g} s apart,"
                f" more than the time step of {dt:g} s, so that resampling would make rows up;"
                f" give a time step of at least {np.median(spacing):.4g} s"
            )
        if spacing[worst] > LONGEST * dt:
            raise HistoryError(
                f"{rows.at(row)}: {spacing[worst]:.4g} s since the sample before in {rows.of(row)},"
                f" more than {LONGEST:g} time steps of {dt:g} s; give the rows after the gap a"
                " trajectory of their own"
            )


def _quotients(tracks: dict[tuple[int, int], _Track], scene: Scene) -> npt.NDArray[np.bool_]:
    """Which velocities are difference quotients of the positions, shape (body, 6).

    After interpolation at uneven places they would pass for measurements of their own.
    """
    found = np.zeros((len(scene.moving), len(STATE)), dtype=bool)
    for body in range(len(scene.moving)):
        own = [track for (_, each), track in tracks.items() if each == body]
        for d in range(3, len(STATE)):
            off: list[list[Floats]] = [[], [], []]
            rates = []
            for track in own:
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
                left = min(float(np.quantile(np.abs(np.concatenate(each)), 0.95)) for each in off)
                found[body, d] = left < _QUOTIENT * spread
    return found


def _states(track: _Track, grid: Floats, dt: float) -> Floats:
    """States at the grid's times, shape (step, 6); NaN in gaps."""
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
    """A run of samples at the grid's times; a position's ``rate`` is used where it is whole."""
    grid = np.clip(grid, time[0], time[-1])
    if rate is None or len(time) < 2:
        return np.interp(grid, time, values)
    if np.isfinite(rate).all():
        return np.asarray(CubicHermiteSpline(time, values, rate)(grid))
    if len(time) < 4:
        return np.interp(grid, time, values)
    return np.asarray(CubicSpline(time, values)(grid))


def _held(track: _Track, grid: Floats) -> Floats:
    """Mean wrench of each step, held from sample to sample, shape (step, 3); none on the last."""
    impulse = np.cumsum(track.action[:-1] * np.diff(track.time)[:, None], axis=0)
    impulse = np.concatenate([np.zeros((1, len(WRENCH))), impulse])
    at = np.stack([np.interp(grid, track.time, column) for column in impulse.T], axis=1)
    mean = np.diff(at, axis=0) / np.diff(grid)[:, None]
    return np.concatenate([mean, np.full((1, len(WRENCH)), np.nan)])


def _weights(time: Floats, grid: Floats, dt: float) -> tuple[Floats, Ints]:
    """Share of the later sample in each step's linear interpolation, and which the earlier is."""
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, max(len(time) - 2, 0))
    after = np.minimum(before + 1, len(time) - 1)
    width = np.where(after > before, time[after] - time[before], 1.0)
    share = np.clip((grid - time[before]) / width, 0.0, 1.0)
    share = np.where(np.abs(grid - time[before]) < _SAME * dt, 0.0, share)
    share = np.where(np.abs(grid - time[after]) < _SAME * dt, 1.0, share)
    return share, before.astype(np.int64)


def _in_words(
    source: str,
    spacing: Floats,
    dt: float,
    n_before: int,
    n_after: int,
    weights: list[tuple[Floats, Ints]],
    empty: int,
    lost: list[str],
) -> str:
    """What was irregular, what was done, and what follows."""
    share = np.concatenate([each for each, _ in weights])
    between = (share > 0) & (share < 1)
    left = np.sqrt(((1 - share) ** 2 + share**2).mean())
    shared, pairs = 0, 0
    for each, before in weights:
        first, last = before + (each == 1), before + (each > 0)
        shared += int((last[:-1] >= first[1:]).sum())
        pairs += len(before) - 1
    text = (
        f"{source}: samples are {spacing.min():.4g} to {spacing.max():.4g} s apart (median"
        f" {np.median(spacing):.4g} s), not {dt:g} s: {n_before} rows were resampled to {n_after}"
    )
    if between.any():
        text += (
            f"; {between.mean():.0%} are interpolated (positions by cubics, velocities linearly;"
            f" wrenches are means), which leaves {left:.0%} of the velocities' noise"
        )
    if shared:
        text += (
            f"; {shared / pairs:.0%} of neighbouring rows share a sample: their errors are less"
            " independent than they look, and intervals come out too narrow"
        )
    if empty:
        text += f"; {empty} rows have empty cells, in gaps of more than {REACH * dt:.4g} s"
    if lost:
        text += (
            f"; {', '.join(lost)}: difference quotients of the positions, no measurements, and"
            " left empty (--estimate-velocities, estimate_velocities=True)"
        )
    return text
