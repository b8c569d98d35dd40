"""Grid scan of effects with a place, a threshold or a time, and detection limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from pbrl_ppl.criticism.criteria import ResidualCriteria
from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.modes import Mode
from pbrl_ppl.state import Floats

#: Measurements times grid points that are simulated in one call, at most.
_VALUES = 4_000_000


@dataclass(frozen=True, eq=False)
class GridPoint:
    """An effect at one grid point of its scan.

    Parameters
    ----------
    values : ndarray
        The effect's parameters, shape (q,), those that are not scanned at their null value.
    signature : ndarray
        Change of the whitened prediction, shape (n, columns): the derivative by each parameter that
        is not scanned, or the whole change where all are.
    columns : tuple of int
        The parameter of each column; empty for a whole change.
    """

    values: Floats
    signature: Floats
    columns: tuple[int, ...]

    @property
    def place(self) -> GridPoint:
        """Return the grid point without its signature."""
        return replace(self, signature=self.signature[:0].copy())

    @property
    def proposed(self) -> Floats:
        """Return the grid point as a scan proposes it, shape (q,), NaN for what is not scanned."""
        point = self.values.astype(float)
        point[list(self.columns)] = np.nan
        return point


def each_grid_point(
    mode: Mode, candidate: Attached, proposed: Floats | None = None, *, at_once: int = 8
) -> Iterator[GridPoint]:
    """Simulate a candidate at grid points, a few at a time, for each holds a value a measurement.

    Parameters
    ----------
    mode : Mode
        Mode of the model that lacks the effect.
    candidate : Attached
        An effect with a ``scan``.
    proposed : ndarray, optional
        The grid points, shape (point, q); by default all that its scan proposes, simulated with as
        few engine steps as tell them apart.
    at_once : int
        Grid points that are simulated in one call, at most; fewer of long recordings.

    Yields
    ------
    GridPoint
        The grid points that change a prediction.
    """
    effect, problem = candidate.effect, mode.problem
    if effect.scan is None:
        return
    body = problem.scene.body(candidate.body)
    enlarged = problem.with_physics(effects=(*problem.physics.effects, candidate)).medium
    of_scan = proposed is None
    if proposed is None:
        proposed, enlarged = effect.scan(problem.scene, problem.data.history, body), enlarged.coarse
    declared = enlarged.layout.places(problem.layout.labels)
    places = enlarged.layout.places(candidate.labels)
    null = np.array(effect.null)

    def whitened(points: Floats) -> Floats:
        phi = np.zeros((len(points), enlarged.layout.size))
        phi[:, declared] = mode.phi
        phi[:, places] = points
        return -enlarged.whitened(phi, mode.sigma).reshape(len(points), -1)

    free = np.isnan(proposed)
    steps = 1e-3 * np.array([parameter.prior.scale for parameter in effect.parameters])
    lower, upper = np.array([p.prior.support for p in effect.parameters]).T
    # one-sided where the null is the least that there can be
    ahead, behind = np.minimum(null + steps, upper) - null, np.maximum(null - steps, lower) - null
    if of_scan:  # one side will do to choose from
        behind = np.where(ahead > 0.0, 0.0, behind)
    nothing = whitened(null[None])
    at_once = max(1, min(at_once, _VALUES // max(mode.whitened_residual.size, 1)))
    for begin in range(0, len(proposed), at_once):
        part = slice(begin, begin + at_once)
        points, plan = _points(proposed[part], free[part], null, (ahead, behind))
        states = np.vstack([nothing, whitened(points)])
        for values, columns, rows in plan:
            if columns:
                ends = states[rows].reshape(len(columns), 2, -1)
                width = (ahead - behind)[list(columns)]
                signature = ((ends[:, 0] - ends[:, 1]) / width[:, None]).T
            else:
                signature = (states[rows] - states[0]).T
            signature = np.nan_to_num(signature, posinf=0.0, neginf=0.0)  # where it diverged
            if np.any(signature):
                yield GridPoint(values, signature, columns)


def _points(
    proposed: Floats, free: Floats, null: Floats, steps: tuple[Floats, Floats]
) -> tuple[Floats, list[tuple[Floats, tuple[int, ...], list[int]]]]:
    """Return points to simulate, and each grid point's values, free columns and rows of states.

    Row 0 is that at the null value, where no column has an effect.
    """
    points: list[Floats] = []
    plan = []
    for row, unknown in zip(proposed, free, strict=True):
        values = np.where(unknown, null, row)
        columns = tuple(int(i) for i in np.flatnonzero(unknown))
        rows = []
        for column in columns:
            for step in steps:
                moved = values.copy()
                moved[column] += step[column]
                if step[column] != 0.0:
                    points.append(moved)
                rows.append(len(points) if step[column] != 0.0 else 0)
        if not columns:
            points.append(values)
            rows = [len(points)]
        plan.append((values, columns, rows))
    return np.array(points), plan


def detection_limits(
    effect: Effect,
    points: Sequence[GridPoint],
    units: Sequence[Floats],
    candidates: int,
    criteria: ResidualCriteria,
) -> dict[str, float]:
    """Return the smallest detectable sizes of an effect, the other parameters at null values.

    Of a scanned one each is at its best grid point. For a whole change by a single parameter, as by
    a threshold, it is the detectable value nearest to the null value; a whole change by several,
    such as an obstacle's place, has no size.

    Parameters
    ----------
    effect : Effect
        The effect.
    points : sequence of GridPoint
        Its grid points.
    units : sequence of ndarray
        Change of the prediction by one unit of each column of a grid point, or all of a whole
        change, in units of noise.
    candidates : int
        Number of tests that the p-value is corrected for, beside the grid points.
    criteria : ResidualCriteria
        P-value and power of the limit.
    """
    tried = candidates * len(points)
    names = [parameter.name for parameter in effect.parameters]
    limits: dict[str, float] = {}
    whole = [
        (point.values, unit) for point, unit in zip(points, units, strict=True) if not point.columns
    ]
    if whole and len(names) == 1:
        null = effect.null[0]
        seen = [values[0] for values, unit in whole if unit[0] >= _needed(tried, criteria)]
        limits[names[0]] = float(min(seen, key=lambda value: abs(value - null), default=np.inf))
    for point, unit in zip(points, units, strict=True):
        with np.errstate(divide="ignore"):
            sizes = _needed(tried, criteria) / unit
        for column, size in zip(point.columns, sizes, strict=False):
            limits[names[column]] = min(limits.get(names[column], np.inf), float(size))
    return limits


def is_upper_limit(effect: Effect, points: Sequence[GridPoint]) -> bool:
    """Return whether smaller is stronger, as for a limit: grid points below the null value."""
    return bool(points) and all(
        not point.columns and point.values[0] < effect.null[0] for point in points
    )


def _needed(tried: int, criteria: ResidualCriteria) -> float:
    """Return the detectable change in units of noise, for a two-sided test."""
    return float(norm.isf(criteria.detection_p / 2 / tried) + norm.ppf(criteria.detection_power))
