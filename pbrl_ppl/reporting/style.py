"""What all pictures share: colours, panels, bars, densities, bands, and their rendering as PNG."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from cycler import cycler
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image
from scipy.stats import gaussian_kde

from pbrl_ppl.state import STATE, STATE_UNITS, Floats

#: Unit of each state dimension.
UNITS: Mapping[str, str] = dict(zip(STATE, STATE_UNITS, strict=True))

# Okabe and Ito's colours: distinct for colour-blind readers and in grey print
BEFORE, AFTER, PLAIN, BAND = "#D55E00", "#0072B2", "#999999", "#e9e9e9"
#: Lines of up to six state dimensions.
LINES = cycler(color=[BEFORE, AFTER] * 3, linestyle=["-", "-", "--", "--", ":", ":"])
#: Box behind a text, through which a line can be seen.
BOX = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
#: Widths of pictures (inches): of a page, and of a telephone, where panels are in one column.
WIDE, NARROW = 8.0, 4.2


def blank_figure(
    width: float,
    height: float,
    count: int = 1,
    columns: int = 1,
    grid: Literal["x", "y"] | None = "y",
    *,
    spare: float = 0.0,
    stack: bool = True,
) -> tuple[Figure, list[Axes]]:
    """Return a figure outside pyplot, and its panels row by row.

    Parameters
    ----------
    width, height : float
        Width of the figure and height of each row of panels (inches). On a narrow figure all panels
        are stacked in one column, and the height grows with them, unless ``stack`` is false.
    count, columns : int
        Panels that are shown, and panels side by side.
    grid : str, optional
        Axis of the grid lines.
    spare : float
        Height of the figure beside the rows (inches).
    """
    rows = -(-count // columns)
    height = spare + height * rows
    if stack and width <= NARROW and columns > 1:
        height, rows, columns = height * columns * 0.95, rows * columns, 1
    figure = Figure(figsize=(width, height), layout="constrained")
    look: Any = {
        "axes.labelsize": 9, "axes.spines.top": False, "axes.spines.right": False,
        "axes.axisbelow": True, "axes.grid": bool(grid), "axes.grid.axis": grid or "both",
        "grid.color": "#dddddd", "grid.linewidth": 0.6,
    }  # fmt: skip
    with rc_context(look):
        panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above all panels, in as many columns as there is room for."""
    wide = figure.get_figwidth() > NARROW
    figure.legend(
        handles=handles, loc="outside upper center", frameon=False,
        fontsize="medium" if wide else "small", ncols=len(handles) if wide else 2,
    )  # fmt: skip


def patches(colours: Mapping[str, str]) -> list[Patch]:
    """Return a legend's entries from colours by name."""
    return [Patch(color=colour, label=name) for name, colour in colours.items()]


def bars(
    axes: Axes,
    names: Sequence[str],
    values: Sequence[float],
    colours: str | Sequence[str],
    texts: Sequence[str],
    *,
    shift: float = 0.0,
    height: float = 0.8,
) -> None:
    """Draw horizontal bars from the top down, with their names, and a text beside each.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    names, values, colours, texts : sequence
        One a bar.
    shift : float
        Places by which the bars are lower than their names.
    height : float
        Of each bar, in places.
    """
    drawn = axes.barh(np.arange(len(names)) + shift, values, height, color=colours)
    axes.bar_label(drawn, texts, padding=3, fontsize=8, bbox=BOX)
    axes.set_yticks(range(len(names)), names)
    axes.yaxis.set_inverted(True)


def density(
    axes: Axes,
    values: Floats,
    colour: str,
    shown: tuple[float, float],
    filled: tuple[float, float],
) -> None:
    """Draw a density of height one, and fill a part of it; nothing if all values are equal.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    values : ndarray
        Draws, shape (draw,).
    colour : str
        Of the line and the filling.
    shown, filled : tuple of float
        Ends of the two intervals.
    """
    if np.ptp(values) > 0:
        # as many points where the density is narrow
        grid = np.r_[np.linspace(*shown, 200), np.quantile(values, np.linspace(0, 1, 100)), filled]
        grid = np.unique(np.clip(grid, *shown))
        height = gaussian_kde(values)(grid)
        height /= height.max()
        inside = (grid >= filled[0]) & (grid <= filled[1])
        axes.plot(grid, height, color=colour, linewidth=1.2)
        axes.fill_between(grid, height, where=inside, color=colour, alpha=0.3, linewidth=0)


def shares_below(axes: Axes, samples: Mapping[str, Floats], size: float) -> tuple[float, float]:
    """Plot the share of values below each quantile, less what an even spread gives.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    samples : mapping of str to ndarray
        Values between 0 and 1 of each curve, by its name.
    size : float
        Independent values a curve: even ones stay in the band 99 times of 100.

    Returns
    -------
    tuple of float
        Half the band's width, and the largest difference.
    """
    # Kolmogorov's distance times the root of the size, at 1 %
    edge, largest, grid = 1.63 / float(np.sqrt(max(size, 1.0))), 0.0, np.linspace(0.0, 1.0, 201)
    axes.axhspan(-edge, edge, color=BAND, zorder=0)
    for name, values in samples.items():
        off = np.searchsorted(np.sort(values), grid, side="right") / max(len(values), 1) - grid
        axes.plot(grid, off, linewidth=1.3, label=name)
        largest = max(largest, float(np.abs(off).max()))
    return edge, largest


def png(figure: Figure, colours: int = 96) -> bytes:
    """Render a figure as a PNG picture, which a palette makes a third as large."""
    figure.set_dpi(130 if figure.get_figwidth() > NARROW else 170)
    canvas: Any = FigureCanvasAgg(figure)
    small = io.BytesIO()
    with warnings.catch_warnings():
        # a name in letters that the font lacks is in the page's text all the same
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        canvas.draw()  # once: saving a figure draws it twice
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture = picture.quantize(colours, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    levels = picture.getpalette() or []
    picture.putpalette([255 if level > 251 else level for level in levels])  # means are not white
    picture.save(small, format="png")
    return small.getvalue()
