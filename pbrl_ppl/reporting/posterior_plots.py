"""Plots of posteriors, of the prior against the data, and of calibration."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

import arviz as az
import numpy as np
import xarray as xr
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.stats import binom, gaussian_kde, rankdata

from pbrl_ppl.criticism import PriorCheck
from pbrl_ppl.posterior import DATATREE, Idata, convergence, from_groups, loo_pit, scalars
from pbrl_ppl.reporting.posterior_summary import (
    most_interesting,
    prior_draws,
    rank_correlations,
    summary,
)
from pbrl_ppl.reporting.style import (
    AFTER,
    BAND,
    BEFORE,
    NARROW,
    PLAIN,
    UNITS,
    WIDE,
    blank_figure,
    legend,
)
from pbrl_ppl.sampling import Calibration, bins
from pbrl_ppl.state import Floats


def plot_trace(
    posterior: Idata, parameters: Sequence[str] | None = None, width: float = WIDE
) -> Figure:
    """Plot ArviZ's trace of some parameters, laid out alike on every ArviZ.

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
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # ArviZ uses what newer Matplotlib deprecates, and a constant parameter makes it complain
        warnings.simplefilter("ignore")
        return _trace(draws, width)


def plot_rank(
    posterior: Idata, parameters: Sequence[str] | None = None, width: float = WIDE
) -> Figure:
    """Plot how evenly the ranks of each chain's draws are spread; arguments as :func:`plot_trace`.

    A curve is the share of a chain's draws below each rank, less what an even spread gives. The
    band follows from the effective sample sizes of the chains: chains that agree stay inside it 99
    times of 100.
    """
    draws = _chosen(posterior, parameters)
    # by chain: chains that differ have few effective draws together
    sizes = [
        convergence(from_groups({"posterior": draws.isel(chain=[i])}, {}))[1]
        for i in range(draws.sizes["chain"])
    ]
    count = len(draws.data_vars)
    columns = 1 if count == 1 else 2
    rows = -(-count // columns)
    figure, panels = blank_figure(width, 0.6 + 1.7 * rows, rows, columns, count=count)
    for axes, (name, values) in zip(panels, draws.items(), strict=False):
        chains = values.to_numpy()
        ranks = rankdata(chains).reshape(chains.shape) / chains.size
        fewest = min(ess[str(name)] for ess in sizes)
        edge = _band(axes, fewest if np.isfinite(fewest) else 1.63**2)
        grid = np.linspace(0.0, 1.0, 201)
        shares = [np.searchsorted(np.sort(chain), grid) / len(chain) for chain in ranks]
        off = np.array(shares) - grid
        for curve in off:
            axes.plot(grid, curve, linewidth=1.1)
        outside = bool(np.abs(off).max() > edge)
        axes.set_title(f"{name}{': chains differ' if outside else ''}", fontsize=9)
        largest = max(1.4 * edge, 1.1 * float(np.abs(off).max()))
        axes.set_ylim(-largest, largest)
        axes.set_xlabel("rank among all draws", fontsize=8)
    return figure


def _band(axes: Axes, size: float) -> float:
    """Draw the band that an even sample of a size leaves once in 100 times; return its edge."""
    # Kolmogorov's distance times the root of the size, at 1 %
    edge = float(1.63 / np.sqrt(max(size, 1.0)))
    axes.axhspan(-edge, edge, color=BAND, zorder=0)
    return edge


def _chosen(posterior: Idata, parameters: Sequence[str] | None) -> xr.Dataset:
    """Return the draws of the parameters to show."""
    if parameters is None:
        parameters = most_interesting(summary(posterior))
    return scalars(posterior)[list(parameters)]


def _trace(draws: xr.Dataset, width: float) -> Figure:
    """Draw with ArviZ; the one place where traces of 0.x and 1.x differ."""
    count = len(draws.data_vars)
    if not DATATREE:
        figure, panels = blank_figure(width, 0.6 + 1.5 * count, count, 2, grid=None)
        grid = np.array(panels, dtype=object).reshape(count, 2)
        az.plot_trace(draws, axes=grid, compact=False, trace_kwargs={"linewidth": 0.5})
        for axes in panels:
            axes.title.set_fontsize(9)
            axes.xaxis.label.set_fontsize(9)
            axes.yaxis.label.set_fontsize(9)
        return figure
    columns = 1 if count == 1 or width <= NARROW else 2
    size = (width, 0.6 + 1.7 * -(-count // columns))
    trace = {"alpha": 0.5, "width": 0.5}
    collection = az.plot_trace(
        draws,
        backend="matplotlib",
        visuals={"title": {"size": 9}, "xlabel": {"size": 8}, "trace": trace},
        col_wrap=columns,
        figure_kwargs={"figsize": size, "layout": "constrained"},
    )
    result: Figure = collection.viz["figure"].item()
    plt.close(result)  # ArviZ 1.x registers it with pyplot, which would never release it
    return result


def plot_prior(posterior: Idata, parameters: Sequence[str], width: float = WIDE) -> Figure:
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
    columns = min(3, len(parameters)) if width > NARROW else 2
    rows = -(-len(parameters) // columns)
    figure, panels = blank_figure(
        width, 0.6 + 1.5 * rows, rows, columns, None, count=len(parameters), stack=False
    )
    for axes, name in zip(panels, parameters, strict=False):
        drawn = [(after[name].to_numpy().ravel(), AFTER, 0.35)]
        if name in before:
            drawn.insert(0, (before[name].to_numpy().ravel(), PLAIN, 0.35))
        low, high = np.quantile(drawn[0][0], [0.01, 0.99])
        low, high = min(low, drawn[-1][0].min()), max(high, drawn[-1][0].max())
        for values, colour, alpha in drawn:
            if np.ptp(values) > 0:
                grid = np.unique(
                    np.r_[np.linspace(low, high, 200), np.quantile(values, np.linspace(0, 1, 100))]
                )
                grid = grid[(grid >= low) & (grid <= high)]
                density = gaussian_kde(values)(grid)
                axes.fill_between(grid, density / density.max(), color=colour, alpha=alpha)
                axes.plot(grid, density / density.max(), color=colour, linewidth=1)
        axes.set_yticks([])
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=8)
        axes.set_title(name, fontsize=9)
    legend(
        figure,
        [Patch(color=PLAIN, alpha=0.6, label="prior"), Patch(color=AFTER, label="posterior")],
    )
    return figure


def plot_pairs(
    posterior: Idata, parameters: Sequence[str], width: float = WIDE, points: int = 800
) -> Figure:
    """Plot some draws of each pair of parameters, with the rank correlation of all."""
    draws = scalars(posterior)
    n = len(parameters) - 1
    correlation = rank_correlations(draws, parameters)
    height = 0.4 + min(width, 6.4) * n / max(n, 2) * 0.9
    figure, panels = blank_figure(width, height, n, n, None, stack=False)
    for row in range(n):
        for column in range(n):
            axes = panels[row * n + column]
            if column > row:
                axes.set_visible(False)
                continue
            first, second = parameters[column], parameters[row + 1]
            x, y = (draws[name].to_numpy().ravel() for name in (first, second))
            some = slice(None, None, max(1, len(x) // points))
            axes.plot(x[some], y[some], ".", color=AFTER, markersize=2, alpha=0.4)
            axes.set_title(f"{correlation[row + 1, column]:+.2f}".replace("-", "−"), fontsize=9)
            axes.locator_params(nbins=3)
            axes.tick_params(labelsize=7)
            if row == n - 1:
                axes.set_xlabel(first.replace("[", "\n["), fontsize=8)
            if column == 0:
                axes.set_ylabel(second.replace("[", "\n["), fontsize=8)
    return figure


def plot_predictions(posterior: Idata, width: float = WIDE) -> Figure:
    """Plot the calibration of leave-one-out predictions, one curve a state dimension.

    A curve is the share of measurements below each quantile, less what calibrated predictions give;
    those of independent measurements stay in the band 99 times of 100.
    """
    pit = loo_pit(posterior)
    figure, (axes,) = blank_figure(width, 3.4, 1, 1)
    grid = np.linspace(0.0, 1.0, 201)
    fewest = np.inf
    handles = []
    marks: tuple[Literal["-", "--", ":"], ...] = ("-", "--", ":")
    for i, name in enumerate(str(state) for state in pit["state"].values):
        values = np.sort(pit.sel(state=name).to_numpy().ravel())
        values = values[np.isfinite(values)]
        if not values.size:
            continue
        fewest = min(fewest, values.size)
        off = np.searchsorted(values, grid, side="right") / values.size - grid
        colour, mark = (BEFORE, AFTER)[i % 2], marks[i // 2 % 3]
        axes.plot(grid, off, mark, color=colour, linewidth=1.5)
        handles.append(Line2D([], [], color=colour, linestyle=mark, label=name))
    _band(axes, fewest)
    axes.set_xlabel("position in the prediction: 0 below all draws, 1 above")
    axes.set_ylabel("share below, less expected")
    if handles:
        legend(figure, handles)
    return figure


def plot_pareto(k: Floats, good: float, unit: str, width: float = WIDE) -> Figure:
    """Plot Pareto k of every unit left out, and the threshold above which LOO is unreliable."""
    figure, (axes,) = blank_figure(width, 2.8, 1, 1)
    high = ~(k <= good)
    axes.axhline(good, color=BEFORE, linewidth=1.2, linestyle="--")
    axes.plot(np.flatnonzero(~high), k[~high], ".", color=AFTER, markersize=4)
    axes.plot(np.flatnonzero(high), np.nan_to_num(k[high], posinf=2.0), "x", color=BEFORE)
    axes.set_xlabel(unit)
    axes.set_ylabel("Pareto k")
    return figure


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
