"""Rows that belong to no model: single bad frames, and ends where a body is held or stopped.

One rule finds them: :func:`outliers`, how far rows are off the polynomial through those beside.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter1d

from pbrl_ppl.errors import HistoryError, warn
from pbrl_ppl.history.history import History, hashed
from pbrl_ppl.history.kinematics import GAUSSIAN, RATE_REACH, column_noise, finest_step
from pbrl_ppl.history.parts import joined_pieces
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, STATE_UNITS, THETA, VELOCITY, Bools, Floats, wrapped

#: Least rows at rest, and of a trajectory without its ends.
LEAST = 3


@dataclass(frozen=True)
class BadFrame:
    """A measurement that is off the smooth curve through its neighbours.

    Parameters
    ----------
    trajectory : int or str
        Label of the trajectory.
    row : int
        Row of the trajectory, from 0.
    time : float
        When (s).
    body, state : str
        What was measured.
    off : float
        Measured less the curve's value, in ``unit``.
    unit : str
        Of the measurement.
    rows : int
        Rows of the history, all trajectories together.

    Examples
    --------
    >>> print(BadFrame(2, 7, 0.35, "puck", "x", 0.31, "m", 400))
    x of puck at t = 0.35 s of trajectory 2 is off by 0.31 m and left out (1 of 400 rows)
    """

    trajectory: int | str
    row: int
    time: float
    body: str
    state: str
    off: float
    unit: str
    rows: int

    def __str__(self) -> str:
        """Return a sentence: which measurement is left out, and why."""
        return (
            f"{self.state} of {self.body} at t = {self.time:.4g} s of trajectory {self.trajectory}"
            f" is off by {abs(self.off):.2g} {self.unit} and left out (1 of {self.rows} rows)"
        )


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


def bad_frames(history: History) -> Bools:
    """Return which measurements are single bad frames.

    A row, or two neighbouring rows, are bad if they are far off the curve through the rows before,
    far off the one through the rows after, and far off the one through both, which must fit these
    rows. After an impact a row is on one of the first two curves, so it is never called bad; nor is
    it where the body's other positions (or velocities) are not smooth, as in a contact, or where
    positions confirm a velocity. The scale is the median absolute deviation of the whole column, in
    all trajectories; nothing nearer than eight steps of a quantised column is bad. Three measured
    rows are needed on either side.

    Parameters
    ----------
    history : History
        What was measured.

    Returns
    -------
    ndarray of bool
        Shape (trajectory, time, body, state). Under Gaussian noise a row is marked with a
        probability of less than 1e-14.

    Examples
    --------
    ::

        bad_frames(history).sum()
    1
    """
    return np.asarray(np.isfinite(_deviations(history)))


def without_bad_frames(history: History, *, most: float = 0.05) -> tuple[History, list[BadFrame]]:
    """Return the history with its bad frames missing, and the list of them.

    They become NaN in ``observed``, so that they take no part in a likelihood, and what was
    computed from them becomes NaN in ``start``. The hash stays that of the recording.

    Parameters
    ----------
    history : History
        What was measured.
    most : float
        Share of a column's rows that may be left out.

    Returns
    -------
    history : History
        The same object if nothing is left out.
    frames : list of BadFrame
        By trajectory, row, body and state.

    Warns
    -----
    UserWarning
        If more of a column's rows are off: that is heavy-tailed noise, and all are kept.

    Examples
    --------
    ::

        clean, frames = without_bad_frames(history)
        print(frames[0])
    x of puck at t = 0.35 s of trajectory 2 is off by 0.31 m and left out (1 of 400 rows)
    """
    off, dataset = _deviations(history), history.dataset
    bad: Bools = np.isfinite(off)
    count, rows = bad.sum(axis=(0, 1)), int(dataset["n_rows"].sum())
    many = (count > 1) & (count > most * rows)
    for body, d in np.argwhere(many):
        warn(
            f"{STATE[d]} of {history.bodies[body]}: {100 * count[body, d] / rows:.2g} % of the rows"
            f" are far off their neighbours, more than {100 * most:g} %: heavy-tailed noise rather"
            " than single bad frames, so all rows are kept",
            UserWarning,
        )
    return without_measurements(history, np.where(many, np.nan, off))


def without_measurements(history: History, off: Floats) -> tuple[History, list[BadFrame]]:
    """Return the history with some measurements missing, and the list of them.

    Parameters
    ----------
    history : History
        What was measured.
    off : ndarray
        How far they are off, NaN elsewhere, shape (trajectory, time, body, 6), SI units.
    """
    bad, dataset = np.isfinite(off), history.dataset
    if not bad.any():
        return history, []
    rows = int(dataset["n_rows"].sum())
    labels, clock = dataset["trajectory"].to_numpy().tolist(), dataset["clock"].to_numpy()
    frames = []
    for t, i, body, d in np.argwhere(bad):
        where = (labels[t], int(i), float(clock[t, i]), history.bodies[body], STATE[d])
        frames.append(BadFrame(*where, float(off[t, i, body, d]), STATE_UNITS[d], rows))
    observed = dataset["observed"].where(~bad)
    # initial states lose what was computed from bad frames
    computed: Bools = ~np.isfinite(observed.to_numpy())
    lost: Bools = computed & bad.any(axis=(2, 3), keepdims=True)
    near = maximum_filter1d(bad.any(axis=-1).astype(np.uint8), 2 * RATE_REACH + 1, axis=1) > 0
    never = computed.all(axis=(0, 1)) & (np.arange(len(STATE)) >= VELOCITY)
    lost |= near[..., None] & never
    return History(dataset.assign(observed=observed, start=dataset["start"].where(~lost))), frames


def _deviations(history: History, widths: tuple[int, ...] = (3, 4, 5), longest: int = 2) -> Floats:
    """Return how far bad frames are off; NaN elsewhere, shape (trajectory, time, body, state).

    Each of the ``widths`` is tried, the rows on either side that a curve is fitted to, with up to
    ``longest`` neighbouring bad rows.
    """
    observed = history.dataset["observed"].to_numpy()
    dt = float(history.dataset.attrs["time_step"])
    result = np.full(observed.shape, np.nan)
    bodies = np.flatnonzero(~history.dataset["kinematic"].to_numpy())
    for body, velocities in product(bodies, (False, True)):
        columns = range(VELOCITY, len(STATE)) if velocities else range(VELOCITY)
        part = result[:, :, body, columns.start : columns.stop]
        for gap, width in product(range(1, longest + 1), widths):
            kept = np.where(np.isfinite(result[:, :, body]), np.nan, observed[:, :, body])
            deviations = [_off(kept[..., d], width, gap, angle=d == THETA) for d in columns]
            first, ragged = (np.stack(one, axis=2) for one in zip(*deviations, strict=True))
            # a contact changes several coordinates at once
            first[ragged.sum(axis=2, keepdims=True) > ragged] = np.nan
            off = first[..., 0]
            for k in range(1, gap):
                off = np.where(np.isfinite(off), off, np.roll(first[..., k], k, axis=1))
            if velocities:
                off[_happened(kept, off, dt)] = np.nan
            part[...] = np.where(np.isfinite(part), part, off)
    return result


def _off(column: Floats, width: int, gap: int, *, angle: bool) -> tuple[Floats, Bools]:
    """Return how far neighbouring rows are off, and where the rows around them are not smooth.

    A bad row is 8 robust standard deviations off the curve through both sides, and 5 off those
    through either side, which agree on how far it is off, to half of it. Under Gaussian noise a row
    is beyond the first with a probability of 1e-15.

    Parameters
    ----------
    column : ndarray
        Shape (trajectory, time), NaN where missing.
    width : int
        Rows on either side.
    gap : int
        Neighbouring rows that are left out together.
    angle : bool
        Whether the column wraps (rad).

    Returns
    -------
    off : ndarray
        Of each row and those after it, shape (trajectory, time, gap); NaN if one is not bad.
    ragged : ndarray of bool
        Shape (trajectory, time).
    """
    result, ragged = np.full((*column.shape, gap), np.nan), np.zeros(column.shape, dtype=bool)
    span, end = 2 * width + gap, width + gap
    wide = np.pad(column, ((0, 0), (0, span)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(wide, span, axis=1)
    trajectory, first = np.nonzero(np.isfinite(windows).all(axis=-1))
    if not len(first):
        return result, ragged
    rows, middle = windows[trajectory, first], np.arange(width, end)
    if angle:
        sides = np.delete(np.arange(span), middle)
        rows[:, sides] = np.unwrap(rows[:, sides], axis=1)
    least, each = finest_step(column), np.eye(span)[:, middle]
    off, far, sure, misfit = outliers(rows, each, 3, least, angle=angle)
    good = ((far > 8.0) & (sure > 8.0)).all(axis=1)
    for side in (slice(end), slice(width, None)):
        off_side, far, _, _ = outliers(rows[:, side], each[side], 2, least, angle=angle)
        apart = wrapped(off_side - off) if angle else off_side - off
        good &= ((far > 5.0) & (np.abs(apart) <= 0.5 * np.abs(off))).all(axis=1)
    uneven = misfit > 8.0 * max(float(np.median(misfit)), least)
    result[trajectory[good], first[good] + width] = off[good]
    ragged[trajectory[uneven], first[uneven] + width] = True
    return result, ragged


def outliers(
    rows: Floats, parts: Floats, degree: int, least: float, *, angle: bool = False
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the sizes of deviations from a polynomial, fitted alongside, and how large they are.

    Parameters
    ----------
    rows : ndarray
        Windows of a column, shape (window, time).
    parts : ndarray
        Shapes of deviations, shape (time, part); of a row that is off one there, zero elsewhere.
    degree : int
        Of the polynomial.
    least : float
        Least noise.
    angle : bool
        Whether the sizes wrap (rad).

    Returns
    -------
    size, far, sure : ndarray
        Sizes, those over their robust scale in all windows, and over their standard errors, shape
        (window, part).
    misfit : ndarray
        Standard deviation of the rows about the fit, shape (window,).
    """
    time = np.linspace(-1.0, 1.0, rows.shape[1])
    design = np.hstack([parts, np.vander(time, degree + 1)])
    inverse, n = np.linalg.pinv(design), parts.shape[1]
    size = rows @ inverse[:n].T
    residual = rows - rows @ inverse.T @ design.T
    misfit = np.sqrt((residual**2).sum(axis=1) / max(len(time) - design.shape[1], 1))
    size = wrapped(size) if angle else size
    standard = np.abs(size) / np.linalg.norm(inverse[:n], axis=1)
    scale = max(GAUSSIAN * float(np.median(standard)), least)
    sure = standard / np.maximum(misfit, least)[:, None]
    return size, standard / scale, sure, misfit


