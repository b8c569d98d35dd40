"""Style shared by all pictures: colours, panels, units, and their rendering as PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from pbrl_ppl.state import STATE, STATE_UNITS

#: Unit of each state dimension.
UNITS: Mapping[str, str] = dict(zip(STATE, STATE_UNITS, strict=True))


def acceleration_unit(velocity: str) -> str:
    """Return the unit of the acceleration of a velocity such as ``vx`` or ``omega``."""
    return "rad/s²" if velocity == "omega" else "m/s²"


# Okabe and Ito's colours: distinct for colour-blind readers and in grey print
BEFORE, AFTER, PLAIN, BAND = "#D55E00", "#0072B2", "#999999", "#e9e9e9"
#: Widths of pictures (inches): of a page, and of a telephone, where panels are in one column.
WIDE, NARROW = 8.0, 4.2


def blank_figure(
    width: float,
    height: float,
    rows: int,
    columns: int,
    grid: Literal["x", "y"] | None = "y",
    *,
    count: int | None = None,
    stack: bool = True,
) -> tuple[Figure, list[Axes]]:
    """Return a figure outside pyplot, and its panels row by row.

    Parameters
    ----------
    width, height : float
        Size in inches. On a narrow figure all panels are stacked in one column, and the height
        grows with them, unless ``stack`` is false.
    rows, columns : int
        Panels.
    grid : str, optional
        Axis of the grid lines.
    count : int, optional
        Panels that are shown, if fewer than there are.
    """
    if stack and width <= NARROW and columns > 1:
        height, rows, columns = height * columns * 0.95, rows * columns, 1
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_axisbelow(True)
        if grid:
            axes.grid(axis=grid, color="#dddddd", linewidth=0.6)
    for axes in panels[count:] if count is not None else ():
        axes.set_visible(False)
    return figure, panels


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above all panels, in as many columns as there is room for."""
    wide = figure.get_figwidth() > NARROW
    figure.legend(
        handles=handles, loc="outside upper center", frameon=False,
        fontsize="medium" if wide else "small", ncols=len(handles) if wide else 2,
    )  # fmt: skip


def label(axes: Axes, text: str, at: tuple[float, float], **options: Any) -> None:
    """Write a label beside a point of the data, by default 4 points to its right."""
    how: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "fontsize": 8}
    axes.annotate(text, at, **how | options)


def png(figure: Figure, colours: int = 96) -> bytes:
    """Render a figure as a PNG picture, which a palette makes a third as large."""
    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=130 if figure.get_figwidth() > NARROW else 170)
    picture = Image.open(drawn).convert("RGB")
    picture = picture.quantize(colours, dither=Image.Dither.NONE)
    picture.save(small, format="png", optimize=True)
    return small.getvalue()
