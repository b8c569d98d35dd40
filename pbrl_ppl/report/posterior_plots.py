"""Pictures of posteriors, by ArviZ, and its summary of them."""

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

from pbrl_ppl.criticism import Findings
from pbrl_ppl.posterior import DATATREE, HDI_PROB, scalars
from pbrl_ppl.report.style import blank_figure

#: Parameters in one picture, at most; the report's tables show all.
MOST_PARAMETERS = 6


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
    of : Findings, InferenceData or DataTree
        Findings, of which the posterior after revision is looked at, or a posterior.
    table : pandas.DataFrame, optional
        Its :func:`summary`, where that is at hand.
    """
    revised = isinstance(of, Findings)
    table = summary(of.posterior_after if revised else of) if table is None else table
    own = [
        f"{added.effect}_{name}[{added.body}]"
        for added in (of.added if revised else ())
        for name in added.parameters
    ]
    worst = table["r_hat"].fillna(np.inf).sort_values(ascending=False, kind="stable").index
    return list(dict.fromkeys([*(n for n in own if n in table.index), *worst]))[:MOST_PARAMETERS]


def plot_trace(of: Any, parameters: Sequence[str] | None = None) -> Figure:
    """ArviZ's trace of some parameters, laid out alike on every ArviZ.

    Parameters
    ----------
    of : Findings, InferenceData or DataTree
        Findings, of which the posterior after revision is shown, or a posterior.
    parameters : sequence of str, optional
        Labels such as ``mass[cart]``; by default those of most interest: of added effects, and with
        the worst R-hat.
    """
    return _arviz(of, "trace", parameters)


def plot_rank(of: Any, parameters: Sequence[str] | None = None) -> Figure:
    """ArviZ's rank picture of some parameters; arguments as of :func:`plot_trace`."""
    return _arviz(of, "rank", parameters)


def _arviz(of: Any, kind: str, parameters: Sequence[str] | None) -> Figure:
    posterior = of.posterior_after if isinstance(of, Findings) else of
    names = most_interesting(of) if parameters is None else list(parameters)
    draws = scalars(posterior)[names]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # ArviZ uses what newer Matplotlib deprecates, and a constant parameter makes it complain
        warnings.simplefilter("ignore")
        return _arviz_figure(draws, kind)


def _arviz_figure(draws: xr.Dataset, kind: str) -> Figure:
    """Draw with ArviZ: the one place that knows how 0.x and 1.x differ in that."""
    count = len(draws.data_vars)
    columns = 1 if count == 1 else 2
    rows = -(-count // columns)
    size = (8.0, 0.6 + 1.7 * rows)
    if not DATATREE:
        if kind == "trace":
            figure, panels = blank_figure(8.0, 0.6 + 1.5 * count, count, 2, grid=None)
            grid = np.array(panels, dtype=object).reshape(count, 2)
            az.plot_trace(draws, axes=grid, compact=False, trace_kwargs={"linewidth": 0.5})
        else:
            figure, panels = blank_figure(8.0, 0.6 + 2.0 * rows, rows, columns, grid=None)
            az.plot_rank(draws, ax=np.array(panels[:count], dtype=object))
            for axes in panels[count:]:
                axes.set_visible(False)
        for axes in panels:
            axes.title.set_fontsize(9)
            axes.xaxis.label.set_fontsize(9)
            axes.yaxis.label.set_fontsize(9)
        return figure
    draw = az.plot_trace if kind == "trace" else az.plot_rank
    visuals: dict[str, dict[str, Any]] = {"title": {"size": 9}, "xlabel": {"size": 8}}
    if kind == "trace":
        visuals["trace"] = {"alpha": 0.5, "width": 0.5}
    collection = draw(
        draws,
        backend="matplotlib",
        visuals=visuals,
        col_wrap=columns,
        figure_kwargs={"figsize": size, "layout": "constrained"},
    )
    result: Figure = collection.viz["figure"].item()
    plt.close(result)  # ArviZ 1.x registers it with pyplot, which would keep it for ever
    return result
