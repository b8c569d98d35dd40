"""Plots of a closed loop: candidates, held-out errors, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from pbrl_ppl.criticism import Loop, diverged_after
from pbrl_ppl.reporting import style
from pbrl_ppl.reporting.residual_force import ForceLaw, bin_means
from pbrl_ppl.reporting.words import error, plain, quantity
from pbrl_ppl.state import Floats

T = TypeVar("T")

#: Below this identifiable share a candidate is marked as hardly identifiable.
HARDLY = 0.01
#: Bars of candidates, at most; the report's table has all.
MOST_CANDIDATES = 20


def plot_candidates(loop: Loop, level: float = 0.01) -> Figure:
    """Plot the score of the candidates, best on top, with the threshold of each at a level."""
    added = {(addition.effect, addition.body) for addition in loop.added}
    rest = (c for c in loop.candidates[MOST_CANDIDATES:] if (c.effect, c.body) in added)
    shown = [*loop.candidates[:MOST_CANDIDATES], *rest]
    figure, (axes,) = style.blank_figure(0.9 + 0.3 * max(len(shown), 3), grid="x")
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
        height=0.7,
    )
    axes.plot(thresholds, range(len(shown)), "|", color=style.BEFORE, markersize=16, mew=2)
    if shown and max(candidate.statistic for candidate in shown) > 12 * max(thresholds):
        axes.set_xscale("symlog", linthresh=10.0)
        axes.xaxis.set_major_formatter("{x:g}")
    axes.margins(x=0.1)
    axes.set(xlim=(0.0, None), xlabel="score statistic of the effect")
    colours = {"added": style.AFTER, "not added": style.PLAIN}
    colours[f"{100 * level:g} % threshold"] = style.BEFORE
    style.legend(figure, style.patches(colours))
    return figure


def plot_laws(laws: Sequence[ForceLaw]) -> Figure:
    """Plot residual forces against the quantities that they depend on, with means and a curve."""
    figure, panels = style.blank_figure(3.6, len(laws), len(laws))
    for axes, law in zip(panels, laws, strict=True):
        axes.plot(law.x, law.residual.values, ".", color=style.PLAIN, markersize=3, alpha=0.6)
        bins = bin_means(law.x, law.residual.values)
        axes.errorbar(
            bins["centre"], bins["mean"], 2 * bins["error"].fillna(0.0), fmt="o",
            color=style.AFTER, markersize=4, linewidth=1.2, label="mean ± 2 se",
        )  # fmt: skip
        axes.axhline(0.0, color="black", linewidth=0.8, zorder=1)
        order = np.argsort(law.x)
        axes.plot(
            law.x[order], law.curve.values, color=style.BEFORE, linewidth=1.8, label="simple curve"
        )
        reach = 1.25 * float(np.quantile(np.abs(law.residual.values), 0.98))
        if reach > 0:  # a few far off would hide the rest
            axes.set_ylim(-reach, reach)
        x, force = f"{law.quantity} ({law.unit})".replace(" (1)", ""), law.residual
        y = f"{force.name}, {force.dimension} ({force.unit})" * (law is laws[0])
        axes.set(title=f"R² {max(law.curve.share, 0):.2f}", xlabel=x, ylabel=y)
    panels[0].legend(frameon=False, fontsize="small")
    return figure


def _models(loop: Loop, before: T, after: T) -> list[tuple[str, T, str]]:
    """Return name, values and colour of the models to show: one, or before and after."""
    if not loop.added:
        return [("declared model", before, style.AFTER)]
    return [("before", before, style.BEFORE), ("after", after, style.AFTER)]


def plot_errors(loop: Loop) -> Figure:
    """Plot held-out errors one step ahead and at the end of a rollout, before and after."""
    titles = {
        "one_step_rmse": "one step ahead",
        "rollout_rmse": f"{loop.forecasts.horizon} steps ahead",
    }
    kinds = [kind for kind in titles if getattr(loop.before, kind)]
    height = 1.2 + 0.42 * max((len(getattr(loop.before, kind)) for kind in kinds), default=1)
    count = max(len(kinds), 1)
    figure, panels = style.blank_figure(height, count, count, "x")
    for axes, kind in zip(panels, kinds, strict=False):
        before, after, floor = (
            getattr(e, kind) for e in (loop.before, loop.after, loop.noise_floor)
        )
        models = _models(loop, before, after)
        for i, (_, values, colour) in enumerate(models):
            found = [(values.get(d, np.nan), floor.get(d) or np.nan, d) for d in before]
            texts = [error(v) if np.isinf(v) else quantity(v, style.UNITS[d]) for v, _, d in found]
            shown = [float(np.nan_to_num(v / least, posinf=0.0)) for v, least, _ in found]
            shift = 0.38 * (i - (len(models) - 1) / 2)
            style.bars(axes, list(before), shown, colour, texts, shift=shift, height=0.36)
        axes.axvline(1.0, color="black", linewidth=1.0, linestyle=":")
        axes.margins(x=0.3)
        axes.set(title=titles[kind], xlabel="error / noise floor", xlim=(0.0, None))
    colours = {name: colour for name, _, colour in _models(loop, 0, 0)}
    style.legend(figure, style.patches(colours))
    return figure


def plot_rollout(loop: Loop) -> Figure:
    """Plot one held-out trajectory: measured, and predicted before and after."""
    rollout = loop.forecasts.rollout
    count = len(rollout.names)
    figure, panels = style.blank_figure(1.9, count, min(count, 2), spare=0.8)
    for place, (name, unit) in enumerate(zip(rollout.names, rollout.units, strict=True)):
        axes, measured = panels[place], rollout.measured[:, place]
        if unit == "rad":
            measured = unwrap(measured)
        axes.plot(rollout.time, measured, "o", color="black", markersize=2.5, label="measured")
        seen = measured[np.isfinite(measured)]
        for which, values, colour in _models(loop, rollout.before, rollout.after):
            line = values[:, place]
            if unit == "rad":
                line = _beside(unwrap(line), measured)
            dashes = "--" if which == "before" else "-"
            axes.plot(rollout.time, line, dashes, color=colour, linewidth=1.6, label=which)
            end = diverged_after(rollout.time, values)
            if end is None:
                seen = np.r_[seen, line]
            else:
                note, y = f"{which}: diverged after {end:.3g} s", 0.88 - 0.11 * len(axes.texts)
                axes.text(0.98, y, note, color=colour, transform=axes.transAxes, ha="right")
        if axes.texts and seen.size:  # a line that diverges leaves the panel
            spare = 0.5 * float(np.ptp(seen)) or 1.0
            axes.set_ylim(float(seen.min()) - spare, float(seen.max()) + spare)
        axes.set_ylabel(f"{name} ({unit})")
    figure.supxlabel("time (s)", fontsize=9)
    style.legend(figure, panels[0].lines)
    return figure


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
