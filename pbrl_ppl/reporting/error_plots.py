"""Plots of errors: held-out residuals, errors, rollouts, correlations and growth."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from cycler import cycler
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.stats import norm

from pbrl_ppl.criticism import Loop, diverged_after
from pbrl_ppl.posterior import HDI_PROB
from pbrl_ppl.reporting import style
from pbrl_ppl.state import Floats

T = TypeVar("T")


def _models(loop: Loop, before: T, after: T) -> list[tuple[str, T, str]]:
    """Return name, values and colour of the models to show: one, or before and after."""
    if not loop.added:
        return [("declared model", before, style.AFTER)]
    return [("before", before, style.BEFORE), ("after", after, style.AFTER)]


def plot_residuals(loop: Loop, width: float = style.WIDE) -> Figure:
    """Plot held-out residuals of each state dimension in units of noise, before and after."""
    names = list(loop.declared.residuals)
    figure, (axes,) = style.blank_figure(width, 3.6)
    edge = float(norm.ppf(0.5 + HDI_PROB / 2))
    axes.axhspan(-edge, edge, color=style.BAND, zorder=0)
    style.zero_line(axes)
    models = _models(loop, loop.declared.residuals, loop.revised.residuals)
    largest = 0.0
    for i, (_, residuals, colour) in enumerate(models):
        for where, name in enumerate(names):
            place = where + 0.36 * (i - (len(models) - 1) / 2)
            values = np.asarray(residuals[name], dtype=float)
            values = values[np.isfinite(values)]
            if values.size < len(residuals[name]):
                style.label(axes, "diverged", (place, 0.0), color=colour)
            if not values.size:
                continue
            largest = max(largest, float(np.abs(values).max()))
            some = values[:: max(1, values.size // 300)]
            # spread sideways by a sequence that is even and the same on every run
            aside = (np.arange(some.size) * 0.618 % 1 - 0.5) * 0.24
            axes.plot(place + aside, some, ".", color=colour, alpha=0.25, markersize=3)
            ends = np.quantile(values, [0.5 - HDI_PROB / 2, 0.5 + HDI_PROB / 2])
            axes.plot([place] * 2, ends, color=colour, linewidth=3)
    if largest > 12:
        axes.set_yscale("asinh", linear_width=4.0)
        ticks = [tick for tick in (3, 10, 30, 100, 300, 1000) if tick <= largest]
        ticks = [*(-tick for tick in reversed(ticks)), 0, *ticks]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_yticks([], minor=True)
    axes.set_xticks(range(len(names)), names)
    axes.set_ylabel("residual / noise")
    handles: list[Artist] = [Line2D([], [], color=c, linewidth=3, label=n) for n, _, c in models]
    handles.append(Patch(color=style.BAND, label=f"noise alone, {100 * HDI_PROB:.0f} %"))
    style.legend(figure, handles)
    return figure


def plot_errors(loop: Loop, width: float = style.WIDE) -> Figure:
    """Plot held-out errors one step ahead and at the end of a rollout, before and after."""
    titles = {
        "one_step_rmse": "one step ahead",
        "rollout_rmse": f"{loop.forecasts.horizon} steps ahead",
    }
    kinds = [kind for kind in titles if getattr(loop.before, kind)]
    height = 1.2 + 0.42 * max((len(getattr(loop.before, kind)) for kind in kinds), default=1)
    figure, panels = style.blank_figure(width, height, max(len(kinds), 1), max(len(kinds), 1), "x")
    for axes, kind in zip(panels, kinds, strict=False):
        before, after, floor = (
            getattr(e, kind) for e in (loop.before, loop.after, loop.noise_floor)
        )
        has_floor = all(np.isfinite(floor.get(d, np.nan)) and floor[d] > 0 for d in before)
        scale = floor if has_floor else {d: e if np.isfinite(e) else 1.0 for d, e in before.items()}
        models = _models(loop, before, after)
        for i, (_, values, colour) in enumerate(models):
            found = {d: values.get(d, np.nan) for d in before}
            shown = [np.nan_to_num(v / (scale[d] or np.nan), posinf=0.0) for d, v in found.items()]
            texts = [
                "diverged"
                if np.isinf(v)
                else f"{v:.3g} {style.UNITS.get(d, '')}" * bool(np.isfinite(v))
                for d, v in found.items()
            ]
            shift = 0.38 * (i - (len(models) - 1) / 2)
            style.bars(axes, list(before), shown, colour, texts, shift=shift, height=0.36)
        axes.axvline(1.0, color="black", linewidth=1.0, linestyle=":")
        axes.margins(x=0.3)
        axes.set_xlim(left=0.0)
        scaled_by = "noise floor" if has_floor else "error before"
        style.name_axes(axes, titles[kind], f"error / {scaled_by}")
    handles = [Patch(color=colour, label=name) for name, _, colour in _models(loop, 0, 0)]
    style.legend(figure, handles)
    return figure


def plot_rollout(loop: Loop, width: float = style.WIDE) -> Figure:
    """Plot one held-out trajectory: measured, and predicted before and after."""
    rollout = loop.forecasts.rollout
    count = len(rollout.names)
    columns = min(count, 2)
    figure, panels = style.blank_figure(width, 1.9, count, columns, spare=0.8)
    for place, (name, unit) in enumerate(zip(rollout.names, rollout.units, strict=True)):
        axes, measured = panels[place], rollout.measured[:, place]
        if unit == "rad":
            measured = unwrap(measured)
        axes.plot(rollout.time, measured, "o", color="black", markersize=2.5, label="measured")
        notes = [("black", _measured_until(rollout.time, measured))]
        shown, models = [measured], _models(loop, rollout.before, rollout.after)
        for which, values, colour in models:
            line = values[:, place]
            if unit == "rad":
                line = _beside(unwrap(line), measured)
            dashes = "--" if which == "before" else "-"
            axes.plot(rollout.time, line, dashes, color=colour, linewidth=1.6, label=which)
            end = diverged_after(rollout.time, values)
            if end is None:
                shown.append(line)
            else:
                notes.append((colour, f"{which}: diverged after {end:.3g} s"))
        seen = np.concatenate(shown)
        seen = seen[np.isfinite(seen)]
        if len(shown) <= len(models) and seen.size:  # a line that diverges leaves the panel
            spare = 0.5 * float(np.ptp(seen)) or 1.0
            axes.set_ylim(float(seen.min()) - spare, float(seen.max()) + spare)
        for i, (colour, text) in enumerate(note for note in notes if note[1]):
            axes.text(
                0.98, 0.97 - 0.11 * i, text, color=colour, transform=axes.transAxes, ha="right",
                va="top", fontsize=8, bbox=style.BOX,
            )  # fmt: skip
        axes.set_ylabel(f"{name} ({unit})")
        if place >= count - columns:
            axes.set_xlabel("time (s)")
    style.legend(figure, panels[0].lines)
    return figure


def _measured_until(time: Floats, measured: Floats) -> str:
    """Say where measurements end before the curve does; empty if they do not."""
    seen = np.flatnonzero(np.isfinite(measured))
    if not seen.size:
        return "not measured"
    last = seen[-1]
    return "" if last + 1 == len(time) else f"not measured after {time[last]:.3g} s"


def unwrap(angle: Floats) -> Floats:
    """Return angles (rad) without jumps of a turn, shape (time,); NaN stays NaN."""
    result = np.array(angle, dtype=float)
    seen = np.isfinite(result)
    result[seen] = np.unwrap(result[seen])
    return result


def _beside(line: Floats, measured: Floats) -> Floats:
    """Return a line of angles, moved by whole turns to start beside the measurement."""
    both = np.flatnonzero(np.isfinite(line) & np.isfinite(measured))
    if not both.size:
        return line
    turns = np.round((measured[both[0]] - line[both[0]]) / (2 * np.pi))
    return np.asarray(line + 2 * np.pi * turns)


def plot_correlations(loop: Loop, width: float = style.WIDE, most: int = 4) -> Figure:
    """Plot correlations of errors with earlier errors and with commands; name the largest.

    Noise alone puts any curve of a panel outside the band once in 100 times.
    """
    found = loop.misfit.correlations
    pairs = found.pairs[found.pairs > 1].min(initial=found.pairs.max(initial=1))  # the fewest
    panels_of = {"with itself": (found.own, 1, pairs, list(found.cells))}
    if found.commands:
        names = [f"{c}, {u.replace('_', ' ')}" for u in found.commands for c in found.cells]
        driven = found.driven.reshape(len(found.driven), -1)
        panels_of["with commands"] = (driven, 0, found.pairs.max(initial=1), names)
    figure, panels = style.blank_figure(width, 3.2, len(panels_of), len(panels_of))
    for axes, (title, (values, first, size, names)) in zip(panels, panels_of.items(), strict=True):
        edge = norm.isf(0.01 / 2 / max(values.size, 1)) / np.sqrt(max(size, 1))
        axes.axhspan(-edge, edge, color=style.BAND, zorder=0)
        style.zero_line(axes)
        largest, lags = np.abs(values).max(axis=0), np.arange(first, len(values) + first)
        shown = [i for i in np.argsort(-largest) if largest[i] > edge][:most]
        for i in (i for i in range(values.shape[1]) if i not in shown):
            axes.plot(lags, values[:, i], ".-", color=style.PLAIN, linewidth=0.7, markersize=4)
        for i in shown:
            axes.plot(lags, values[:, i], ".-", linewidth=1.6, markersize=7, label=names[i])
        if shown:
            axes.legend(frameon=False, fontsize="small")
        top = max(1.3 * edge, 1.1 * largest.max())
        axes.set(ylim=(-top, top), xticks=lags)
        style.name_axes(
            axes, title, "intervals before", "correlation of errors" * (axes is panels[0])
        )
    return figure


def plot_growth(loop: Loop, width: float = style.WIDE) -> Figure:
    """Plot errors of forecasts over their length, as multiples of the error from noise alone."""
    growth = loop.misfit.growth
    figure, (axes,) = style.blank_figure(width, 3.2)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_prop_cycle(style.LINES + cycler(marker=list("ooss^^")))
    for name in (name for name, size in growth.floor[-1].items() if size > 0):
        ratio = [
            error.get(name, np.nan) / (floor.get(name) or np.nan)
            for error, floor in zip(growth.error, growth.floor, strict=True)
        ]
        ended, why = np.flatnonzero(~np.isfinite(ratio)), ""
        if ended.size:
            said = "diverged" if np.isinf(ratio[ended[0]]) else "not measured"
            why = f" ({said} at {growth.seconds[ended[0]]:.3g} s)"
        axes.plot(growth.seconds, ratio, label=f"{name}{why}")
    axes.set(xlabel="length of the forecast (s)", ylabel="error / noise alone")
    top = axes.get_ylim()[1]
    if top > 10:
        axes.set_yscale("log")
    else:
        axes.set_ylim(0.0, max(2.0, top))
    axes.legend(frameon=False, ncols=3, fontsize="small")
    return figure