def _happened(state: Floats, off: Floats, dt: float) -> Bools:
    """Return which deviations of velocities the positions confirm, as between two impacts.

    Parameters
    ----------
    state : ndarray
        Measured, shape (trajectory, time, 6), SI units.
    off : ndarray
        Velocities less their curve, shape (trajectory, time, 3); NaN where they are on it.
    dt : float
        Time step (s).
    """
    more = np.nan_to_num(off)
    curve = state[..., VELOCITY:] - more
    change = np.diff(state[..., :VELOCITY], axis=1) - dt / 2 * (curve[:, 1:] + curve[:, :-1])
    change[..., THETA] = wrapped(change[..., THETA])
    change = np.pad(change, ((0, 0), (1, 1), (0, 0)))
    beside = change[:, :-1] + change[:, 1:]
    # the position moves on by a quarter of what the velocity says
    return np.asarray(beside * more > dt / 4 * more**2)


def unmodelled_ends(history: History, scene: Scene) -> list[End]:
    """Return the ends of trajectories that neither a command nor the scene explains.

    A body is held if it is at rest for three rows or more and then moves off while no command acts
    on any body. It was stopped if its velocity changes abruptly near the end, where the commands
    do not change, in a scene that has nothing to meet. Either must be far outside of what all
    trajectories show elsewhere. Only positions and angles are looked at.

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

        print(*unmodelled_ends(history, scene))
    ball is held in the first 6 rows of trajectory 2 (t = 0 to 0.167 s)
    """
    dataset = history.dataset
    observed, clock = dataset["observed"].to_numpy(), dataset["clock"].to_numpy()
    follows, labels = dataset["kinematic"].to_numpy(), dataset["trajectory"].to_numpy().tolist()
    push = np.nan_to_num(dataset["action"].to_numpy())[:, :, ~follows]
    found: dict[tuple[int, bool], End] = {}
    for body, d in product(np.flatnonzero(~follows), range(3)):
        rows_of = enumerate(dataset["n_rows"].to_numpy())
        filled = {t: _filled(observed[t, :n, body, d], d == THETA) for t, n in rows_of}
        series = {t: values for t, values in filled.items() if values is not None}
        if not any(len(values) > 4 and np.ptp(values) > 0 for values in series.values()):
            continue
        noise = column_noise(series.values(), 4, robust=True)
        noise = max(noise, finest_step(np.concatenate([*series.values()])) / np.sqrt(12))
        search = _Ends(series, push, noise)
        stops = {} if _may_meet(scene, history.bodies[body]) else search.stopped()
        for t, values in series.items():
            n, held, stopped = len(values), search.held(t), stops.get(t, 0)
            others = np.delete(observed[t, :n], body, axis=1)[: 2 * held + search.beside, :, :3]
            # what others may set moving is not held
            held *= not (np.fmax.reduce(others, axis=0) > np.fmin.reduce(others, axis=0)).any()
            for last, rows, what in ((False, held, "held"), (True, stopped, "stopped")):
                if rows > (found[t, last].rows if (t, last) in found else 0):
                    times = clock[t, n - rows : n] if last else clock[t, :rows]
                    where = (rows, float(times[0]), float(times[-1]), history.bodies[body])
                    found[t, last] = End(labels[t], not last, *where, what)
    return [found[key] for key in sorted(found)]


