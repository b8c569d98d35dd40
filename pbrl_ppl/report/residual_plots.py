"""Pictures of what a model leaves: correlation of its errors, growth of those of forecasts."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import norm

from pbrl_ppl.criticism import Loop
from pbrl_ppl.report.style import AFTER, BAND, BEFORE, PLAIN, WIDE, blank_figure

Array = NDArray[np.float64]

#: Chance that a correlation of noise is outside its band, over all that a panel shows.
CHANCE = 0.01
#: Curves that are named in a legend.
_NAMED = 4


def plot_correlations(findings: Loop, width: float = WIDE) -> Figure:
    """Correlations of errors with those before and with commands, and the band of noise alone."""
    told = findings.correlations
    panels = 2 if told.commands else 1
    figure, axes = blank_figure(width, 3.2, 1, panels)
    lags = np.arange(1, len(told.own) + 1)
    _panel(axes[0], lags, told.own, told.pairs, list(told.cells))
    axes[0].set_xlabel("intervals before")
    axes[0].set_title("with itself", fontsize="medium")
    if told.commands:
        lags = np.arange(len(told.driven))
        names = [
            f"{cell}, {command.replace('_', ' ')}"
            for command in told.commands
            for cell in told.cells
        ]
        pairs = np.full((len(lags), len(names)), max(float(told.pairs.max(initial=1)), 1.0))
        _panel(axes[1], lags, told.driven.reshape(len(lags), -1), pairs, names)
        axes[1].set_xlabel("intervals before")
        axes[1].set_title("with commands", fontsize="medium")
    axes[0].set_ylabel("correlation of errors")
    return figure


def _panel(
    axes: Axes, lags: NDArray[np.intp], values: Array, pairs: Array, names: list[str]
) -> None:
    """Curves of correlations over lags; those that leave the band of noise have a name."""
    edge = norm.isf(CHANCE / 2 / max(values.size, 1)) / np.sqrt(np.maximum(pairs, 1)).min()
    axes.axhspan(-edge, edge, color=BAND, zorder=0)
    axes.axhline(0.0, color="black", linewidth=0.8, zorder=1)
    largest = np.abs(values).max(axis=0)
    outside = [i for i in np.argsort(-largest) if largest[i] > edge]
    for i in range(values.shape[1]):
        if i not in outside[:_NAMED]:
            axes.plot(lags, values[:, i], ".-", color=PLAIN, linewidth=0.7, markersize=4)
    for i in outside[:_NAMED]:
        axes.plot(lags, values[:, i], ".-", linewidth=1.6, markersize=7, label=names[i])
    if outside:
        axes.legend(frameon=False, fontsize="small")
    axes.set_ylim(-max(1.3 * edge, 1.1 * largest.max()), max(1.3 * edge, 1.1 * largest.max()))
    axes.set_xticks(lags)


def plot_growth(findings: Loop, width: float = WIDE) -> Figure:
    """Errors of forecasts over their length, in units of what noise alone makes at each length."""
    growth = findings.growth
    names = [name for name in growth.floor[-1] if growth.floor[-1][name] > 0]
    figure, (axes,) = blank_figure(width, 3.2, 1, 1)
    axes.axhline(1.0, color="black", linewidth=0.8)
    for i, name in enumerate(names):
        ratio = [
            error.get(name, np.nan) / floor[name] if floor.get(name) else np.nan
            for error, floor in zip(growth.error, growth.floor, strict=True)
        ]
        colour = AFTER if i % 2 else BEFORE
        axes.plot(growth.seconds, ratio, ["o-", "s--", "^:"][i // 2 % 3], color=colour, label=name)
    axes.set_xlabel("length of the forecast (s)")
    axes.set_ylabel("error / noise alone")
    top = axes.get_ylim()[1]
    if top > 10:
        axes.set_yscale("log")
    else:
        axes.set_ylim(0.0, max(2.0, top))
    axes.legend(frameon=False, ncols=3, fontsize="small")
    return figure
