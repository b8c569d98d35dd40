"""Unusable rows at a trajectory's ends: a body that is still held, an abrupt stop."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.bad_frames import outliers
from pbrl_ppl.history.history import History, hashed
from pbrl_ppl.history.kinematics import RATE_REACH, column_noise, finest_step
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import THETA, Floats

#: Positions of a dimension without gaps, by trajectory.
Series = dict[int, Floats]
#: Least rows at rest, and of a trajectory without its ends.
LEAST = 3
#: Least rows of motion beside those at rest.
BESIDE = 6
#: Rows at rest, and rows of motion, that are looked at, at most.
LONGEST = 200
#: Robust standard deviations, and standard errors, of a bend.
LIMIT = 8.0


@dataclass(frozen=True)
class End:
    """Rows at one end of a trajectory that belong to no model.

    Parameters
    ----------
    trajectory : int or str
        Label of the trajectory.
    first : bool
        Whether these are its first rows; else its last.
    rows : int
        How many.
    begin, end : float
        Times of the first and the last of them (s).
    body : str
        Which body.
    what : str
        ``held`` (at rest, then moving off without a command) or ``stopped`` (after an abrupt change
        of velocity).

    Examples
    --------
    >>> print(End(2, True, 6, 0.0, 0.167, "ball", "held"))
    ball is held in the first 6 rows of trajectory 2 (t = 0 to 0.167 s)
    """

    trajectory: int | str
    first: bool
    rows: int
    begin: float
    end: float
    body: str
    what: str

    def __str__(self) -> str:
        """Return a sentence: which rows, and why."""
        where = f"{'first' if self.first else 'last'} {self.rows} rows of trajectory"
        said = f"is held in the {where}" if self.first else f"stops abruptly before the {where}"
        return f"{self.body} {said} {self.trajectory} (t = {self.begin:.4g} to {self.end:.4g} s)"


def strange_ends(history: History, scene: Scene) -> list[End]:
    """Return the ends of trajectories that neither a command nor the scene explains.

    A body is held if it is at rest for three rows or more and then moves off while no command acts
    on any body. It was stopped if its velocity changes abruptly near the end, where the commands
    do not change and nothing in the scene is near enough to be met. Either must be far outside of
    what all trajectories show elsewhere. Only positions and angles are looked at.

    Parameters
    ----------
    history : History
        What was measured.
    scene : Scene
        Says what a body may meet.

    Returns
    -------
    list of End
        By trajectory, first rows before last ones; of several bodies the one with the most rows.

    Examples
    --------
    ::

        print(*strange_ends(history, scene))
    ball is held in the first 6 rows of trajectory 2 (t = 0 to 0.167 s)
    """
    dataset = history.dataset
    observed, clock = dataset["observed"].to_numpy(), dataset["clock"].to_numpy()
    follows, labels = dataset["kinematic"].to_numpy(), dataset["trajectory"].to_numpy().tolist()
    lengths = dataset["n_rows"].to_numpy()
    push = np.nan_to_num(dataset["action"].to_numpy())[:, :, ~follows]
    ends: dict[tuple[int, bool], End] = {}
    for body, d in product(np.flatnonzero(~follows), range(3)):
        found = [_filled(observed[t, :n, body, d], d == THETA) for t, n in enumerate(lengths)]
        series = {t: values for t, values in enumerate(found) if values is not None}
        if not any(len(values) > 4 and np.ptp(values) > 0 for values in series.values()):
            continue
        noise = column_noise(series.values(), 4, robust=True)
        noise = max(noise, finest_step(np.concatenate([*series.values()])) / np.sqrt(12))
        kinks = _kinks(series, noise)
        for t, values in series.items():
            n, name = len(values), history.bodies[body]
            others = np.delete(observed[t, :n], body, axis=1)[..., :3]
            rows = _held(values, push[t], series, noise)
            if rows and not _moves(others[: 2 * rows + BESIDE]):
                end = End(labels[t], True, rows, clock[t, 0], clock[t, rows - 1], name, "held")
                ends[t, False] = max(ends.get((t, False), end), end, key=lambda end: end.rows)
            rows = _stopped(values, push[t], kinks[t], noise)
            if rows and not _near(scene, int(body), observed[t, :n], n - rows):
                times = clock[t, n - rows], clock[t, n - 1]
                end = End(labels[t], False, rows, *times, name, "stopped")
                ends[t, True] = max(ends.get((t, True), end), end, key=lambda end: end.rows)
    return [ends[key] for key in sorted(ends)]


def _still(values: Floats, noise: float) -> int:
    """Return the number of rows at the beginning that stay within the noise of their mean."""
    mean = np.cumsum(values) / np.arange(1, len(values) + 1)
    near = np.convolve(values, np.full(3, 1 / 3), "same")[1:-1]  # of three rows
    off = np.abs(near - mean[1:-1]) > 4 * noise / np.sqrt(3)
    return int(np.argmax(off)) + 1 if off.any() else len(values)


def _windows(series: Series, n: int) -> tuple[Floats, list[tuple[int, int]]]:
    """Return windows of all series, shape (window, n), and the key and first row of each."""
    at = [(t, i) for t, values in series.items() for i in range(len(values) - n + 1)]
    return np.array([series[t][i : i + n] for t, i in at]).reshape(-1, n), at


def _held(values: Floats, push: Floats, series: Series, noise: float) -> int:
    """Return the rows at rest at the beginning, before it moves off without a command.

    Motion that sets off at rest differs from a cubic by a quadratic and a cubic after that moment.
    """
    still = _still(values, noise)
    if not LEAST <= still < len(values) - BESIDE:
        return 0
    skip = max(0, still - LONGEST)
    for times in (1, 2, 4):
        end = still + int(np.clip(times * (still - skip), BESIDE, LONGEST))
        if end > len(values) or push[:end].any():
            break
        rows, at = _windows(series, end - skip)
        rest = np.eye(end - skip)[:, : still - skip]
        _, far, sure, _ = outliers(rows, rest, 3, noise)
        mine = next(i for i, (t, first) in enumerate(at) if series[t] is values and first == skip)
        if ((far[mine] > 3) & (sure[mine] > LIMIT)).any():
            return still
    return 0


def _kinks(series: Series, noise: float) -> dict[int, list[tuple[float, int, int]]]:
    """Return abrupt changes of velocity: certainty, first row of a window, first row after it."""
    found: dict[int, list[tuple[float, int, int]]] = {t: [] for t in series}
    for after in (3, 6, 12, 24):
        rows, at = _windows(series, 3 * after)
        if not len(rows):
            continue

        def bent(place: float, power: int, rows: Floats = rows) -> tuple[Floats, ...]:
            part = np.maximum(np.arange(rows.shape[1]) - place, 0.0)[:, None] ** power
            return outliers(rows, part, 2, noise)

        places = np.linspace(1, 3 * after - 2, min(6 * after, 60))
        smooth = np.min([bent(place, 2)[3] for place in places], axis=0)
        for place in 2 * after - 1 + np.arange(10) / 10:
            _, far, sure, misfit = bent(place, 1)
            abrupt = np.minimum(far, sure)[:, 0] > LIMIT
            for i in np.flatnonzero(abrupt & (misfit < 0.3 * smooth)):
                t, first = at[i]
                found[t].append((float(sure[i, 0]), first, first + 2 * after))
    return found


def _stopped(
    values: Floats, push: Floats, kinks: list[tuple[float, int, int]], noise: float
) -> int:
    """Return the rows at the end after an abrupt change of velocity with constant commands."""
    n = len(values)
    most = max(n // 4, min(_still(values[::-1], noise), n - BESIDE))
    ends = [
        (certainty, n - row)
        for certainty, first, row in kinks
        if n - row <= most and not np.ptp(push[first : n - 1], axis=0).any()
    ]
    return max(ends)[1] if ends else 0


def trimmed(history: History, ends: Iterable[End]) -> History:
    """Return the history without the rows of these ends.

    Parameters
    ----------
    history : History
        What was measured.
    ends : iterable of End
        As of :func:`strange_ends`.

    Raises
    ------
    HistoryError
        If less than three rows of a trajectory would be left.

    Examples
    --------
    ::

        trimmed(history, strange_ends(history, scene)).n_transitions
    38
    """
    dataset = history.dataset
    labels, n_rows = dataset["trajectory"].to_numpy().tolist(), dataset["n_rows"].to_numpy()
    begin, end = np.zeros(len(labels), dtype=np.int64), n_rows.astype(np.int64)
    for bad in ends:
        t = labels.index(bad.trajectory)
        if bad.first:
            begin[t] = max(begin[t], bad.rows)
        else:
            end[t] = min(end[t], n_rows[t] - bad.rows)
    for t in np.flatnonzero(end - begin < LEAST):
        raise HistoryError(
            f"history: trajectory {labels[t]} has {max(end[t] - begin[t], 0)} rows without its"
            f" first {begin[t]} and last {n_rows[t] - end[t]}; expected at least {LEAST}; drop the"
            " trajectory"
        )
    if (begin == 0).all() and (end == n_rows).all():
        return history
    length = int((end - begin).max())
    rows = begin[:, None] + np.arange(length)
    outside = rows >= end[:, None]
    rows = np.where(outside, 0, rows)
    result = dataset.isel(time=slice(length)).copy()
    for name in ("observed", "action", "start", "clock"):
        values = dataset[name].to_numpy()
        kept = values[np.arange(len(labels))[:, None], rows]
        kept[outside] = np.nan
        result[name] = result[name].copy(data=kept)
    # velocities estimated from positions across a stop
    never = ~np.isfinite(dataset["observed"].to_numpy()[..., 3:]).any(axis=(0, 1))
    start = result["start"].to_numpy().copy()
    for t in np.flatnonzero(end < n_rows):
        kept = end[t] - begin[t]
        start[t, max(kept - RATE_REACH, 1) : kept, :, 3:][:, never] = np.nan
    action, before = dataset["action"].to_numpy(), dataset["before"].to_numpy().copy()
    late = np.flatnonzero(begin)
    before[late] = np.nan_to_num(action[late, begin[late] - 1])
    last = result["action"].to_numpy()
    last[np.arange(len(labels)), end - begin - 1] = np.nan
    result = result.assign(
        action=result["action"].copy(data=last),
        start=result["start"].copy(data=start),
        before=dataset["before"].copy(data=before),
        n_rows=dataset["n_rows"].copy(data=end - begin),
    )
    return History(hashed(result))


def _filled(values: Floats, angle: bool) -> Floats | None:
    """Return values with gaps interpolated, an angle without jumps; None with too many gaps."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < max(2 * BESIDE, 0.8 * len(values)):
        return None
    if known[0] > 0 or known[-1] < len(values) - 1:
        return None
    level = np.unwrap(values[known]) if angle else values[known]
    return np.interp(np.arange(len(values)), known, level)


