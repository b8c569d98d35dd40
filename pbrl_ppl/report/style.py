"""Style shared by all pictures: colours, panels, units, and their rendering as PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pbrl_ppl.state import STATE, STATE_UNITS

#: Unit of each state dimension.
UNITS: Mapping[str, str] = dict(zip(STATE, STATE_UNITS, strict=True))
# Okabe and Ito's colours: told apart by colour-blind readers and in grey print
BEFORE, AFTER, PLAIN, BAND = "#D55E00", "#0072B2", "#999999", "#e9e9e9"


def blank_figure(
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


def png(figure: Figure) -> bytes:
    """Render a figure as a PNG picture."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
