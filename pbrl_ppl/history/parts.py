"""Part of a recording that is too long to be judged as a whole."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import xarray as xr

from pbrl_ppl.history.cuts import slowest
from pbrl_ppl.history.history import History, hashed
from pbrl_ppl.state import Floats

#: Transitions that a law is searched in. They show one of a hundredth of the motion, and a search's
#: time grows faster than they do.
MOST_TRANSITIONS = 3000
#: Transitions of a piece, at least.
_SHORTEST = 100


def drawn_pieces(
    history: History, most: int, seed: int = 0, *, pieces: int = 12
) -> tuple[History, tuple[str, ...]]:
    """Return pieces of a history with at most so many transitions in all, and a sentence on them.

    A history that has no more is returned as it is, without a sentence.

    Trajectories are cut to pieces as long as the slowest motion, of 100 transitions or more, and at
    most one of ``pieces`` equal parts of all. The seed draws them, in proportion to how much moves
    in each: a rest says little. A piece keeps its trajectory's number and time.

    Parameters
    ----------
    history : History
        Measured trajectories.
    most : int
        Transitions of the result, at most; at least 4.
    seed : int
        The same seed gives the same pieces.
    pieces : int
        Pieces that are drawn, at least.
    """
    if history.n_transitions <= most:
        return history, ()
    slow = int(_slowest_motion(history) / history.dataset.attrs["time_step"])
    longest = max(min(max(slow, _SHORTEST), most // pieces), 1)
    parts: list[tuple[int, int, int]] = []
    complete = history.complete
    for trajectory, n in enumerate(history.dataset["n_rows"].to_numpy() - 1):
        edges = np.linspace(0, n, -(-n // longest) + 1).astype(int)
        for first, last in pairwise(edges.tolist()):
            begins = np.flatnonzero(complete[trajectory, first:last])  # not in a gap
            parts += [(trajectory, first + int(begins[0]), last)] if len(begins) else []
    if not parts:
        return history, ()
    moves = _motion(history.dataset["observed"].to_numpy(), parts)
    moves = moves if moves.any() else np.ones(len(parts))
    with np.errstate(divide="ignore"):  # keys of a draw without replacement; a rest comes last
        order = np.argsort(np.random.default_rng(seed).exponential(size=len(parts)) / moves)
    sizes = np.array([b - a for _, a, b in parts])[order]
    chosen = np.sort(order[np.cumsum(sizes) <= most])
    joined = xr.concat(
        [_piece(history.dataset, *parts[i]) for i in chosen],
        "trajectory", data_vars="minimal", coords="minimal", compat="override", join="outer",
    )  # fmt: skip
    labels = [str(label) for label in joined["trajectory"].to_numpy()]
    drawn = History(hashed(joined.assign_coords(trajectory=labels)))
    said = (
        f"{drawn.n_transitions} of {history.n_transitions} transitions are used, in"
        f" {drawn.n_trajectories} pieces drawn by the seed"
    )
    return drawn, (said,)


def _slowest_motion(history: History) -> float:
    """Return the longest period of a coordinate (s), in the median of the trajectories."""
    places = history.dataset["observed"].to_numpy()[..., :3].reshape(*history.elapsed.shape, -1)
    slow = [slowest(*one) for one in zip(history.elapsed, places, strict=True)]
    return float(np.median(slow))


def _motion(observed: Floats, pieces: list[tuple[int, int, int]]) -> Floats:
    """Return how far coordinates move in each piece, in units of the whole, summed, (piece,)."""
    whole = np.fmax.reduce(observed, axis=(0, 1)) - np.fmin.reduce(observed, axis=(0, 1))
    whole[~(whole > 0.0)] = np.inf
    ranges = []
    for trajectory, first, last in pieces:
        rows = observed[trajectory, first : last + 1]
        far = np.fmax.reduce(rows) - np.fmin.reduce(rows)
        ranges.append(np.nansum(far / whole))
    return np.array(ranges)


def _piece(data: xr.Dataset, trajectory: int, first: int, last: int) -> xr.Dataset:
    """Return the rows ``first`` to ``last`` of a trajectory, as one from ``first`` on."""
    one = data.isel(trajectory=[trajectory], time=slice(first, last + 1))
    if first == 0 and last == data["n_rows"][trajectory] - 1:
        return one
    action, before = one["action"].copy(), one["before"]
    action[:, -1] = np.nan
    if first:
        held = data["action"].isel(trajectory=[trajectory], time=first - 1)
        before = before.copy(data=np.nan_to_num(held.to_numpy()))
    return one.assign(
        action=action, before=before, n_rows=one["n_rows"].copy(data=[last + 1 - first])
    ).assign_coords(
        time=np.arange(last + 1 - first),
        trajectory=[f"{one['trajectory'].item()} from {first}"],
    )
