"""Bends of a motion near its ends: from rest, or an abrupt change of velocity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

#: Rows at rest, at least, and rows of motion beside them that are looked at, at least and at most.
LEAST, BESIDE, _MOST = 3, 6, 200
#: Rows of motion that are looked at, over those at rest: each is tried.
_LENGTHS = (1, 2, 4)
#: Measurement noises within which a body is at rest.
_STILL = 4.0
#: A bend is one if it takes this much off the sum of squares of a cubic, in variances of the noise,
#: and this share of it.
_CERTAIN, _SHARE = 100.0, 0.9
#: A cubic must fit the end this many times worse than it fits the median window of all rows.
_OUTSIDE = 2.5
#: A change of velocity in standard errors, and over the 90th percentile of all rows' changes.
_ABRUPT, _LARGE = 8.0, 4.0
#: Places of a bend that are tried, at most.
_PLACES = 60
#: A moment of release may fit worse than the best by so much (in variances): its upper limit.
_LIMIT = 4.0


@dataclass(frozen=True, eq=False)
class Column:
    """Positions of a dimension in all trajectories: their noise, and their changes of velocity."""

    series: list[Floats]
    noise: float
    change: float

    @classmethod
    def of(cls, series: list[Floats]) -> Column | None:
        """From fourth and second differences; None where nothing moves or rows are too few."""
        longer = [np.diff(own, 4) for own in series if len(own) > 4]
        if not longer or not any(np.ptp(own) > 0 for own in series):
            return None
        every = np.concatenate(series)
        steps = np.diff(np.unique(every))
        rounding = 1e-9 * float(np.abs(every).max())
        finest = float(steps[steps > rounding].min()) if (steps > rounding).any() else 0.0
        noise = 1.4826 * float(np.median(np.abs(np.concatenate(longer)))) / np.sqrt(70.0)
        second = np.concatenate([np.diff(own, 2) for own in series])
        noise = max(noise, finest / np.sqrt(12), rounding)
        # of independent errors the second differences have six times the variance
        change = float(np.quantile(np.abs(second), 0.9)) ** 2 - 6 * (1.8 * noise) ** 2
        return cls(series, noise, float(np.sqrt(max(change, 0.0))))

    def held(self, own: Floats, push: Floats) -> int:
        """Rows at the beginning at rest, then moving off with no command."""
        still = self._still(own)
        if not LEAST <= still < len(own) - BESIDE:
            return 0
        skip = max(0, still - _MOST)  # of a long rest its last rows are enough
        still -= skip
        for window in _windows(own[skip:], still):
            if push[: skip + len(window)].any():
                break
            places = np.linspace(2, still, min(2 * still - 3, _PLACES))
            bend = self._bend(window, places, 3, rest=True, abrupt=False)
            if bend is not None and bend.place >= LEAST - 1:
                return skip + int(np.ceil(bend.latest))
        return 0

    def stopped(self, own: Floats, push: Floats) -> int:
        """Rows at the end after an abrupt change of velocity while no command changes."""
        back = own[::-1]
        still = self._still(back)
        n = len(own)
        tries = [(min(max(LEAST, n // 4), _MOST), 0, False)]
        if LEAST <= still < n - BESIDE:
            skip = max(0, still - _MOST)
            tries.append((still - skip, skip, True))
        best, rows = None, 0
        for longest, skip, rest, window in (
            (*each, w) for each in tries for w in _windows(back[each[1] :], each[0])
        ):
            if np.ptp(push[n - skip - len(window) : -1], axis=0).any():
                continue
            places = np.linspace(1.5, longest, min(2 * longest - 2, _PLACES))
            bend = self._bend(window, places, 2, rest=rest, abrupt=True)
            if bend is None or bend.certainty < _ABRUPT or abs(bend.jump) < _LARGE * self.change:
                continue
            if best is None or bend.certainty > best.certainty:
                # rows after the moment of the stop: in reversed time those before it
                best, rows = bend, skip + int(np.floor(bend.latest)) + 1
        return rows

    def _still(self, own: Floats) -> int:
        """Rows at the beginning that stay within the noise of where they begin."""
        mean = np.cumsum(own) / np.arange(1, len(own) + 1)
        off = np.abs(own - mean) > _STILL * self.noise
        return int(np.argmax(off)) if off.any() else len(own)

    def _bend(
        self, window: Floats, places: Floats, degree: int, *, rest: bool, abrupt: bool
    ) -> Bend | None:
        """Return the best place of a bend, if nothing smoother does as well and fits elsewhere.

        Smoother is a cubic; than an abrupt change of velocity also one of the acceleration, as
        where dry friction ends a motion.
        """
        n = len(window)
        time = np.arange(n, dtype=float)
        cubic = np.vander(time / n, 4)
        smooth = np.eye(n) - cubic @ np.linalg.pinv(cubic)
        without = float(((smooth @ window) ** 2).sum())
        for place in np.linspace(1, n - 2, min(2 * n, _PLACES)) if abrupt else ():
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
        if without - best.left < _CERTAIN * variance or best.left > (1 - _SHARE) * without:
            return None
        elsewhere = [
            ((np.lib.stride_tricks.sliding_window_view(own, n) @ smooth) ** 2).sum(axis=1)
            for own in self.series
            if len(own) >= n
        ]
        if without < _OUTSIDE**2 * float(np.median(np.concatenate(elsewhere))):
            return None
        near = [bend.place for bend in bends if bend.left < best.left + _LIMIT * variance]
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


def _windows(own: Floats, still: int) -> list[Floats]:
    """Beginnings of a series: the rows at rest, and more and more beside them."""
    beside = (int(np.clip(times * still, BESIDE, _MOST)) for times in _LENGTHS)
    return [own[: still + each] for each in beside if still + each <= len(own)]
