"""Linear filters by which loggers compute velocities from positions, and the test for each."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import comb

import numpy as np
from scipy.signal import savgol_coeffs
from scipy.stats import f as f_distribution

from pbrl_ppl.state import Floats

#: Positions and velocities of rows without gaps, m and m/s or rad and rad/s.
Runs = list[tuple[Floats, Floats]]

#: False-alarm rate of each test; some forty are made of a column.
_ALARM = 1e-5
#: A filter leaves at most this share of the variance that the positions' noise would leave of an
#: independent measurement (half of its amplitude), however many rows there are.
_SHARE = 0.25
#: Order of differences of positions that show their noise, and their variance for white noise.
_ORDER = 8
_GAIN = comb(2 * _ORDER, _ORDER)
#: The noise is no less than this share of what they show, where one order more shows noise: this
#: many times the variance (3.8 for white noise).
_FLOOR, _WHITE = 1e-3, 2.0
#: Standard deviations of a Gaussian in its median absolute deviation.
_MEDIAN = 1.4826
#: Without noise: this share of the velocity's variance, by a known filter and by a fitted one.
_EXACT, _EXACT_FITTED = 1e-12, 1e-8
#: Rows per coefficient of a fitted filter, at least, and for the longest.
_ROWS, _ROWS_LONGEST = 2.5, 4.0
#: Least denominator of a low-pass at half the sampling rate. It is zero in a relation that holds of
#: noiseless measurements too: that the mean of two velocities is the difference quotient.
_POLE = 0.1
#: Rows on either side of the longest fitted filter.
_REACH = 8


@dataclass(frozen=True)
class Filter:
    """A linear relation between a velocity, its neighbours and positions.

    Attributes
    ----------
    name : str
        As the report says it.
    places : tuple of int
        Rows of the positions, relative to the velocity's.
    weights : tuple of float, optional
        Of the positions, in units of 1 / time step; fitted if empty.
    rates : tuple of tuple of int
        Rows of earlier (later) velocities, relative; those of a group share a fitted weight.
    rows : float
        Rows per fitted coefficient, at least.
    """

    name: str
    places: tuple[int, ...]
    weights: tuple[float, ...] = ()
    rates: tuple[tuple[int, ...], ...] = ()
    rows: float = _ROWS


@dataclass(frozen=True)
class Match:
    """A filter that gives a velocity, its delay (s), and its misfit over the bound of noise."""

    name: str
    lag: float
    misfit: float = field(repr=False)


@lru_cache(maxsize=1)
def known_filters() -> tuple[Filter, ...]:
    """Return the filters without unknown coefficients.

    Examples
    --------
    >>> [each.name for each in known_filters()][:3]
    ['forward differences', 'backward differences', 'central differences']
    """
    filters = [
        Filter("forward differences", (0, 1), (-1.0, 1.0)),
        Filter("backward differences", (-1, 0), (-1.0, 1.0)),
        Filter("central differences", (-1, 1), (-0.5, 0.5)),
        *(
            Filter(f"backward differences over {m} rows", (-m, 0), (-1 / m, 1 / m))
            for m in range(2, 11)
        ),
        *(
            Filter(f"central differences over {2 * m} rows", (-m, m), (-0.5 / m, 0.5 / m))
            for m in range(2, 6)
        ),
    ]
    for window in range(5, 22, 2):
        half = window // 2
        for order, orders in ((2, "2"), (4, "3 or 4")):  # of odd windows, 3 and 4 are the same
            weights = savgol_coeffs(window, order, deriv=1, use="dot")
            name = f"a Savitzky-Golay filter of {window} rows, order {orders}"
            filters.append(Filter(name, tuple(range(-half, half + 1)), tuple(weights.tolist())))
    return tuple(filters)


def _fitted(name: str, before: int, after: int, *rates: tuple[int, ...]) -> Filter:
    return Filter(name, tuple(range(-before, after + 1)), rates=rates)


#: Filters with fitted coefficients, the fewest first: exponential smoothing and Butterworth
#: low-passes of a difference, causal and forward-backward, and any finite filter.
FITTED = (
    _fitted("a finite filter of 5 rows", 2, 2),
    _fitted("a causal first-order low-pass of differences", 2, 1, (-1,)),
    _fitted("a zero-phase first-order low-pass of differences", 2, 2, (-1, 1)),
    _fitted("a causal second-order low-pass of differences", 3, 1, (-1,), (-2,)),
    _fitted("a zero-phase second-order low-pass of differences", 3, 3, (-1, 1), (-2, 2)),
    replace(
        _fitted(f"a finite filter of {2 * _REACH + 1} rows", _REACH, _REACH), rows=_ROWS_LONGEST
    ),
)


def position_noise(runs: Runs, dt: float) -> tuple[float, float]:
    """Return the noise variances of positions and of velocities, from their kinematic residuals.

    The mean of two neighbouring velocities differs from the difference quotient between them by
    noise alone. Second differences take off what a smooth acceleration leaves. Of those,
    independent noises of positions (in units of ``dt``) and velocities have variance ``20 A + B``
    and covariance at lag one ``-15 A - B / 4``.

    Parameters
    ----------
    runs : list of (ndarray, ndarray)
        Positions and velocities, shape (n,) each.
    dt : float
        Time step (s).

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> x, v = rng.normal(0.0, 0.002, 4000), rng.normal(0.0, 0.01, 4000)
    >>> float(np.sqrt(position_noise([(x, v)], 0.01)[0]).round(4))
    0.002
    """
    square = product = 0.0
    n = m = 0
    for position, rate in runs:
        off = np.diff(np.diff(position) / dt - (rate[1:] + rate[:-1]) / 2, 2)
        square, n = square + float(off @ off), n + len(off)
        product, m = product + float(off[1:] @ off[:-1]), m + max(len(off) - 1, 0)
    place = max(0.0, -(square / max(n, 1) + 4 * product / max(m, 1)) / 40)
    return place * dt**2, max(0.0, square / max(n, 1) - 20 * place)


def computed_by(runs: Runs, dt: float) -> Match | None:
    """Return the filter that computed velocities from positions, or None.

    A velocity with independent noise differs from a filter of noisy positions with weights ``w``
    by a variance of at least ``|w|^2 s^2``, ``s`` being the positions' noise. A computed velocity
    does not. The ratio of what a filter leaves to that bound is compared with the lower tail of the
    F distribution (1e-5 for each filter), degrees of freedom corrected for serial correlation.

    Parameters
    ----------
    runs : list of (ndarray, ndarray)
        Positions and velocities of rows without gaps, shape (n,) each.
    dt : float
        Time step (s).

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(size=40)
    >>> computed_by([(x[1:], np.diff(x) / 0.1)], 0.1)
    Match(name='backward differences', lag=0.05)
    """
    rates = np.concatenate([rate for _, rate in runs]) if runs else np.zeros(0)
    total = float(rates.var()) if len(rates) else 0.0
    if not total > 0:
        return None
    least, most = _noise_bounds(runs)
    noise = min(max(position_noise(runs, dt)[0], least), most)
    shown = sum(max(len(position) - 3, 0) for position, _ in runs) / _correlation([-1, 3, -3, 1])
    found = [_tested(each, runs, dt, noise, shown, total) for each in known_filters()]
    if matches := [match for match in found if match is not None]:
        return min(matches, key=lambda match: match.misfit)
    for each in FITTED:
        if match := _tested(each, runs, dt, noise, shown, total):
            return match
    return None


def _noise_bounds(runs: Runs) -> tuple[float, float]:
    """Return bounds of the variance of positions' noise, from positions alone.

    Kinematics do not tell it where a velocity is late, which leaves more than noise does, and tell
    too much where bodies collide: high differences of smooth positions leave noise, their median
    no collision.
    """
    eighth, ninth = (
        np.concatenate([np.diff(position, order) for position, _ in runs])
        for order in (_ORDER, _ORDER + 1)
    )
    if not len(ninth):
        return 0.0, 0.0
    square = float(np.mean(eighth**2))
    white = float(np.mean(ninth**2)) > _WHITE * square
    most = (_MEDIAN * float(np.median(np.abs(eighth)))) ** 2 / _GAIN
    return (_FLOOR * square / _GAIN if white else 0.0), most


def _tested(
    candidate: Filter, runs: Runs, dt: float, noise: float, shown: float, total: float
) -> Match | None:
    """Return the match of a filter; None if its misfit is above the bound."""
    before = -min(candidate.places + tuple(min(group) for group in candidate.rates))
    after = max(candidate.places + tuple(max(group) for group in candidate.rates))
    places, rates, middle = [], [], []
    for position, rate in runs:
        k = np.arange(max(before, 0), len(position) - max(after, 0))
        if len(k):
            places.append(position[k[:, None] + candidate.places] - position[k, None])
            groups = [rate[k[:, None] + group].sum(axis=1) for group in candidate.rates]
            rates.append(np.array(groups).T.reshape(len(k), len(groups)))
            middle.append(rate[k])
    if not middle:
        return None
    x, v, y = np.concatenate(places), np.concatenate(rates), np.concatenate(middle)
    if candidate.weights:
        a, b, errors = np.zeros(0), np.array(candidate.weights) / dt, np.zeros((0, len(y)))
    else:
        if len(y) < candidate.rows * (x.shape[1] - 1 + v.shape[1]):
            return None
        middle_one = candidate.places.index(0)
        inverse = np.linalg.pinv(np.hstack([v, np.delete(x, middle_one, axis=1) / dt]))
        errors = inverse[v.shape[1] :] / dt
        errors = np.insert(errors, middle_one, -errors.sum(axis=0), axis=0)
        a, b = inverse[: v.shape[1]] @ y, errors @ y
        ends = (sum((-1.0) ** row for row in group) for group in candidate.rates)
        if 1 - sum(weight * end for weight, end in zip(a, ends, strict=True)) < _POLE:
            return None
    dof = len(y) - (len(candidate.places) - 1 + len(a) if len(errors) else 0)
    variance = float(((y - v @ a - x @ b) ** 2).sum()) / dof
    square = float(b @ b) - variance * float((errors**2).sum())  # without the errors of the weights
    if not square > 0:
        return None
    share = min(_SHARE, float(f_distribution.ppf(_ALARM, dof / _correlation(b), max(shown, 1.0))))
    exact = (
        _EXACT if candidate.weights else _EXACT_FITTED if candidate.rows == _ROWS_LONGEST else 0.0
    )
    bound = max(share * square * noise, exact * total)
    if not variance < bound:
        return None
    return Match(candidate.name, _lag(candidate, a, b) * dt, variance / square)


def _correlation(weights: Floats | list[int]) -> float:
    """Return how many squares of filtered white noise count as one independent square."""
    product = np.correlate(weights, weights, "full")
    return float(product @ product / product.max() ** 2)


def _lag(candidate: Filter, a: Floats, b: Floats) -> float:
    """Return the group delay of a differentiator at low frequency, in rows."""
    row = np.array(candidate.places, dtype=float)
    lag = -float(b @ row**2) / (2 * float(b @ row))
    for weight, group in zip(a, candidate.rates, strict=True):
        lag -= float(weight) * sum(group) / (1 - sum(a * [len(each) for each in candidate.rates]))
    return round(float(lag), 6) + 0.0
