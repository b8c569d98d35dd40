"""Plots of effects: their search, scores, posteriors and evidence; residual forces."""

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
from pbrl_ppl.reporting.evidence import Evidence, Law, bin_means
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


def plot_evidence(evidence: Evidence, width: float = style.WIDE) -> Figure:
    """Plot the gain of log-likelihood by measured number, speed, place, time and contact."""
    figure, panels = style.blank_figure(width, 8.0 / 3, 6, 2)
    gains, body = evidence.by_transition, evidence.body
    sums = dict(list(evidence.by_cell.items())[:12])
    values = list(sums.values())
    style.bars(panels[0], list(sums), values, [_colour(value) for value in values])
    panels[0].grid(visible=False, axis="y")
    style.name_axes(panels[0], "by what was measured", "gain in all (nats)")
    along = {f"speed of {body}": (evidence.speed, "m/s"),
             "time in the trajectory": (evidence.time, "s")}  # fmt: skip
    for axes, (name, (x, unit)) in zip(panels[1:], along.items(), strict=False):
        _means(axes, x, gains, "o-")
        style.name_axes(axes, f"by {name}", f"{name} ({unit})", "gain a transition (nats)")
    _in_place(figure, panels[3], evidence)
    _by_contact(panels[4], evidence)
    _shares(panels[5], evidence)
    return figure


def _colour(gain: float) -> str:
    """Return the colour of a gain of the revised model, or of a loss."""
    return style.AFTER if gain >= 0 else style.BEFORE


def _means(axes: Axes, x: Floats, y: Floats, marks: str) -> None:
    """Draw the means of y in bins of x, with two standard errors."""
    bins = bin_means(x, y)
    axes.errorbar(
        bins.centre, bins.mean, 2 * np.nan_to_num(bins.error), fmt=marks, color=style.AFTER,
        markersize=4, linewidth=1.2, label="mean ± 2 se",
    )  # fmt: skip
    style.zero_line(axes)


def _in_place(figure: Figure, axes: Axes, evidence: Evidence) -> None:
    gains = evidence.by_transition
    edge = max(float(np.quantile(np.abs(gains), 0.98)), 1e-9)  # a few would hide the rest
    order = np.argsort(np.abs(gains))
    x, y = evidence.position[order].T
    points = axes.scatter(
        x, y, c=gains[order], s=12, cmap="coolwarm_r", vmin=-edge, vmax=edge, edgecolors="#555555",
        linewidths=0.3,
    )  # fmt: skip
    figure.colorbar(points, ax=axes, shrink=0.85, label="gain (nats)")
    axes.axis("equal")
    style.name_axes(axes, f"by place of {evidence.body}", "x (m)", "y (m)")


def _by_contact(axes: Axes, evidence: Evidence) -> None:
    groups = {"free": ~evidence.touching, "touching": evidence.touching}
    for place, which in enumerate(groups.values()):
        if which.any():
            mean = evidence.by_transition[which].mean()
            axes.bar(place, mean, width=0.6, color=_colour(mean))
    names = [f"{name}\n{which.sum()} transitions" for name, which in groups.items()]
    axes.set_xticks([0, 1], names)
    style.zero_line(axes)
    axes.set_xlim(-0.6, 1.6)
    style.name_axes(axes, "by contact", y="gain a transition (nats)")


def _shares(axes: Axes, evidence: Evidence) -> None:
    gains = np.sort(np.maximum(evidence.by_transition, 0.0))[::-1]
    shares = 100 * np.cumsum(np.r_[0.0, gains]) / max(float(gains.sum()), 1e-300)
    count = len(evidence.carriers())
    at = (100 * count / len(gains), 80)
    axes.plot(np.linspace(0, 100, len(shares)), shares, color=style.AFTER)
    axes.plot([0, 100], [0, 100], color=style.PLAIN, linestyle=":", linewidth=1)
    axes.plot(*at, "o", color=style.BEFORE)
    style.label(axes, f"{count} transitions\nhold 80 %", at, (8, -24))
    x = "transitions, largest gain first (%)"
    style.name_axes(axes, "by transition", x, "share of the gains (%)")


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
