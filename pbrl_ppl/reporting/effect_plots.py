"""Plots of effects: their scores and posteriors; residual forces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.stats import chi2

from pbrl_ppl.criticism import Loop
from pbrl_ppl.posterior import scalars
from pbrl_ppl.reporting import style
from pbrl_ppl.reporting.residual_force import Law, bin_means
from pbrl_ppl.reporting.words import plain
from pbrl_ppl.scene import units_of
from pbrl_ppl.state import Floats

#: Below this identifiable share a candidate is marked as hardly identifiable.
HARDLY = 0.01
#: Bars of candidates, at most; the report's table has all.
MOST_CANDIDATES = 20


def plot_candidates(loop: Loop, width: float = style.WIDE, level: float = 0.01) -> Figure:
    """Plot the score of the candidates, best on top, with the threshold of each at a level."""
    added = {(addition.effect, addition.body) for addition in loop.added}
    rest = (c for c in loop.candidates[MOST_CANDIDATES:] if (c.effect, c.body) in added)
    shown = [*loop.candidates[:MOST_CANDIDATES], *rest]
    figure, (axes,) = style.blank_figure(width, 0.9 + 0.3 * max(len(shown), 3), grid="x")
    several = len({candidate.body for candidate in shown}) > 1
    thresholds = [
        chi2.isf(level / (len(loop.candidates) * max(candidate.n_grid_points, 1)), candidate.dof)
        for candidate in shown
    ]
    style.bars(
        axes,
        [f"{plain(c.effect)}{f' · {c.body}' * several}" for c in shown],
        [c.statistic for c in shown],
        [style.AFTER if (c.effect, c.body) in added else style.PLAIN for c in shown],
        [f"{c.statistic:.3g}{', hardly identifiable' * (c.identifiable < HARDLY)}" for c in shown],
        height=0.7, hatch=["////" * (c.identifiable < HARDLY) for c in shown],
    )  # fmt: skip
    places = np.arange(len(shown))
    axes.vlines(thresholds, places - 0.45, places + 0.45, color=style.BEFORE, linewidth=2)
    if shown and max(candidate.statistic for candidate in shown) > 12 * max(thresholds):
        axes.set_xscale("asinh", linear_width=5.0)
    axes.margins(x=0.1)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("score statistic of the effect")
    handles: list[Artist] = [
        Patch(color=style.AFTER, label="added"),
        Patch(color=style.PLAIN, label="not added"),
        Patch(facecolor=style.PLAIN, edgecolor="white", hatch="////", label="hardly identifiable"),
        Line2D([], [], color=style.BEFORE, linewidth=2, label=f"{100 * level:g} % threshold"),
    ]
    style.legend(figure, handles)
    return figure


def plot_added(loop: Loop, width: float = style.WIDE, most: int = 12) -> Figure:
    """Plot the posterior of the added effects' parameters, and the values that mean no effect."""
    shown = [
        (added, name, estimate)
        for added in loop.accepted
        for name, estimate in added.parameters.items()
    ][:most]
    columns = min(max(len(shown), 1), 2)
    width = width if columns > 1 else min(width, 5.0)
    figure, panels = style.blank_figure(width, 2.6, max(len(shown), 1), columns, "x")
    draws = scalars(loop.posterior_after)
    effects = {effect.name: effect for effect in loop.catalogue}
    for axes, (added, name, estimate) in zip(panels, shown, strict=False):
        variable = f"{added.effect}_{name}[{added.body}]"
        if variable in draws:
            values = draws[variable].to_numpy().ravel()
            style.density(axes, values, style.AFTER, (values.min(), values.max()), estimate.hdi)
        axes.plot(estimate.hdi, [-0.06] * 2, color=style.AFTER, linewidth=4, solid_capstyle="butt")
        axes.plot(estimate.mean, -0.06, "o", color="white", markeredgecolor=style.AFTER)
        if added.effect in effects:
            sized = effects[added.effect].in_si(units_of(loop.scene, added.body))
            null = {parameter.name: parameter.null for parameter in sized.parameters}[name]
            least = 1e-12 * abs(estimate.mean) + np.finfo(float).tiny
            _mark_null(axes, null, estimate.mean, max(estimate.sd, least))
        axes.set(ylim=(-0.14, 1.15), yticks=[])
        title = f"{plain(added.effect)} on {added.body}"
        style.name_axes(axes, title, f"{plain(name)} ({estimate.unit})")
    return figure


def _mark_null(axes: Axes, null: float, mean: float, sd: float) -> None:
    """Draw a line at the value that means no effect, or an arrow where that is far away."""
    if abs(null - mean) < 25 * sd:
        axes.axvline(null, color="black", linestyle="--", linewidth=1.2)
        style.label(axes, "no effect", (null, 1.05), (3, 0))
        return
    text, x, side = f"no effect ({null:g}) →", 0.98, "right"
    if null < mean:
        text, x, side = f"← no effect ({null:g})", 0.02, "left"
    axes.annotate(text, (x, 0.93), xycoords="axes fraction", ha=side, fontsize=8)


def _means(axes: Axes, x: Floats, y: Floats, marks: str) -> None:
    """Draw the means of y in bins of x, with two standard errors."""
    bins = bin_means(x, y)
    axes.errorbar(
        bins.centre, bins.mean, 2 * np.nan_to_num(bins.error), fmt=marks, color=style.AFTER,
        markersize=4, linewidth=1.2, label="mean ± 2 se",
    )  # fmt: skip
    style.zero_line(axes)


def plot_laws(laws: Sequence[Law], width: float = style.WIDE) -> Figure:
    """Plot residual forces against the quantities that they depend on, with means and a curve."""
    count = max(len(laws), 1)
    figure, panels = style.blank_figure(width, 3.6, count, count)
    for axes, law in zip(panels, laws, strict=False):
        axes.plot(law.x, law.residual.values, ".", color=style.PLAIN, markersize=3, alpha=0.6)
        _means(axes, law.x, law.residual.values, "o")
        order = np.argsort(law.x)
        axes.plot(
            law.x[order], law.curve.values, color=style.BEFORE, linewidth=1.8, label="simple curve"
        )
        reach = 1.25 * float(np.quantile(np.abs(law.residual.values), 0.98))
        if reach > 0:  # a few far off would hide the rest
            axes.set_ylim(-reach, reach)
        x, force = f"{law.quantity} ({law.unit})".replace(" (1)", ""), law.residual
        y = f"{force.name}, {force.dimension} ({force.unit})" * (law is laws[0])
        style.name_axes(axes, f"R² {max(law.curve.share, 0):.2f}", x, y)
    if laws:
        panels[0].legend(frameon=False, fontsize="small")
    return figure
