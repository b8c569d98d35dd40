"""Part of a recording that is too long to be judged as a whole."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

from pbrl_ppl.history.cuts import slowest
from pbrl_ppl.history.history import History, hashed
from pbrl_ppl.history.kinematics import column_noise
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

#: Transitions that a law is searched in. They show one of a hundredth of the motion, and a search's
#: time grows faster than they do.
MOST_TRANSITIONS = 3000


def drawn_pieces(
    history: History, most: int, seed: int = 0, *, pieces: int = 12, shortest: int = 100
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
    pieces, shortest : int
        Pieces that are drawn, and transitions of a piece, at least.
    """
    if history.n_transitions <= most:
        return history, ()
    slow = int(_slowest_motion(history) / history.dataset.attrs["time_step"])
    longest = max(min(max(slow, shortest), most // pieces), 1)
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
    drawn = joined_pieces(history.dataset, (parts[i] for i in chosen))
    said = (
        f"{drawn.n_transitions} of {history.n_transitions} transitions are used, in"
        f" {drawn.n_trajectories} pieces drawn by the seed"
    )
    return drawn, (said,)


def joined_pieces(data: xr.Dataset, pieces: Iterable[tuple[int, int, int]]) -> History:
    """Return pieces of trajectories: which one, its first row and its last one."""
    joined = xr.concat(
        [_piece(data, *piece) for piece in pieces],
        "trajectory", data_vars="minimal", coords="minimal", compat="override", join="outer",
    )  # fmt: skip
    labels = [str(label) for label in joined["trajectory"].to_numpy()]
    return History(hashed(joined.assign_coords(trajectory=labels)))


def thinned(
    scene: Scene, *histories: History, most: int = 1000
) -> tuple[Scene, tuple[History, ...], tuple[str, ...]]:
    """Return a scene and histories with a longer time step, if the first is finer than it moves.

    Every k-th row is kept, and commands are averaged between them, so that about ``most``
    transitions remain and a spline through the rows that are kept passes the others by no more than
    measurement errors. Recordings in which bodies may touch stay: a collision is an instant.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    *histories : History
        Of its bodies, with its time step; the first one is judged.
    most : int
        Transitions of a recording that is not thinned any more, about.

    Returns
    -------
    scene : Scene
        With the longer time step.
    histories : tuple of History
        With it.
    said : tuple of str
        A sentence on it, if rows are left out.
    """
    train = histories[0]
    alone = len(scene.moving) == 1 or bool(scene.joints)
    still = scene.walls or len(scene.moving) < len(scene.bodies)
    if still or not alone or any(body.kinematic for body in scene.moving):
        return scene, histories, ()
    observed, step = train.dataset["observed"].to_numpy(), 1
    limit = _limits(observed)
    while step < train.n_transitions // most and (_passed_by(observed, step + 1) <= limit).all():
        step += 1
    if step < 2:
        return scene, histories, ()
    dt = float(train.dataset.attrs["time_step"]) * step
    said = (
        f"one row in {step} is used, each {dt:.4g} s, and commands are averaged between them: the"
        " motion needs no more"
    )
    coarse = tuple(_each(one.dataset, step, dt) for one in histories)
    return replace(scene, time_step=dt), coarse, (said,)


def _limits(observed: Floats, *, noisy: float = 2.0, smooth: float = 1e-3) -> Floats:
    """Return by how much rows may be passed by, (body, state): by a few times their noise, or so.

    ``noisy``: times the noise; ``smooth``: share of the motion, which may be more.
    """
    limits = np.zeros(observed.shape[2:])
    for place in np.ndindex(limits.shape):
        column = observed[(slice(None), slice(None), *place)]
        seen = column[np.isfinite(column)]
        motion = float(seen.std()) if len(seen) else 0.0
        limits[place] = max(noisy * column_noise(column, 6), smooth * motion)
    return limits


def _passed_by(observed: Floats, step: int) -> Floats:
    """Return how far splines through one row in ``step`` pass the others by, rms, (body, state)."""
    off = np.zeros((2, *observed.shape[2:]))
    for one in observed:
        for place in np.ndindex(one.shape[1:]):
            values = one[(slice(None), *place)]
            rows = np.flatnonzero(np.isfinite(values))
            kept = rows[rows % step == 0]
            rows = rows[(rows % step != 0) & (rows < kept.max(initial=0))]
            if len(kept) > 3 and len(rows):
                error = values[rows] - CubicSpline(kept, values[kept])(rows)
                off[(slice(None), *place)] += (error**2).sum(), len(rows)
    size: Floats = np.sqrt(off[0] / np.maximum(off[1], 1.0))
    return size


def _each(data: xr.Dataset, step: int, dt: float) -> History:
    """Return the history with one row in ``step``, each ``dt`` seconds."""
    kept = data.isel(time=slice(None, None, step))
    rows = (data["n_rows"] - 1) // step + 1
    action = data["action"].to_numpy()
    action = np.pad(action, ((0, 0), (0, -action.shape[1] % step), (0, 0), (0, 0)), "edge")
    action = action.reshape(len(action), -1, step, *action.shape[2:]).mean(axis=2)
    beyond = np.arange(len(kept["time"])) >= rows.to_numpy()[:, None]
    action[np.arange(len(action)), rows.to_numpy() - 1] = np.nan
    seen = xr.DataArray(~beyond, dims=("trajectory", "time"))
    changed = {name: kept[name].where(seen) for name in ("observed", "start", "clock")}
    changed |= {"action": kept["action"].copy(data=action), "n_rows": rows}
    kept = kept.assign(changed).assign_coords(time=np.arange(len(kept["time"])))
    return History(hashed(kept.assign_attrs(time_step=dt)))


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
    n, label = last + 1 - first, f"{one['trajectory'].item()} from {first}"
    one = one.assign(action=action, before=before, n_rows=one["n_rows"].copy(data=[n]))
    return one.assign_coords(time=np.arange(n), trajectory=[label])
