"""Plots of effects: their search, scores, posteriors and evidence; residual forces."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.stats import chi2, gaussian_kde

from pbrl_ppl.criticism import Loop
from pbrl_ppl.posterior import scalars
from pbrl_ppl.reporting.evidence import Evidence, Law, bin_means
from pbrl_ppl.reporting.style import AFTER, BEFORE, PLAIN, WIDE, blank_figure, label, legend
from pbrl_ppl.reporting.words import accepted, plain
from pbrl_ppl.scene import units_of
from pbrl_ppl.state import Floats

#: Below this identifiable share a candidate is marked as hardly identifiable.
HARDLY = 0.01
#: Bars of candidates, at most; the report's table has all.
MOST_CANDIDATES = 20


def plot_candidates(loop: Loop, width: float = WIDE, level: float = 0.01) -> Figure:
    """Plot the score of the candidates, best on top, with the threshold of each at a level."""
    added = {(addition.effect, addition.body) for addition in loop.added}
    rest = (c for c in loop.candidates[MOST_CANDIDATES:] if (c.effect, c.body) in added)
    shown = [*loop.candidates[:MOST_CANDIDATES], *rest]
    figure, (axes,) = blank_figure(width, 0.9 + 0.3 * max(len(shown), 3), 1, 1, grid="x")
    several = len({candidate.body for candidate in shown}) > 1
    total = max(len(loop.candidates), 1)
    thresholds = [
        float(chi2.isf(level / (total * max(candidate.looks, 1)), candidate.dof))
        for candidate in shown
    ]
    for place, (candidate, threshold) in enumerate(zip(shown, thresholds, strict=True)):
        hardly = candidate.identifiable < HARDLY
        is_added = (candidate.effect, candidate.body) in added
        axes.barh(
            place, candidate.statistic, height=0.7, color=AFTER if is_added else PLAIN,
            edgecolor="white", hatch="////" if hardly else None,
        )  # fmt: skip
        axes.plot([threshold] * 2, [place - 0.45, place + 0.45], color=BEFORE, linewidth=2)
        text = f"{candidate.statistic:.3g}{', hardly identifiable' if hardly else ''}"
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
        label(axes, text, (candidate.statistic, place), va="center", bbox=box)
    if shown and max(candidate.statistic for candidate in shown) > 12 * max(thresholds):
        axes.set_xscale("asinh", linear_width=5.0)
    names = [f"{plain(c.effect)}{f' · {c.body}' if several else ''}" for c in shown]
    axes.set_yticks(range(len(shown)), names)
    axes.margins(x=0.1)
    axes.set_xlim(left=0.0)
    axes.invert_yaxis()
    axes.set_xlabel("score statistic of the effect")
    handles: list[Artist] = [
        Patch(color=AFTER, label="added"),
        Patch(color=PLAIN, label="not added"),
        Patch(facecolor=PLAIN, edgecolor="white", hatch="////", label="hardly identifiable"),
        Line2D([], [], color=BEFORE, linewidth=2, label=f"{100 * level:g} % threshold"),
    ]
    legend(figure, handles)
    return figure


def plot_search(loop: Loop, width: float = WIDE) -> Figure:
    """Plot the simulation error over the number of further laws, one line a length of pieces."""
    figure, (axes,) = blank_figure(width, 3.2, 1, 1)
    shades = colormaps["Blues"](np.linspace(1.0, 0.4, len(loop.rungs)))[::-1]
    for rung, shade, mark in zip(loop.rungs, shades, cycle("o^sDv"), strict=False):
        sizes = [0, *(len(best.laws) for best in rung.path)]
        errors = [1.0, *(best.error for best in rung.path)]
        name = f"{rung.seconds:.3g} s" + f", {len(rung.accepted)} accepted" * bool(rung.accepted)
        axes.plot(sizes, errors, color=shade, marker=mark, label=name)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="further laws in the best subset", ylabel="simulation error / error without")
    axes.set_ylim(0.0, 1.05)
    legend(figure, axes.lines)
    return figure


def plot_added(loop: Loop, width: float = WIDE, most: int = 12) -> Figure:
    """Plot the posterior of the added effects' parameters, and the values that mean no effect."""
    shown = [
        (added, name, estimate)
        for added in accepted(loop)
        for name, estimate in added.parameters.items()
    ][:most]
    columns = min(max(len(shown), 1), 2)
    rows = max(-(-len(shown) // columns), 1)
    width = width if columns > 1 else min(width, 5.0)
    figure, panels = blank_figure(width, 2.6 * rows, rows, columns, "x", count=len(shown))
    draws = scalars(loop.posterior_after)
    effects = {effect.name: effect for effect in loop.catalogue}
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
        if added.effect in effects:
            sized = effects[added.effect].in_si(units_of(loop.scene, added.body))
            null = {parameter.name: parameter.null for parameter in sized.parameters}[name]
            least = 1e-12 * abs(estimate.mean) + np.finfo(float).tiny
            _mark_null(axes, null, estimate.mean, max(estimate.sd, least), top)
        axes.set_ylim(-0.14 * top, 1.15 * top)
        axes.set_yticks([])
        small = "" if added.main else " (small)"
        axes.set_title(f"{plain(added.effect)} on {added.body}{small}", fontsize=10)
        axes.set_xlabel(f"{plain(name)} ({estimate.unit})")
    return figure


def _mark_null(axes: Axes, null: float, mean: float, sd: float, top: float) -> None:
    """Draw a line at the value that means no effect, or an arrow where that is far away."""
    if abs(null - mean) < 25 * sd:
        axes.axvline(null, color="black", linestyle="--", linewidth=1.2)
        label(axes, "no effect", (null, 1.05 * top), xytext=(3, 0))
        return
    text, x, side = f"no effect ({null:g}) →", 0.98, "right"
    if null < mean:
        text, x, side = f"← no effect ({null:g})", 0.02, "left"
    axes.annotate(text, (x, 0.93), xycoords="axes fraction", ha=side, fontsize=8)


def plot_evidence(evidence: Evidence, width: float = WIDE) -> Figure:
    """Plot the gain of log-likelihood by measured number, speed, place, time and contact."""
    figure, panels = blank_figure(width, 8.0, 3, 2)
    _by_cell(panels[0], evidence)
    gains = evidence.by_transition
    _along(panels[1], evidence.speed, gains, f"speed of {evidence.body} (m/s)")
    _along(panels[2], evidence.time, gains, "time in the trajectory (s)")
    _in_place(figure, panels[3], evidence)
    _by_contact(panels[4], evidence)
    _shares(panels[5], evidence)
    return figure


def _by_cell(axes: Axes, evidence: Evidence, most: int = 12) -> None:
    sums = list(evidence.by_cell.items())[:most]
    names, values = [name for name, _ in sums], [value for _, value in sums]
    colours = [AFTER if value >= 0 else BEFORE for value in values]
    axes.barh(range(len(sums)), values, color=colours)
    axes.set_yticks(range(len(sums)), names)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_title("by what was measured", fontsize=10)
    axes.set_xlabel("gain in all (nats)")


def _along(axes: Axes, x: Floats, gains: Floats, label: str) -> None:
    """Draw the mean gain of transitions in bins of a quantity, with two standard errors."""
    bins = bin_means(x, gains)
    error = 2 * np.nan_to_num(bins.error)
    axes.errorbar(bins.centre, bins.mean, error, fmt="o-", color=AFTER, markersize=4, linewidth=1.2)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_title(f"by {label.partition(' (')[0]}", fontsize=10)
    axes.set_xlabel(label)
    axes.set_ylabel("gain a transition (nats)")


def _in_place(figure: Figure, axes: Axes, evidence: Evidence) -> None:
    gains = evidence.by_transition
    edge = max(float(np.quantile(np.abs(gains), 0.98)), 1e-9)  # a few would hide the rest
    order = np.argsort(np.abs(gains))
    x, y = evidence.position[order].T
    points = axes.scatter(
        x, y, c=gains[order], s=12, cmap="coolwarm_r", vmin=-edge, vmax=edge, edgecolors="#555555",
        linewidths=0.3,
    )  # fmt: skip
    bar = figure.colorbar(points, ax=axes, shrink=0.85)
    bar.set_label("gain (nats)")
    axes.axis("equal")
    axes.set_title(f"by place of {evidence.body}", fontsize=10)
    axes.set(xlabel="x (m)", ylabel="y (m)")


def _by_contact(axes: Axes, evidence: Evidence) -> None:
    gains = evidence.by_transition
    groups = [("free", gains[~evidence.touching]), ("touching", gains[evidence.touching])]
    for place, (_, gained) in enumerate(groups):
        if len(gained):
            axes.bar(place, gained.mean(), width=0.6, color=AFTER if gained.mean() >= 0 else BEFORE)
    names = [f"{name}\n{len(gained)} transitions" for name, gained in groups]
    axes.set_xticks([0, 1], names)
    axes.set_xlim(-0.6, 1.6)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_title("by contact", fontsize=10)
    axes.set_ylabel("gain a transition (nats)")


def _shares(axes: Axes, evidence: Evidence) -> None:
    gains = np.sort(np.maximum(evidence.by_transition, 0.0))[::-1]
    cumulated = np.cumsum(gains) / max(float(gains.sum()), 1e-300)
    axes.plot(
        100 * np.arange(len(cumulated) + 1) / len(cumulated), 100 * np.r_[0, cumulated], color=AFTER
    )
    axes.plot([0, 100], [0, 100], color=PLAIN, linestyle=":", linewidth=1)
    count = len(evidence.carriers())
    axes.plot([100 * count / len(cumulated)], [80], "o", color=BEFORE)
    text = f"{count} transitions\nhold 80 %"
    label(axes, text, (100 * count / len(cumulated), 80), xytext=(8, -24))
    axes.set_title("by transition", fontsize=10)
    axes.set(xlabel="transitions, largest gain first (%)", ylabel="share of the gains (%)")


def plot_laws(laws: Sequence[Law], width: float = WIDE) -> Figure:
    """Plot residual forces against the quantities that they depend on, with means and a curve."""
    figure, panels = blank_figure(width, 3.6, 1, max(len(laws), 1))
    for axes, law in zip(panels, laws, strict=False):
        order = np.argsort(law.x)
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.plot(law.x, law.residual.values, ".", color=PLAIN, markersize=3, alpha=0.6)
        axes.errorbar(
            law.bins.centre, law.bins.mean, 2 * np.nan_to_num(law.bins.error), fmt="o",
            color=AFTER, markersize=4, label="mean ± 2 se",
        )  # fmt: skip
        axes.plot(law.x[order], law.curve.values, color=BEFORE, linewidth=1.8, label="simple curve")
        reach = 1.25 * float(np.quantile(np.abs(law.residual.values), 0.98))
        if reach > 0:  # a few far off would hide the rest
            axes.set_ylim(-reach, reach)
        axes.set_title(f"R² {max(law.curve.share, 0):.2f}", fontsize=10)
        axes.set_xlabel(f"{law.quantity} ({law.unit})".replace(" (1)", ""))
    if laws:
        residual = laws[0].residual
        panels[0].set_ylabel(f"{residual.name}, {residual.dimension} ({residual.unit})")
        panels[0].legend(frameon=False, fontsize="small")
    return figure
