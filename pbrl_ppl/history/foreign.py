"""Tables from WPILib's SysId (JSON) and from MATLAB (.mat)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError, printable
from pbrl_ppl.files import check_survives, reason
from pbrl_ppl.history.files import reads
from pbrl_ppl.scene import Recording
from pbrl_ppl.state import Floats

#: Columns of SysId's rows by their number: one mechanism, and a drivetrain.
_SYSID = {
    4: ("time", "voltage", "position", "velocity"),
    9: ("time", "left voltage", "right voltage", "left position", "right position",
        "left velocity", "right velocity", "angle", "angular rate"),
}  # fmt: skip
_SYSID_UNITS = {"meters": "m", "feet": "ft", "inches": "in", "radians": "rad", "degrees": "deg",
                "rotations": "rev"}  # fmt: skip


@reads(".json")
def read_sysid(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of a WPILib SysId log, with the name of each test as ``trajectory``.

    Columns are ``time``, ``voltage``, ``position`` and ``velocity``, or those of a drivetrain's two
    sides with ``angle`` and ``angular rate``. The log's units are kept.

    Raises
    ------
    HistoryError
        If the file is no such log.
    """
    try:
        log: dict[str, object] = json.loads(path.read_bytes())
        tests = {k: np.array(v, float) for k, v in log.items() if isinstance(v, list) and v}
        (width,) = {rows.shape[1] for rows in tests.values()}
        names = _SYSID[width]
        if any(printable(k) != k for k in tests):
            raise ValueError
    except (ValueError, KeyError, AttributeError, IndexError, TypeError, RecursionError):
        raise HistoryError(
            f"history {path}: not a log of WPILib's SysId; expected an object with rows of 4 or 9"
            ' numbers for each test, such as "fast-forward"; save other JSON as CSV'
        ) from None
    parts = [pd.DataFrame(rows, columns=names).assign(trajectory=k) for k, rows in tests.items()]
    frame: pd.DataFrame = pd.concat(parts, ignore_index=True)
    unit = _SYSID_UNITS.get(str(log.get("units", "")).lower(), "")
    of_rates = {"voltage": "V", "rate": "rad/s", "angle": "rad"}
    units = {name: of_rates.get(name.split()[-1], unit) for name in names[1:]}
    units |= {name: f"{unit}/s" for name in names if name.endswith("velocity") and unit}
    frame.attrs["units"] = {name: text for name, text in units.items() if text}
    return frame


@reads(".mat")
def read_mat(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the vectors of a MATLAB file that are as long as most, a column each.

    Fields of structures have their path as names, ``log.theta``; columns of matrices their number,
    ``pos[0]``.

    Raises
    ------
    HistoryError
        If the file cannot be read, or has no vectors.
    """
    from scipy.io import loadmat

    with path.open("rb") as file:
        try:
            check_survives(path, "import sys, scipy.io; scipy.io.loadmat(sys.argv[1])")
            content = loadmat(file, squeeze_me=True, simplify_cells=True)
        except Exception as error:  # damaged files raise errors of many kinds
            cure = 'save it from MATLAB with "-v7", or as CSV'
            why = reason(error)
            raise HistoryError(f"history {path}: not a MATLAB file ({why}); {cure}") from None
    columns: dict[str, Floats] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _add_vectors(columns, name, value)
    lengths = [len(column) for column in columns.values()]
    if not lengths:
        raise HistoryError(f"history {path}: it has no vectors of numbers; save each as a column")
    longest = max(set(lengths), key=lambda length: (lengths.count(length), length))
    return pd.DataFrame({k: column for k, column in columns.items() if len(column) == longest})


def _add_vectors(columns: dict[str, Floats], name: str, value: object) -> None:
    """Add the vectors of a MATLAB value under their names."""
    if isinstance(value, dict):
        for key, item in value.items():
            _add_vectors(columns, f"{name}.{key}", item)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "iufb" and value.size > 1:
        if value.ndim == 1:
            columns[name] = value.astype(float)
        elif value.ndim == 2:
            tall = value if value.shape[0] >= value.shape[1] else value.T
            columns |= {f"{name}[{i}]": column.astype(float) for i, column in enumerate(tall.T)}
