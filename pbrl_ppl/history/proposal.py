"""Proposal of a recording's layout from its file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from pbrl_ppl.history.layout import peaks, velocity_changes
from pbrl_ppl.history.resampling import LONGEST
from pbrl_ppl.history.rows import TIME_TOLERANCE
from pbrl_ppl.scene import Recording
from pbrl_ppl.state import WRENCH, Bools, Floats, Ints

#: Zeros this many typical changes from the rows before stand for "not seen".
_FAR = 5.0
#: Changes of velocity this many times the typical one are jumps, in this share of rows at most.
_ABRUPT, _RARE = 10.0, 0.1
#: Trajectories that criticism needs, and rows of each: fewer of longer ones are cut.
_FEW, _LEAST_ROWS, _MOST_ROWS = 4, 30, 200


def propose(
    frame: pd.DataFrame, layout: Recording, time_step: float
) -> tuple[Recording, list[str]]:
    """Return a layout with what a recording's rows show, and a sentence on each.

    Parameters
    ----------
    frame : pandas.DataFrame
        The recording's rows as the layout reads them, in SI units, with ``time``.
    layout : Recording
        What is known; its entries are kept.
    time_step : float
        Median time between rows (s).
    """
    said = []
    times = pd.to_numeric(frame["time"], errors="coerce").to_numpy(float)
    indices = frame.groupby(["trajectory", "body"], sort=False).indices.values()
    groups = [np.asarray(rows, dtype=np.int64) for rows in indices]
    places = [name for name in ("x", "y") if name in frame]
    states = frame[places].apply(pd.to_numeric, errors="coerce").to_numpy(float, copy=True)
    unseen = _unseen(states, groups)
    if unseen.any() and not layout.not_seen:
        layout = replace(layout, not_seen=tuple((name, 0.0) for name in places))
        said.append(f"{' = '.join(places)} = 0 in {unseen.sum()} rows: read as not seen")
        states[unseen] = np.nan
    spacing = np.concatenate([np.diff(times[rows]) for rows in groups])
    if not layout.resample and (np.abs(spacing - time_step) > TIME_TOLERANCE * time_step).any():
        layout = replace(layout, resample=True)
        said.append(f"samples are uneven: interpolated every {time_step:g} s")
    if layout.cut:
        return layout, said
    cut: dict[str, float] = {}
    longest = max(_longest_gap(times[rows], states[rows]) for rows in groups)
    if longest > LONGEST * time_step:
        cut["gaps"] = float(f"{LONGEST * time_step:.6g}")
        said.append(f"nothing was seen for up to {longest:.3g} s: cut at gaps")
    pushed = frame[[name for name in WRENCH if name in frame]].apply(pd.to_numeric, errors="coerce")
    if places and not pushed.fillna(0.0).to_numpy().any():
        least = _jump([(times[rows], states[rows]) for rows in groups])
        if least:
            cut["jumps"] = least
            said.append(
                "the velocity jumps, as at a wall, and none is declared: cut there"
                f" (by more than {least:g} m/s)"
            )
    whole = frame.groupby("trajectory", sort=False)["time"].count().to_numpy()
    rows = float(np.median(whole)) / frame["body"].nunique()
    if len(whole) < _FEW and not cut and rows >= 2 * _LEAST_ROWS:
        wanted = np.clip(rows * len(whole) / 12, _LEAST_ROWS, _MOST_ROWS)
        cut["every"] = float(f"{wanted * time_step:.2g}")
        said.append(
            f"{len(whole)} long trajectory: cut every {cut['every']:g} s, so that there are several"
        )
    return replace(layout, cut=tuple(cut.items())), said


def _unseen(states: Floats, groups: list[Ints]) -> Bools:
    """Return the rows where all places are zero, far from the rows seen before, shape (row,)."""
    zero = np.all(states == 0.0, axis=1) if states.shape[1] > 1 else np.zeros(len(states), bool)
    for rows in groups:
        own, seen = zero[rows], np.flatnonzero(~zero[rows])
        before = np.searchsorted(seen, np.flatnonzero(own)) - 1
        steps = np.linalg.norm(np.diff(states[rows][seen], axis=0), axis=1)
        away = np.linalg.norm(states[rows][seen[before[before >= 0]]], axis=1)
        far = len(steps) and len(away) and np.median(away) > _FAR * np.median(steps)
        zero[rows] &= bool(far)
    return zero


def _longest_gap(times: Floats, states: Floats) -> float:
    """Return the longest time in which nothing was seen (s)."""
    seen = np.isfinite(states).any(axis=1) if states.shape[1] else np.ones(len(times), bool)
    return float(np.diff(times[seen]).max(initial=0.0))


def _jump(tracks: list[tuple[Floats, Floats]]) -> float:
    """Return a change of velocity between rows (m/s) beyond which it jumps; 0 if it never does."""
    changes: list[Floats] = []
    for times, states in tracks:
        seen = np.isfinite(states).all(axis=1) & np.isfinite(times)
        changes.append(velocity_changes(times[seen], states[seen]))
    every = np.concatenate([np.zeros(0), *changes])
    least = _ABRUPT * float(np.median(every)) if len(every) else 0.0
    found = sum(len(peaks(each, least)) for each in changes) if least > 0 else 0
    return float(f"{least:.2g}") if 0 < found <= _RARE * len(every) else 0.0
