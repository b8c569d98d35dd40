"""Pictures of a posterior beside its prior, of pairs of parameters, and of predictions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal

import arviz as az
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.stats import gaussian_kde

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.posterior import from_groups, group, groups, left_out, loo_pit, scalars, separate
from pbrl_ppl.report.style import AFTER, BAND, BEFORE, NARROW, PLAIN, WIDE, blank_figure, legend

Array = NDArray[np.float64]

#: Parameters in a picture of pairs, and beside their priors, at most.
MOST_PAIRS, MOST_PRIORS = 4, 12
#: Kolmogorov's distance at 1 %, as of ranks.
_WORST_SHIFT = 1.63
_POINTS = 800


def plot_prior(posterior: Any, parameters: Sequence[str], width: float = WIDE) -> Figure:
    """Posterior densities over those of the prior.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``prior``.
    parameters : sequence of str
        Labels such as ``mass[cart]``.
    width : float
        Of the figure (inches).
    """
    after, before = scalars(posterior), _prior(posterior)
    columns = min(3, len(parameters)) if width > NARROW else 2
    rows = -(-len(parameters) // columns)
    figure, panels = _grid(width, 0.6 + 1.5 * rows, rows, columns)
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
    for axes in panels[len(parameters) :]:
        axes.set_visible(False)
    legend(
        figure,
        [Patch(color=PLAIN, alpha=0.6, label="prior"), Patch(color=AFTER, label="posterior")],
    )
    return figure


def most_dependent(posterior: Any, most: int = MOST_PAIRS) -> list[str]:
    """The parameters whose draws depend most on each other, by rank correlation."""
    draws = scalars(posterior)
    names = [str(name) for name, v in draws.items() if float(v.max() - v.min()) > 0]
    if len(names) < 2:
        return []
    strength = np.abs(np.nan_to_num(_correlations(draws, names)))
    np.fill_diagonal(strength, 0.0)
    chosen = list(divmod(int(strength.argmax()), len(names)))
    while len(chosen) < min(most, len(names)):
        rest = [i for i in range(len(names)) if i not in chosen]
        chosen.append(max(rest, key=lambda i: float(strength[i, chosen].max())))
    return [names[i] for i in chosen]


def plot_pairs(posterior: Any, parameters: Sequence[str], width: float = WIDE) -> Figure:
    """Draws of each pair of parameters, with their rank correlation."""
    draws = scalars(posterior)
    n = len(parameters) - 1
    correlation = _correlations(draws, parameters)
    figure, panels = _grid(width, 0.4 + min(width, 6.4) * n / max(n, 2) * 0.9, n, n)
    for row in range(n):
        for column in range(n):
            axes = panels[row * n + column]
            if column > row:
                axes.set_visible(False)
                continue
            first, second = parameters[column], parameters[row + 1]
            x, y = (draws[name].to_numpy().ravel() for name in (first, second))
            some = slice(None, None, max(1, len(x) // _POINTS))
            axes.plot(x[some], y[some], ".", color=AFTER, markersize=2, alpha=0.4)
            axes.set_title(f"{correlation[row + 1, column]:+.2f}".replace("-", "−"), fontsize=9)
            axes.locator_params(nbins=3)
            axes.tick_params(labelsize=7)
            if row == n - 1:
                axes.set_xlabel(first.replace("[", "\n["), fontsize=8)
            if column == 0:
                axes.set_ylabel(second.replace("[", "\n["), fontsize=8)
    return figure


def plot_predictions(posterior: Any, width: float = WIDE) -> Figure:
    """Where measurements lie in leave-one-out predictions, less what calibrated ones would give.

    One curve a state dimension; the band is where those of independent measurements stay 99 times
    of 100.
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
    edge = _WORST_SHIFT / np.sqrt(max(fewest, 1.0)) if np.isfinite(fewest) else 0.0
    axes.axhspan(-edge, edge, color=BAND, zorder=0)
    axes.set_xlabel("position in the prediction: 0 below all draws, 1 above")
    axes.set_ylabel("share below, less expected")
    if handles:
        legend(figure, handles)
    return figure


def coverage(posterior: Any) -> dict[str, tuple[float, float, int]]:
    """Shares of measurements inside the central 50 % and 94 % of their predictions, and how many.

    Leave-one-out, by state dimension.
    """
    pit = loo_pit(posterior)
    result = {}
    for name in (str(state) for state in pit["state"].values):
        values = pit.sel(state=name).to_numpy()
        values = values[np.isfinite(values)]
        if values.size:
            off = np.abs(values - 0.5)
            result[name] = (float((off < 0.25).mean()), float((off < 0.47).mean()), values.size)
    return result


def pareto_k(posterior: Any) -> tuple[Array, float, str]:
    """Pareto k, the threshold above which it is bad, and what is left out at a time.

    Raises
    ------
    PosteriorError
        If ArviZ cannot say.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # of high k, which the result says
        try:
            loo = az.loo(separate(posterior), pointwise=True)
        except Exception as error:  # whatever it is, a report can do without
            raise PosteriorError(f"leave-one-out cross-validation: {error}") from error
    return np.asarray(loo.pareto_k, dtype=float).ravel(), float(loo.good_k), left_out(posterior)


def plot_pareto(k: Array, good: float, unit: str, width: float = WIDE) -> Figure:
    """Pareto k of every unit left out, and the threshold above which LOO is not to be relied on."""
    figure, (axes,) = blank_figure(width, 2.8, 1, 1)
    high = ~(k <= good)
    axes.axhline(good, color=BEFORE, linewidth=1.2, linestyle="--")
    axes.plot(np.flatnonzero(~high), k[~high], ".", color=AFTER, markersize=4)
    axes.plot(np.flatnonzero(high), np.nan_to_num(k[high], posinf=2.0), "x", color=BEFORE)
    axes.set_xlabel(unit)
    axes.set_ylabel("Pareto k")
    return figure


def _prior(posterior: Any) -> xr.Dataset:
    """One variable per scalar parameter of the prior, if the file holds draws of it."""
    if "prior" not in groups(posterior):
        return xr.Dataset()
    return scalars(from_groups({"posterior": group(posterior, "prior")}, {}))


def _grid(width: float, height: float, rows: int, columns: int) -> tuple[Figure, list[Any]]:
    """Small panels that stay side by side on a narrow figure."""
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _correlations(draws: xr.Dataset, names: Sequence[str]) -> Array:
    """Rank correlations, shape (parameter, parameter)."""
    table = pd.DataFrame({name: draws[name].to_numpy().ravel() for name in names})
    return np.asarray(table.corr("spearman"))
