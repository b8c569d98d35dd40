"""Plots of the evidence for an effect, and of residual forces against what they depend on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pbrl_ppl.report.evidence import Evidence, binned
from pbrl_ppl.report.laws import Law
from pbrl_ppl.report.style import AFTER, BEFORE, PLAIN, WIDE, blank_figure

Array = NDArray[np.float64]

#: Bars of measured numbers in one panel, at most.
_MOST_BARS = 12


def plot_evidence(evidence: Evidence, width: float = WIDE) -> Figure:
    """Gain of log-likelihood by what was measured, speed, place, time and contact."""
    figure, panels = blank_figure(width, 8.0, 3, 2)
    _by_cell(panels[0], evidence)
    gains = evidence.by_transition
    _along(panels[1], evidence.speed, gains, f"speed of {evidence.body} (m/s)")
    _along(panels[2], evidence.time, gains, "time in the trajectory (s)")
    _in_place(figure, panels[3], evidence)
    _by_contact(panels[4], evidence)
    _shares(panels[5], evidence)
    return figure


def _by_cell(axes: Axes, evidence: Evidence) -> None:
    sums = list(evidence.by_cell.items())[:_MOST_BARS]
    names, values = [name for name, _ in sums], [value for _, value in sums]
    colours = [AFTER if value >= 0 else BEFORE for value in values]
    axes.barh(range(len(sums)), values, color=colours)
    axes.set_yticks(range(len(sums)), names)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_title("by what was measured", fontsize=10)
    axes.set_xlabel("gain in all (nats)")


def _along(axes: Axes, x: Array, gains: Array, label: str) -> None:
    """Mean gain of a transition in bins of a quantity, with two standard errors."""
    which, bins = binned(x)
    own = [np.flatnonzero(which == i) for i in range(bins)]
    centre = [float(np.median(x[each])) for each in own]
    mean = [float(gains[each].mean()) for each in own]
    error = [2 * float(gains[each].std(ddof=1)) / len(each) ** 0.5 if len(each) > 1 else 0.0
             for each in own]  # fmt: skip
    axes.errorbar(centre, mean, error, fmt="o-", color=AFTER, markersize=4, linewidth=1.2)
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
    for place, (_, own) in enumerate(groups):
        if len(own):
            axes.bar(place, own.mean(), width=0.6, color=AFTER if own.mean() >= 0 else BEFORE)
    names = [f"{name}\n{len(own)} transitions" for name, own in groups]
    axes.set_xticks([0, 1], names)
    axes.set_xlim(-0.6, 1.6)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_title("by contact", fontsize=10)
    axes.set_ylabel("gain a transition (nats)")


def _shares(axes: Axes, evidence: Evidence) -> None:
    gains = np.sort(np.maximum(evidence.by_transition, 0.0))[::-1]
    held = np.cumsum(gains) / max(float(gains.sum()), 1e-300)
    axes.plot(100 * np.arange(len(held) + 1) / len(held), 100 * np.r_[0, held], color=AFTER)
    axes.plot([0, 100], [0, 100], color=PLAIN, linestyle=":", linewidth=1)
    count = len(evidence.carriers())
    axes.plot([100 * count / len(held)], [80], "o", color=BEFORE)
    axes.annotate(
        f"{count} transitions\nhold 80 %", (100 * count / len(held), 80), xytext=(8, -24),
        textcoords="offset points", fontsize=8,
    )  # fmt: skip
    axes.set_title("by transition", fontsize=10)
    axes.set(xlabel="transitions, most telling first (%)", ylabel="share of the gains (%)")


def plot_laws(laws: Sequence[Law], width: float = WIDE) -> Figure:
    """Plot residual forces against the quantities that they depend on, with means and a curve."""
    figure, panels = blank_figure(width, 3.6, 1, max(len(laws), 1))
    for axes, law in zip(panels, laws, strict=False):
        order = np.argsort(law.x)
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.plot(law.x, law.y, ".", color=PLAIN, markersize=3, alpha=0.6)
        axes.errorbar(
            law.centre, law.mean, 2 * np.nan_to_num(law.error), fmt="o", color=AFTER, markersize=4,
            label="mean ± 2 se",
        )  # fmt: skip
        axes.plot(law.x[order], law.curve, color=BEFORE, linewidth=1.8, label="simple curve")
        reach = 1.25 * float(np.quantile(np.abs(law.y), 0.98))
        if reach > 0:  # a few far off would hide the rest
            axes.set_ylim(-reach, reach)
        axes.set_title(f"R² {max(law.curve_share, 0):.2f}", fontsize=10)
        axes.set_xlabel(f"{law.quantity} ({law.x_unit})".replace(" (1)", ""))
    if laws:
        panels[0].set_ylabel(f"{laws[0].y_name}, {laws[0].dimension} ({laws[0].y_unit})")
        panels[0].legend(frameon=False, fontsize="small")
    return figure
