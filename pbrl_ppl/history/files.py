"""Files of histories: text tables, Parquet, NetCDF, logs of SysId and MATLAB; and writing.

A format is one function that :func:`reads` declares, in any module of this room.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import pkgutil
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import xarray as xr

from pbrl_ppl.errors import HistoryError, OutputError, printable
from pbrl_ppl.history.measures import SAME
from pbrl_ppl.scene import SEPARATORS, Recording
from pbrl_ppl.state import STATE, WRENCH, Floats
from pbrl_ppl.system.files import (
    check_hdf5,
    check_regular,
    check_survives,
    is_as_sealed,
    reason,
    seal,
    write_atomically,
)

COLUMNS = ("trajectory", "step", "time", "body", *STATE, *WRENCH)
#: Suffixes of files that `History.save` writes.
SUFFIXES = (".csv", ".parquet", ".nc")
# pandas reads numbers exactly from 3.1 on, and warns there of the option that older ones need.
_PANDAS = tuple(int(part) for part in pd.__version__.split(".")[:2])
_EXACT: dict[str, Any] = {} if _PANDAS >= (3, 1) else {"float_precision": "round_trip"}
_MISSING = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None"]
#: Rows that show what the columns hold.
_SAMPLE = 200
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.I)
#: In place of the suffix of a folder.
FOLDER = "a folder"

#: Takes a file and what is known of its layout; returns its rows, with the names of its columns.
Reader = Callable[[Path, Recording], pd.DataFrame]
#: By suffix, in lower case.
_READERS: dict[str, Reader] = {}


def reads(*suffixes: str) -> Callable[[Reader], Reader]:
    """Declare a function of this room to read the files with these suffixes.

    It raises a `HistoryError` where the file is damaged; errors of the operating system are turned
    into one by :func:`read_table`. The attribute ``units`` of its table may have the units of
    columns, and ``said`` sentences on what was left out.
    """

    def declare(reader: Reader) -> Reader:
        _READERS.update(dict.fromkeys(suffixes, reader))
        return reader

    return declare


def readers() -> Mapping[str, Reader]:
    """Return the readers of all modules of this room."""
    package = importlib.import_module("pbrl_ppl.history")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"pbrl_ppl.history.{module.name}")
    return _READERS


def read_table(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of a history file, as they are.

    Parameters
    ----------
    path : Path
        The suffix is its format; a folder is a ROS 2 bag. Of a folder of logs see :func:`logs_in`.
    layout : Recording
        What is known of the file: topics of a bag; separator, header and columns of a text table,
        which are otherwise found from its lines. The columns of one without header are called 0, 1,
        2, ...

    Raises
    ------
    HistoryError
        If the file is missing, of an unknown kind, or damaged.
    """
    suffix, known = path.suffix.lower(), readers()
    reader = known[FOLDER] if path.is_dir() else known.get(suffix)
    if reader is None:
        raise HistoryError(
            f"history {path}: the suffix is {path.suffix!r}, expected one of "
            f"{', '.join(known)}; save it as one of these"
        )
    try:
        if not path.is_dir():
            check_regular(path)
        return reader(path, layout)
    except FileNotFoundError:
        raise HistoryError(f"history {path}: there is no such file; check the path") from None
    except OSError as error:
        raise HistoryError(f"history {path}: cannot be read: {reason(error)}") from None


