"""Rows of long takes: where tracking was lost, where they are cut, and proposals of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import find_peaks

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.clocks import Say
from pbrl_ppl.history.kinematics import column_noise, finest_step
from pbrl_ppl.history.measures import numbers
from pbrl_ppl.history.resampling import LONGEST
from pbrl_ppl.history.rows import TIME_TOLERANCE
from pbrl_ppl.scene import Recording, Scene
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints


def without_lost_rows(frame: pd.DataFrame, scene: Scene, say: Say) -> pd.DataFrame:
    """Return a table whose states are empty where tracking was lost.

    Paths of kinematic bodies are kept: they need every row.

    Parameters
    ----------
    frame : pandas.DataFrame
        With ``trajectory``, ``body`` and states in SI units, rows in order of time.
    scene : Scene
        Says which bodies are kinematic.
    say : callable
        Takes a sentence on each kind of lost rows.
    """
    places = [name for name in STATE[:3] if name in frame]
    poses = frame[places].apply(pd.to_numeric, errors="coerce").to_numpy(float, copy=True)
    zero, frozen = np.zeros((2, len(frame)), dtype=bool)
    follows = {body.name for body in scene.moving if body.kinematic}
    for rows in frame.groupby(["trajectory", "body"], sort=False).indices.values():
        if frame["body"].iloc[rows[0]] in follows:
            continue
        if len(places) > 1:  # an angle alone may pass through 0 turn by turn
            zero[rows] = zero_poses(poses[rows])
        seen = rows[~zero[rows]]
        frozen[seen] = frozen_poses(poses[seen])
    names = " = ".join(places)
    if zero.any():
        say(f"{names} = 0 in {int(zero.sum())} rows, far from the rows beside: read as not seen")
    if frozen.any():
        say(
            f"{int(frozen.sum())} rows repeat the pose before and the next is as far as if the body"
            " had moved on: read as not seen"
        )
    lost, states = zero | frozen, [name for name in STATE if name in frame]
    return frame.assign(**{name: frame[name].mask(lost) for name in states if lost.any()})


def zero_poses(poses: Floats, far: float = 5.0) -> Bools:
    """Return the rows where all coordinates are 0, far from those before and after, shape (row,).

    Parameters
    ----------
    poses : ndarray
        Shape (row, coordinate).
    far : float
        The typical changes between rows that they are away from those seen before.
    """
    zero = np.all(poses == 0.0, axis=1)
    seen = np.flatnonzero(~zero & np.isfinite(poses).all(axis=1))
    if not zero.any() or len(seen) < 2:
        return np.zeros(len(poses), dtype=bool)
    step = float(np.median(np.linalg.norm(np.diff(poses[seen], axis=0), axis=1)))
    away = np.linalg.norm(poses[seen], axis=1)
    at = np.searchsorted(seen, np.flatnonzero(zero))
    near = np.minimum(away[np.clip(at - 1, 0, len(seen) - 1)], away[np.clip(at, 0, len(seen) - 1)])
    zero[zero] = near > far * step
    return np.asarray(zero)


def frozen_poses(poses: Floats, *, far: float = 2.5) -> Bools:
    """Return the rows that repeat the pose before although the body went on, shape (row,).

    Where a body rests and then goes on, the first step is as short as those after it. After a pose
    that was repeated because nothing was seen, the first step holds the way of all these rows. A
    resting body, or a coarse encoder, whose steps are as large as its resolution, is not frozen.

    Parameters
    ----------
    poses : ndarray
        Shape (row, coordinate), NaN where missing.
    far : float
        A step of more than so many resolutions of its coordinate counts.
    """
    frozen = np.zeros(len(poses), dtype=bool)
    first = np.flatnonzero(np.append(True, (np.diff(poses, axis=0) != 0.0).any(axis=1)))
    if len(first) < 4:
        return frozen
    change, rows = np.abs(np.diff(poses[first], axis=0)), np.diff(first)
    finest = np.array(  # within the noise a pose may be as before, which changes nothing
        [max(finest_step(one), 2.0 * column_noise([one], robust=True)) for one in poses[first].T]
    )
    size, rate = np.linalg.norm(change, axis=1), np.linalg.norm(change, axis=1) / rows
    usual = np.fmax(np.append(rate[0], rate[:-1]), np.append(rate[1:], rate[-1]))
    jumps = (change > far * finest).any(axis=1) & (size > 0.5 * (rows + 1) * usual)
    # one coordinate may have a value twice by chance
    for k in np.flatnonzero(jumps & (rows > (1 if poses.shape[1] > 1 else 2))):
        frozen[first[k] + 1 : first[k + 1]] = True
    return frozen


def cut(frame: pd.DataFrame, cuts: Mapping[str, float], source: str) -> pd.DataFrame:
    """Return a table whose trajectories are cut to pieces."""
    parts, single = [], frame["trajectory"].nunique() == 1
    for label, rows in frame.groupby("trajectory", sort=False):
        numeric = rows.assign(time=pd.to_numeric(rows["time"], errors="coerce"))
        piece = _pieces(numeric, cuts)
        for number in range(piece.max(initial=-1) + 1):
            name = str(number) if single else f"{label}.{number}"
            part = rows[piece == number].assign(trajectory=name)
            parts.append(part.drop(columns="step", errors="ignore"))
    if not parts:
        raise HistoryError(
            f"{source}: nothing is left between its cuts; make [recording] cut less strict"
        )
    joined: pd.DataFrame = pd.concat(parts)
    return joined


def _pieces(rows: pd.DataFrame, cuts: Mapping[str, float], least: int = 3) -> Ints:
    """Return the piece that each row of a trajectory belongs to, -1 for none, shape (row,).

    Pieces have at least so many times.
    """
    times, at = np.unique(rows["time"].to_numpy(float), return_inverse=True)
    names = [name for name in STATE[:3] if name in rows]
    table = rows.assign(time=at)[["time", "body", *names]]
    places = table.set_index(["time", "body"])[names].apply(pd.to_numeric, errors="coerce")
    states = places.unstack("body").to_numpy(float)  # (time, name * body)
    kept, begins = np.ones_like(times, dtype=bool), np.zeros_like(times, dtype=bool)
    if "gaps" in cuts:
        seen = np.flatnonzero(np.isfinite(states).any(axis=1))
        within = np.arange(len(times))
        kept &= (within >= seen.min(initial=len(times))) & (within <= seen.max(initial=-1))
        for first, last in pairwise(seen):
            if times[last] - times[first] > cuts["gaps"]:
                kept[first + 1 : last] = False
                begins[last] = True
    if "jumps" in cuts:
        bodies = states.shape[1] // len(names)
        planar = [i for i, name in enumerate(names) if name in ("x", "y")]
        for body in range(bodies):
            kept &= ~_jumps(times, states[:, [i * bodies + body for i in planar]], cuts["jumps"])
    begins |= kept & ~np.append(False, kept[:-1])
    piece = np.where(kept, np.cumsum(begins) - 1, -1)
    if "every" in cuts:
        piece = _every(times, piece, cuts["every"])
    sizes = np.bincount(piece[piece >= 0], minlength=max(piece.max(initial=-1) + 1, 1))
    number = np.cumsum(sizes >= least) - 1
    long = (piece >= 0) & (sizes[piece] >= least)
    return np.asarray(np.where(long, number[piece], -1)[at])


def _every(times: Floats, piece: Ints, length: float) -> Ints:
    """Return pieces cut to equal parts of about this length (s)."""
    out, begin = np.full(len(piece), -1), 0
    for number in range(piece.max(initial=-1) + 1):
        members = np.flatnonzero(piece == number)
        spent = times[members] - times[members[0]]
        parts = max(1, round(spent[-1] / length))
        width = max(spent[-1] / parts, 1e-300)
        out[members] = begin + np.minimum((spent / width + 1e-9).astype(int), parts - 1)
        begin += parts
    return out


def _jumps(times: Floats, places: Floats, least: float) -> Bools:
    """Return the rows beside changes of the velocity by more than so many m/s, shape (time,)."""
    beside = np.zeros(len(times), dtype=bool)
    seen, changes = _velocity_changes(times, places)
    for peak in find_peaks(changes, height=least, distance=5)[0]:
        beside[seen[max(peak - 1, 0) : peak + 2]] = True
    return beside


def _velocity_changes(times: Floats, places: Floats, side: int = 5) -> tuple[Ints, Floats]:
    """Return the rows with a position, and how much the velocity changes there (m/s).

    The velocities before and after each are slopes of so many rows on that side, so that noise is
    averaged; the change is zero near the ends.

    Parameters
    ----------
    times : ndarray
        Rising, shape (row,), s.
    places : ndarray
        Positions, shape (row, coordinate), m; NaN where missing.
    """
    seen = np.flatnonzero(np.isfinite(places).all(axis=1) & np.isfinite(times))
    times, places = times[seen], places[seen]
    changes = np.zeros(len(times))
    if len(times) > 2 * side:
        t = sliding_window_view(times, side)
        p = sliding_window_view(places, side, axis=0)
        off = t - t.mean(axis=1, keepdims=True)
        slopes = np.einsum("kt,kct->kc", off, p) / (off**2).sum(axis=1)[:, None]
        changes[side:-side] = np.linalg.norm(slopes[side + 1 :] - slopes[: -side - 1], axis=1)
    return seen, changes


def propose(
    frame: pd.DataFrame, layout: Recording, time_step: float, *, jumps: bool = True
) -> tuple[Recording, list[str]]:
    """Return a layout with what a recording's rows show, and a sentence on each.

    Fewer than four long trajectories, which criticism needs, are cut to pieces of 30 rows or more,
    at most 12 each, and as long as the motion needs, see `telling`, where that leaves four.

    Parameters
    ----------
    frame : pandas.DataFrame
        The recording's rows as the layout reads them, in SI units, with ``time``.
    layout : Recording
        What is known; its entries are kept.
    time_step : float
        Time between rows of the scene (s).
    jumps : bool
        Whether velocities may jump where nothing is declared.
    """
    said = []
    times = numbers(frame["time"])
    indices = frame.groupby(["trajectory", "body"], sort=False).indices.values()
    groups = [np.asarray(rows, dtype=np.int64) for rows in indices]
    names = [name for name in STATE[:3] if name in frame]
    poses = frame[names].apply(pd.to_numeric, errors="coerce").to_numpy(float)
    places = poses[:, [i for i, name in enumerate(names) if name != "theta"]]
    spacing = np.concatenate([np.diff(times[rows]) for rows in groups])
    if not layout.resample and (np.abs(spacing - time_step) > TIME_TOLERANCE * time_step).any():
        layout = replace(layout, resample=True)
        said.append(f"rows are not {time_step:g} s apart: interpolated every {time_step:g} s")
    if layout.cut:
        return layout, said
    cuts: dict[str, float] = {}
    gap = max(_longest_gap(times[rows], poses[rows]) for rows in groups)
    if gap > LONGEST * time_step:
        cuts["gaps"] = float(f"{LONGEST * time_step:.6g}")
        said.append(f"nothing was seen for up to {gap:.3g} s: cut at gaps")
    pushed = frame[[name for name in WRENCH if name in frame]].apply(pd.to_numeric, errors="coerce")
    if jumps and places.shape[1] and not pushed.fillna(0.0).to_numpy().any():
        least = _jump([(times[rows], places[rows]) for rows in groups])
        if least:
            cuts["jumps"] = least
            said.append(
                "the velocity jumps, as at a wall, and none is declared: cut there"
                f" (by more than {least:g} m/s)"
            )
    length = float(np.median([np.ptp(times[rows]) for rows in groups]))
    few = frame["trajectory"].nunique() < 4
    if few and not cuts and length >= 60 * time_step:
        slow = max(telling(times[rows], poses[rows]) for rows in groups)
        parts = np.clip(length / max(slow, 30 * time_step), 4, 12)
        cuts["every"] = float(f"{length / int(parts):.2g}")
        said.append(
            f"{frame['trajectory'].nunique()} long trajectory: cut every {cuts['every']:g} s, so"
            " that there are several"
        )
    return replace(layout, cut=tuple(cuts.items())), said


def slowest(times: Floats, poses: Floats) -> float:
    """Return the longest period of a coordinate (s): twice the time between means crossed."""
    crossed = [int((np.diff(np.sign(off)) != 0).sum()) for off in _moving(poses)]
    seconds = float(np.ptp(times))  # of a trajectory that ends before others it is unknown
    return 2.0 * seconds / max(min(crossed), 1) if crossed and np.isfinite(seconds) else 0.0


def _moving(poses: Floats) -> list[Floats]:
    """Return the columns that move, of the rows that were seen, less their means."""
    columns = [column[np.isfinite(column)] for column in poses.T]
    return [seen - seen.mean() for seen in columns if len(seen) > 2 and np.ptp(seen) > 0]


def telling(times: Floats, poses: Floats, *, periods: float = 8.0, constants: float = 3.0) -> float:
    """Return how long a piece must be for slow losses to show (s): eight periods of a swing.

    Of a motion that does not swing it is three time constants: the times in which the correlation
    of its coordinates falls to 1/e.

    Parameters
    ----------
    times : ndarray
        Shape (row,), s.
    poses : ndarray
        Shape (row, coordinate), NaN where missing.
    periods, constants : float
        How many.

    Examples
    --------
    >>> t = np.arange(0.0, 40.0, 0.05)
    >>> round(telling(t, np.cos(2.0 * np.pi * t / 1.25)[:, None]))
    10
    """
    period = slowest(times, poses)
    if 4.0 * period <= np.ptp(times):
        return periods * period
    longest = 0.0
    for off in _moving(poses):
        power = np.abs(np.fft.rfft(off, 2 * len(off))) ** 2
        near = np.fft.irfft(power)[: len(off)] > np.exp(-1.0) * float(off @ off)
        fallen = int(near.argmin()) if not near.all() else len(off)
        longest = max(longest, fallen / len(off) * float(np.ptp(times)))
    return constants * longest


def _longest_gap(times: Floats, states: Floats) -> float:
    """Return the longest time in which nothing was seen (s)."""
    seen = np.isfinite(states).any(axis=1) if states.shape[1] else np.ones(len(times), bool)
    return float(np.diff(times[seen]).max(initial=0.0))


def _jump(tracks: list[tuple[Floats, Floats]], abrupt: float = 10.0, rare: float = 0.1) -> float:
    """Return a change of velocity between rows (m/s) beyond which it jumps; 0 if it never does.

    Jumps are ``abrupt`` times the typical change, in the share ``rare`` of rows at most.
    """
    changes = [_velocity_changes(times, places)[1] for times, places in tracks]
    every = np.concatenate([np.zeros(0), *changes])
    least = abrupt * float(np.median(every)) if len(every) else 0.0
    peaks = [find_peaks(one, height=least, distance=5)[0] for one in changes if least > 0]
    jumps = sum(map(len, peaks))
    return float(f"{least:.2g}") if 0 < jumps <= rare * len(every) else 0.0
