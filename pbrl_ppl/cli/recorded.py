"""What a recording says of a scene that is yet to be written: its bodies and its clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pbrl_ppl.errors import HistoryError

if TYPE_CHECKING:
    import pandas as pd

#: Time steps may differ by so much of themselves (as in a history) before they are uneven.
_EVEN = 0.01


@dataclass(frozen=True)
class Recorded:
    """Names of the bodies in a recording, and its clock.

    Parameters
    ----------
    names : tuple of str
        In order of appearance.
    time_step : float
        Median time between a body's rows (s), to six digits.
    even : bool
        Whether all are that long.
    velocities : bool
        Whether it has columns of velocities.
    """

    names: tuple[str, ...]
    time_step: float
    even: bool
    velocities: bool


def recorded(
    path: Path,
    columns: Mapping[str, str | float],
    units: Mapping[str, str],
    given: Sequence[str] = (),
) -> Recorded:
    """Read the names of bodies and the time step off a recording.

    Parameters
    ----------
    path : Path
        The recording.
    columns, units : mapping of str
        As of `History.load`.
    given : sequence of str
        Names of bodies from options, for a recording that names none.

    Raises
    ------
    HistoryError
        If it cannot be read, names no body, or its times do not rise.
    """
    import numpy as np
    import pandas as pd

    from pbrl_ppl.history import as_history, read_table
    from pbrl_ppl.scene import Body, Scene, Shape

    frame = read_table(path, columns)
    names = _names(frame, columns) or list(given)
    if not names:
        raise HistoryError(
            f"history {path}: no column has the bodies' names; give --body NAME=SHAPE for one body,"
            " --columns body=COLUMN, or --columns NAME.x=COLUMN,... for bodies side by side"
        )
    # read with the names, as later commands read it with the scene; the outline does not matter
    stand_in = Scene(time_step=1.0, bodies=tuple(Body(n, Shape.circle(1.0)) for n in names))
    table = as_history(frame, stand_in, f"history {path}", columns=columns, units=units)
    for name in ("trajectory", "body", "time"):
        if name not in table:
            raise HistoryError(
                f"history {path}: it has no column {name}; say which it is"
                f" (--columns {name}=COLUMN), or give --body and --time-step instead"
            )
    table["time"] = pd.to_numeric(table["time"], errors="coerce")
    steps = table.groupby(["trajectory", "body"])["time"].diff().dropna().to_numpy()
    step = float(np.median(steps)) if len(steps) else float("nan")
    if not step > 0:
        raise HistoryError(
            f"history {path}: its times do not rise from row to row of a body and trajectory;"
            " correct them, or give --body and --time-step instead"
        )
    return Recorded(
        tuple(names),
        float(f"{step:.6g}"),
        even=bool((np.abs(steps - step) <= _EVEN * step).all()),
        velocities=bool({"vx", "vy", "omega"} & set(table.columns)),
    )


def _names(frame: pd.DataFrame, columns: Mapping[str, str | float]) -> list[str]:
    """Names of bodies: of columns side by side, of a column of names, or one for all rows."""
    beside = dict.fromkeys(key.rpartition(".")[0] for key in columns if "." in key)
    column = columns.get("body", "body")
    if beside:
        return list(beside)
    if column in frame:
        texts = (str(name).strip() for name in frame[column].dropna().unique())
        return [text for text in texts if text]
    return [column] if isinstance(column, str) and "body" in columns else []
