"""What all pictures share: colours, panels, bars, and their rendering as PNG."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from pbrl_ppl.state import STATE, STATE_UNITS

#: Unit of each state dimension.
UNITS: Mapping[str, str] = dict(zip(STATE, STATE_UNITS, strict=True))

# Okabe and Ito's colours: distinct for colour-blind readers and in grey print
BEFORE, AFTER, PLAIN, BAND = "#D55E00", "#0072B2", "#999999", "#e9e9e9"


def blank_figure(
    height: float,
    count: int = 1,
    columns: int = 1,
    grid: Literal["x", "y"] = "y",
    *,
    spare: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """Return a figure outside pyplot, 8 inches wide, and its panels row by row.

    Parameters
    ----------
    height : float
        Height of each row of panels (inches).
    count, columns : int
        Panels that are shown, and panels side by side.
    grid : str
        Axis of the grid lines.
    spare : float
        Height of the figure beside the rows (inches).
    """
    rows = -(-count // columns)
    figure = Figure(figsize=(8.0, spare + height * rows), layout="constrained")
    look: Any = {
        "axes.labelsize": 9, "axes.spines.top": False, "axes.spines.right": False,
        "axes.axisbelow": True, "axes.grid": True, "axes.grid.axis": grid,
        "grid.color": "#dddddd", "grid.linewidth": 0.6,
    }  # fmt: skip
    with rc_context(look):
        panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above all panels."""
    figure.legend(handles=handles, loc="outside upper center", frameon=False, ncols=len(handles))


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
    axes.bar_label(drawn, texts, padding=3, fontsize=8)
    axes.set_yticks(range(len(names)), names)
    axes.yaxis.set_inverted(True)


def png(figure: Figure, colours: int = 96) -> bytes:
    """Render a figure as a PNG picture, which a palette makes a third as large."""
    figure.set_dpi(130)
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
