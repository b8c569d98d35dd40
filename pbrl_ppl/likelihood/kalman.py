"""Kalman filter of linearised trajectories: whitening, and its adjoint, which is the smoother.

The deviation ``d`` of a state from where it was linearised moves by ``d' = F d - r + w`` and is
measured as ``y = d + e``. Measured cells are taken in one by one (their noises are independent), so
that missing ones are simply left out. See B. D. O. Anderson and J. B. Moore, Optimal Filtering
(1979), chapter 6, and G. J. Bierman, Fixed interval smoothing with discrete measurements (1973).
The derivative by the noise is S. J. Koopman and N. Shephard's, Exact score for time series models
in state space form (1992).

Noise so small that a variance rounds to zero gives NaN, which is no likelihood. Arrays are copied
by loops: assigning one adds seconds to the compilation, for the message of a wrong shape.
"""

from __future__ import annotations

import numba
import numpy as np

from pbrl_ppl.state import Bools, Floats


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _restart(p: Floats, variance: Floats) -> None:
    """Set the covariance ``p``, shape (cell, cell), to that of a trajectory's first state."""
    for a in range(len(variance)):
        for b in range(len(variance)):
            p[a, b] = variance[a] if a == b else 0.0


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _forward(p: Floats, slope: Floats, step: Floats, moved: Floats) -> None:
    """Replace the covariance p by ``F p F' + step``; ``moved`` is room for ``F p``."""
    d = len(p)
    for a in range(d):
        for b in range(d):
            total = 0.0
            for c in range(d):
                total += slope[a, c] * p[c, b]
            moved[a, b] = total
    for a in range(d):
        for b in range(a + 1):
            total = step[a, b]
            for c in range(d):
                total += moved[a, c] * slope[b, c]
            p[a, b] = total
            p[b, a] = total


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _take(p: Floats, i: int, sensor: float, gain: Floats) -> float:
    """Take in a measurement of cell i; return its innovation's variance, and fill its gain.

    A cell that hardly varies may get a variance below zero by rounding: it counts as zero.
    """
    d = len(p)
    if p[i, i] < 0.0:
        p[i, i] = 0.0
    variance: float = p[i, i] + sensor
    for a in range(d):
        gain[a] = p[a, i] / variance
    for a in range(d):
        share = gain[a] * variance
        for b in range(a + 1):
            p[a, b] -= share * gain[b]
    for a in range(d):
        if p[a, a] < 0.0:
            p[a, a] = 0.0
        for b in range(a):
            p[b, a] = p[a, b]
    for a in range(d):  # differences lose all digits if the sensor is far better than was known
        p[a, i] = p[i, a] = gain[a] * sensor
    return variance


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def gains(
    slope: Floats, first: Bools, seen: Bools, begin: Floats, sensor: Floats, step: Floats,
    met: Bools,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Return the gain and standard deviation of every innovation.

    Parameters
    ----------
    slope : ndarray
        F, shape (transition, cell, cell), transitions of a trajectory one after the other.
    first : ndarray
        Whether a transition is its trajectory's first, shape (transition,).
    seen : ndarray
        Whether a cell was measured at the transition's end, shape (transition, cell).
    begin : ndarray
        Variance of the state before each first transition, shape (transition, cell).
    sensor : ndarray
        Variance of a measurement, shape (cell,).
    step : ndarray
        Covariance of what a step without and with contact adds, shape (2, cell, cell).
    met : ndarray of bool
        Whether bodies touch in a transition, shape (transition,).

    Returns
    -------
    gain : ndarray
        Shape (transition, cell, cell): ``gain[k, i]`` is what cell i's innovation moves.
    scale : ndarray
        Standard deviation of each cell's innovation, shape (transition, cell); 1 where not seen.
    covariance : ndarray
        Of the state after each transition's measurements, shape (transition, cell, cell).
    """
    n, d = seen.shape
    gain, scale = np.zeros((n, d, d)), np.ones((n, d))
    covariance = np.empty((n, d, d))
    p, moved = np.zeros((d, d)), np.zeros((d, d))
    for k in range(n):
        if first[k]:
            _restart(p, begin[k])
        _forward(p, slope[k], step[int(met[k])], moved)
        for i in range(d):
            if seen[k, i]:
                scale[k, i] = np.sqrt(_take(p, i, sensor[i], gain[k, i]))
        for a in range(d):
            for b in range(d):
                covariance[k, a, b] = p[a, b]
    return gain, scale, covariance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _deviate(slope: Floats, state: Floats, residual: Floats, ahead: Floats) -> None:
    """Fill ``ahead`` with the deviation after a transition, ``F state - residual``."""
    for a in range(len(state)):
        total = -residual[a]
        for b in range(len(state)):
            total += slope[a, b] * state[b]
        ahead[a] = total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def innovations(
    slope: Floats, first: Bools, seen: Bools, gain: Floats, scale: Floats,
    residual: Floats, begin: Floats, measured: Floats,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return the whitened innovations and filtered deviations.

    Parameters
    ----------
    slope, first, seen, gain, scale : ndarray
        As of :func:`gains`.
    residual : ndarray
        Linearised minus predicted state at each transition's end, r, shape (set, transition, cell).
    begin : ndarray
        Deviation before each first transition, shape (transition, cell).
    measured : ndarray
        y at each transition's end, shape (transition, cell).

    Returns
    -------
    white, filtered : ndarray
        Shape (set, transition, cell); an innovation is 0 where nothing was seen.
    """
    sets, n, d = residual.shape
    white, filtered = np.zeros((sets, n, d)), np.empty((sets, n, d))
    state, moved = np.zeros(d), np.zeros(d)
    for j in range(sets):
        for k in range(n):
            if first[k]:
                for a in range(d):
                    state[a] = begin[k, a]
            _deviate(slope[k], state, residual[j, k], moved)
            for i in range(d):
                if seen[k, i]:
                    innovation = measured[k, i] - moved[i]
                    white[j, k, i] = innovation / scale[k, i]
                    for a in range(d):
                        moved[a] += gain[k, i, a] * innovation
            for a in range(d):
                state[a] = filtered[j, k, a] = moved[a]
    return white, filtered


@numba.njit(cache=True, nogil=True, error_model="numpy")
def whitened(
    slope: Floats, first: Bools, seen: Bools, variance: Floats, sensor: Floats, step: Floats,
    met: Bools, residual: Floats, begin: Floats, measured: Floats,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return whitened innovations of sets that each have a noise of their own.

    It is :func:`gains` and :func:`innovations` in one, which keeps nothing but the result.

    Parameters
    ----------
    slope, first, seen, met : ndarray
        As of :func:`gains`.
    variance : ndarray
        Variance of the state before each first transition, shape (set, transition, cell).
    sensor, step : ndarray
        As of :func:`gains`, shapes (set, cell) and (set, 2, cell, cell).
    residual, begin, measured : ndarray
        As of :func:`innovations`.

    Returns
    -------
    white : ndarray
        Shape (set, transition, cell); 0 where nothing was seen.
    log_scale : ndarray
        Log standard deviations, summed over the cells, shape (set, transition).
    """
    sets, n, d = residual.shape
    white, log_scale = np.zeros((sets, n, d)), np.zeros((sets, n))
    p, moved, gain = np.zeros((d, d)), np.zeros((d, d)), np.zeros(d)
    state, ahead = np.zeros(d), np.zeros(d)
    for j in range(sets):
        for k in range(n):
            if first[k]:
                for a in range(d):
                    state[a] = begin[k, a]
                _restart(p, variance[j, k])
            _forward(p, slope[k], step[j, int(met[k])], moved)
            _deviate(slope[k], state, residual[j, k], ahead)
            for i in range(d):
                if seen[k, i]:
                    innovation = measured[k, i] - ahead[i]
                    spread = _take(p, i, sensor[j, i], gain)
                    scale = np.sqrt(spread)
                    white[j, k, i] = innovation / scale
                    log_scale[j, k] += np.log(scale)
                    for a in range(d):
                        ahead[a] += gain[a] * innovation
            for a in range(d):
                state[a] = ahead[a]
    return white, log_scale


@numba.njit(cache=True, error_model="numpy")
def adjoint(
    slope: Floats, first: Bools, seen: Bools, gain: Floats, scale: Floats, weighted: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the adjoint of the filter: derivatives of a sum of innovations.

    With ``weighted = white``, it is Bierman's smoother: the smoothed deviation after a transition
    is ``filtered - covariance @ after``.

    Parameters
    ----------
    slope, first, seen, gain, scale : ndarray
        As of :func:`gains`.
    weighted : ndarray
        Derivative of the sum by each white innovation, shape (transition, cell).

    Returns
    -------
    before, residual, after : ndarray
        Derivative by the state before the transition, by its prediction (which is minus that by the
        residual) and by the state after its measurements, shape (transition, cell) each.
    """
    n, d = seen.shape
    before, residual, after = np.zeros((n, d)), np.zeros((n, d)), np.zeros((n, d))
    for k in range(n - 1, -1, -1):
        for a in range(d):
            if k + 1 < n and not first[k + 1]:
                after[k, a] = before[k + 1, a]
            residual[k, a] = after[k, a]
        for i in range(d - 1, -1, -1):
            if seen[k, i]:
                total = weighted[k, i] / scale[k, i]
                for a in range(d):
                    total += gain[k, i, a] * residual[k, a]
                residual[k, i] -= total
        for a in range(d):
            for b in range(d):
                before[k, a] += slope[k, b, a] * residual[k, b]
    return before, residual, after


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def score(
    slope: Floats, first: Bools, seen: Bools, gain: Floats, scale: Floats, white: Floats, met: Bools
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the derivative of the log-likelihood by the variances.

    Parameters
    ----------
    slope, first, seen, gain, scale : ndarray
        As of :func:`gains`.
    white : ndarray
        White innovations, shape (transition, cell).
    met : ndarray
        As of :func:`gains`.

    Returns
    -------
    sensor : ndarray
        Twice the derivative by each cell's variance of measuring, shape (cell,).
    step : ndarray
        Twice that by the covariance of what a step without and with contact adds, shape (2, cell,
        cell).
    begin : ndarray
        Twice that by the variance of the state before each transition, shape (transition, cell).
    auxiliary : ndarray
        Residual of each measurement given all others, over its standard deviation (auxiliary
        residuals: A. C. Harvey and S. J. Koopman, Journal of Business & Economic Statistics 10,
        1992), shape (2, transition, cell): at the transition's end, and of the state before it as
        if measured there; 0 where not seen.
    """
    n, d = seen.shape
    auxiliary = np.zeros((2, n, d))
    sensor, step, begin = np.zeros(d), np.zeros((2, d, d)), np.zeros((n, d))
    state, moved = np.zeros(d), np.zeros(d)
    known, pulled = np.zeros((d, d)), np.zeros((d, d))
    for k in range(n - 1, -1, -1):
        if k == n - 1 or first[k + 1]:
            state[:], known[:] = 0.0, 0.0
        for i in range(d - 1, -1, -1):
            if not seen[k, i]:
                continue
            weight = gain[k, i]
            total, spread = white[k, i] / scale[k, i], 1.0 / scale[k, i] ** 2
            for a in range(d):
                moved[a] = 0.0
                for b in range(d):
                    moved[a] += known[a, b] * weight[b]
            for a in range(d):
                total += weight[a] * state[a]
                spread += weight[a] * moved[a]
            sensor[i] += total * total - spread
            auxiliary[0, k, i] = total / np.sqrt(spread)
            state[i] -= total
            for a in range(d):
                known[i, a] -= moved[a]
                known[a, i] -= moved[a]
            known[i, i] += spread
        for a in range(d):
            for b in range(d):
                step[int(met[k]), a, b] += state[a] * state[b] - known[a, b]
        transition = slope[k]
        for a in range(d):
            moved[a] = 0.0
            for b in range(d):
                moved[a] += transition[b, a] * state[b]
                total = 0.0
                for c in range(d):
                    total += known[a, c] * transition[c, b]
                pulled[a, b] = total
        for a in range(d):
            for b in range(a + 1):
                total = 0.0
                for c in range(d):
                    total += transition[c, a] * pulled[c, b]
                known[a, b] = known[b, a] = total
        for a in range(d):
            state[a] = moved[a]
            begin[k, a] = state[a] * state[a] - known[a, a]
            if known[a, a] > 0.0:
                auxiliary[1, k, a] = state[a] / np.sqrt(known[a, a])
    return sensor, step, begin, auxiliary
