"""Recognition of velocity columns that were computed from the positions of the same log."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pbrl_ppl.history.angles import unwrapped
from pbrl_ppl.history.history import History
from pbrl_ppl.state import STATE, THETA

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: Samples on either side that a smoother may have looked at.
_REACH = 8
#: A velocity is computed if positions predict it better than their noise would let them, were it
#: measured by itself: this share of that noise's variance, or less, is left over.
_SHARE = 0.5
#: The same where the positions have no noise: a share of the velocity's own variance.
_EXACT = 1e-8
#: An angle that looks noisier than this (rad) turns too far between rows to be followed.
_WRAPPED = 0.5
#: Windows a coefficient of the regression, at least.
_ENOUGH = 4


def measured_alone(history: History, columns: Bools | None = None) -> History:
    """Return the history without derived velocities: they stay as states to start from.

    Parameters
    ----------
    history : History
        What was recorded.
    columns : ndarray of bool, optional
        Which not to count as measured, shape (body, state); :func:`derived_velocities` by default.
    """
    columns = derived_velocities(history) if columns is None else columns
    if not columns.any():
        return history
    observed = history.dataset["observed"]
    return History(history.dataset.assign(observed=observed.where(~columns)))


def derived_velocities(history: History) -> Bools:
    """Which velocities are linear in the positions around them, and so no measurements.

    A velocity with a noise of its own cannot be predicted from noisy positions with weights w more
    closely than ``|w|^2 s^2``, s being the positions' noise; a difference quotient or a smoother
    can. That noise is known without a model: the mean of two neighbouring velocities differs from
    the difference quotient between them by noise alone.

    Parameters
    ----------
    history : History
        What was measured.

    Returns
    -------
    ndarray of bool
        Shape (body, state); positions are never derived.
    """
    dt = float(history.dataset.attrs["time_step"])
    result = np.zeros(history.dataset["observed"].shape[2:], dtype=bool)
    for body in np.flatnonzero(~history.dataset["kinematic"].to_numpy()):
        for d in range(3, len(STATE)):
            result[body, d] = _is_derived(_series(history, int(body), d - 3), dt)
    return result


def _series(history: History, body: int, d: int) -> list[tuple[Floats, Floats]]:
    """Positions of a dimension and their rates, of trajectories in which neither has gaps."""
    observed = history.dataset["observed"].to_numpy()[:, :, body]
    dt = float(history.dataset.attrs["time_step"])
    series: list[tuple[Floats, Floats]] = []
    for own, n in zip(observed, history.dataset["n_rows"].to_numpy(), strict=True):
        position, rate = own[:n, [d, d + 3]].T
        if np.isfinite(position).all() and np.isfinite(rate).all():
            if d == THETA:
                position = unwrapped(dt * np.arange(n), position, rate)
            series.append((position, rate))
    return series


def _is_derived(series: list[tuple[Floats, Floats]], dt: float) -> bool:
    """Whether rates follow from positions, of trajectories without gaps."""
    width = 2 * _REACH + 1
    windows, middle = [], []
    for position, rate in series:
        if len(position) < width:
            continue
        own = np.lib.stride_tricks.sliding_window_view(position, width)
        windows.append(np.delete(own - own[:, [_REACH]], _REACH, axis=1))
        middle.append(rate[_REACH:-_REACH])
    if not windows:
        return False
    x, y = np.concatenate(windows), np.concatenate(middle)
    if len(x) < _ENOUGH * width or not np.any(y):
        return False
    weights = np.linalg.lstsq(x, y, rcond=None)[0]
    left = float(((y - x @ weights) ** 2).sum() / (len(x) - len(weights)))
    spread = weights @ weights + weights.sum() ** 2  # the middle position's noise is in all columns
    noise = float(spread) * _noise(series, dt)[0]
    return left < max(_SHARE * noise, _EXACT * float(y.var()))


def measurement_noise(history: History) -> Floats:
    """Standard deviation of measuring each state, from kinematics alone, shape (body, state).

    Zero where a position or its velocity has gaps: nothing is known there. It is no more than third
    differences show, so that a position in another unit than its velocity does not look noisy.
    """
    dt = float(history.dataset.attrs["time_step"])
    result = np.zeros(history.dataset["observed"].shape[2:])
    for body in range(len(result)):
        for d in range(3):
            if series := _series(history, body, d):
                third = [np.concatenate([np.diff(s[i], 3) for s in series]) for i in (0, 1)]
                least = [float(np.mean(own**2)) / 20 if len(own) else 0.0 for own in third]
                result[body, [d, d + 3]] = np.sqrt(np.minimum(_noise(series, dt), least))
    result[result[:, THETA] > _WRAPPED, THETA] = 0.0
    return result


def _noise(series: list[tuple[Floats, Floats]], dt: float) -> tuple[float, float]:
    """Variances of positions and of rates, from what kinematics leave of measured ones.

    Second differences take off what a smooth acceleration leaves. Of those, independent noises of
    positions (in units of ``dt``) and rates have variance ``20 A + B`` and covariance at lag one
    ``-15 A - B / 4``.
    """
    square = product = 0.0
    n = m = 0
    for position, rate in series:
        off = np.diff(np.diff(position) / dt - (rate[1:] + rate[:-1]) / 2, 2)
        square, n = square + float(off @ off), n + len(off)
        product, m = product + float(off[1:] @ off[:-1]), m + max(len(off) - 1, 0)
    place = max(0.0, -(square / max(n, 1) + 4 * product / max(m, 1)) / 40)
    return place * dt**2, max(0.0, square / max(n, 1) - 20 * place)
