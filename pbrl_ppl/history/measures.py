"""Columns in SI units, and angles from the scene's zero."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.kinematics import joint_order
from pbrl_ppl.scene import Recording, Scene, column_of, nearest
from pbrl_ppl.state import STATE, VELOCITY, Floats, wrapped

#: Units of time in s.
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "in": 0.0254, "ft": 0.3048,
           "yd": 0.9144}  # fmt: skip
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "rev": 2 * np.pi, "turn": 2 * np.pi}
#: A thrust stand's g is the weight of a gram.
_FORCE = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": 4.4482216152605, "kgf": 9.80665, "kg": 9.80665,
          "gf": 9.80665e-3, "g": 9.80665e-3, "ozf": 0.27801385, "oz": 0.27801385}  # fmt: skip
#: How files write units that are listed above.
SAME = {"\u00b0": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad",
         "meter": "m", "meters": "m", "metre": "m", "metres": "m", "sec": "s", "seconds": "s",
         "second": "s", "\u00b5s": "us", "millimeters": "mm", "feet": "ft", "inches": "in",
         "rotations": "rev", "newton": "N", "\u00b0/s": "deg/s", "dps": "deg/s", "kmh": "km/h",
         "kph": "km/h", "1/min": "rpm", "RPM": "rpm"}  # fmt: skip
_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\[\]()]*)\s*[\])]")
#: Where an arm points when its angle is 0, from the direction of gravity (rad).
ZEROS = {"hanging": 0.0, "horizontal": np.pi / 2, "upright": np.pi}


def _rates(units: Mapping[str, float]) -> dict[str, float]:
    return {f"{a}/{b}": size / time for a, size in units.items() for b, time in TIME.items()}


#: What each column may be measured in, in SI units.
_UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("time", "duration"), TIME),
    **dict.fromkeys(("x", "y"), _LENGTH),
    "theta": _ANGLE,
    **dict.fromkeys(("vx", "vy"), _rates(_LENGTH) | {"mph": 0.44704, "kn": 1852 / 3600}),
    "omega": _rates(_ANGLE) | {"rpm": 2 * np.pi / 60, "rps": 2 * np.pi},
    **dict.fromkeys(("force_x", "force_y"), _FORCE),
    "torque": {
        f"{a}{mark}{b}": force * length
        for a, force in _FORCE.items()
        for b, length in _LENGTH.items()
        for mark in (" ", "", "*", ".", "\u00b7")
    },
}


def numbers(column: pd.Series) -> Floats:
    """Return the numbers of a column, a copy; NaN where a cell is none."""
    return np.array(pd.to_numeric(column, errors="coerce"), dtype=float)


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


def stated_unit(frame: pd.DataFrame, column: str) -> str:
    """Return the unit of a file's column as its row of units or its name states it, or ""."""
    return frame.attrs.get("units", {}).get(column) or unit_in_name(column)[1]


def stated_units(frame: pd.DataFrame, columns: Mapping[str, object]) -> dict[str, str]:
    """Return the unit of each history's column that the file states and that is not SI.

    Parameters
    ----------
    frame : pandas.DataFrame
        The file's columns; its attribute ``units`` has those of a row of units. Names such as
        ``angle [deg]`` state theirs.
    columns : mapping of str to str, float or table
        From a history's column to the file's, as of `Recording.columns`.

    Raises
    ------
    HistoryError
        If a row of units has one that is not known.
    """
    row, units = frame.attrs.get("units", {}), {}
    for key in dict.fromkeys((*columns, *(name for name in _UNITS if name in frame))):
        column, name = columns.get(key, key), key.rpartition(".")[2]
        if isinstance(column, int | float) or name not in _UNITS or name == "time":
            continue
        column = column_of(column)
        whole = next((c for c in frame.columns if column in (c, unit_in_name(str(c))[0])), column)
        text = stated_unit(frame, str(whole))
        unit = SAME.get(text, text)
        if unit in _UNITS[name]:
            units[key] = unit
        elif row.get(whole) and unit not in ("-", "1"):
            raise HistoryError(_no_unit(key, text) + "; the file's row of units says so")
    return units


