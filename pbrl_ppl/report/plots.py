"""Pictures of findings; the only place that draws, and every function returns a Figure."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import arviz as az
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.stats import binom, chi2, gaussian_kde, norm

from pbrl_ppl.calibration import Calibration, bins
from pbrl_ppl.criticism import Findings, PriorCheck
from pbrl_ppl.effects import catalogue
from pbrl_ppl.posterior import DATATREE, HDI_PROB, scalars
from pbrl_ppl.state import STATE, STATE_UNITS

Array = NDArray[np.float64]

#: Unit of each state dimension.
UNITS: Mapping[str, str] = dict(zip(STATE, STATE_UNITS, strict=True))
#: Candidates are called significant below this corrected p-value.
LEVEL = 0.01
#: Below this identifiable share a candidate is marked as hardly identifiable.
HARDLY = 0.01
#: Bars and parameters in one picture, at most; the report's tables show all.
MOST_CANDIDATES, MOST_PARAMETERS = 20, 6

# Okabe and Ito's colours: told apart by colour-blind readers and in grey print
_BEFORE, _AFTER, _PLAIN, _BAND = "#D55E00", "#0072B2", "#999999", "#e9e9e9"


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


def plot_residuals(findings: Findings) -> Figure:
    """Held-out residuals of each state dimension before and after, in units of noise."""
    names = list(findings.residuals_before)
    figure, (axes,) = _figure(8.0, 3.6, 1, 1)
    edge = float(norm.ppf(0.5 + HDI_PROB / 2))
    axes.axhspan(-edge, edge, color=_BAND, zorder=0)
    axes.axhline(0.0, color="black", linewidth=0.8, zorder=1)
    shown = [(findings.residuals_before, _BEFORE, "before", -0.18)]
    if findings.added:
        shown.append((findings.residuals_after, _AFTER, "after", 0.18))
    else:
        shown = [(findings.residuals_before, _AFTER, "declared model", 0.0)]
    largest = 0.0
    for residuals, colour, _, shift in shown:
        for place, name in enumerate(names):
            values = np.asarray(residuals[name], dtype=float)
            values = values[np.isfinite(values)]
            if not values.size:
                continue
            largest = max(largest, float(np.abs(values).max()))
            some = values[:: max(1, values.size // 300)]
            # spread sideways by a sequence that is even and the same on every run
            aside = (np.arange(some.size) * 0.618 % 1 - 0.5) * 0.24
            axes.plot(place + shift + aside, some, ".", color=colour, alpha=0.25, markersize=3)
            low, high = np.quantile(values, [0.5 - HDI_PROB / 2, 0.5 + HDI_PROB / 2])
            axes.plot([place + shift] * 2, [low, high], color=colour, linewidth=3)
    if largest > 12:
        axes.set_yscale("asinh", linear_width=4.0)
        ticks = [tick for tick in (3, 10, 30, 100, 300, 1000) if tick <= largest]
        ticks = [*(-tick for tick in reversed(ticks)), 0, *ticks]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_yticks([], minor=True)
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("residual / noise")
    handles: list[Any] = [Line2D([], [], color=c, linewidth=3, label=n) for _, c, n, _ in shown]
    handles.append(Patch(color=_BAND, label=f"noise alone, {100 * HDI_PROB:.0f} %"))
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
    return figure


def plot_candidates(findings: Findings) -> Figure:
    """Score statistic of the candidates, best on top, with the threshold of each."""
    added = {(one.effect, one.body) for one in findings.added}
    shown = [
        one
        for place, one in enumerate(findings.candidates)
        if place < MOST_CANDIDATES or (one.effect, one.body) in added
    ]
    figure, (axes,) = _figure(8.0, 0.9 + 0.3 * max(len(shown), 3), 1, 1, grid="x")
    several = len({one.body for one in shown}) > 1
    total = max(len(findings.candidates), 1)
    thresholds = [float(chi2.isf(LEVEL / total, one.dof)) for one in shown]
    for place, (one, threshold) in enumerate(zip(shown, thresholds, strict=True)):
        hardly = one.identifiable < HARDLY
        is_added = (one.effect, one.body) in added
        axes.barh(
            place,
            one.statistic,
            height=0.7,
            color=_AFTER if is_added else _PLAIN,
            edgecolor="white",
            hatch="////" if hardly else None,
        )
        axes.plot([threshold] * 2, [place - 0.45, place + 0.45], color=_BEFORE, linewidth=2)
        axes.annotate(
            f"{one.statistic:.3g}{', hardly identifiable' if hardly else ''}",
            (one.statistic, place),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )
    if shown and max(one.statistic for one in shown) > 12 * max(thresholds):
        axes.set_xscale("asinh", linear_width=5.0)
    labels = [f"{plain(one.effect)}{f' · {one.body}' if several else ''}" for one in shown]
    axes.set_yticks(range(len(shown)), labels)
    axes.margins(x=0.1)
    axes.set_xlim(left=0.0)
    axes.invert_yaxis()
    axes.set_xlabel("score statistic: how strongly the residual asks for the effect")
    handles: list[Any] = [
        Patch(color=_AFTER, label="added"),
        Patch(color=_PLAIN, label="not added"),
        Patch(facecolor=_PLAIN, edgecolor="white", hatch="////", label="hardly identifiable"),
        Line2D([], [], color=_BEFORE, linewidth=2, label="1 % threshold"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    return figure


def plot_rollout(findings: Findings) -> Figure:
    """One held-out trajectory: measured, and predicted before and after."""
    rollout = findings.rollout
    count = len(rollout.names)
    columns = 1 if count == 1 else 2
    rows = -(-count // columns)
    figure, panels = _figure(8.0, 0.8 + 1.9 * rows, rows, columns)
    lines: list[tuple[Array, str, Literal["-", "--"], str]] = [
        (rollout.before, _BEFORE, "--", "before"),
        (rollout.after, _AFTER, "-", "after"),
    ]
    if not findings.added:
        lines = [(rollout.before, _AFTER, "-", "predicted by the declared model")]
    for place, (name, unit) in enumerate(zip(rollout.names, rollout.units, strict=True)):
        axes = panels[place]
        measured = rollout.measured[:, place]
        if unit == "rad":
            measured = unwrap(measured)
        axes.plot(rollout.time, measured, "o", color="black", markersize=2.5)
        for values, colour, style, _ in lines:
            line = values[:, place]
            if unit == "rad":
                line = _beside(unwrap(line), measured)
            axes.plot(rollout.time, line, style, color=colour, linewidth=1.6)
        axes.set_ylabel(f"{name} ({unit})")
        if place >= count - columns:
            axes.set_xlabel("time (s)")
    for axes in panels[count:]:
        axes.set_visible(False)
    handles = [Line2D([], [], color="black", marker="o", linestyle="", markersize=3)]
    handles += [Line2D([], [], color=c, linestyle=s) for _, c, s, _ in lines]
    names = ["measured", *(name for *_, name in lines)]
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False)
    return figure


def plot_added(findings: Findings) -> Figure:
    """Posterior of every parameter of the added effects, with the value that means no effect."""
    shown = [
        (one, name, estimate) for one in findings.added for name, estimate in one.parameters.items()
    ][: 2 * MOST_PARAMETERS]
    columns = min(max(len(shown), 1), 2)
    rows = max(-(-len(shown) // columns), 1)
    figure, panels = _figure(8.0 if columns > 1 else 5.0, 2.6 * rows, rows, columns, grid="x")
    draws = scalars(findings.posterior_after)
    nulls = {(effect.name, p.name): p.null for effect in catalogue for p in effect.parameters}
    for axes, (one, name, estimate) in zip(panels, shown, strict=False):
        low, high = estimate.hdi
        variable = f"{one.effect}_{name}[{one.body}]"
        top = 1.0
        if variable in draws:
            values = draws[variable].to_numpy().ravel()
            if np.ptp(values) > 0:
                grid = np.linspace(values.min(), values.max(), 300)
                density = gaussian_kde(values)(grid)
                top = float(density.max())
                axes.plot(grid, density, color=_AFTER)
                inside = (grid >= low) & (grid <= high)
                axes.fill_between(grid[inside], density[inside], color=_AFTER, alpha=0.25)
        axes.plot([low, high], [-0.06 * top] * 2, color=_AFTER, linewidth=4, solid_capstyle="butt")
        axes.plot(estimate.mean, -0.06 * top, "o", color="white", markeredgecolor=_AFTER)
        null = nulls.get((one.effect, name))
        if null is not None:
            _mark_null(axes, null, estimate.mean, max(estimate.sd, 1e-12), top)
        axes.set_ylim(-0.14 * top, 1.15 * top)
        axes.set_yticks([])
        axes.set_title(f"{plain(one.effect)} on {one.body}", fontsize=10)
        axes.set_xlabel(f"{plain(name)} ({estimate.unit})")
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    return figure


def plot_errors(findings: Findings) -> Figure:
    """Held-out errors before and after, one step ahead and at the end of a rollout."""
    kinds = [
        ("one_step_rmse", "one step ahead"),
        ("rollout_rmse", f"{findings.rollout_horizon} steps ahead"),
    ]
    kinds = [(kind, title) for kind, title in kinds if getattr(findings.before, kind)]
    names = [list(getattr(findings.before, kind)) for kind, _ in kinds]
    height = 1.2 + 0.42 * max((len(each) for each in names), default=1)
    figure, panels = _figure(8.0, height, 1, max(len(kinds), 1), grid="x")
    for axes, (kind, title), dims in zip(panels, kinds, names, strict=False):
        before, after, floor = (
            getattr(e, kind) for e in (findings.before, findings.after, findings.noise_floor)
        )
        has_floor = all(np.isfinite(floor.get(d, np.nan)) and floor[d] > 0 for d in dims)
        scale = floor if has_floor else before
        bars = [(before, _BEFORE, -0.19), (after, _AFTER, 0.19)]
        if not findings.added:
            bars = [(before, _AFTER, 0.0)]
        for values, colour, shift in bars:
            for place, dim in enumerate(dims):
                value = values.get(dim, np.nan)
                if not np.isfinite(value) or not scale[dim] > 0:
                    continue
                axes.barh(place + shift, value / scale[dim], height=0.36, color=colour)
                axes.annotate(
                    f"{value:.3g} {UNITS.get(dim, '')}",
                    (value / scale[dim], place + shift),
                    xytext=(3, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=7.5,
                )
        axes.axvline(1.0, color="black", linewidth=1.0, linestyle=":")
        axes.set_yticks(range(len(dims)), dims)
        axes.invert_yaxis()
        axes.margins(x=0.3)
        axes.set_xlim(left=0.0)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("error / noise floor" if has_floor else "error / error before")
    labels = ["before", "after"] if findings.added else ["declared model"]
    colours = [_BEFORE, _AFTER] if findings.added else [_AFTER]
    handles = [Patch(color=c, label=n) for c, n in zip(colours, labels, strict=True)]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure


def plot_prior_check(check: PriorCheck) -> Figure:
    """Measured changes of state over a segment beside those that the prior predicts."""
    bodies, states = check.dataset["body"].values, check.dataset["state"].values
    rows = len(bodies) * -(-len(states) // 2)
    figure, panels = _figure(8.0, 0.8 + 1.3 * rows, rows, 2, grid="x")
    pairs = [(body, state) for body in bodies for state in states]
    for axes, (body, state) in zip(panels, pairs, strict=False):
        one = check.dataset.sel(body=body, state=state)
        for place, (name, colour) in enumerate((("predicted", _PLAIN), ("measured", _AFTER))):
            low, lower, middle, upper, high = one[name].to_numpy()
            axes.plot([low, high], [place] * 2, color=colour, linewidth=2)
            axes.plot([lower, upper], [place] * 2, color=colour, linewidth=7)
            axes.plot(middle, place, "o", color="white", markeredgecolor=colour)
        axes.set_yticks([0, 1], ["prior", "measured"])
        axes.set_ylim(1.6, -0.6)
        share = float(one["share_inside"])
        axes.set_title(f"{state} of {body}: {100 * share:.0f} % as expected", fontsize=9)
        axes.set_xlabel(f"change in {check.seconds:g} s ({UNITS[str(state)]})", fontsize=8)
    for axes in panels[len(pairs) :]:
        axes.set_visible(False)
    return figure


def most_interesting(findings: Findings, table: pd.DataFrame | None = None) -> list[str]:
    """Parameters to look at first: those of added effects, then the worst by R-hat.

    Parameters
    ----------
    findings : Findings
        The posterior after revision is looked at.
    table : pandas.DataFrame, optional
        Its :func:`summary`, where that is at hand.
    """
    table = summary(findings.posterior_after) if table is None else table
    own = [f"{one.effect}_{name}[{one.body}]" for one in findings.added for name in one.parameters]
    worst = table["r_hat"].fillna(np.inf).sort_values(ascending=False, kind="stable").index
    return list(dict.fromkeys([*(n for n in own if n in table.index), *worst]))[:MOST_PARAMETERS]


def plot_trace(findings: Findings, parameters: Sequence[str] | None = None) -> Figure:
    """ArviZ's trace of the parameters of most interest, after revision."""
    return _arviz(findings, "trace", parameters)


