"""How the table of a history is to be read, where it is not one of the package's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict, Unpack

import pandas as pd

from pbrl_ppl.history.conversion import in_si, renamed
from pbrl_ppl.history.resampling import resampled
from pbrl_ppl.scene import Scene


class Reading(TypedDict, total=False):
    """Options of :meth:`History.load` for tables of others.

    Attributes
    ----------
    columns : mapping of str to str or float
        The table's own column names, ``{"x": "pos_x"}``, or a number that holds on all rows,
        ``{"force_x": 0.0}``; ``{"cart.x": "cart_px"}`` with several bodies in a row. Columns that
        are neither named here nor a history's are left out.
    units : mapping of str to str
        What columns are measured in, if not SI units: ``{"x": "mm", "theta": "deg"}``.
    resample : bool
        Whether uneven samples are interpolated every ``time_step`` of the scene, with a
        `ResamplingWarning` that says what this does to the noise.
    """

    columns: Mapping[str, str | float] | None
    units: Mapping[str, str] | None
    resample: bool


def as_history(
    frame: pd.DataFrame, scene: Scene, source: str, **reading: Unpack[Reading]
) -> pd.DataFrame:
    """Return a table as a history has it: names first, then units, then even steps."""
    if columns := reading.get("columns"):
        frame = renamed(frame, scene, columns, source)
    if units := reading.get("units"):
        frame = in_si(frame, units)
    return resampled(frame, scene, source) if reading.get("resample") else frame
