"""Velocity columns that were computed from positions, lag them, or have another unit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as t_distribution

from pbrl_ppl.history.bad_frames import finest_step
from pbrl_ppl.history.filters import Runs, computed_by, position_noise
from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import unwrapped
from pbrl_ppl.state import STATE, THETA, Floats, wrapped

#: An angle that looks noisier than this (rad) turns too far between rows to be followed.
_WRAPPED = 0.5
#: Rows without gaps of which a velocity is judged, at least.
_SHORTEST = 5
#: Error of a velocity at the end of a quadratic of five positions, in their errors a time step.
_AT_AN_END = 1.1
#: A lag matters from this share of the time step on, and is reported if significant at this p.
_MATERIAL, _ALARM = 0.05, 1e-4
#: Steps to a lag of several rows, at most.
_STEPS = 20
#: A lag of this share of a time step more than what matters is seen without any noise, too.
_TINY = 1e-6
#: Intervals that a lag is estimated from, at least.
_ENOUGH = 12


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
    computed_by : str or None
        The filter that gives it from the position; None if it lags the position only.
    lag : float
        By how much it is late (s); negative if early.

    Examples
    --------
    >>> UnusedVelocity("ball", "vy", "y", "central differences", 0.0).sentence
    'vy of ball was computed from y (central differences) and is not used'
    >>> UnusedVelocity("arm", "omega", "theta", None, 0.012).sentence
    'omega of arm lags theta by 12 ms and is not used'
    """

    body: str
    state: str
    position: str
    computed_by: str | None
    lag: float

    @property
    def sentence(self) -> str:
        """Sentence: the column, how it was computed or by how much it lags."""
        name, late = f"{self.state} of {self.body}", f"{abs(self.lag):.3g} s"
        if 1e-3 <= abs(self.lag) < 1.0:
            late = f"{1e3 * abs(self.lag):.3g} ms"
        if self.computed_by is None:
            verb = "lags" if self.lag > 0 else "leads"
            return f"{name} {verb} {self.position} by {late} and is not used"
        lag = f", {late} {'late' if self.lag > 0 else 'early'}" if self.lag else ""
        return f"{name} was computed from {self.position} ({self.computed_by}{lag}) and is not used"


def unused_velocities(history: History) -> tuple[UnusedVelocity, ...]:
    """Return the velocity columns that were computed from positions of the log, or lag them.

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
    vx of puck was computed from x (central differences) and is not used
    """
    dt = float(history.dataset.attrs["time_step"])
    found: list[UnusedVelocity] = []
    for body in np.flatnonzero(~history.dataset["kinematic"].to_numpy()):
        for d in range(3):
            runs = _runs(history, int(body), d)
            names = (history.bodies[body], STATE[d + 3], STATE[d])
            if match := computed_by(runs, dt):
                late = match.lag if abs(match.lag) > _MATERIAL * dt else 0.0
                found.append(UnusedVelocity(*names, match.name, late))
            elif lag := velocity_lag(runs, dt):
                found.append(UnusedVelocity(*names, None, lag))
    return tuple(found)


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
    columns = np.zeros((len(history.bodies), len(STATE)), dtype=bool)
    for each in unused:
        columns[history.bodies.index(each.body), STATE.index(each.state)] = True
    observed = history.dataset["observed"]
    return History(history.dataset.assign(observed=observed.where(~columns)))