@reads(".csv", ".txt", ".tsv", ".dat")
def read_text(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of a text table, with the number of each line as its index.

    Title lines above the names of columns are left out, and a last line that was cut off. The
    attributes ``headerless`` (no line names the columns, which are called 0, 1, 2, ...), ``units``
    (of columns, from a row of units or from names such as ``angle [deg]``) and ``said`` (sentences
    on what was left out) hold what else was found.

    Parameters
    ----------
    path : Path
        The file: UTF-8, UTF-16 or Latin-1.
    layout : Recording
        Separator and header, if they are declared. Missing cells may be words such as ``nan``, but
        of the columns ``trajectory`` and ``body``.

    Raises
    ------
    HistoryError
        If it is empty or no table.
    """
    return _table_of(_decoded(path.read_bytes()), path, layout)


@reads(".xlsx")
def read_excel(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of the first sheet of a workbook, read as a text table is."""
    with path.open("rb") as file:
        try:
            sheet = pd.read_excel(file, header=None, dtype=object, engine="openpyxl")
        except ImportError:
            raise HistoryError(
                f"history {path}: reading it needs openpyxl: pip install 'pbrl_ppl[excel]'"
            ) from None
        except Exception as error:  # damaged files raise errors of many kinds
            raise HistoryError(f"history {path}: not a workbook: {reason(error)}") from None
    text = sheet.to_csv(sep="\t", header=False, index=False, lineterminator="\n")
    return _table_of(text, path, replace(layout, separator="tab"))


def _table_of(text: str, path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of a text table; arguments and attributes as of :func:`read_text`."""
    lines = re.split(r"\r\n|\r|\n", text)
    filled = [line for line in lines if line.strip()]
    if not filled:
        raise HistoryError(f"history {path}: the file is empty; expected a header and rows")
    separator = SEPARATORS.get(layout.separator, layout.separator) or _separator(filled)
    first, names, units = _head(lines, separator, layout.header)
    width = len(_cells(lines[first], separator)) if names is None else len(names)
    said = []
    last = max(i for i, line in enumerate(lines) if line.strip())
    # pandas fills short rows with blanks without a word: a file that was cut off would pass.
    if '"' not in text:
        cut = _NUMBER.fullmatch(lines[last].strip()[-1:]) is None or len(lines) == last + 1
        if cut and last > first and len(_cells(lines[last], separator)) < width:
            said.append(f"line {last + 1} is cut off and left out")
            lines = lines[:last]
        for number, line in enumerate(lines[first:], start=first + 1):
            cells = len(_cells(line, separator))
            if cells != width and line.strip():
                raise HistoryError(
                    f"history row {number}: {cells} cells, expected {width} as in the first"
                    f" line; repair or drop the row (file {path})"
                )
    columns = [str(i) for i in range(width)] if names is None else names
    decimal = "," if separator != "," and _has_commas(lines[first:]) else "."
    missing = {name: _MISSING for name in columns if name not in ("trajectory", "body")}
    try:
        frame: pd.DataFrame = pd.read_csv(
            io.StringIO("\n".join(lines[first:])), sep=separator, names=columns, header=None,
            decimal=decimal, dtype={"trajectory": "str", "body": "str"}, keep_default_na=False,
            na_values=missing, skipinitialspace=True, skip_blank_lines=False, low_memory=False,
            **_EXACT,
        )  # fmt: skip
    except (ValueError, pd.errors.ParserError) as error:
        raise HistoryError(f"history {path}: not a CSV table: {error}") from None
    if not isinstance(frame.index, pd.RangeIndex):
        raise HistoryError(f"history {path}: rows have more cells than the header; repair them")
    frame.index = pd.RangeIndex(first + 1, first + 1 + len(frame))
    frame.attrs.update(lines=True, headerless=names is None, units=units, said=said)
    return frame


def _decoded(content: bytes) -> str:
    """Return the text of a file, by its byte order mark or by what its bytes can be."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", errors="replace")
    if content[:200].count(b"\0") > len(content[:200]) // 3:
        return content.decode("utf-16-le" if content[1:2] == b"\0" else "utf-16-be", "replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _separator(filled: list[str]) -> str:
    """Return the mark that parts most lines below a head; a spreadsheet may write "1,5;2,0"."""
    body = filled[len(filled) // 2 :][:_SAMPLE]
    for mark in (";", "\t", ","):
        if sum(mark in line for line in body) > len(body) / 2:
            return mark
    return "," if len(filled[-1].split()) < 2 else SEPARATORS["blank"]


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without blanks and quotes around them."""
    if separator == SEPARATORS["blank"]:
        return line.split()
    parts = next(csv.reader([line], delimiter=separator)) if '"' in line else line.split(separator)
    return [part.strip() for part in parts]


def _head(
    lines: list[str], separator: str, header: bool | None, most: int = 30
) -> tuple[int, list[str] | None, dict[str, str]]:
    """Return the first line of data, the columns' names (None without), and units of columns.

    At most so many lines are above.
    """
    filled = [i for i, line in enumerate(lines) if line.strip()]
    body = [_cells(lines[i], separator) for i in filled[1:][-_SAMPLE:]]
    width = Counter(map(len, body)).most_common(1)[0][0] if body else 0
    rows = [cells for cells in body if len(cells) == width]
    numeric = [
        sum(_is_number(row[i]) for row in rows) > sum(_is_word(row[i]) for row in rows)
        for i in range(width)
    ]  # fmt: skip

    def is_data(cells: list[str], below: list[str]) -> bool:
        """Return whether a line has numbers where others have, or a name that the next one has."""
        both = zip(cells, [*below, *[""] * len(cells)], numeric, strict=False)
        wrong = any(number and _is_word(cell) and cell != after for cell, after, number in both)
        return not wrong and any(map(_is_number, cells))

    cells = [_cells(lines[i].lstrip("#% "), separator) for i in filled[: most + 1]]
    above = int(header is not False)  # if no line looks like data, the first names the columns
    if header is None:
        pairs = zip(cells[:most], [*cells[1:], []], strict=False)
        above = next((k for k, pair in enumerate(pairs) if is_data(*pair)), 1)
    if not above:
        return filled[0], None, {}
    heads = cells[:above]
    full = [sum(cell != "" for cell in each) for each in heads]
    at = full.index(max(full))
    names, units = heads[at], {}
    under = heads[at + 1] if at + 1 < len(heads) else []
    if len(under) == len(names):
        units = {n: unit.strip("[]() ") for n, unit in zip(names, under, strict=True) if unit}
    # the last line of a head is the last that is left out
    return filled[above - 1] + 1, names, units


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, with a point or a comma."""
    return _NUMBER.fullmatch(cell) is not None


def _is_word(cell: str) -> bool:
    return cell not in _MISSING and not _is_number(cell)


def _has_commas(lines: list[str]) -> bool:
    """Return whether commas are decimal marks in most rows that have any mark."""
    marks = np.array([[line.count(","), line.count(".")] for line in lines[-_SAMPLE:]])
    return bool(marks[:, 0].sum() > marks[:, 1].sum())


@reads(".parquet")
def read_parquet(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of a Parquet table."""
    with path.open("rb") as file:
        try:
            return pd.read_parquet(file)
        except Exception as error:  # pyarrow's own errors share no base with Python's
            raise HistoryError(f"history {path}: not a Parquet table: {reason(error)}") from None


@reads(".nc")
def read_netcdf(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the rows of a NetCDF file that `History.save` wrote."""
    path.open("rb").close()
    try:
        if is_as_sealed(path) is False:
            raise ValueError("it is damaged; copy it again")
        check_hdf5(path)
        with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
            dataset = stored.load()
    except Exception as error:  # HDF5 raises many kinds on a damaged file
        raise HistoryError(f"history {path}: not a NetCDF file: {reason(error)}") from None
    of_body = {"observed": ("body", "state"), "action": ("body", "wrench")}
    for name, last in (of_body | {"clock": ()}).items():
        got = dataset[name].dims if name in dataset else None
        if got != (expected := ("trajectory", "time", *last)):
            raise HistoryError(
                f"history {path}: variable {name!r} has dimensions {got}, expected {expected}; "
                "write the file with History.save"
            )
    return to_table(dataset)


#: Columns of SysId's rows by their number: one mechanism, and a drivetrain.
_SYSID = {
    4: ("time", "voltage", "position", "velocity"),
    9: ("time", "left voltage", "right voltage", "left position", "right position",
        "left velocity", "right velocity", "angle", "angular rate"),
}  # fmt: skip


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
    unit = SAME.get(str(log.get("units", "")).lower(), "")
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


def to_table(dataset: xr.Dataset) -> pd.DataFrame:
    """Return one row for each (trajectory, step, body) of a history's dataset.

    Steps without a time are left out.
    """
    names = ("trajectory", "clock", "body", "observed", "action")
    return table_of_arrays(*(dataset[name].to_numpy() for name in names))


def table_of_arrays(
    trajectory: npt.NDArray[np.generic],
    clock: Floats,
    bodies: Sequence[str] | npt.NDArray[np.generic],
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
    each = {"trajectory": trajectory[which], "step": step, "time": clock[which, step]}
    columns = {name: np.repeat(values, k) for name, values in each.items()}
    columns["body"] = np.tile(np.array(bodies, dtype=object), len(step))
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

    def write(to: Path) -> None:
        if suffix == ".nc":
            measured = dataset[["observed", "action", "clock", "n_rows"]]
            measured.to_netcdf(to, engine="h5netcdf")
            seal(to)
        elif suffix == ".csv":
            to_table(dataset).to_csv(to, index=False, lineterminator="\n")
        else:
            to_table(dataset).to_parquet(to, index=False)

    write_atomically(path, write)
