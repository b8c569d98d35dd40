"""How a recording is laid out: columns, units, separators, and where it is cut."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.checks import choice, finite, flag, nearest, positive, settle

#: Separators by name; others are a single character.
SEPARATORS = {"blank": r"\s+", "tab": "\t", "comma": ",", "semicolon": ";"}
#: What the columns of velocities are.
VELOCITIES = ("measured", "computed", "estimate")

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
        seconds, at ``rests`` of at least so many seconds, at ``jumps`` of a velocity by more than
        so many m/s between rows.
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
        tables = [field.name for field in fields(self) if field.type == "Pairs"]
        settle(self, "[recording]", **dict.fromkeys(tables, _pairs))
        for name, column in self.columns:
            if isinstance(column, bool) or not isinstance(column, str | int | float | tuple):
                raise SceneError(
                    f"[recording]: column {name} is {column!r}, expected a name or a number"
                )
            if isinstance(column, tuple) and {"column", "zero"} != {*dict(column)}:
                raise SceneError(
                    f"[recording]: column {name} is {dict(column)}, expected a table such as"
                    f' {{ column = "knee", zero = "hanging" }}'
                )
        if not isinstance(self.commands, str) or self.forces not in ("world", "body"):
            raise SceneError(
                f"[recording]: commands is {self.commands!r} and forces {self.forces!r}, expected"
                ' the name of a file, and "world" or "body"'
            )
        topics = tuple((n, tuple(t) if isinstance(t, list) else t) for n, t in self.topics)
        object.__setattr__(self, "topics", topics)
        for key in ("units", "topics"):
            for name, value in getattr(self, key):
                texts = value if key == "topics" and isinstance(value, tuple) else (value,)
                if not all(isinstance(text, str) for text in texts):
                    raise SceneError(f"[recording]: {key} of {name} is {value!r}, expected text")
        known = (*SEPARATORS, "")
        if self.separator not in known and len(self.separator) != 1:
            raise SceneError(
                f"[recording]: separator is {self.separator!r}, expected one of"
                f" {', '.join(SEPARATORS)} or one character"
            )
        settle(self, "[recording]", header=flag, hold=flag, resample=flag, trim=flag, camera=flag)
        if "rate" in dict(self.time):
            positive(dict(self.time)["rate"], "[recording]: time, rate")
        expected = f"one of {', '.join(VELOCITIES)}"
        choice(self.velocities, "[recording]: velocities", VELOCITIES, expected)
        for name, value in self.not_seen:
            finite(value, f"[recording]: not_seen of {name}")
        cuts = ("every", "gaps", "rests", "jumps")
        for name, value in self.cut:
            if name not in cuts:
                raise SceneError(
                    f'[recording]: cut has no "{name}", only {", ".join(cuts)}{nearest(name, cuts)}'
                )
            positive(value, f"[recording]: cut, {name}")

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


def _pairs(value: object, where: str) -> Pairs:
    """Return names with their values."""
    if isinstance(value, Mapping):
        items = ((k, tuple(v.items()) if isinstance(v, Mapping) else v) for k, v in value.items())
        return tuple(items)
    if isinstance(value, tuple) and all(isinstance(e, tuple) and len(e) == 2 for e in value):
        return value
    raise SceneError(f"{where} is {value!r}, expected a table such as {{ x = ... }}")


def column_of(entry: object) -> str:
    """Return the name of the file's column of an entry of `Recording.columns`, without a sign.

    Examples
    --------
    >>> column_of("-heading"), column_of((("column", "knee"), ("zero", "hanging")))
    ('heading', 'knee')
    """
    name = dict(entry)["column"] if isinstance(entry, tuple) else entry
    return str(name).removeprefix("-")
