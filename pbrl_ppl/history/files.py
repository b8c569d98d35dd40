"""Files of histories to a table: by suffix; and back, written atomically."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import xarray as xr

from pbrl_ppl.errors import HistoryError, OutputError
from pbrl_ppl.files import write_atomically
from pbrl_ppl.history import bags
from pbrl_ppl.scene import Recording
from pbrl_ppl.state import STATE, WRENCH, Floats

COLUMNS = ("trajectory", "step", "time", "body", *STATE, *WRENCH)
SUFFIXES = (".csv", ".parquet", ".nc")
#: Suffixes of text tables that are read, and never written.
_TEXTS = (".csv", ".txt", ".tsv", ".dat")
#: Suffixes of other programs' tables that are read, and never written.
_FOREIGN = (".json", ".mat")


def read_table(
    path: Path, names: Mapping[str, object] | None = None, layout: Recording | None = None
) -> pd.DataFrame:
    """Return the rows of a history file, as they are.

    Parameters
    ----------
    path : Path
        The suffix is its format; a folder is a ROS 2 bag.
    names : mapping of str to object, optional
        Its values are names of columns of numbers, as of `Reading`.
    layout : Recording, optional
        Separator and header of a text table; otherwise found from its lines. The columns of one
        without header are called 0, 1, 2, ...

    Raises
    ------
    HistoryError
        If the file is missing, of an unknown kind, or damaged.
    """
    suffix, layout = path.suffix.lower(), layout or Recording()
    if suffix in bags.SUFFIXES or path.is_dir():
        return _read_bag(path, dict(layout.topics))
    known = tuple(dict.fromkeys((*_TEXTS, *SUFFIXES, *_FOREIGN)))
    if suffix not in known:
        raise HistoryError(
            f"history {path}: the suffix is {path.suffix!r}, expected one of "
            f"{', '.join(known)}; save it as one of these"
        )
    try:
        if suffix in _TEXTS:
            columns = {**dict(layout.columns), **(names or {})}
            named = [column for column in columns.values() if isinstance(column, str)]
            from pbrl_ppl.history.text import read_text

            return read_text(path, layout, ["step", "time", *STATE, *WRENCH, *named])
        if suffix in _FOREIGN:
            from pbrl_ppl.history.foreign import read_mat, read_sysid

            return read_mat(path) if suffix == ".mat" else read_sysid(path)
        return _read_parquet(path) if suffix == ".parquet" else _read_netcdf(path)
    except FileNotFoundError:
        raise HistoryError(f"history {path}: there is no such file; check the path") from None
    except OSError as error:
        raise HistoryError(f"history {path}: cannot be read: {error}") from None


def read_commands(path: Path, layout: Recording | None) -> pd.DataFrame | None:
    """Return the table of a layout's ``commands``, beside a recording; None without any."""
    if layout is None or not layout.commands:
        return None
    beside = path.parent / layout.commands.replace("{stem}", path.stem)
    return read_table(beside, layout=Recording(columns=layout.columns))


def _read_bag(path: Path, topics: dict[str, Any]) -> pd.DataFrame:
    if not topics:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in bags.bag_topics(path).items())
        raise HistoryError(
            f"history {path}: say which topics are whose (--topic BODY=/odom, or topics in"
            f" [recording]); it has {there}"
        )
    return bags.read_bag(path, topics)


def _read_parquet(path: Path) -> pd.DataFrame:
    with path.open("rb") as file:
        try:
            return pd.read_parquet(file)
        except Exception as error:  # pyarrow's own errors share no base with Python's
            raise HistoryError(f"history {path}: not a Parquet table: {error}") from None


def _read_netcdf(path: Path) -> pd.DataFrame:
    path.open("rb").close()
    try:
        with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
            dataset = stored.load()
    except Exception as error:  # HDF5 raises many kinds on a damaged file
        raise HistoryError(f"history {path}: not a NetCDF file: {error}") from None
    for name, last in (
        ("observed", ("body", "state")),
        ("action", ("body", "wrench")),
        ("clock", ()),
    ):
        expected = ("trajectory", "time", *last)
        got = dataset[name].dims if name in dataset else None
        if got != expected:
            raise HistoryError(
                f"history {path}: variable {name!r} has dimensions {got}, expected {expected}; "
                "write the file with History.save"
            )
    return to_table(dataset)


def to_table(dataset: xr.Dataset) -> pd.DataFrame:
    """Return one row for each (trajectory, step, body) of a history's dataset.

    Steps without a time are left out.
    """
    names = ("trajectory", "clock", "body", "observed", "action")
    return table_of_arrays(*(dataset[name].to_numpy() for name in names))


def table_of_arrays(
    trajectory: npt.NDArray[Any],
    clock: Floats,
    bodies: Sequence[str] | npt.NDArray[Any],
    states: Floats,
    wrenches: Floats,
) -> pd.DataFrame:
    """Return one row for each (trajectory, step, body) that has a time.

    Parameters
    ----------
    trajectory : ndarray
        Labels, shape (trajectory,).
    clock : ndarray
        Times, NaN after a trajectory's end, shape (trajectory, time), s.
    bodies : sequence of str
        Names.
    states : ndarray
        Shape (trajectory, time, body, 6), m, m, rad, m/s, m/s, rad/s.
    wrenches : ndarray
        From each row to the next, shape (trajectory, time, body, 3), N, N, N m.
    """
    which, step = np.nonzero(~np.isnan(clock))
    k = len(bodies)
    columns = {
        "trajectory": np.repeat(trajectory[which], k),
        "step": np.repeat(step, k),
        "time": np.repeat(clock[which, step], k),
        "body": np.tile(np.array(bodies, dtype=object), len(step)),
    }
    for names, values in ((STATE, states), (WRENCH, wrenches)):
        rows = values[which, step].reshape(len(step) * k, -1)
        columns |= zip(names, rows.T, strict=True)
    return pd.DataFrame(columns)


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a history's measured arrays as CSV, Parquet or NetCDF by suffix.

    Raises
    ------
    OutputError
        If the suffix is unknown or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise OutputError(
            f"history {path}: the suffix is {path.suffix!r}, expected one of {', '.join(SUFFIXES)}"
        )
    if suffix == ".nc":
        measured = dataset[["observed", "action", "clock", "n_rows"]]
        write_atomically(path, lambda to: measured.to_netcdf(to, engine="h5netcdf"))
        return
    table = to_table(dataset)
    if suffix == ".csv":
        write_atomically(path, lambda to: table.to_csv(to, index=False, lineterminator="\n"))
    else:
        write_atomically(path, lambda to: table.to_parquet(to, index=False))
