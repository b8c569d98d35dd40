"""Pictures of chains, and ArviZ's summary of posteriors."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import arviz as az
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from scipy.stats import rankdata

from pbrl_ppl.criticism import Loop
from pbrl_ppl.posterior import DATATREE, HDI_PROB, convergence, from_groups, scalars
from pbrl_ppl.report.style import BAND, NARROW, WIDE, blank_figure

#: Parameters in one picture, at most; the report's tables show all.
MOST_PARAMETERS = 6
#: Kolmogorov's distance of an even sample from evenness, times the root of its size, at 1 %.
_WORST_SHIFT = 1.63


def summary(posterior: Any) -> pd.DataFrame:
    """ArviZ's summary of every scalar parameter, with the same columns on every ArviZ.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.

    Returns
    -------
    pandas.DataFrame
        Columns mean, sd, lower, upper (94 % highest density), ess_bulk, ess_tail, r_hat.
    """
    # the same interval has other names before and after ArviZ 1.0
    options = {"ci_prob": HDI_PROB, "ci_kind": "hdi"} if DATATREE else {"hdi_prob": HDI_PROB}
    with np.errstate(all="ignore"):  # a parameter that never moved has no R-hat
        table = az.summary(scalars(posterior), round_to="none", **options)
    names = {table.columns[2]: "lower", table.columns[3]: "upper"}
    columns = ["mean", "sd", "lower", "upper", "ess_bulk", "ess_tail", "r_hat"]
    result: pd.DataFrame = table.rename(columns=names)[columns]
    return result


def most_interesting(of: Any, table: pd.DataFrame | None = None) -> list[str]:
    """Parameters to look at first: those of added effects, then the worst by R-hat.

    Parameters
    ----------
    of : Loop, InferenceData or DataTree
        Findings, of which the posterior after revision is looked at, or a posterior.
    table : pandas.DataFrame, optional
        Its :func:`summary`, where that is at hand.
    """
    revised = isinstance(of, Loop)
    table = summary(of.posterior_after if revised else of) if table is None else table
    own = [
        f"{added.effect}_{name}[{added.body}]"
        for added in (of.added if revised else ())
        for name in added.parameters
    ]
    worst = table["r_hat"].fillna(np.inf).sort_values(ascending=False, kind="stable").index
    return list(dict.fromkeys([*(n for n in own if n in table.index), *worst]))[:MOST_PARAMETERS]


def plot_trace(of: Any, parameters: Sequence[str] | None = None, width: float = WIDE) -> Figure:
    """ArviZ's trace of some parameters, laid out alike on every ArviZ.

    Parameters
    ----------
    of : Loop, InferenceData or DataTree
        Findings, of which the posterior after revision is shown, or a posterior.
    parameters : sequence of str, optional
        Labels such as ``mass[cart]``; by default those of most interest: of added effects, and with
        the worst R-hat.
    width : float
        Of the figure (inches).
    """
    draws = _chosen(of, parameters)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # ArviZ uses what newer Matplotlib deprecates, and a constant parameter makes it complain
        warnings.simplefilter("ignore")
        return _trace(draws, width)


def plot_rank(of: Any, parameters: Sequence[str] | None = None, width: float = WIDE) -> Figure:
    """How evenly the ranks of each chain's draws are spread; arguments as of :func:`plot_trace`.

    A curve is the share of a chain's draws below each rank, less what an even spread gives. The
    band is as wide as the chains' own effective sample sizes make it, which that of independent
    draws is not: chains that agree stay inside it 99 times of 100.
    """
    draws = _chosen(of, parameters)
    # of each chain by itself: chains that differ have next to no effective draws together
    alone = [
        convergence(from_groups({"posterior": draws.isel(chain=[i])}, {}))[1]
        for i in range(draws.sizes["chain"])
    ]
    count = len(draws.data_vars)
    columns = 1 if count == 1 else 2
    rows = -(-count // columns)
    figure, panels = blank_figure(width, 0.6 + 1.7 * rows, rows, columns)
    for axes, (name, values) in zip(panels, draws.items(), strict=False):
        chains = values.to_numpy()
        ranks = rankdata(chains).reshape(chains.shape) / chains.size
        fewest = min(ess[str(name)] for ess in alone)
        edge = _WORST_SHIFT / np.sqrt(max(fewest, 1.0)) if np.isfinite(fewest) else 1.0
        axes.axhspan(-edge, edge, color=BAND, zorder=0)
        grid = np.linspace(0.0, 1.0, 201)
        off = np.array([np.searchsorted(np.sort(own), grid) / len(own) - grid for own in ranks])
        for own in off:
            axes.plot(grid, own, linewidth=1.1)
        outside = bool(np.abs(off).max() > edge)
        axes.set_title(f"{name}{': chains differ' if outside else ''}", fontsize=9)
        largest = max(1.4 * edge, 1.1 * float(np.abs(off).max()))
        axes.set_ylim(-largest, largest)
        axes.set_xlabel("rank among all draws", fontsize=8)
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure


def _chosen(of: Any, parameters: Sequence[str] | None) -> xr.Dataset:
    """Draws of the parameters to show."""
    names = most_interesting(of) if parameters is None else list(parameters)
    return scalars(of.posterior_after if isinstance(of, Loop) else of)[names]


def _trace(draws: xr.Dataset, width: float) -> Figure:
    """Draw with ArviZ: the one place that knows how 0.x and 1.x differ in that."""
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
    collection = az.plot_trace(
        draws,
        backend="matplotlib",
        visuals={
            "title": {"size": 9},
            "xlabel": {"size": 8},
            "trace": {"alpha": 0.5, "width": 0.5},
        },
        col_wrap=columns,
        figure_kwargs={
            "figsize": (width, 0.6 + 1.7 * -(-count // columns)),
            "layout": "constrained",
        },
    )
    result: Figure = collection.viz["figure"].item()
    plt.close(result)  # ArviZ 1.x registers it with pyplot, which would keep it for ever
    return result
