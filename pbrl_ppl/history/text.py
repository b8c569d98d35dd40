"""Text tables as loggers write them: encodings, title lines, rows of units, decimal commas."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.scene import SEPARATORS, Recording

# pandas reads numbers exactly from 3.1 on, and warns there of the option that older ones need.
_PANDAS = tuple(int(part) for part in pd.__version__.split(".")[:2])
_EXACT: dict[str, Any] = {} if _PANDAS >= (3, 1) else {"float_precision": "round_trip"}
_MISSING = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None"]
#: Rows that show what the columns hold, and lines that may be above them.
_SAMPLE, _HEAD = 200, 30
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.I)
_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\[\]()]*)\s*[\])]")


def read_text(path: Path, layout: Recording, numbers: list[str]) -> pd.DataFrame:
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
        Separator and header, if they are declared.
    numbers : list of str
        Columns whose missing cells may be words such as ``nan``.

    Raises
    ------
    HistoryError
        If it is empty or no table.
    """
    text = _decoded(path.read_bytes())
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
    try:
        frame: pd.DataFrame = pd.read_csv(
            io.StringIO("\n".join(lines[first:])),
            sep=separator,
            names=columns,
            header=None,
            decimal="," if separator != "," and _has_commas(lines[first:]) else ".",
            dtype={"trajectory": "str", "body": "str"},
            keep_default_na=False,
            na_values=dict.fromkeys((*numbers, *(columns if names is None else ())), _MISSING),
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            **_EXACT,
        )
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
    lines: list[str], separator: str, header: bool | None
) -> tuple[int, list[str] | None, dict[str, str]]:
    """Return the first line of data, the columns' names (None without), and units of columns."""
    filled = [i for i, line in enumerate(lines) if line.strip()]
    body = [_cells(lines[i], separator) for i in filled[1:][-_SAMPLE:]]
    width = Counter(map(len, body)).most_common(1)[0][0] if body else 0
    rows = [cells for cells in body if len(cells) == width]
    numeric = [
        sum(_is_number(row[i]) for row in rows) > sum(_is_word(row[i]) for row in rows)
        for i in range(width)
    ]  # fmt: skip

    def is_data(cells: list[str]) -> bool:
        """Return whether a line fits below: no words where others have numbers."""
        fits = not any(_is_word(cell) and n for cell, n in zip(cells, numeric, strict=False))
        return fits and any(map(_is_number, cells))

    above: list[int] = []
    if header is None:
        for i in filled[:_HEAD]:
            if is_data(_cells(lines[i].lstrip("#% "), separator)):
                break
            above.append(i)
        else:
            above = filled[:1]  # no line looks like data: the first one names the columns
    elif header:
        above = filled[:1]
    if not above:
        return filled[0], None, {}
    heads = [_cells(lines[i].lstrip("#% "), separator) for i in above]
    full = [sum(cell != "" for cell in cells) for cells in heads]
    at = full.index(max(full))
    names, units = heads[at], {}
    under = heads[at + 1] if at + 1 < len(heads) else []
    if len(under) == len(names):
        units = {n: unit.strip("[]() ") for n, unit in zip(names, under, strict=True) if unit}
    # the last line of a head is the last that is left out
    return above[-1] + 1, names, units


def unit_in_name(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit: of ``angle [deg]`` both.

    Examples
    --------
    >>> unit_in_name("angle [deg]"), unit_in_name("yaw_deg"), unit_in_name("x")
    (('angle', 'deg'), ('yaw', 'deg'), ('x', ''))
    """
    if found := _BRACKETS.fullmatch(name.strip()):
        return found[1], found[2].strip()
    stem, _, last = name.strip().rpartition("_")
    plain = ("deg", "rad", "mrad", "mm", "cm", "ms", "us", "ns", "rpm", "kN", "Nm", "Nmm")
    return (stem, last) if stem and last in plain else (name, "")


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, with a point or a comma."""
    return _NUMBER.fullmatch(cell) is not None


def _is_word(cell: str) -> bool:
    return cell not in _MISSING and not _is_number(cell)


def _has_commas(lines: list[str]) -> bool:
    """Return whether commas are decimal marks in most rows that have any mark."""
    marks = np.array([[line.count(","), line.count(".")] for line in lines[-_SAMPLE:]])
    return bool(marks[:, 0].sum() > marks[:, 1].sum())
