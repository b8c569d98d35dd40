"""Files of histories: CSV, Parquet and NetCDF to a table, and back, written atomically."""

import io
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
from pbrl_ppl.scene import SEPARATORS, Recording
from pbrl_ppl.state import STATE, WRENCH, Floats

COLUMNS = ("trajectory", "step", "time", "body", *STATE, *WRENCH)
SUFFIXES = (".csv", ".parquet", ".nc")
#: Suffixes of text tables that are read, and never written.
_TEXTS = (".csv", ".txt", ".tsv", ".dat")

# pandas reads numbers exactly from 3.1 on, and warns there of the option that older ones need.
_PANDAS = tuple(int(part) for part in pd.__version__.split(".")[:2])
_EXACT: dict[str, Any] = {} if _PANDAS >= (3, 1) else {"float_precision": "round_trip"}
#: Separator of columns by blanks.
_BLANKS = SEPARATORS["blank"].encode()
_MISSING = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None"]


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
        Separator and header of a text table; otherwise found from its first line. The columns of
        one without header are called 0, 1, 2, ...

    Raises
    ------
    HistoryError
        If the file is missing, of an unknown kind, or damaged.
    """
    suffix, layout = path.suffix.lower(), layout or Recording()
    if suffix in bags.SUFFIXES or path.is_dir():
        return _read_bag(path, dict(layout.topics))
    known = tuple(dict.fromkeys((*_TEXTS, *SUFFIXES)))
    if suffix not in known:
        raise HistoryError(
            f"history {path}: the suffix is {path.suffix!r}, expected one of "
            f"{', '.join(known)}; save it as one of these"
        )
    try:
        if suffix in _TEXTS:
            columns = {**dict(layout.columns), **(names or {})}
            return _read_text(
                path, [column for column in columns.values() if isinstance(column, str)], layout
            )
        return _read_parquet(path) if suffix == ".parquet" else _read_netcdf(path)
    except FileNotFoundError:
        raise HistoryError(f"history {path}: there is no such file; check the path") from None
    except OSError as error:
        raise HistoryError(f"history {path}: cannot be read: {error}") from None


def _read_bag(path: Path, topics: dict[str, Any]) -> pd.DataFrame:
    if not topics:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in bags.bag_topics(path).items())
        raise HistoryError(
            f"history {path}: say which topics are whose (--topic BODY=/odom, or topics in"
            f" [recording]); it has {there}"
        )
    return bags.read_bag(path, topics)


def _read_text(path: Path, others: list[str], layout: Recording) -> pd.DataFrame:
    content = path.read_bytes()
    lines = content.removeprefix(b"\xef\xbb\xbf").splitlines()
    if not any(line.strip() for line in lines):
        raise HistoryError(f"history {path}: the file is empty; expected a header and rows")
    declared = SEPARATORS.get(layout.separator, layout.separator).encode()
    # a spreadsheet may write "1,5;2,0"
    guessed = next((mark for mark in (b",", b";", b"\t") if mark in lines[0]), b"")
    separator = declared or guessed or (b"," if len(lines[0].split()) < 2 else _BLANKS)
    decimal = "," if separator in (b";", b"\t") and b"," in content else "."
    first = _cells(lines[0], separator)
    header = layout.header if layout.header is not None else not all(map(_is_number, first))
    # pandas fills short rows with blanks without a word: a file that was cut off would pass.
    if b'"' not in content:
        for number, line in enumerate(lines, start=1):
            cells = len(_cells(line, separator))
            if cells != len(first) and line.strip():
                raise HistoryError(
                    f"history row {number}: {cells} cells, expected {len(first)} as in the first"
                    f" line; repair or drop the row (file {path})"
                )
    unnamed = [] if header else [str(i) for i in range(len(first))]
    number_columns = dict.fromkeys(("step", "time", *STATE, *WRENCH, *others, *unnamed), _MISSING)
    try:
        frame: pd.DataFrame = pd.read_csv(
            io.BytesIO(content),
            sep=separator.decode(),
            header=0 if header else None,
            names=None if header else unnamed,
            decimal=decimal,
            dtype={"trajectory": "str", "body": "str"},
            keep_default_na=False,
            na_values=number_columns,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            encoding="utf-8",
            **_EXACT,
        )
    except (ValueError, pd.errors.ParserError) as error:
        raise HistoryError(f"history {path}: not a CSV table: {error}") from None
    if not isinstance(frame.index, pd.RangeIndex):
        raise HistoryError(f"history {path}: rows have more cells than the header; repair them")
    frame.attrs["headerless"] = not header
    return frame


def _cells(line: bytes, separator: bytes) -> list[bytes]:
    """Return the cells of a line."""
    return line.split() if separator == _BLANKS else line.split(separator)


def _is_number(cell: bytes) -> bool:
    """Return whether a cell is a number, with a point or a comma."""
    try:
        float(cell.replace(b",", b"."))
    except ValueError:
        return False
    return True


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
