"""Unusable rows at a trajectory's ends: a body that is still held, an abrupt stop."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.history import History, hashed
from pbrl_ppl.history.kinematics import RATE_REACH, column_noise, finest_step
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import THETA, Floats

#: Least rows at rest, and of a trajectory without its ends.
LEAST = 3
#: Least rows of motion beside those at rest.
BESIDE = 6


@dataclass(frozen=True, eq=False)
class Column:
    """Positions of a dimension in all trajectories.

    Attributes
    ----------
    series : list of ndarray
        Shape (time,) each.
    noise : float
        Standard deviation of the measurement noise.
    change : float
        90th percentile of the changes of velocity, per row.
    still : float
        Measurement noises within which a body is at rest.
    longest : int
        Rows at rest, and rows of motion, that are looked at, at most.
    places : int
        Places of a bend that are tried, at most.
    gain, share : float
        A bend takes this much off the sum of squares of a cubic, in variances of the noise, and
        this share of it.
    outside : float
        A cubic fits the end this many times worse than it fits the median window of all rows.
    certainty, large : float
        An abrupt change of velocity in standard errors, and over ``change``.
    limit : float
        A moment of release may fit worse than the best by so much, in variances.
    """

    series: list[Floats]
    noise: float
    change: float
    still: float = 4.0
    longest: int = 200
    places: int = 60
    gain: float = 100.0
    share: float = 0.9
    outside: float = 2.5
    certainty: float = 8.0
    large: float = 4.0
    limit: float = 4.0

    @classmethod
    def of(cls, series: list[Floats]) -> Column | None:
        """Return the column of series; None where nothing moves or rows are too few.

        Noise comes from fourth differences, changes of velocity from second ones.
        """
        if not any(len(values) > 4 for values in series) or not any(map(np.ptp, series)):
            return None
        finest = finest_step(np.concatenate(series))
        noise = max(column_noise(series, 4, robust=True), finest / np.sqrt(12))
        second = np.concatenate([np.diff(values, 2) for values in series])
        # of independent errors the second differences have six times the variance
        change = float(np.quantile(np.abs(second), 0.9)) ** 2 - 6 * (1.8 * noise) ** 2
        return cls(series, noise, float(np.sqrt(max(change, 0.0))))

    def held(self, values: Floats, push: Floats) -> int:
        """Return the rows at rest at the beginning, before it moves off without a command."""
        still = self._still(values)
        if not LEAST <= still < len(values) - BESIDE:
            return 0
        skip = max(0, still - self.longest)  # of a long rest its last rows are enough
        still -= skip
        for window in self._windows(values[skip:], still):
            if push[: skip + len(window)].any():
                break
            places = np.linspace(2, still, min(2 * still - 3, self.places))
            bend = self._bend(window, places, 3, rest=True, abrupt=False)
            if bend is not None and bend.place >= LEAST - 1:
                return skip + int(np.ceil(bend.latest))
        return 0

    def stopped(self, values: Floats, push: Floats) -> int:
        """Return the rows at the end after an abrupt change of velocity with constant commands."""
        back = values[::-1]
        still = self._still(back)
        n = len(values)
        tries = [(min(max(LEAST, n // 4), self.longest), 0, False)]
        if LEAST <= still < n - BESIDE:
            skip = max(0, still - self.longest)
            tries.append((still - skip, skip, True))
        best, rows = None, 0
        for longest, skip, rest in tries:
            places = np.linspace(1.5, longest, min(2 * longest - 2, self.places))
            for window in self._windows(back[skip:], longest):
                if np.ptp(push[n - skip - len(window) : -1], axis=0).any():
                    continue
                bend = self._bend(window, places, 2, rest=rest, abrupt=True)
                if bend is None or abs(bend.jump) < self.large * self.change:
                    continue
                if bend.certainty < self.certainty:
                    continue
                if best is None or bend.certainty > best.certainty:
                    # rows after the moment of the stop: in reversed time those before it
                    best, rows = bend, skip + int(np.floor(bend.latest)) + 1
        return rows

    def _still(self, values: Floats) -> int:
        """Return the number of rows at the beginning that stay within the noise of their mean."""
        mean = np.cumsum(values) / np.arange(1, len(values) + 1)
        off = np.abs(values - mean) > self.still * self.noise
        return int(np.argmax(off)) if off.any() else len(values)

    def _windows(self, values: Floats, still: int) -> list[Floats]:
        """Return beginnings of a series: the rows at rest, and more and more beside them."""
        beside = (int(np.clip(times * still, BESIDE, self.longest)) for times in (1, 2, 4))
        return [values[: still + rows] for rows in beside if still + rows <= len(values)]

    def _bend(
        self, window: Floats, places: Floats, degree: int, *, rest: bool, abrupt: bool
    ) -> Bend | None:
        """Return the best bend, if no smoother motion fits as well and it is unlike other rows.

        Smoother is a cubic; than an abrupt change of velocity also one of the acceleration, as
        where dry friction ends a motion.
        """
        n = len(window)
        time = np.arange(n, dtype=float)
        cubic = np.vander(time / n, 4)
        smooth = np.eye(n) - cubic @ np.linalg.pinv(cubic)
        without = float(((smooth @ window) ** 2).sum())
        for place in np.linspace(1, n - 2, min(2 * n, self.places)) if abrupt else ():
            parts = [time, time**2, np.maximum(time - place, 0.0) ** 2]
            without = min(without, _fitted(window, parts)[2])
        bends, powers = [], range(2 if rest else 1, degree + 1)
        for place in places:
            after = np.maximum(time - place, 0.0)
            more = [(after if rest else time) ** k for k in powers]
            jump, error, left = _fitted(window, [after, *more])
            free = max(n - len(more) - 3, 1)
            error *= max(self.noise, float(np.sqrt(left / free)))
            bends.append(Bend(float(place), float(place), jump, error, left))
        best = min(bends, key=lambda bend: bend.left)
        variance = max(self.noise**2, best.left / max(n - 5, 1))
        if without - best.left < self.gain * variance or best.left > (1 - self.share) * without:
            return None
        elsewhere = [
            ((np.lib.stride_tricks.sliding_window_view(values, n) @ smooth) ** 2).sum(axis=1)
            for values in self.series
            if len(values) >= n
        ]
        if without < self.outside**2 * float(np.median(np.concatenate(elsewhere))):
            return None
        near = [bend.place for bend in bends if bend.left < best.left + self.limit * variance]
        return replace(best, latest=max(near))


@dataclass(frozen=True)
class Bend:
    """A bend at a row (a fraction): its latest place, its jump of velocity with standard error."""

    place: float
    latest: float
    jump: float
    error: float
    left: float

    @property
    def certainty(self) -> float:
        """Jump over its standard error."""
        return abs(self.jump) / self.error


def _fitted(window: Floats, parts: list[Floats]) -> tuple[float, float, float]:
    """Return the first part's size, its error at a noise of one, and the sum of squares left."""
    design = np.stack([*parts, np.ones(len(window))], axis=1)
    inverse = np.linalg.pinv(design)
    size = inverse @ window
    left = float(((window - design @ size) ** 2).sum())
    return float(size[0]), float(np.linalg.norm(inverse[0])), left


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
    action = np.nan_to_num(dataset["action"].to_numpy())
    follows = dataset["kinematic"].to_numpy()
    labels, n_rows = dataset["trajectory"].to_numpy().tolist(), dataset["n_rows"].to_numpy()
    ends: dict[tuple[int, bool], End] = {}
    for body, d in product(np.flatnonzero(~follows), range(3)):
        series = [_filled(observed[t, :n, body, d], d == THETA) for t, n in enumerate(n_rows)]
        column = Column.of([complete for complete in series if complete is not None])
        for t, values in enumerate(series):
            if values is None or column is None:
                continue
            n = len(values)
            push = action[t, :n][:, ~follows].reshape(n, -1)
            others = np.delete(observed[t, :n], body, axis=1)[..., :3]
            for first in (True, False):
                rows = column.held(values, push) if first else column.stopped(values, push)
                if rows <= (ends[t, first].rows if (t, first) in ends else 0):
                    continue
                if first:
                    explained = _moves(others[: 2 * rows + BESIDE])
                else:
                    explained = _near(scene, int(body), observed[t, :n], n - rows)
                if not explained:
                    times = clock[t, :rows] if first else clock[t, n - rows : n]
                    begin, end = float(times[0]), float(times[-1])
                    why, name = "held" if first else "stopped", history.bodies[body]
                    ends[t, first] = End(labels[t], first, rows, begin, end, name, why)
    return [ends[key] for key in sorted(ends, key=lambda key: (key[0], not key[1]))]


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
