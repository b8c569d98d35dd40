"""Correlation of innovations with those before them, and with commands.

The residual tests of L. Ljung, System Identification (1999), chapter 16. An innovation's variance
is one, so that of a correlation over n pairs is 1 / n if nothing is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import Correlations, ResidualTest
from pbrl_ppl.criticism.unexplained import innovations_over_steps
from pbrl_ppl.modes import Mode
from pbrl_ppl.state import STATE, WRENCH

Array = NDArray[np.float64]

_WHITENESS, _COMMANDS = "whiteness", "correlation with commands"
#: Lags of either test.
LAGS = 5
#: A share of the innovations' variance that matters.
_SHARE = 0.02
#: Pairs that a correlation needs.
_PAIRS = 10


@dataclass(frozen=True, eq=False)
class _Correlation:
    """Correlations and numbers of pairs, shape (lag, series, cell)."""

    values: Array
    pairs: Array

    @property
    def p_value(self) -> float:
        """Of the sum of squares, chi-squared if nothing is missing."""
        enough = self.pairs > _PAIRS
        statistic = float((self.pairs * self.values**2)[enough].sum())
        return float(chi2.sf(statistic, max(int(enough.sum()), 1)))

    def worst(self, share: Array) -> tuple[int, int, int]:
        """Where the largest is, of those of enough pairs; weights are of the cells."""
        size = np.where(self.pairs > _PAIRS, np.abs(self.values), 0.0) * share
        lag, series, cell = np.unravel_index(int(np.argmax(size)), size.shape)
        return int(lag), int(series), int(cell)

    def matters(self, share: Array, negligible: float) -> bool:
        """Whether any is large against what a step changes, and against the noise."""
        large = (self.values**2 > _SHARE) & (np.abs(self.values) * share > negligible)
        return bool((large & (self.pairs > _PAIRS)).any())


def correlation_tests(
    mode: Mode, criteria: Criteria = DEFAULT
) -> tuple[tuple[ResidualTest, ...], Correlations]:
    """Test whiteness over lags, and correlation with present and past commands, of enough data.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    criteria : Criteria
        What is significant, and what negligible.

    Returns
    -------
    tests : tuple of ResidualTest
        Of whiteness and of commands; untested where the data cannot fail them.
    correlations : Correlations
        For a picture.
    """
    noise = mode.problem.trajectory_noise
    white, seen = mode.whitened_residual, noise.seen
    number = np.cumsum(noise.first.astype(np.intp))
    share = innovations_over_steps(mode)
    scene, places = mode.problem.scene, noise.cells.places
    cells = [f"{STATE[p % len(STATE)]} of {scene.moving[p // len(STATE)].name}" for p in places]
    own = _lagged(white, seen, number, None)
    few = "too few pairs of intervals"
    tests = [
        _whiteness(own, share, cells, criteria)
        if (own.pairs > _PAIRS).any()
        else ResidualTest.untested(_WHITENESS, few)
    ]
    commands, names = _commands(mode)
    driven = None
    if names:
        driven = _lagged(white, seen, number, commands)
        p_value = _driven_by_chance(white, seen, number, commands)
        tests.append(
            ResidualTest.untested(_COMMANDS, few)
            if p_value is None
            else _driven(driven, p_value, share, cells, names, criteria)
        )
    else:
        tests.append(ResidualTest.untested(_COMMANDS, "no command varies"))
    return tuple(tests), Correlations(
        tuple(cells),
        own.values[:, 0],
        own.pairs[:, 0],
        tuple(names),
        np.zeros((0, 0, len(cells))) if driven is None else driven.values,
    )


def _lagged(
    white: Array, seen: NDArray[np.bool_], number: NDArray[np.intp], series: Array | None
) -> _Correlation:
    """Correlation with series some intervals before, or of each cell with itself."""
    values, pairs = [], []
    for lag in range(1, LAGS + 1) if series is None else range(LAGS + 1):
        end = max(len(number) - lag, 0)
        same = number[lag:] == number[:end]
        later, counts = white[lag:][same], seen[lag:][same]
        if series is None:
            earlier = white[:end][same][:, None]
            counts = (counts & seen[:end][same])[:, None]
            later = later[:, None]
        else:
            earlier = series[:end][same][:, :, None]
            later, counts = later[:, None], np.broadcast_to(counts[:, None], later[:, None].shape)
        n = np.broadcast_to(counts, np.broadcast_shapes(counts.shape, earlier.shape)).sum(axis=0)
        values.append((later * earlier * counts).sum(axis=0) / np.maximum(n, 1))
        pairs.append(n)
    return _Correlation(np.array(values), np.array(pairs))


def _commands(mode: Mode) -> tuple[Array, list[str]]:
    """Commanded wrenches that vary, standardised, shape (transition, series), and their names."""
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


def _whiteness(
    own: _Correlation, share: Array, cells: list[str], criteria: Criteria
) -> ResidualTest:
    p_value = own.p_value
    passed = p_value > criteria.false_alarm or not own.matters(share, criteria.negligible)
    lag, _, cell = own.worst(np.ones(len(cells)) if passed else share)
    worst = float(own.values[lag, 0, cell])
    sentence = "errors of one interval say nothing of those of the next"
    if not passed:
        sentence = (
            f"the error of {cells[cell]} is correlated with itself"
            f" {lag + 1} interval{'s' * (lag > 0)} later ({worst:.2f})"
        )
    return ResidualTest(_WHITENESS, p_value, abs(worst), passed, sentence)


def _driven_by_chance(
    white: Array, seen: NDArray[np.bool_], number: NDArray[np.intp], commands: Array
) -> float | None:
    """Chance of so much regression of errors on commands of several lags; None of too few data.

    Commands that are held are correlated over lags, so their correlations with errors are not
    independent of each other: what regression on all of them explains is chi-squared.
    """
    lagged = []
    for lag in range(LAGS + 1):
        before = np.roll(commands, lag, axis=0)
        before[:lag] = 0.0
        lagged.append(np.where((number == np.roll(number, lag))[:, None], before, 0.0))
    x = np.hstack(lagged)
    statistic, count = 0.0, 0
    for cell in range(white.shape[1]):
        own = seen[:, cell]
        if own.sum() <= _PAIRS * x.shape[1] // 2:
            continue
        u, size, _ = np.linalg.svd(x[own], full_matrices=False)
        u = u[:, size > 1e-6 * size.max(initial=0.0)]
        statistic += float(((u.T @ white[own, cell]) ** 2).sum())
        count += u.shape[1]
    return float(chi2.sf(statistic, count)) if count else None


def _driven(
    driven: _Correlation,
    p_value: float,
    share: Array,
    cells: list[str],
    names: list[str],
    criteria: Criteria,
) -> ResidualTest:
    passed = p_value > criteria.false_alarm or not driven.matters(share, criteria.negligible)
    lag, series, cell = driven.worst(np.ones(len(cells)) if passed else share)
    worst = float(driven.values[lag, series, cell])
    sentence = "errors say nothing of present and past commands"
    if not passed:
        when = f"{lag} interval{'s' * (lag > 1)} before" if lag else "of the same interval"
        sentence = (
            f"the error of {cells[cell]} is correlated with {names[series].replace('_', ' ')}"
            f" {when} ({worst:.2f})"
        )
    return ResidualTest(_COMMANDS, p_value, abs(worst), passed, sentence)