def known_size(key: str, unit: str) -> float:
    """Return a unit of a history's column in SI units, as of :func:`unit_size`.

    Raises
    ------
    HistoryError
        If the column has no such unit.
    """
    size = unit_size(key.rpartition(".")[2], unit)
    if size is None:
        raise HistoryError(_no_unit(key, unit))
    return size


def _no_unit(key: str, unit: str) -> str:
    units = _UNITS[key.rpartition(".")[2]]
    known = [known for known in units if not {"*", ".", "\u00b7"} & {*known}]
    return (
        f'units: "{unit}" is none of {key}; expected one of'
        f' {", ".join(known[:12])}, or a number of counts to one, "8192/{known[-1]}":'
        f' units = {{ {key} = "{known[0]}" }}'
    )


def unit_size(name: str, text: str) -> float | None:
    """Return a unit of a history's column in SI units; None if it has no such unit.

    Of counts ``"8192/turn"`` is 8,192 to a turn; of a rate ``"8192/turn"`` is the same in a second.

    Examples
    --------
    >>> [unit_size("x", unit) for unit in ("mm", "2000/m", "N")], unit_size("vx", "2000/m")
    ([0.001, 0.0005, None], 0.0005)
    """
    units = _UNITS[name]
    if (unit := SAME.get(text, text)) in units:
        return units[unit]
    number, _, rest = (part.strip() for part in unit.partition("/"))
    try:
        count = float(number)
    except ValueError:
        return None
    rest = SAME.get(rest, rest)
    of_rate = name in STATE[VELOCITY:] and f"{rest}/s" in units
    size = units.get(f"{rest}/s" if of_rate else rest)
    return size / count if size is not None and np.isfinite(count) and count > 0 else None


def in_si(frame: pd.DataFrame, units: Mapping[str, str]) -> pd.DataFrame:
    """Return a history's table in SI units.

    Parameters
    ----------
    frame : pandas.DataFrame
        With a history's column names.
    units : mapping of str to str
        What columns are measured in, such as ``{"x": "mm", "cart.theta": "deg"}``; the others are
        in SI units.

    Raises
    ------
    HistoryError
        If a column or a unit is unknown.

    Examples
    --------
    >>> in_si(pd.DataFrame({"x": [1500.0], "omega": [180.0]}), {"x": "mm", "omega": "deg/s"})
         x     omega
    0  1.5  3.141593
    """
    frame = frame.copy()
    for key, text in units.items():
        body, _, name = key.rpartition(".")
        if name not in _UNITS:
            raise HistoryError(f'units: "{key}" has none{nearest(name, _UNITS)}')
        size = known_size(key, text)
        if name not in frame:
            raise HistoryError(f'units: "{name}" is in {text}, and the table has no such column')
        values = pd.to_numeric(frame[name], errors="coerce")
        scaled = values.notna() & (frame["body"] == body if body else True)
        # non-numbers are kept, for the message that names them
        frame[name] = (values * size).where(scaled, frame[name])
    return frame