def plot_rank(findings: Findings, parameters: Sequence[str] | None = None) -> Figure:
    """ArviZ's rank picture of the parameters of most interest, after revision."""
    return _arviz(findings, "rank", parameters)


def plot_calibration(calibration: Calibration) -> Figure:
    """Rank histograms of a simulation-based calibration, one panel a parameter.

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
    figure, panels = _figure(2.6 * columns, 1.7 * rows + 0.6, rows, columns)
    count = bins(n)
    low, high = binom.interval(0.99, n, 1 / count)
    for axes, (label, row) in zip(panels, table.iterrows(), strict=False):
        axes.axhspan(low, high, color=_BAND)
        axes.axhline(n / count, color=_PLAIN, linewidth=1)
        color = _AFTER if row["passed"] else _BEFORE
        axes.hist(
            positions.sel(parameter=label), bins=count, range=(0, 1), histtype="step", color=color
        )
        verdict = "" if row["passed"] else ", failed"
        axes.set_title(f"{label}: p = {row['p_holm']:.2g}{verdict}", fontsize=9, color=color)
        axes.set_ylim(bottom=0)
    for axes in panels[len(table) :]:
        axes.set_axis_off()
    figure.supxlabel("rank of the true value among posterior draws, as a share", fontsize=9)
    figure.supylabel("replications", fontsize=9)
    return figure


def _arviz(findings: Findings, kind: str, parameters: Sequence[str] | None) -> Figure:
    names = most_interesting(findings) if parameters is None else list(parameters)
    draws = scalars(findings.posterior_after)[names]
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
            figure, panels = _figure(8.0, 0.6 + 1.5 * count, count, 2, grid=None)
            grid = np.array(panels, dtype=object).reshape(count, 2)
            az.plot_trace(draws, axes=grid, compact=False, trace_kwargs={"linewidth": 0.5})
        else:
            figure, panels = _figure(8.0, 0.6 + 2.0 * rows, rows, columns, grid=None)
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


def png(figure: Figure) -> bytes:
    """Render a figure as a PNG picture."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def plain(name: str) -> str:
    """Write a catalogue name as words."""
    return name.replace("_", " ")


def unwrap(angle: Array) -> Array:
    """Angles (rad) without jumps of a turn, shape (time,); NaN stays NaN."""
    result = np.array(angle, dtype=float)
    seen = np.isfinite(result)
    result[seen] = np.unwrap(result[seen])
    return result


def _beside(line: Array, measured: Array) -> Array:
    """Shift a line by whole turns so that it starts beside the measurement."""
    both = np.flatnonzero(np.isfinite(line) & np.isfinite(measured))
    if not both.size:
        return line
    turns = np.round((measured[both[0]] - line[both[0]]) / (2 * np.pi))
    return np.asarray(line + 2 * np.pi * turns)


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


def _figure(
    width: float, height: float, rows: int, columns: int, grid: Literal["x", "y"] | None = "y"
) -> tuple[Figure, list[Axes]]:
    """Return a figure that pyplot does not know of, and its panels row by row."""
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_axisbelow(True)
        if grid:
            axes.grid(axis=grid, color="#dddddd", linewidth=0.6)
    return figure, panels
