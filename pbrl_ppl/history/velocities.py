"""Velocity columns that were computed from positions of the log, lag or contradict them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import f as f_distribution
from scipy.stats import t as t_distribution

from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import column_noise, finest_step, unwrapped
from pbrl_ppl.history.units import units_that_differ
from pbrl_ppl.state import STATE, THETA, VELOCITY, Bools, Floats, wrapped

#: Positions and velocities of rows without gaps, m and m/s or rad and rad/s.
Runs = list[tuple[Floats, Floats]]


@dataclass(frozen=True)
class Contradiction:
    """What is wrong with a velocity column, and where.

    Attributes
    ----------
    kind : str
        What it does: "wraps every 1.2", "is clipped at 0.5", ...
    share : float
        Share of the rows in which it does not agree with the changes of its position.
    trajectory, row : int
        The first such row, from 0.
    factor : float
        What the column is to be multiplied by, where that is all; else 0.
    """

    kind: str
    share: float
    trajectory: int
    row: int
    factor: float = 0.0


@dataclass(frozen=True)
class UnusedVelocity:
    """A velocity column that does not count as measured, and why.

    Attributes
    ----------
    body : str
        Name of the body.
    state : str
        Name of the velocity: "vx", "vy" or "omega".
    position : str
        Name of its position: "x", "y" or "theta".
    computed : bool
        Whether positions of the log give it; else it only lags them.
    lag : float
        By how much it is late (s); negative if early.
    zero : bool
        Whether it is 0 in all rows while the position moves: nobody measured it.
    fault : Contradiction, optional
        How it contradicts its position.

    Examples
    --------
    >>> UnusedVelocity("ball", "vy", "y", True, 0.02).sentence
    'vy of ball was computed from y, 20 ms late, and is not used'
    >>> UnusedVelocity("arm", "omega", "theta", False, 0.012).sentence
    'omega of arm lags theta by 12 ms and is not used'
    """

    body: str
    state: str
    position: str
    computed: bool
    lag: float
    zero: bool = False
    fault: Contradiction | None = None

    @property
    def sentence(self) -> str:
        """Sentence: the column, how it was computed, what is wrong or by how much it lags."""
        name, size = f"{self.state} of {self.body}", abs(self.lag)
        if self.fault:
            cure = 'velocities = "computed"'
            if self.fault.factor:
                cure = f'units = {{ {self.state} = "{self.unit()}" }} or {cure}'
            return (
                f"{name} contradicts the changes of {self.position} in {self.fault.share:.0%} of"
                f" the rows, first in row {self.fault.row} of trajectory {self.fault.trajectory}:"
                f" it {self.fault.kind}, and is not used: {cure} in [recording]"
            )
        if self.zero:
            return f"{name} is 0 in all rows while {self.position} moves, and is not used"
        late = f"{1e3 * size:.3g} ms" if 1e-3 <= size < 1.0 else f"{size:.3g} s"
        verb, word = ("lags", "late") if self.lag > 0 else ("leads", "early")
        if not self.computed:
            return f"{name} {verb} {self.position} by {late} and is not used"
        lag = f", {late} {word}," if self.lag else ""
        return f"{name} was computed from {self.position}{lag} and is not used"

    def unit(self, present: float = 1.0) -> str:
        """Return the unit that cures another factor, from the size of the present one in SI."""
        factor = self.fault.factor if self.fault else 1.0
        return f"{1 / (present * factor or 1.0):.5g}/{'rad' if self.state == 'omega' else 'm'}"


def unused_velocities(history: History) -> tuple[UnusedVelocity, ...]:
    """Return the velocity columns that were computed from positions, lag or contradict them.

    Tests are made so that fewer than one in a hundred logs with independently measured velocities
    loses one; it then costs information, as positions are enough for a fit.

    Parameters
    ----------
    history : History
        What was measured. Rows with gaps are left out.

    Returns
    -------
    tuple of UnusedVelocity
        By body and state.

    Examples
    --------
    >>> import pandas as pd
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> from pbrl_ppl.state import STATE, WRENCH
    >>> scene = Scene(time_step=0.05, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> table = pd.DataFrame(0.0, range(50), [*STATE, *WRENCH]).assign(trajectory=0, body="puck")
    >>> table["step"] = np.arange(50)
    >>> table["time"] = 0.05 * table["step"]
    >>> table["x"] = np.cumsum(np.random.default_rng(1).normal(0.0, 0.02, 50))
    >>> table["vx"] = np.gradient(table["x"], 0.05)
    >>> print(unused_velocities(History.from_dataframe(table, scene))[0].sentence)
    vx of puck was computed from x and is not used
    """
    dt, observed = float(history.dataset.attrs["time_step"]), history.dataset["observed"].to_numpy()
    unused, differ = list[UnusedVelocity](), units_that_differ(history)
    for body in np.flatnonzero(~history.dataset["kinematic"].to_numpy()):
        for d in range(3):
            runs = _runs(history, int(body), d)
            one = UnusedVelocity(history.bodies[body], STATE[d + VELOCITY], STATE[d], False, 0.0)
            pair = (observed[:, :, body, d], observed[:, :, body, d + VELOCITY])
            fault = contradiction(*pair, dt, angle=d == THETA)
            if fault and not np.nan_to_num(pair[1]).any():
                unused.append(replace(one, zero=True))
            elif fault and fault.kind.startswith(("wraps", "is clipped")):
                unused.append(replace(one, fault=fault))
            elif (late := computed_lag(runs, dt)) is not None:
                late = late if abs(late) > 0.05 * dt else 0.0
                unused.append(replace(one, computed=True, lag=late))
            elif lag := velocity_lag(runs, dt):
                unused.append(replace(one, lag=lag))
            elif fault and (int(body), d) not in differ:
                unused.append(replace(one, fault=fault))
    return tuple(unused)


def measured_alone(history: History, unused: Sequence[UnusedVelocity] | None = None) -> History:
    """Return the history without unused velocities: they stay as states to start from.

    Parameters
    ----------
    history : History
        What was recorded.
    unused : sequence of UnusedVelocity, optional
        Which columns not to count as measured; :func:`unused_velocities` by default.
    """
    unused = unused_velocities(history) if unused is None else unused
    if not unused:
        return history
    observed = history.dataset["observed"].copy(deep=True)
    for velocity in unused:
        observed.loc[{"body": velocity.body, "state": velocity.state}] = np.nan
    return History(history.dataset.assign(observed=observed))


def velocity_lag(runs: Runs, dt: float) -> float:
    """Return by how much (s) velocities are late; 0 where that is not significant, or < 0.05 dt.

    The position's change in an interval is its mean velocity; of a velocity that is late by ``tau``
    it differs by ``tau`` times the acceleration. Of differences of velocities that bracket the
    interval as instruments the estimate is consistent whatever the noise of both. A constant
    offset, a scale and the curvature within an interval are fitted alongside. Residuals of
    neighbouring intervals share a velocity, for which the standard error is multiplied by sqrt(2).

    Parameters
    ----------
    runs : list of (ndarray, ndarray)
        Positions and velocities of rows without gaps, shape (n,) each.
    dt : float
        Time step (s).

    Examples
    --------
    >>> t = np.arange(200) * 0.02
    >>> round(velocity_lag([(np.sin(5 * t), 5 * np.cos(5 * (t - 0.012)))], 0.02), 4)
    0.012
    >>> velocity_lag([(np.sin(5 * t), 5 * np.cos(5 * t))], 0.02)
    0.0
    """
    (lag, differs), shift = _shifted(runs, dt, 0), 0
    if not differs:
        return 0.0
    for _ in range(20):  # it is linear in the lag only near it
        if np.isfinite(lag) and abs(lag - shift) > 0.5:
            shift = int(np.clip(round(lag), shift - 1, shift + 1))
            lag = _shifted(runs, dt, shift)[0]
    return float(lag) * dt if np.isfinite(lag) else 0.0


def _shifted(runs: Runs, dt: float, shift: int, material: float = 0.05) -> tuple[float, bool]:
    """Return the lag (rows) linearised about ``shift`` rows, and whether it differs materially.

    The instrument's covariance with the residual at the least lag that matters is tested, which
    needs no accurate lag (Anderson and Rubin's test of size 1e-4, in 12 intervals or more).
    Lags of less than ``material`` rows do not matter.
    """
    parts: list[Floats] = []
    for position, rate in runs:
        k = np.arange(max(0, 1 - shift), len(position) - max(1, 2 + shift))
        if len(k):
            before, one, two, after = (rate[k + shift + i] for i in (-1, 0, 1, 2))
            mean, off = (one + two) / 2, (position[k + 1] - position[k]) / dt
            curve = before - one - two + after
            parts.append(np.stack([off - mean, mean, curve, two - one, after - before]))
    if sum(part.shape[1] for part in parts) < 12:
        return np.nan, False
    y, mean, curve, x, z = np.concatenate(parts, axis=1)
    basis = np.linalg.svd(np.stack([np.ones(len(y)), mean, curve], axis=1), full_matrices=False)[0]
    y, x, z = (column - basis @ (basis.T @ column) for column in (y, x, z))
    slope, square, dof = float(z @ x), float(z @ z), len(y) - 4
    if not slope > 0 or not square > 0:
        return np.nan, False
    lag = float(z @ y) / slope
    rest = y - np.copysign(material, lag) * x
    residual = rest - float(z @ rest) / square * z
    # the second in collisions
    spread = max(float(residual @ residual) / dof * square, float(((z * residual) ** 2).sum()))
    bound = float(t_distribution.isf(0.5e-4, dof)) * np.sqrt(2 * spread)
    # rounding alone leaves a millionth of a row, without any noise
    differs = abs(lag) > material and abs(float(z @ rest)) > max(bound, 1e-6 * slope)
    return lag + shift, bool(differs)


def measurement_noise(history: History) -> Floats:
    """Return the measurement noise of each state, from kinematics alone, shape (body, state).

    Zero where nothing is known. It is no more than third differences show, so that a position in
    another unit than its velocity does not look noisy; and what they show where no velocity was
    measured, which a local polynomial then knows that much less at a trajectory's end.
    """
    dt = float(history.dataset.attrs["time_step"])
    observed = history.dataset["observed"].to_numpy()
    result = np.zeros(observed.shape[2:])
    for body in range(len(result)):
        for d in range(VELOCITY):
            pair = [d, d + VELOCITY]
            if runs := _runs(history, body, d):
                most = [column_noise(column) for column in zip(*runs, strict=True)]
                result[body, pair] = np.minimum(np.sqrt(position_noise(runs, dt)), most)
            elif np.isnan(observed[:, :, body, d + VELOCITY]).all():
                column = observed[:, :, body, d]
                size, coarse = column_noise(column, angle=d == THETA), finest_step(column)
                if coarse < np.inf:  # rounding looks like no noise where hardly anything moves
                    size = max(size, coarse / np.sqrt(12.0))
                # the error at the end of a quadratic of five positions is 1.1 of theirs a time step
                result[body, pair] = size, 1.1 * size / dt
    # an angle that looks noisier than half a radian turns too far between rows to be followed
    result[result[:, THETA] > 0.5, THETA] = 0.0
    return result


def _runs(history: History, body: int, d: int, shortest: int = 5) -> Runs:
    """Return positions of a dimension and their rates, in rows between gaps of either."""
    observed = history.dataset["observed"].to_numpy()[:, :, body]
    dt = float(history.dataset.attrs["time_step"])
    runs: Runs = []
    for trajectory, n in zip(observed, history.dataset["n_rows"].to_numpy(), strict=True):
        both = trajectory[:n, [d, d + VELOCITY]]
        seen = np.flatnonzero(np.isfinite(both).all(axis=1))
        for rows in np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1):
            position, rate = both[rows].T
            if d == THETA:
                position = unwrapped(dt * rows.astype(float), position, rate)
            runs += [(position, rate)] if len(rows) >= shortest else []
    return runs


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
    off = [np.diff(np.diff(x) / dt - (v[1:] + v[:-1]) / 2, 2) for x, v in runs]
    n, m = max(sum(map(len, off)), 1), max(sum(max(len(one) - 1, 0) for one in off), 1)
    square = sum(float(one @ one) for one in off) / n
    product = sum(float(one[1:] @ one[:-1]) for one in off) / m
    place = max(0.0, -(square + 4 * product) / 40)
    return place * dt**2, max(0.0, square - 20 * place)


def computed_lag(runs: Runs, dt: float, *, widest: int = 20) -> float | None:
    """Return by how much (s) velocities computed from positions are late; None for measured ones.

    Velocities are regressed on the positions of rows before and after. A velocity with independent
    noise differs from any sum of noisy positions with weights ``w`` by a variance of at least
    ``|w|^2 s^2``, ``s`` being the positions' noise. A computed velocity does not. The ratio of the
    residual variance to that bound is compared with the lower tail (1e-5) of the F distribution,
    degrees of freedom corrected for serial correlation; however many rows there are, it is less
    than a quarter. The lag is the group delay of the weights at low
    frequency.

    Parameters
    ----------
    runs : list of (ndarray, ndarray)
        Positions and velocities of rows without gaps, shape (n,) each.
    dt : float
        Time step (s).
    widest : int
        Rows before and after, at most; in short logs fewer, for two windows a weight.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(size=40)
    >>> computed_lag([(x[1:], np.diff(x) / 0.1)], 0.1)
    0.05
    """
    lengths = np.array([len(position) for position, _ in runs])
    reaches = (n for n in range(widest, 0, -1) if np.maximum(lengths - 2 * n, 0).sum() >= 4 * n)
    reach = next(reaches, 0)
    if not reach or not any(rate.any() for _, rate in runs):
        return None
    place = np.arange(-reach, reach + 1)
    long = [np.stack(run) for run in runs if len(run[0]) >= len(place)]
    windows = [sliding_window_view(run, len(place), axis=1) for run in long]
    x, rates = np.concatenate(windows, axis=1)
    y = rates[:, reach]
    inverse = np.linalg.pinv(np.delete(x - x[:, [reach]], reach, axis=1), rcond=1e-9)
    # the weights of all rows add up to none
    inverse = np.insert(inverse, reach, -inverse.sum(axis=0), axis=0)
    b = inverse @ y
    slope, curve = float(b @ place), float(b @ place**2)
    if not slope > 0:  # positions that never change give no velocity
        return None
    dof = len(y) - 2 * reach
    variance = float(((y - x @ b) ** 2).sum()) / dof
    square = float(b @ b) - variance * float((inverse**2).sum())  # less the weights' errors
    shown = sum(np.maximum(lengths - 3, 0)) / _correlation([-1, 3, -3, 1])
    tail = f_distribution.ppf(1e-5, dof / _correlation(b), max(shown, 1.0))
    bound = min(0.25, float(tail)) * square * _noise(runs, dt)
    exact = len(y) > 8 * reach and abs(slope * dt - 1) < 1e-6
    total = float(np.concatenate([rate for _, rate in runs]).var())
    lag = round(-curve / (2 * slope), 6) * dt + 0.0
    return lag if variance < max(bound, 1e-12 * total * exact) and abs(lag) < 100 * dt else None


def _noise(runs: Runs, dt: float, floor: float = 1e-3) -> float:
    """Return the variance of positions' noise from kinematics, within bounds of positions alone.

    Kinematics do not tell it where a velocity is late, which leaves more than noise does, and tell
    too much where bodies collide: high differences of smooth positions leave noise, their median
    no collision. The noise is no less than a share ``floor`` of what eighth differences show, where
    ninth ones have at least twice their variance: those of white noise have 3.8 times.
    """
    positions = [position for position, _ in runs]
    eighth, ninth = (column_noise(positions, order) ** 2 for order in (8, 9))
    white = ninth * comb(18, 9) > 2.0 * eighth * comb(16, 8)
    most = column_noise(positions, 8, robust=True) ** 2
    return float(np.clip(position_noise(runs, dt)[0], floor * eighth * white, most))


def _correlation(weights: Floats | list[int]) -> float:
    """Return how many squares of filtered white noise count as one independent square."""
    product = np.correlate(weights, weights, "full")
    return float(product @ product / product.max() ** 2)


def contradiction(
    position: Floats, rate: Floats, dt: float, *, angle: bool = False, few: int = 10
) -> Contradiction | None:
    """Return how measured velocities contradict the changes of their position; None if they agree.

    A velocity lies between the difference quotients before and after its row, an impact's as well,
    but for noise and a constant, which is the law ``sensor_bias``. A column that moves as its
    position does, at nearly the same rate, is no contradiction either: sensors have such laws.

    Parameters
    ----------
    position, rate : ndarray
        Shape (trajectory, time), NaN where missing.
    dt : float
        Time step (s).
    angle : bool
        Whether the position may have been wrapped at a turn (rad).
    few : int
        Fewer rows are no contradiction, nor is a share of less than 3 %, or what differs by less
        than 30 % of the typical speed, unless it is impossible.

    Examples
    --------
    >>> t = np.arange(0.0, 9.0, 0.02)
    >>> said = contradiction(np.sin(t)[None], np.clip(np.cos(t), -0.8, 0.8)[None], 0.02)
    >>> said.kind, round(said.share, 2), said.row
    ('is clipped at 0.8', 0.32, 1)
    """
    if position.shape[1] < 3:
        return None
    mean = (rate[:, 1:] + rate[:, :-1]) / 2
    change = np.diff(position, axis=1)
    quotient = (mean + wrapped(change - mean * dt) / dt) if angle else change / dt
    middle, found, tolerance = _wrong(quotient, rate, position, dt)
    seen = np.isfinite(middle)
    share = float(found.sum()) / max(int(seen.sum()), 1)
    if share < 0.03 or found.sum() < few:
        return None
    inner = rate[:, 1:-1]
    kind, factor = _kind(middle, inner, found, tolerance), 0.0
    if not kind:
        bias = np.median((middle - inner)[seen])
        found = _wrong(quotient, rate + bias, position, dt)[1]
        off = np.sqrt(np.mean((middle - inner - bias)[found] ** 2)) if found.sum() >= few else 0.0
        if off < 0.3 * np.sqrt(np.mean(middle[seen] ** 2)):
            return None
        share = float(found.sum()) / float(seen.sum())
        factor = _factor(middle[seen], inner[seen])
        rest = _wrong(quotient, factor * rate, position, dt)[1].sum()
        if not factor or rest > 0.05 * found.sum():
            turned = _wrong(quotient, -rate, position, dt)[1].sum() < 0.05 * found.sum()
            factor, kind = 0.0, "has the other sign" if turned else "is another quantity"
        else:
            kind = f"is {1 / factor:.3g} times the rate of its position, as in another unit"
    trajectory, row = (int(one) for one in np.argwhere(found)[0])
    return Contradiction(kind, share, trajectory, row + 1, factor)


def _wrong(
    quotient: Floats, rate: Floats, position: Floats, dt: float
) -> tuple[Floats, Bools, float]:
    """Return mean quotients beside the inner rows, the rows that do not agree, and the tolerance.

    The noise is what differences show in whichever order shows least, as none is that of a motion,
    or the quarter of the rows that agree best, if that is less: of single rows that are wrong
    differences have their share.
    """
    before, after, inner = quotient[:, :-1], quotient[:, 1:], rate[:, 1:-1]
    middle = np.where(np.isfinite(inner), (before + after) / 2, np.nan)
    seen = np.isfinite(middle)
    outside = np.maximum(inner - np.maximum(before, after), np.minimum(before, after) - inner)
    # where a force turns round a speed leaves both, and its means with the next ones neither
    off = np.abs((rate[:, 1:] + rate[:, :-1]) - 2.0 * quotient)
    outside = np.fmin(outside, np.fmin(off[:, :-1], off[:, 1:]))
    if not seen.any():
        return middle, np.zeros(middle.shape, dtype=bool), 0.0
    places, rates = (
        min(column_noise(column, order, robust=True) for order in (3, 5, 8))
        for column in (dt * np.cumsum(quotient, axis=1), rate)
    )
    step = finest_step(position) / dt
    agree = float(np.quantile(np.abs(inner - middle)[seen], 0.25)) / 0.3186  # of a Gaussian
    noise = min(float(np.hypot(rates, places / dt)), agree)
    fast = float(np.quantile(np.abs(middle[seen]), 0.9))
    tolerance = 6.0 * noise + (step if np.isfinite(step) else 0.0) + 0.05 * fast
    return middle, np.asarray(np.where(seen, outside, 0.0) > tolerance), tolerance


def _factor(middle: Floats, inner: Floats) -> float:
    """Return the factor from velocities to quotients in rows that move; 0 if it is near one."""
    moves = np.abs(inner) > 0.3 * np.abs(inner).max(initial=0.0)
    factor = float(np.median(middle[moves] / inner[moves])) if moves.any() else 0.0
    return factor if factor > 0 and abs(np.log(factor)) > np.log(1.25) else 0.0


def _kind(middle: Floats, inner: Floats, found: Bools, tolerance: float) -> str:
    """Return how a column fails that its position leaves the range of, or that stands still."""
    true, shown = middle[found], inner[found]
    low, high = float(np.nanmin(inner)), float(np.nanmax(inner))
    beyond = (true > high) | (true < low)
    if beyond.mean() > 0.9:
        end = np.where(true > high, high, low)
        if np.mean(np.abs(shown - end) <= 1e-3 * (high - low)) > 0.9:
            return f"is clipped at {max(abs(end.min()), abs(end.max())):.3g}"
        size = np.abs(true - shown)
        size = np.median(size[size < 1.5 * np.quantile(size, 0.1)])
        off = np.abs(true - shown - size * np.round((true - shown) / size))
        if high - low < 1.1 * size and np.quantile(off, 0.8) < min(tolerance, 0.2 * size):
            return f"wraps every {size:.3g}, as a counter that overflows"
    return "is 0" if np.mean(shown == 0.0) > 0.9 else ""