def with_whole_counts(frame: pd.DataFrame, say: Callable[[str], None]) -> pd.DataFrame:
    """Return a table whose counters of 8, 16 or 32 bits go on where they overflow.

    Parameters
    ----------
    frame : pandas.DataFrame
        With a history's column names, in the file's units.
    say : callable
        Takes a sentence on each column that was mended.

    Examples
    --------
    >>> turning = pd.DataFrame({"theta": [32700.0, 32760.0, -32716.0, -32656.0]})
    >>> with_whole_counts(turning, print)["theta"].tolist()
    theta is a counter of 16 bits that overflows 1 time, first in row 2: it goes on
    [32700.0, 32760.0, 32820.0, 32880.0]
    """
    none = np.zeros(len(frame))
    bodies = frame["body"].to_numpy() if "body" in frame else none
    time = numbers(frame["time"]) if "time" in frame else none
    frame = frame.copy()
    for name in (name for name in STATE if name in frame):
        values = numbers(frame[name])
        found = list[tuple[int, int]]()
        for body in pd.unique(bodies):
            rows = np.flatnonzero((bodies == body) & np.isfinite(values))
            every = values[rows]
            for run in np.split(rows, np.flatnonzero(np.diff(time[rows]) < 0.0) + 1):
                if bits := _overflows(values[run], every):
                    jumps = np.abs(np.diff(values[run])) > 0.5 * 2.0**bits
                    found += [(bits, int(row)) for row in run[1:][jumps]]
                    values[run] = np.unwrap(values[run], period=2.0**bits)
        if found:
            times = f"{len(found)} time{'s' * (len(found) > 1)}"
            say(
                f"{name} is a counter of {found[0][0]} bits that overflows {times}, first in row"
                f" {min(row for _, row in found)}: it goes on"
            )
            frame[name] = values
    return frame


def _overflows(run: Floats, every: Floats, *, full: float = 0.75) -> int:
    """Return the bits of a counter that overflows in a run of a column; 0 if it does not.

    ``full``: a jump is at least this share of what it counts to.
    """
    if len(run) < 2 or (every != np.round(every)).any():
        return 0
    for bits in (8, 16, 32):
        size = 2.0**bits
        if any(low <= every.min() and every.max() < low + size for low in (-size / 2, 0.0)):
            return bits * bool((np.abs(np.diff(run)) > full * size).any())
    return 0


def zero_angle(scene: Scene, body: str, zero: str) -> float:
    """Return the angle theta (rad) of a hinged body whose arm points this way.

    Parameters
    ----------
    scene : Scene
        Has the hinge, and gravity; without gravity, down is -y.
    body : str
        Its arm leads from the hinge to its centre.
    zero : str
        ``"hanging"``, ``"horizontal"`` (a quarter turn counter-clockwise from it) or ``"upright"``.

    Raises
    ------
    HistoryError
        If the word is another, or the body hangs on no hinge.
    """
    if zero not in ZEROS:
        raise HistoryError(
            f"[recording]: zero of {body}'s theta is {zero!r}, expected a number or one of"
            f" {', '.join(ZEROS)}{nearest(zero, ZEROS)}"
        )
    held = (edge for edge in joint_order(scene) if edge[1] == body)
    anchor = next((edge[3] for edge in held if edge[4].traits.pins_anchors), (0.0, 0.0))
    if not np.any(anchor):
        raise HistoryError(
            f'[recording]: zero of {body}\'s theta is "{zero}", and {body} hangs on no hinge beside'
            " its centre: declare it as [[joint]], or give the number of the column at theta 0"
        )
    down = np.arctan2(scene.gravity[1], scene.gravity[0]) if any(scene.gravity) else -np.pi / 2
    arm = np.arctan2(-anchor[1], -anchor[0])
    return float(wrapped(np.asarray(down + ZEROS[zero] - arm)))


def with_zeros(frame: pd.DataFrame, scene: Scene, layout: Recording, source: str) -> pd.DataFrame:
    """Return a table whose angles are a body's theta, where a word says what their zero is."""
    for key, column in layout.columns:
        zero = dict(column).get("zero") if isinstance(column, tuple) else None
        if not isinstance(zero, str):
            continue
        name, _, coordinate = key.rpartition(".")
        if coordinate != "theta" or "body" not in frame:
            raise HistoryError(f"{source}: {key} has a zero, which angles of bodies have alone")
        bodies = [name] if name else list(frame["body"].dropna().unique())
        offset = frame["body"].map({body: zero_angle(scene, body, zero) for body in bodies})
        angle = pd.to_numeric(frame["theta"], errors="coerce")
        frame = frame.assign(theta=angle + offset.fillna(0.0))
    return frame