def _moves(states: Floats) -> bool:
    """Return whether any body of shape (time, body, 3) moves, and may set others moving."""
    with np.errstate(invalid="ignore"):
        spread = np.fmax.reduce(states, axis=0) - np.fmin.reduce(states, axis=0)
    return bool((np.nan_to_num(spread) > 0).any())


def _near(scene: Scene, body: int, states: Floats, row: int, slack: float = 0.25) -> bool:
    """Return whether a wall, another body or a joint may have stopped a body at a row.

    A contact reaches beyond the shapes' radii by the share ``slack`` of them.
    """
    moving = scene.moving
    places = states[max(row - 2, 0) : row + 2, :, :2]
    values = places[:, body]
    if not np.isfinite(values).all():
        return False  # a hinged body with a measured angle alone
    speed = np.abs(np.diff(values, axis=0)).max() if len(values) > 1 else 0.0
    reach = (1 + slack) * moving[body].shape.bounding_radius + 2 * float(speed)
    for wall in scene.walls:
        start, way = np.array(wall.start), np.array(wall.end) - np.array(wall.start)
        along = np.clip(
            (values - start) @ way / max(float(way @ way), np.finfo(float).tiny), 0.0, 1.0
        )
        if (np.linalg.norm(values - start - along[:, None] * way, axis=1) < reach).any():
            return True
    others = [(neighbour, places[:, i]) for i, neighbour in enumerate(moving) if i != body]
    others += [
        (neighbour, np.array(neighbour.pose)[:2]) for neighbour in scene.bodies if neighbour.static
    ]
    for other, place in others:
        far = np.linalg.norm(values - place, axis=1)
        if not (far > reach + (1 + slack) * other.shape.bounding_radius).all():
            return True
    return any(
        joint.traits.stops_bodies and moving[body].name in (joint.bodies or ())
        for joint in scene.joints
    )