def velocity_lag(runs: Runs, dt: float) -> float:
    """Return by how much (s) velocities are late; 0 where that is negligible or not significant.

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
    lag, found = _shifted(runs, dt, 0)
    if not found:
        return 0.0
    shift = 0
    for _ in range(_STEPS):  # it is linear in the lag only near it
        if not np.isfinite(lag) or abs(lag - shift) <= 0.5:
            break
        shift = int(np.clip(round(lag), shift - 1, shift + 1))
        lag = _shifted(runs, dt, shift)[0]
    return float(lag) * dt if np.isfinite(lag) else 0.0


def _shifted(runs: Runs, dt: float, shift: int) -> tuple[float, bool]:
    """Return the lag (rows) linearised about ``shift`` rows, and whether it differs materially.

    The instrument's covariance with the residual at the least lag that matters is tested, which
    needs no accurate lag (Anderson and Rubin's test).
    """
    columns: list[list[Floats]] = [[], [], [], [], []]
    for position, rate in runs:
        k = np.arange(max(0, 1 - shift), len(position) - max(1, 2 + shift))
        if len(k):
            before, one, two, after = (rate[k + shift + i] for i in (-1, 0, 1, 2))
            mean, off = (one + two) / 2, (position[k + 1] - position[k]) / dt
            own = (off - mean, mean, before - one - two + after, two - one, after - before)
            for column, values in zip(columns, own, strict=True):
                column.append(values)
    if sum(map(len, columns[0])) < _ENOUGH:
        return np.nan, False
    y, mean, curve, x, z = (np.concatenate(each) for each in columns)
    basis = np.linalg.svd(np.stack([np.ones(len(y)), mean, curve], axis=1), full_matrices=False)[0]
    y, x, z = (each - basis @ (basis.T @ each) for each in (y, x, z))
    slope, square, dof = float(z @ x), float(z @ z), len(y) - 4
    if not slope > 0 or not square > 0:
        return np.nan, False
    lag = float(z @ y) / slope
    rest = y - np.copysign(_MATERIAL, lag) * x
    residual = rest - float(z @ rest) / square * z
    spread = max(  # the second in collisions
        float(residual @ residual) / dof * square, float((z * residual) @ (z * residual))
    )
    error = np.sqrt(2 * spread)
    bound = float(t_distribution.isf(_ALARM / 2, dof)) * error
    found = abs(lag) > _MATERIAL and abs(float(z @ rest)) > max(bound, _TINY * slope)
    return lag + shift, bool(found)


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
        for d in range(3):
            if runs := _runs(history, body, d):
                third = [np.concatenate([np.diff(s[i], 3) for s in runs]) for i in (0, 1)]
                least = [float(np.mean(own**2)) / 20 if len(own) else 0.0 for own in third]
                result[body, [d, d + 3]] = np.sqrt(np.minimum(position_noise(runs, dt), least))
            elif np.isnan(observed[:, :, body, d + 3]).all():
                change = np.diff(observed[:, :, body, d])
                noisy = np.diff(wrapped(change) if d == THETA else change, 2)
                some = noisy[np.isfinite(noisy)]
                size = float(np.sqrt(np.mean(some**2) / 20)) if some.size else 0.0
                coarse = finest_step(observed[:, :, body, d])
                if coarse < np.inf:  # rounding looks like no noise where hardly anything moves
                    size = max(size, coarse / np.sqrt(12.0))
                result[body, [d, d + 3]] = size, _AT_AN_END * size / dt
    result[result[:, THETA] > _WRAPPED, THETA] = 0.0
    return result


def _runs(history: History, body: int, d: int) -> Runs:
    """Return positions of a dimension and their rates, in rows between gaps of either."""
    observed = history.dataset["observed"].to_numpy()[:, :, body]
    dt = float(history.dataset.attrs["time_step"])
    runs: Runs = []
    for own, n in zip(observed, history.dataset["n_rows"].to_numpy(), strict=True):
        both = own[:n, [d, d + 3]]
        seen = np.flatnonzero(np.isfinite(both).all(axis=1))
        for rows in np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1):
            if len(rows) < _SHORTEST:
                continue
            position, rate = np.asarray(both[rows].T, dtype=np.float64)
            if d == THETA:
                position = unwrapped(dt * np.arange(float(len(rows))), position, rate)
            runs.append((position, rate))
    return runs


#: Factors by which a position in other units changes faster than its velocity says, and the units;
#: where the velocity is too large by as much, it may be in these units per second.
_LENGTHS = {1000.0: "mm", 100.0: "cm", 9.81: ""}
_SPEEDS = {1000.0: "mm/s", 100.0: "cm/s", 9.81: ""}
_ANGLES = {180 / np.pi: "deg", 1000.0: "mrad"}
_RATES = {180 / np.pi: "deg/s", 1000.0: "mrad/s", 30 / np.pi: "rpm"}
#: How far a measured factor may be from one of these, as a share of it.
_NEAR = 0.1
#: How far half of the single factors may be from their median, as a share of it.
_SPREAD = 0.2
#: Over how many intervals changes are taken: the longer, the less measurement noise counts.
_SPANS = (1, 4, 16)
#: Changes that a factor is computed from, at least.
_CHANGES = 8


def unit_mismatches(history: History) -> tuple[str, ...]:
    """Return a sentence for each velocity that differs from its position's changes by a unit.

    Changes of a position are divided by the integral of the measured velocity. A position is left
    out where that factor varies (noise), where it is near one, or where no unit is near it.

    Parameters
    ----------
    history : History
        Positions and velocities of which both were measured are compared; an angle's turns between
        two rows count as none.

    Returns
    -------
    tuple of str
        Empty where all agree.
    """
    observed = history.dataset["observed"].to_numpy()
    found = []
    for i, body in enumerate(history.bodies):
        for d in range(3):
            position, rate = observed[:, :, i, d], observed[:, :, i, d + 3]
            dt = float(history.dataset.attrs["time_step"])
            factor = _unit_factor(position, rate, dt, angle=d == THETA)
            if factor is not None and (words := _unit_sentence(body, d, factor)):
                found.append(words)
    return tuple(found)


def _unit_factor(position: Floats, rate: Floats, dt: float, *, angle: bool) -> float | None:
    """Return a position's change over the integral of its rate; None where that varies."""
    best, least = None, _SPREAD
    for span in _SPANS:
        n = (position.shape[1] - 1) // span
        change = np.diff(position[:, : n * span + 1 : span], axis=1).ravel()
        mean = ((rate[:, 1:] + rate[:, :-1]) / 2)[:, : n * span].reshape(len(rate), n, span)
        integral = dt * span * mean.mean(axis=2).ravel()
        seen = np.isfinite(change) & np.isfinite(integral)
        change, integral = change[seen], integral[seen]
        if len(integral) < _CHANGES:
            continue
        size = np.abs(integral)
        fast = (size > 0) & (size >= np.quantile(size, 0.9) / 2)  # where noise counts least
        change, integral = change[fast], integral[fast]
        if len(integral) < _CHANGES:
            continue
        # angles may have been wrapped between two rows
        off = np.median(np.abs(wrapped(change - integral)))
        if angle and off < 0.5 * min(1.0, float(np.median(np.abs(integral)))):
            return 1.0
        factor = float(np.median(change / integral))
        spread = float(np.median(np.abs(change / integral - factor))) / (abs(factor) or np.inf)
        if factor > 0 and spread < least:
            best, least = factor, spread
    return best


def _unit_sentence(body: str, d: int, factor: float) -> str:
    """Return a sentence about a factor between a position and its rate that is near a unit's."""
    place, rate = STATE[d], STATE[d + 3]
    units, rates = (_ANGLES, _RATES) if d == THETA else (_LENGTHS, _SPEEDS)
    faster = f"{place} of {body} changes {factor:.3g} times as fast as {rate} says"
    larger = f"{rate} of {body} is {1 / factor:.3g} times the rate at which {place} changes"
    for words, column, size, known in (
        (faster, place, factor, units),
        (larger, rate, 1 / factor, rates),
    ):
        for one, unit in known.items():
            if abs(size / one - 1) < _NEAR:
                cure = f" {column} may be in {unit}; read it with --units {column}={unit}"
                return f"{words}: units?{cure if unit else ''}"
    return ""
