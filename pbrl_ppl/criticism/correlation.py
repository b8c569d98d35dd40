"""Correlation tests of innovations: whiteness over lags, and correlation with commands.

The residual tests of L. Ljung, System Identification (1999), chapter 16. An innovation's variance
is one, so that of a correlation over n pairs is 1 / n if nothing is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import Correlations, KindOfTest, ResidualTest
from pbrl_ppl.criticism.unexplained import innovations_over_steps
from pbrl_ppl.modes import FilteredMode
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints

#: Intervals up to which innovations are correlated with earlier ones and with commands; a
#: correlation counts if it is taken over more pairs than this.
_LAGS, _LEAST_PAIRS = 5, 10


class _Place(NamedTuple):
    """Place of a correlation, and its value."""

    lag: int
    series: int
    cell: int
    value: float


@dataclass(frozen=True, eq=False)
class _Correlation:
    """Correlations and numbers of pairs, shape (lag, series, coordinate)."""

    values: Floats
    pairs: Floats
    criteria: Criteria

    @property
    def enough(self) -> Bools:
        """Return which were taken over enough pairs."""
        return np.asarray(self.pairs > _LEAST_PAIRS)

    @property
    def p_value(self) -> float:
        """Return the p-value of the sum of squares, chi-squared if nothing is missing."""
        statistic = float((self.pairs * self.values**2)[self.enough].sum())
        return float(chi2.sf(statistic, max(int(self.enough.sum()), 1)))

    def passes(self, p_value: float, share: Floats) -> bool:
        """Return whether no correlation is significant and large beside the noise and the motion.

        ``share`` is the size of innovations over the change in a step, shape (coordinate,).
        """
        criteria = self.criteria
        large = self.values**2 > criteria.residual.correlation_share
        large &= np.abs(self.values) * share > criteria.negligible
        return p_value > criteria.false_alarm or not (large & self.enough).any()

    def worst(self, weights: Floats) -> _Place:
        """Return the largest one, weighted by coordinate."""
        size = np.where(self.enough, np.abs(self.values), 0.0) * weights
        lag, series, cell = map(int, np.unravel_index(int(np.argmax(size)), size.shape))
        return _Place(lag, series, cell, float(self.values[lag, series, cell]))


def correlation_tests(
    mode: FilteredMode, criteria: Criteria = DEFAULT
) -> tuple[tuple[ResidualTest, ...], Correlations]:
    """Test whiteness over lags, and correlation with present and past commands.

    Parameters
    ----------
    mode : FilteredMode
        Fitted to whole trajectories.
    criteria : Criteria
        Thresholds of significant and of negligible.

    Returns
    -------
    tests : tuple of ResidualTest
        Of whiteness and of commands; untested where the data cannot fail.
    correlations : Correlations
        For a picture.
    """
    noise = mode.problem.likelihood.noise
    white, seen = mode.whitened_residual, noise.seen
    number = np.cumsum(noise.first.astype(np.intp))
    share = innovations_over_steps(mode)
    scene, places = mode.problem.scene, noise.coordinates.places
    cells = [f"{STATE[p % len(STATE)]} of {scene.moving[p // len(STATE)].name}" for p in places]
    by_lag = _lagged(white, seen, number, None, criteria)
    few = "too few pairs of intervals"
    whiteness = ResidualTest.untested(KindOfTest.WHITENESS, few)
    if by_lag.enough.any():
        whiteness = _test(by_lag, by_lag.p_value, share, cells, [])
    series, names = _commands(mode)
    values = np.zeros((0, 0, len(cells)))
    commands = ResidualTest.untested(KindOfTest.COMMANDS, few if names else "no command varies")
    if names:
        driven = _lagged(white, seen, number, series, criteria)
        values = driven.values
        p_value = _regression_p_value(white, seen, number, series)
        if p_value is not None:
            commands = _test(driven, p_value, share, cells, names)
    return (whiteness, commands), Correlations(
        tuple(cells), by_lag.values[:, 0], by_lag.pairs[:, 0], tuple(names), values
    )


def _lagged(
    white: Floats, seen: Bools, number: Ints, series: Floats | None, criteria: Criteria
) -> _Correlation:
    """Return correlations with series some intervals before, or of each coordinate with itself."""
    values, pairs = [], []
    for lag in range(1 if series is None else 0, _LAGS + 1):
        end = max(len(number) - lag, 0)
        same = number[lag:] == number[:end]
        later, counts = white[lag:][same][:, None], seen[lag:][same][:, None]
        if series is None:
            earlier = white[:end][same][:, None]
            counts = counts & seen[:end][same][:, None]
        else:
            earlier = series[:end][same][:, :, None]
        products = later * earlier * counts
        n = np.broadcast_to(counts, products.shape).sum(axis=0)
        values.append(products.sum(axis=0) / np.maximum(n, 1))
        pairs.append(n)
    return _Correlation(np.array(values), np.array(pairs), criteria)


def _commands(mode: FilteredMode) -> tuple[Floats, list[str]]:
    """Return the commands that vary, standardised, shape (transition, series), and their names."""
    segments, scene = mode.problem.segments, mode.problem.scene
    columns, names = [], []
    for i, body in enumerate(scene.moving):
        for j, name in enumerate(WRENCH):
            values = segments.actions[:, 0, i, j]
            spread = values.std()
            if not body.kinematic and spread > 1e-9 * max(float(np.abs(values).max()), 1e-300):
                columns.append((values - values.mean()) / spread)
                names.append(f"{name} on {body.name}")
    return np.array(columns).reshape(len(columns), segments.n).T, names


def _regression_p_value(white: Floats, seen: Bools, number: Ints, commands: Floats) -> float | None:
    """Return the p-value of the regression on commands of several lags; None if data are too few.

    Commands that are held are correlated over lags, so their correlations with innovations are not
    independent of each other, but the sum of squares that regression on all explains is
    chi-squared.
    """
    lagged = []
    for lag in range(_LAGS + 1):
        before = np.roll(commands, lag, axis=0)
        before[:lag] = 0.0
        lagged.append(np.where((number == np.roll(number, lag))[:, None], before, 0.0))
    x = np.hstack(lagged)
    statistic, count = 0.0, 0
    for cell in range(white.shape[1]):
        rows = seen[:, cell]
        if rows.sum() <= _LEAST_PAIRS * x.shape[1] // 2:
            continue
        u, size, _ = np.linalg.svd(x[rows], full_matrices=False)
        u = u[:, size > 1e-6 * size.max(initial=0.0)]
        statistic += float(((u.T @ white[rows, cell]) ** 2).sum())
        count += u.shape[1]
    return float(chi2.sf(statistic, count)) if count else None


def _test(
    correlation: _Correlation, p_value: float, share: Floats, cells: list[str], names: list[str]
) -> ResidualTest:
    """Return the test of correlations with commands, or of whiteness if there are no names."""
    passed = correlation.passes(p_value, share)
    worst = correlation.worst(np.ones(len(cells)) if passed else share)
    lag = worst.lag if names else worst.lag + 1
    intervals = f"{lag} interval{'s' * (lag > 1)}"
    if not names:
        sentence, other = "errors of successive intervals are not correlated", "itself"
        when = f"{intervals} later"
    else:
        sentence = "errors are not correlated with present and past commands"
        other = names[worst.series].replace("_", " ")
        when = f"{intervals} before" if lag else "of the same interval"
    if not passed:
        error = f"the error of {cells[worst.cell]}"
        sentence = f"{error} is correlated with {other} {when} ({worst.value:.2f})"
    name = KindOfTest.COMMANDS if names else KindOfTest.WHITENESS
    dimension, _, body = ("" if passed else cells[worst.cell]).partition(" of ")
    return ResidualTest(name, p_value, abs(worst.value), passed, sentence, body, dimension)
