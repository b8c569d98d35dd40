"""Pictures of effects: the candidates' scores, and what was added."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.stats import chi2, gaussian_kde

from pbrl_ppl.criticism import Loop
from pbrl_ppl.effects import catalogue
from pbrl_ppl.posterior import scalars
from pbrl_ppl.report.style import AFTER, BEFORE, PLAIN, WIDE, blank_figure, legend
from pbrl_ppl.report.words import plain

#: Candidates are called significant below this corrected p-value.
LEVEL = 0.01
#: Below this identifiable share a candidate is marked as hardly identifiable.
HARDLY = 0.01
#: Bars and parameters in one picture, at most; the report's tables show all.
MOST_CANDIDATES, MOST_ADDED = 20, 12


def plot_candidates(findings: Loop, width: float = WIDE) -> Figure:
    """Score statistic of the candidates, best on top, with the threshold of each."""
    added = {(addition.effect, addition.body) for addition in findings.added}
    shown = [
        candidate
        for place, candidate in enumerate(findings.candidates)
        if place < MOST_CANDIDATES or (candidate.effect, candidate.body) in added
    ]
    figure, (axes,) = blank_figure(width, 0.9 + 0.3 * max(len(shown), 3), 1, 1, grid="x")
    several = len({candidate.body for candidate in shown}) > 1
    total = max(len(findings.candidates), 1)
    thresholds = [
        float(chi2.isf(LEVEL / (total * max(candidate.looks, 1)), candidate.dof))
        for candidate in shown
    ]
    for place, (candidate, threshold) in enumerate(zip(shown, thresholds, strict=True)):
        hardly = candidate.identifiable < HARDLY
        is_added = (candidate.effect, candidate.body) in added
        axes.barh(
            place,
            candidate.statistic,
            height=0.7,
            color=AFTER if is_added else PLAIN,
            edgecolor="white",
            hatch="////" if hardly else None,
        )
        axes.plot([threshold] * 2, [place - 0.45, place + 0.45], color=BEFORE, linewidth=2)
        axes.annotate(
            f"{candidate.statistic:.3g}{', hardly identifiable' if hardly else ''}",
            (candidate.statistic, place),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )
    if shown and max(candidate.statistic for candidate in shown) > 12 * max(thresholds):
        axes.set_xscale("asinh", linear_width=5.0)
    labels = [
        f"{plain(candidate.effect)}{f' · {candidate.body}' if several else ''}"
        for candidate in shown
    ]
    axes.set_yticks(range(len(shown)), labels)
    axes.margins(x=0.1)
    axes.set_xlim(left=0.0)
    axes.invert_yaxis()
    axes.set_xlabel("score statistic: how strongly the residual asks for the effect")
    handles: list[Any] = [
        Patch(color=AFTER, label="added"),
        Patch(color=PLAIN, label="not added"),
        Patch(facecolor=PLAIN, edgecolor="white", hatch="////", label="hardly identifiable"),
        Line2D([], [], color=BEFORE, linewidth=2, label="1 % threshold"),
    ]
    legend(figure, handles)
    return figure


def plot_added(findings: Loop, width: float = WIDE) -> Figure:
    """Posterior of every parameter of the added effects, with the value that means no effect."""
    shown = [
        (added, name, estimate)
        for added in findings.added
        for name, estimate in added.parameters.items()
    ][:MOST_ADDED]
    columns = min(max(len(shown), 1), 2)
    rows = max(-(-len(shown) // columns), 1)
    width = width if columns > 1 else min(width, 5.0)
    figure, panels = blank_figure(width, 2.6 * rows, rows, columns, grid="x")
    draws = scalars(findings.posterior_after)
    nulls = {(effect.name, p.name): p.null for effect in catalogue for p in effect.parameters}
    for axes, (added, name, estimate) in zip(panels, shown, strict=False):
        low, high = estimate.hdi
        variable = f"{added.effect}_{name}[{added.body}]"
        top = 1.0
        if variable in draws:
            values = draws[variable].to_numpy().ravel()
            if np.ptp(values) > 0:
                grid = np.linspace(values.min(), values.max(), 300)
                density = gaussian_kde(values)(grid)
                top = float(density.max())
                axes.plot(grid, density, color=AFTER)
                inside = (grid >= low) & (grid <= high)
                axes.fill_between(grid[inside], density[inside], color=AFTER, alpha=0.25)
        axes.plot([low, high], [-0.06 * top] * 2, color=AFTER, linewidth=4, solid_capstyle="butt")
        axes.plot(estimate.mean, -0.06 * top, "o", color="white", markeredgecolor=AFTER)
        null = nulls.get((added.effect, name))
        if null is not None:
            _mark_null(axes, null, estimate.mean, max(estimate.sd, 1e-12), top)
        axes.set_ylim(-0.14 * top, 1.15 * top)
        axes.set_yticks([])
        axes.set_title(f"{plain(added.effect)} on {added.body}", fontsize=10)
        axes.set_xlabel(f"{plain(name)} ({estimate.unit})")
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    return figure


def _mark_null(axes: Axes, null: float, mean: float, sd: float, top: float) -> None:
    """Draw a line at the value that means no effect, or an arrow where that is far away."""
    if abs(null - mean) < 25 * sd:
        axes.axvline(null, color="black", linestyle="--", linewidth=1.2)
        axes.annotate(
            "no effect", (null, 1.05 * top), xytext=(3, 0), textcoords="offset points", fontsize=8
        )
        return
    side = -1 if null < mean else 1
    text = f"← no effect ({null:g})" if side < 0 else f"no effect ({null:g}) →"
    axes.annotate(
        text,
        (0.02 if side < 0 else 0.98, 0.93),
        xycoords="axes fraction",
        ha="left" if side < 0 else "right",
        fontsize=8,
    )
