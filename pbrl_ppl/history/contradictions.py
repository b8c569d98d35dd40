"""Velocity columns that contradict their positions: wrapped, clipped, late, smoothed, scaled."""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pbrl_ppl.history.kinematics import column_noise, finest_step
from pbrl_ppl.state import Bools, Floats, wrapped

#: Rows of the moving means that a smoothed velocity is compared with; 1 is no smoothing.
_WINDOWS = (1, 3, 5, 9, 17, 33)


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

    @property
    def impossible(self) -> bool:
        """Return whether the position is faster there than the column can say."""
        return self.kind.startswith(("wraps", "is clipped"))


def contradiction(
    position: Floats, rate: Floats, dt: float, *, angle: bool = False,
    least: float = 0.03, few: int = 10, material: float = 0.3,
) -> Contradiction | None:  # fmt: skip
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
    least, few : float, int
        Fewer rows, as a share and in number, are no contradiction.
    material : float
        What differs by a smaller share of the typical speed is none, unless it is impossible.

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
    if share < least or found.sum() < few:
        return None
    inner = rate[:, 1:-1]
    kind, factor = _kind(middle, inner, found, tolerance), 0.0
    if not kind:
        inner = inner + np.median((middle - inner)[seen])
        found = _wrong(quotient, rate + np.median((middle - rate[:, 1:-1])[seen]), position, dt)[1]
        off = np.sqrt(np.mean((middle - inner)[found] ** 2)) if found.sum() >= few else 0.0
        if off < material * np.sqrt(np.mean(middle[seen] ** 2)):
            return None
        share = float(found.sum()) / float(seen.sum())
        factor = _factor(middle[seen], rate[:, 1:-1][seen])
        rest = _wrong(quotient, factor * rate, position, dt)[1].sum()
        if not factor or rest > 0.05 * found.sum():
            turned = _wrong(quotient, -rate, position, dt)[1].sum() < 0.05 * found.sum()
            late = "has the other sign" if turned else _late(quotient, rate, found)
            factor, kind = 0.0, late or "is another quantity"
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


def _late(quotient: Floats, rate: Floats, found: Bools, *, most: int = 8, left: float = 0.5) -> str:
    """Return the delay and the smoothing that give the column from its position, in words.

    ``most``: rows of delay; ``left``: share of the difference, root mean square, that may remain.
    """
    mean, best = (rate[:, 1:] + rate[:, :-1]) / 2, (np.inf, 0, 1)
    # the intervals on both sides of each row that does not agree
    wrong = np.pad(found, ((0, 0), (1, 0))) | np.pad(found, ((0, 0), (0, 1)))
    for window in (one for one in _WINDOWS if one < quotient.shape[1] / 2):
        smooth = np.full(quotient.shape, np.nan)
        half = window // 2
        smooth[:, half : quotient.shape[1] - half] = sliding_window_view(
            quotient, window, axis=1
        ).mean(axis=2)
        for late in range(-most, window // 2 + most + 1):
            moved = np.roll(smooth, late, axis=1)
            off = (moved - mean)[wrong & np.isfinite(moved) & np.isfinite(quotient)]
            if len(off) > 0.5 * wrong.sum():
                best = min(best, (float(np.sqrt(np.mean(off**2))), late, window))
    whole = (quotient - mean)[wrong & np.isfinite(quotient - mean)]
    size, late, window = best
    if not size < left * np.sqrt(np.mean(whole**2)):
        return ""
    words = [f"is smoothed over some {window} rows"] if window > 1 else []
    words += [f"is {abs(late)} row{'s' * (abs(late) > 1)} {'late' if late > 0 else 'early'}"] * (
        late != 0
    )
    return " and ".join(words)
