"""Plots of posteriors, and of the prior against the data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.stats import rankdata

from pbrl_ppl.criticism import PriorCheck
from pbrl_ppl.posterior import Idata, convergence, from_groups, scalars
from pbrl_ppl.reporting import style
from pbrl_ppl.reporting.posterior_summary import (
    most_interesting,
    pit_values,
    prior_draws,
    rank_correlations,
    summary,
)
from pbrl_ppl.state import Floats


def plot_rank(
    posterior: Idata, parameters: Sequence[str] | None = None, width: float = style.WIDE
) -> Figure:
    """Plot how evenly the ranks of each chain's draws are spread.

    A curve is the share of a chain's draws below each rank, less what an even spread gives. The
    band follows from the effective sample sizes of the chains: chains that agree stay inside it 99
    times of 100.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.
    parameters : sequence of str, optional
        Labels such as ``mass[cart]``; by default those with the worst R-hat.
    width : float
        Width of the figure (inches).
    """
    draws = _chosen(posterior, parameters)
    # by chain: chains that differ have few effective draws together
    sizes = [
        convergence(from_groups({"posterior": draws.isel(chain=[i])}, {}))[1]
        for i in range(draws.sizes["chain"])
    ]
    count = len(draws.data_vars)
    figure, panels = style.blank_figure(width, 1.7, count, min(count, 2), spare=0.6)
    for axes, (name, values) in zip(panels, draws.items(), strict=False):
        chains = values.to_numpy()
        ranks = rankdata(chains).reshape(chains.shape) / chains.size
        fewest = min(ess[str(name)] for ess in sizes)
        size = fewest if np.isfinite(fewest) else 1.0
        edge, largest = style.shares_below(
            axes, {str(i): chain for i, chain in enumerate(ranks)}, size
        )
        top = max(1.4 * edge, 1.1 * largest)
        axes.set_ylim(-top, top)
        differ = ": chains differ" * (largest > edge)
        style.name_axes(axes, f"{name}{differ}", "rank among all draws", small=True)
    return figure


def _chosen(posterior: Idata, parameters: Sequence[str] | None) -> xr.Dataset:
    """Return the draws of the parameters to show."""
    if parameters is None:
        parameters = most_interesting(summary(posterior))
    return scalars(posterior)[list(parameters)]


def plot_prior(posterior: Idata, parameters: Sequence[str], width: float = style.WIDE) -> Figure:
    """Plot posterior densities over those of the prior.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``prior``.
    parameters : sequence of str
        Labels such as ``mass[cart]``.
    width : float
        Width of the figure (inches).
    """
    after, before = scalars(posterior), prior_draws(posterior)
    count = len(parameters)
    columns = min(3, count) if width > style.NARROW else 2
    figure, panels = style.blank_figure(width, 1.5, count, columns, None, spare=0.6, stack=False)
    for axes, name in zip(panels, parameters, strict=False):
        drawn = {
            colour: draws[name].to_numpy().ravel()
            for colour, draws in ((style.PLAIN, before), (style.AFTER, after))
            if name in draws
        }
        low, high = np.quantile(next(iter(drawn.values())), [0.01, 0.99])
        ends = min(low, drawn[style.AFTER].min()), max(high, drawn[style.AFTER].max())
        for colour, values in drawn.items():
            style.density(axes, values, colour, ends, ends)
        axes.set_yticks([])
        style.name_axes(axes, name, small=True)
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=8)
    style.legend(
        figure,
        [Patch(color=style.PLAIN, label="prior"), Patch(color=style.AFTER, label="posterior")],
    )
    return figure


def plot_pairs(
    posterior: Idata, parameters: Sequence[str], width: float = style.WIDE, points: int = 800
) -> Figure:
    """Plot some draws of each pair of parameters, with the rank correlation of all."""
    draws = scalars(posterior)
    n = len(parameters) - 1
    correlation = rank_correlations(draws, parameters)
    height = 0.4 + min(width, 6.4) * n / max(n, 2) * 0.9
    figure, panels = style.blank_figure(width, height / n, n * n, n, None, stack=False)
    for i, axes in enumerate(panels):
        row, column = divmod(i, n)
        if column > row:
            axes.set_visible(False)
            continue
        first, second = parameters[column], parameters[row + 1]
        x, y = (draws[name].to_numpy().ravel() for name in (first, second))
        some = slice(None, None, max(1, len(x) // points))
        axes.plot(x[some], y[some], ".", color=style.AFTER, markersize=2, alpha=0.4)
        axes.locator_params(nbins=3)
        axes.tick_params(labelsize=7)
        style.name_axes(
            axes, f"{correlation[row + 1, column]:+.2f}".replace("-", "−"),
            first.replace("[", "\n[") * (row == n - 1), second.replace("[", "\n[") * (column == 0),
            small=True,
        )  # fmt: skip
    return figure


def plot_predictions(posterior: Idata, width: float = style.WIDE) -> Figure:
    """Plot the calibration of leave-one-out predictions, one curve a state dimension.

    A curve is the share of measurements below each quantile, less what calibrated predictions give;
    those of independent measurements stay in the band 99 times of 100.
    """
    seen = pit_values(posterior)
    figure, (axes,) = style.blank_figure(width, 3.4)
    axes.set_prop_cycle(style.LINES)
    style.shares_below(axes, seen, min((len(values) for values in seen.values()), default=1))
    x = "position in the prediction: 0 below all draws, 1 above"
    style.name_axes(axes, x=x, y="share below, less expected")
    if seen:
        style.legend(figure, axes.lines)
    return figure


def plot_pareto(k: Floats, good: float, unit: str, width: float = style.WIDE) -> Figure:
    """Plot Pareto k of every unit left out, and the threshold above which LOO is unreliable."""
    figure, (axes,) = style.blank_figure(width, 2.8)
    high = ~(k <= good)
    axes.axhline(good, color=style.BEFORE, linewidth=1.2, linestyle="--")
    axes.plot(np.flatnonzero(~high), k[~high], ".", color=style.AFTER, markersize=4)
    axes.plot(np.flatnonzero(high), np.nan_to_num(k[high], posinf=2.0), "x", color=style.BEFORE)
    style.name_axes(axes, x=unit, y="Pareto k")
    return figure


def plot_prior_check(check: PriorCheck) -> Figure:
    """Plot the measured changes of state over a segment beside those that the prior predicts."""
    bodies, states = check.dataset["body"].values, check.dataset["state"].values
    pairs = [(body, state) for body in bodies for state in states]
    figure, panels = style.blank_figure(8.0, 1.3, len(pairs), 2, "x", spare=0.8)
    for axes, (body, state) in zip(panels, pairs, strict=False):
        changes = check.dataset.sel(body=body, state=state)
        for place, (name, colour) in enumerate(
            (("predicted", style.PLAIN), ("measured", style.AFTER))
        ):
            low, lower, middle, upper, high = changes[name].to_numpy()
            axes.plot([low, high], [place] * 2, color=colour, linewidth=2)
            axes.plot([lower, upper], [place] * 2, color=colour, linewidth=7)
            axes.plot(middle, place, "o", color="white", markeredgecolor=colour)
        axes.set_yticks([0, 1], ["prior", "measured"])
        share = float(changes["share_inside"])
        axes.set_ylim(1.6, -0.6)
        x = f"change in {check.seconds:g} s ({style.UNITS[str(state)]})"
        style.name_axes(axes, f"{state} of {body}: {100 * share:.0f} % as expected", x, small=True)
    return figure
