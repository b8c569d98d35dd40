"""How a recording is laid out: columns, units, separators, and where it is cut."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.checks import Check

#: Separators by name; others are a single character.
SEPARATORS = {"blank": r"\s+", "tab": "\t", "comma": ",", "semicolon": ";"}

Pairs = tuple[tuple[str, Any], ...]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Layout of a recording's files: the table ``[recording]`` of a scene file.

    Of a file that has all columns of a history, ``columns``, ``units`` and ``not_seen`` are not
    used. Wrench columns that a file lacks are zero: nothing pushed.

    Attributes
    ----------
    columns : tuple of (str, str, float or table)
        Column of the file for each of a history, ``{ x = "pos_x" }``, or a number that holds on all
        rows; of a file without header the number of the column, from 0. A minus turns the sign,
        ``"-heading"``. ``duration`` in place of ``time`` is the time since the row before. An angle
        may be a table, ``{ column = "knee", zero = "hanging" }``: its ``zero`` is where the body on
        its hinge is when the column is 0 (``"hanging"``, ``"upright"`` or ``"horizontal"``), or the
        number in the column when the body has theta 0. A dict will do here and below.
    units : tuple of (str, str)
        Unit of each column that is not in SI units, ``{ x = "mm" }``; goes before units that the
        file states.
    time : tuple of (str, str or float)
        Clocks: ``rate`` in Hz of rows that are even, whatever their stamps, with ``counter``, the
        column that counts them; ``{ theta = "angle_time" }`` where a column has stamps of its own;
        ``commands``, the column of times in the file of commands; ``offset`` (s) is added to these,
        or to the times of commands in the same file.
    commands : str
        File of the commands, beside the recording, with times of its own on the same clock.
    hold : bool, optional
        Whether a command with stamps of its own holds until the next, or runs straight to it; by
        default samples of a smooth signal do not hold.
    forces : str
        ``"world"``, or ``"body"`` for forces along the body's own axes, which turn with it.
    separator : str
        ``"blank"``, ``"tab"``, ``"comma"``, ``"semicolon"`` or a character; found from the first
        line by default.
    header : bool, optional
        Whether the first line names the columns; by default whether it holds anything but numbers.
    not_seen : tuple of (str, float)
        Values that stand for "not seen": a body's row with all of them is empty,
        ``{ x = 0.0, y = 0.0 }``. In the file's units.
    velocities : str
        ``"measured"``, ``"computed"`` (differences of positions: left out) or ``"estimate"``
        (single transitions may start from velocities that are estimated from positions).
    resample : bool
        Whether uneven samples are interpolated to the scene's time step.
    trim : bool
        Whether commands leave out rows at a trajectory's ends that belong to no model; in Python
        :func:`pbrl_ppl.history.trimmed` does.
    cut : tuple of (str, float)
        Where trajectories are cut: ``every`` so many seconds, at ``gaps`` longer than so many
        seconds, at ``jumps`` of a velocity by more than so many m/s between rows.
    camera : bool, optional
        Whether places come from a camera, whose laws are then tried; by default where x and y are
        measured.
    topics : tuple of (str, str or tuple of str)
        Topic, or topics, of each body in a ROS bag or an MCAP file.

    Raises
    ------
    SceneError
        If a value is of another kind, or a name is unknown.

    Examples
    --------
    >>> Recording(columns={"duration": 0, "x": 1, "y": 2}, header=False, cut={"jumps": 0.2}).cut
    (('jumps', 0.2),)
    """

    columns: Pairs = ()
    units: Pairs = ()
    time: Pairs = ()
    commands: str = ""
    hold: bool | None = None
    forces: str = "world"
    separator: str = ""
    header: bool | None = None
    not_seen: Pairs = ()
    velocities: str = "measured"
    resample: bool = False
    trim: bool = False
    cut: Pairs = ()
    camera: bool | None = None
    topics: Pairs = ()

    def __post_init__(self) -> None:
        checks.settle(self, "[recording]", **_CHECKS)

    def table(self) -> dict[str, object]:
        """Return the entries of the TOML table: those that are not the defaults."""
        values = ((field, getattr(self, field.name)) for field in fields(self))
        return {field.name: value for field, value in values if value != field.default}

    def with_entries(self, **entries: Mapping[str, object]) -> Recording:
        """Return the layout with more entries in tables, which go before those that it has."""
        tables: dict[str, Any] = {
            key: dict(getattr(self, key)) | dict(value) for key, value in entries.items()
        }
        return replace(self, **tables)


def _name_or_number(value: object, where: str) -> object:
    """Return a name of a column, or a number, as it is."""
    if not (checks.is_number(value) or isinstance(value, str)):
        raise SceneError(f"{where} is {value!r}, expected a name or a number")
    return value


def _column(value: object, where: str) -> object:
    """Return a name or a number, or a column with its zero as pairs."""
    if not isinstance(value, Mapping | tuple):
        return _name_or_number(value, where)
    column = checks.items(value, where)
    if {"column", "zero"} != {*column}:
        raise SceneError(
            f'{where} is {column}, expected a table such as {{ column = "knee", zero = "hanging" }}'
        )
    return tuple(column.items())


def _topics(value: object, where: str) -> object:
    """Return a topic, or several."""
    return value if isinstance(value, str) else checks.names(value, where)


def _separator(value: object, where: str) -> object:
    """Return a separator's name, a character, or nothing."""
    if value not in (*SEPARATORS, "") and len(checks.text(value, where)) != 1:
        raise SceneError(
            f"{where} is {value!r}, expected one of {', '.join(SEPARATORS)} or one character"
        )
    return value


def _clocks(value: object, where: str) -> object:
    """Return the clocks, of which a rate is positive."""
    if "rate" in (given := checks.items(value, where)):
        checks.positive(given["rate"], f"{where}: rate")
    return checks.entries(_name_or_number)(value, where)


_CUTS = dict.fromkeys(("every", "gaps", "jumps"), checks.positive)
#: The check of each attribute.
_CHECKS: Mapping[str, Check] = {
    **dict.fromkeys(("hold", "header", "resample", "trim", "camera"), checks.flag),
    **{"columns": checks.entries(_column), "units": checks.entries(checks.text)},
    **{"time": _clocks, "not_seen": checks.entries(checks.finite)},
    **{"cut": partial(checks.table, checks=_CUTS), "topics": checks.entries(_topics)},
    **{"commands": checks.text, "separator": _separator},
    "forces": checks.choice(("world", "body")),
    "velocities": checks.choice(("measured", "computed", "estimate")),
}


def column_of(entry: object) -> str:
    """Return the name of the file's column of an entry of `Recording.columns`, without a sign.

    Examples
    --------
    >>> column_of("-heading"), column_of((("column", "knee"), ("zero", "hanging")))
    ('heading', 'knee')
    """
    name = dict(entry)["column"] if isinstance(entry, tuple) else entry
    return str(name).removeprefix("-")