@dataclass(frozen=True)
class _Ends:
    """A search for unmodelled ends in a dimension of a body.

    Attributes
    ----------
    series : dict of int to ndarray
        Positions without gaps, by trajectory.
    push : ndarray
        Commands to all bodies, shape (trajectory, time, body, 3).
    noise : float
        Of a position.
    beside : int
        Least rows of motion beside those at rest.
    longest : int
        Rows at rest, and rows of motion, that are looked at, at most.
    limit : float
        Robust standard deviations, and standard errors, of a bend.
    """

    series: dict[int, Floats]
    push: Floats
    noise: float
    beside: int = 6
    longest: int = 200
    limit: float = 8.0

    def still(self, values: Floats) -> int:
        """Return the number of first rows that stay within the noise of their mean."""
        mean = np.cumsum(values) / np.arange(1, len(values) + 1)
        three = np.convolve(values, np.full(3, 1 / 3), "valid")
        off = np.abs(three - mean[1:-1]) > 4 * self.noise / np.sqrt(3)
        return int(np.argmax(off)) + 1 if off.any() else len(values)

    def windows(self, n: int) -> tuple[Floats, list[tuple[int, int]]]:
        """Return all windows, shape (window, n), and the trajectory and first row of each."""
        at = [(t, i) for t, values in self.series.items() for i in range(len(values) - n + 1)]
        return np.array([self.series[t][i : i + n] for t, i in at]).reshape(-1, n), at

    def held(self, t: int) -> int:
        """Return the rows at rest at a trajectory's beginning, before it moves uncommanded.

        They are off the cubic through the rows after them, which a smooth motion from rest is not.
        """
        values = self.series[t]
        still = self.still(values)
        first = max(0, still - self.longest)  # of a long rest its last rows are enough
        for times in (1, 2, 4) if LEAST <= still < len(values) - self.beside else ():
            end = still + int(np.clip(times * (still - first), self.beside, self.longest))
            if end > len(values) or self.push[t, :end].any():
                break
            rows = np.vstack([values[first:end], self.windows(end - first)[0]])
            parts = np.eye(end - first)[:, : still - first]
            _, far, sure, _ = outliers(rows, parts, 3, self.noise)
            if ((far[0] > 3) & (sure[0] > self.limit)).any():
                return still
        return 0

    def stopped(self) -> dict[int, int]:
        """Return the rows after an abrupt change of velocity with constant commands, at an end.

        A change of the acceleration, as where dry friction ends a motion, must fit far worse.
        """
        best: dict[int, tuple[float, int]] = {}
        for after in (3, 6, 12, 24):
            rows, at = self.windows(3 * after)
            time, places = np.arange(3 * after)[:, None], np.linspace(1, 3 * after - 2, 6 * after)
            for place in 2 * after - 1 + np.arange(10) / 10 if len(rows) else ():
                part = np.maximum(time - place, 0.0)
                _, far, sure, misfit = outliers(rows, part, 2, self.noise)
                abrupt = np.flatnonzero(np.minimum(far, sure)[:, 0] > self.limit)
                if not len(abrupt):
                    continue
                bent = [np.maximum(time - other, 0.0) ** 2 for other in places]
                left = [outliers(rows[abrupt], part, 2, self.noise)[3] for part in bent]
                for i in abrupt[misfit[abrupt] < 0.3 * np.min(left, axis=0)]:
                    (t, first), values = at[i], self.series[at[i][0]]
                    n = len(values) - first - 2 * after
                    rest = min(self.still(values[::-1]), len(values) - self.beside)
                    constant = not np.ptp(self.push[t, first : len(values) - 1], axis=0).any()
                    if constant and n <= max(len(values) // 4, rest):
                        best[t] = max(best.get(t, (0.0, 0)), (float(sure[i, 0]), n))
        return {t: n for t, (_, n) in best.items()}


def trimmed(history: History, ends: Iterable[End]) -> History:
    """Return the history without the rows of these ends.

    Parameters
    ----------
    history : History
        What was measured.
    ends : iterable of End
        As of :func:`unmodelled_ends`.

    Raises
    ------
    HistoryError
        If less than three rows of a trajectory would be left.

    Examples
    --------
    ::

        trimmed(history, unmodelled_ends(history, scene)).n_transitions
    38
    """
    dataset = history.dataset
    labels, n_rows = dataset["trajectory"].to_numpy().tolist(), dataset["n_rows"].to_numpy()
    begin, end = np.zeros_like(n_rows), n_rows.copy()
    for bad in ends:
        t = labels.index(bad.trajectory)
        begin[t] = max(begin[t], bad.rows if bad.first else 0)
        end[t] = min(end[t], n_rows[t] - (0 if bad.first else bad.rows))
    kept = end - begin
    for t in np.flatnonzero(kept < LEAST):
        raise HistoryError(
            f"history: trajectory {labels[t]} has {max(kept[t], 0)} rows without its first"
            f" {begin[t]} and last {n_rows[t] - end[t]}; expected at least {LEAST}; drop the"
            " trajectory"
        )
    if (kept == n_rows).all():
        return history
    pieces = zip(range(len(labels)), begin, end - 1, strict=True)
    result = joined_pieces(dataset, pieces).dataset.assign_coords(trajectory=dataset["trajectory"])
    # velocities estimated from positions across a stop
    never = ~np.isfinite(dataset["observed"].to_numpy()[..., 3:]).any(axis=(0, 1))
    for t in np.flatnonzero(end < n_rows):
        last = slice(max(kept[t] - RATE_REACH, 1), kept[t])
        result["start"].to_numpy()[t, last, :, 3:][:, never] = np.nan
    return History(hashed(result))


def _filled(values: Floats, angle: bool) -> Floats | None:
    """Return values with gaps interpolated, an angle without jumps; None with too many gaps."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < max(12, 0.8 * len(values)) or not np.isfinite(values[[0, -1]]).all():
        return None
    level = np.unwrap(values[known]) if angle else values[known]
    return np.interp(np.arange(len(values)), known, level)


def _may_meet(scene: Scene, body: str) -> bool:
    """Return whether a wall, another body or a joint may stop a body."""
    stops = (joint.bodies or () for joint in scene.joints if joint.traits.stops_bodies)
    return bool(scene.walls) or len(scene.bodies) > 1 or any(body in both for both in stops)
