"""Single bad frames of a recording: rows off the smooth curve through their neighbours."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter1d

from pbrl_ppl.errors import warn
from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import GAUSSIAN, RATE_REACH, finest_step
from pbrl_ppl.state import STATE, STATE_UNITS, THETA, VELOCITY, Bools, Floats, wrapped


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
    count = bad.sum(axis=(0, 1))
    rows = int(dataset["n_rows"].sum())
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


def _off(
    column: Floats,
    width: int,
    gap: int,
    *,
    angle: bool,
    limit: float = 8.0,
    limit_of_side: float = 5.0,
    agreement: float = 0.5,
) -> tuple[Floats, Bools]:
    """Return how far neighbouring rows are off, and where the rows around them are not smooth.

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
    limit, limit_of_side : float
        Robust standard deviations that a bad row is off the curve through both sides, and off those
        through either side. Under Gaussian noise a row is beyond the first with a probability of
        1e-15.
    agreement : float
        The curves must agree on how far the row is off, to this share of it.

    Returns
    -------
    off : ndarray
        Of each row and those after it, shape (trajectory, time, gap); NaN if one is not bad.
    ragged : ndarray of bool
        Shape (trajectory, time).
    """
    result, ragged = np.full((*column.shape, gap), np.nan), np.zeros(column.shape, dtype=bool)
    span, end = 2 * width + gap, width + gap
    if column.shape[1] < span:
        return result, ragged
    windows = np.lib.stride_tricks.sliding_window_view(column, span, axis=1)
    trajectory, first = np.nonzero(np.isfinite(windows).all(axis=-1))
    if not len(first):
        return result, ragged
    rows, middle = windows[trajectory, first], np.arange(width, end)
    if angle:
        sides = np.delete(np.arange(span), middle)
        rows[:, sides] = np.unwrap(rows[:, sides], axis=1)
    least, each = finest_step(column), np.eye(span)[:, middle]
    off, far, sure, misfit = outliers(rows, each, 3, least, angle=angle)
    good = ((far > limit) & (sure > limit)).all(axis=1)
    for side in (slice(end), slice(width, None)):
        off_side, far, _, _ = outliers(rows[:, side], each[side], 2, least, angle=angle)
        apart = wrapped(off_side - off) if angle else off_side - off
        good &= ((far > limit_of_side) & (np.abs(apart) <= agreement * np.abs(off))).all(axis=1)
    uneven = misfit > limit * max(float(np.median(misfit)), least)
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
