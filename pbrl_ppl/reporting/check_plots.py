"""Pictures of checks: the prior against the data, and simulation-based calibration."""

from __future__ import annotations

from matplotlib.figure import Figure
from scipy.stats import binom

from pbrl_ppl.criticism import PriorCheck
from pbrl_ppl.reporting.style import AFTER, BAND, BEFORE, PLAIN, UNITS, blank_figure
from pbrl_ppl.sampling import Calibration, bins


def plot_prior_check(check: PriorCheck) -> Figure:
    """Plot the measured changes of state over a segment beside those that the prior predicts."""
    bodies, states = check.dataset["body"].values, check.dataset["state"].values
    rows = len(bodies) * -(-len(states) // 2)
    pairs = [(body, state) for body in bodies for state in states]
    figure, panels = blank_figure(8.0, 0.8 + 1.3 * rows, rows, 2, "x", count=len(pairs))
    for axes, (body, state) in zip(panels, pairs, strict=False):
        changes = check.dataset.sel(body=body, state=state)
        for place, (name, colour) in enumerate((("predicted", PLAIN), ("measured", AFTER))):
            low, lower, middle, upper, high = changes[name].to_numpy()
            axes.plot([low, high], [place] * 2, color=colour, linewidth=2)
            axes.plot([lower, upper], [place] * 2, color=colour, linewidth=7)
            axes.plot(middle, place, "o", color="white", markeredgecolor=colour)
        axes.set_yticks([0, 1], ["prior", "measured"])
        axes.set_ylim(1.6, -0.6)
        share = float(changes["share_inside"])
        axes.set_title(f"{state} of {body}: {100 * share:.0f} % as expected", fontsize=9)
        axes.set_xlabel(f"change in {check.seconds:g} s ({UNITS[str(state)]})", fontsize=8)
    return figure


def plot_calibration(calibration: Calibration) -> Figure:
    """Plot rank histograms of a simulation-based calibration, one panel a parameter.

    Parameters
    ----------
    calibration : Calibration
        As made by :func:`pbrl_ppl.calibrate`.

    Returns
    -------
    matplotlib.figure.Figure
        The band holds 99 % of each bar's heights if ranks are uniform; failed parameters stand out.
    """
    table, positions = calibration.table(), calibration.dataset["position"]
    n, columns = positions.sizes["replication"], min(4, len(table))
    rows = -(-len(table) // columns)
    size = (2.6 * columns, 1.7 * rows + 0.6)
    figure, panels = blank_figure(*size, rows, columns, count=len(table))
    count = bins(n)
    low, high = binom.interval(0.99, n, 1 / count)
    for axes, (label, row) in zip(panels, table.iterrows(), strict=False):
        axes.axhspan(low, high, color=BAND)
        axes.axhline(n / count, color=PLAIN, linewidth=1)
        color = AFTER if row["passed"] else BEFORE
        axes.hist(
            positions.sel(parameter=label), bins=count, range=(0, 1), histtype="step", color=color
        )
        verdict = "" if row["passed"] else ", failed"
        axes.set_title(f"{label}: p = {row['p_holm']:.2g}{verdict}", fontsize=9, color=color)
        axes.set_ylim(bottom=0)
    figure.supxlabel("rank of the true value among posterior draws, as a share", fontsize=9)
    figure.supylabel("replications", fontsize=9)
    return figure
