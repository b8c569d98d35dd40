"""Columns that follow from a recording's names: stamps and yaw, and guesses for a new scene."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from itertools import islice

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.clocks import TIMES, Say
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.measures import numbers, stated_unit, unit_in_name, unit_size
from pbrl_ppl.scene import Actuator, Recording, Shape, column_of
from pbrl_ppl.state import STATE, WRENCH, Floats

Actuators = tuple[Actuator, ...]

#: Names of the parts of a stamp (seconds, nanoseconds), in lower case.
_STAMPS = (("secs", "nsecs"), ("sec", "nanosec"), ("sec", "nsec"))
#: Names of a quaternion's parts, in the order x, y, z, w.
_QUATERNIONS = ("x y z w", "qx qy qz qw", "q_x q_y q_z q_w", "q1 q2 q3 q0")
#: Names, in lower case, of each column of a history: of a message's field the last two parts.
_GUESSES = {
    "time": ("header.stamp", *TIMES),
    "x": ("position.x", "pos_x", "px", "x"),
    "y": ("position.y", "pos_y", "py", "y"),
    "theta": ("yaw", "theta", "angle"),
    "vx": ("velocity.x", "vel_x", "vx"),
    "vy": ("velocity.y", "vel_y", "vy"),
    "omega": ("angular_velocity.z", "angular_velocity", "angular_rate", "angular.rate", "omega"),
    "force_x": ("force.x", "force_x", "fx"),
    "force_y": ("force.y", "force_y", "fy"),
    "torque": ("torque.z", "torque", "tau"),
}
#: Names of a column that is one of two of a history's, by its unit.
_BY_UNIT = {
    ("x", "theta"): ("position", "pos", "qpos"),
    ("vx", "omega"): ("velocity", "vel", "speed", "qvel"),
}


def with_derived(frame: pd.DataFrame, say: Say) -> pd.DataFrame:
    """Return a table with ``stamp`` of a message's header and ``yaw`` of each quaternion.

    Stamps of two columns, such as ``header.stamp.secs`` and ``header.stamp.nsecs``, become
    ``header.stamp`` (s); the columns of a quaternion, such as ``pose.orientation.x`` to ``w``,
    become ``yaw`` (rad, unwrapped; NaN where the quaternion is not of length 1); of further ones
    ``<their prefix>.yaw``.

    Parameters
    ----------
    frame : pandas.DataFrame
        Any columns.
    say : callable
        Takes a sentence where a quaternion's order is not that of its names.
    """
    added = {}
    for name, parts in derived_columns(frame).items():
        values = np.stack([numbers(frame[part]) for part in parts], axis=1)
        if len(parts) == 2:
            added[name] = values @ [1.0, 1e-9]
            continue
        yaw, order = planar_yaw(values)
        if order:
            say(f"{', '.join(parts)} are not x, y, z, w: yaw is of their order {order}")
        if np.isfinite(yaw).any():
            added[name] = yaw
    return frame.assign(**added) if added else frame


def derived_columns(frame: pd.DataFrame) -> dict[str, list[str]]:
    """Return the columns that each stamp and yaw follows from; names of the table are left out."""
    stamps = (group for names in _STAMPS for group in _groups(frame, names))
    found = {prefix.rstrip("._ ") or "stamp": parts for prefix, parts in stamps}
    for names in map(str.split, _QUATERNIONS):
        for prefix, parts in _groups(frame, names):
            found["yaw" if "yaw" not in found else f"{prefix}yaw"] = parts
    return {name: parts for name, parts in found.items() if name not in frame}


def _groups(frame: pd.DataFrame, names: tuple[str, ...] | list[str]) -> list[tuple[str, list[str]]]:
    """Return the prefixes that all these names follow, with the columns, in the table's order."""
    lower = {str(column).strip().lower(): str(column) for column in frame.columns}
    ends = re.escape(names[-1])
    found = (re.fullmatch(rf"(.*?[._ /]|){ends}", column) for column in lower)
    prefixes = [match[1] for match in found if match]
    groups = [(prefix, [lower.get(prefix + name, "") for name in names]) for prefix in prefixes]
    return [(prefix, parts) for prefix, parts in groups if all(parts)]


def planar_yaw(quaternions: Floats, flat: float = 0.2) -> tuple[Floats, str]:
    """Return the yaw of quaternions, and the order of their columns where it is not x, y, z, w.

    A body in a plane turns about one axis: the parts along the other two are small. The named order
    and the axis z are kept unless these parts are more than ``flat`` (root mean square) and
    another order or axis has them at a third.

    Parameters
    ----------
    quaternions : ndarray
        Shape (n, 4); NaN or zeros where missing.

    Returns
    -------
    yaw : ndarray
        Unwrapped, NaN where the quaternion is not of length 1, shape (n,), rad.
    order : str
        Such as ``"w x y z"``, with the axis where it is not z; empty for x, y, z, w about z.

    Examples
    --------
    >>> half = 0.5 * np.array([0.1, 0.2, 0.3])
    >>> w_first = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    >>> planar_yaw(w_first)
    (array([0.1, 0.2, 0.3]), 'w x y z')
    """
    whole = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < 0.05
    yaw = np.full(len(quaternions), np.nan)
    if not whole.any():
        return yaw, ""
    seen = quaternions[whole]
    orders = {"x y z w": (0, 1, 2, 3), "w x y z": (1, 2, 3, 0)}
    # a turn about x reads as one about z with w first: w begins near 1
    axes = [("x y z w", 2), ("w x y z", 2), ("x y z w", 0), ("x y z w", 1)]
    axes = axes if abs(seen[0, 0]) > abs(seen[0, 3]) else [axes[i] for i in (0, 2, 3, 1)]
    off = {}
    for order, axis in axes:
        others = np.delete(seen[:, orders[order][:3]], axis, axis=1)
        off[order, axis] = float(np.sqrt((others**2).mean()))
    least = min(off.values())
    order, axis = axes[0]
    if off[axes[0]] > flat and least < off[axes[0]] / 3:
        order, axis = next(one for one in axes if off[one] < least + 0.02)
    columns = orders[order]
    yaw[whole] = np.unwrap(2.0 * np.arctan2(seen[:, columns[axis]], seen[:, columns[3]]))
    about = "" if axis == 2 else f", about {'xyz'[axis]}"
    return yaw, "" if (order, axis) == axes[0] else order + about


def with_guesses(
    frame: pd.DataFrame, commands: pd.DataFrame | None, layout: Recording, say: Say
) -> Recording:
    """Return a layout with the columns that a file's names give away.

    Columns that the layout has, or that have a history's name, are kept.

    Parameters
    ----------
    frame, commands : pandas.DataFrame
        The tables of the recording, and of its commands.
    layout : Recording
        What is known.
    say : callable
        Takes a sentence on the columns found.
    """
    if frame.attrs.get("headerless") or any("." in key for key, _ in layout.columns):
        return layout
    names = [*with_derived(frame, lambda _: None), *(() if commands is None else commands)]
    plain = {str(name): _plain(str(name)) for name in names}
    known = dict(layout.columns)
    found: dict[str, str] = {}
    there = {*known, *plain} | ({"time"} if "duration" in known else set())
    for key, guesses in _GUESSES.items():
        if key not in there and (hit := _named(plain, guesses)):
            found[key] = hit
    found |= _found_by_unit(frame, plain, {*found, *known, *plain})
    columns = {**found, **known}
    own = {key: _stamps_of(plain, column) for key, column in columns.items() if key != "time"}
    clocks = {key: name for key, name in own.items() if name and name not in columns.values()}
    if clocks and not layout.time:
        columns.pop("time", None)
        layout = layout.with_entries(time=clocks)
    if found or clocks:
        words = ", ".join(f"{key} = {name}" for key, name in found.items())
        stamps = f"; stamps {', '.join(clocks.values())}" if clocks else ""
        say(f"columns by their names: {words}{stamps}; correct [recording] where that is wrong")
    return layout.with_entries(columns=columns)


def _named(plain: Mapping[str, str], guesses: Sequence[str]) -> str:
    """Return the one column that has the first of these names, or a path that ends in it."""
    hits = ([n for n, text in plain.items() if f".{text}".endswith(f".{g}")] for g in guesses)
    hit = next((names for names in hits if names), [])
    return hit[0] if len(hit) == 1 else ""


def _found_by_unit(
    frame: pd.DataFrame, plain: Mapping[str, str], known: set[str]
) -> dict[str, str]:
    """Return columns that are a position or an angle, or their rate, as their unit says.

    Those without a unit are straight, unless an angle is known. Beside x and y a speed has no
    direction. What a motion should be is not what it was.
    """
    found: dict[str, str] = {}
    plain = {name: text for name, text in plain.items() if not re.search(_WANTED, text)}
    for keys, guesses in _BY_UNIT.items():
        name = _named(plain, guesses)
        taken = {"x", "y", "theta"} if "x" in keys else {"y", "vx", "vy", "omega"}
        if not name or taken & known:
            continue
        unit = stated_unit(frame, name)
        turns = plain[name].startswith("q") or "theta" in {*known, *found}
        order = keys[::-1] if turns else keys
        fits = (key for key in order if not unit or unit_size(key, unit) is not None)
        found |= {key: name for key in islice(fits, 1)}
    return found


def check_states(frame: pd.DataFrame, layout: Recording, source: str) -> None:
    """Refuse a table of which no column is a pose or a speed, with a proposal.

    Raises
    ------
    HistoryError
        Lists the columns with their ranges and units.
    """
    if {*STATE} & {*frame.columns, *(key.rpartition(".")[2] for key, _ in layout.columns)}:
        return
    table = frame.apply(pd.to_numeric, errors="coerce")
    ends = table.agg(["min", "max"]).T.itertuples()
    spread = {n: "text" if np.isnan(low) else f"{low:.6g}..{high:.6g}" for n, low, high in ends}
    listed = [f"{name} {spread[name]} {stated_unit(frame, str(name))}".strip() for name in table]
    guess = {key: str(column) for key, column in layout.columns}
    rising = [str(name) for name, column in table.items() if (column.diff() > 0).mean() > 0.9]
    if rising and not {"time", "duration"} & {*guess, *frame.columns}:
        guess["time"] = rising[0]
    used = {*guess.values(), *rising[:1]}
    moving = [name for name in unused_columns(frame, layout) if name not in used]
    moving = [n for n in moving if spread[n] != "text" and not _actuator_kind(n)] or ["COLUMN"]
    guess |= zip(("x", "y"), moving, strict=False) if len(moving) > 1 else {"theta": moving[0]}
    words = ",".join(f"{key}={column}" for key, column in guess.items())
    raise HistoryError(
        f"{source}: no column is known as a pose or a speed of a body ({', '.join(STATE)}); it has"
        f" {', '.join(listed)}; say which is which, such as --columns {shlex.quote(words)}, and"
        " --units where they are not SI"
    )


def unused_columns(frame: pd.DataFrame, layout: Recording) -> list[str]:
    """Return the columns of a table that vary, and that its layout leaves out."""
    named = [*dict(layout.columns).values(), *dict(layout.time).values()]
    used = {*map(column_of, named), *COLUMNS}
    for name, parts in derived_columns(frame).items():
        used |= {*parts} if name in used else set()
    left = [str(name) for name in frame.columns if not {name, unit_in_name(str(name))[0]} & used]
    return [name for name in left if frame[name].nunique() > 1]


#: Words in names of columns of commands, by the kind of actuator.
_ACTUATORS = {
    "thruster": r"fan|thrust|prop|rotor|jet|rocket|engine",
    "servo": r"goal|target|setpoint|servo|desired",
    "motor": r"motor|duty|pwm|volt|throttle|current|cmd(?!_?vel)|command",
}
#: Words in names of a pose or a speed that is wanted, not measured.
_WANTED = r"goal|target|setpoint|desired|cmd|command"


def guessed_actuators(
    frame: pd.DataFrame, layout: Recording, shape: Shape, hung: bool, *, counts: float = 2.0
) -> Actuators:
    """Return actuators of the one body that unused columns' names give away.

    None where the layout has wrenches, or they are more than three.

    Parameters
    ----------
    frame : pandas.DataFrame
        The table of the recording.
    layout : Recording
        What is known.
    shape : Shape
        Outline of the body: a fan on the left or right is at its edge.
    hung : bool
        Whether it hangs on a hinge, which a motor or a servo needs.
    counts : float
        A command that exceeds this is no share of a full one.
    """
    if any(name in WRENCH for name in (*dict(layout.columns), *frame.columns)):
        return ()
    found = []
    for column in unused_columns(frame, layout):
        text, kind = column.lower(), _actuator_kind(column)
        is_number = pd.api.types.is_numeric_dtype(frame[column])
        if kind is None or (kind == "servo" and not hung) or not is_number:
            continue
        side = float("left" in text) - float("right" in text)
        *_, low, high = shape.bounds
        place = (0.0, round(side * 0.4 * (high - low), 6))
        name = re.sub(r"\W+", "_", column).strip("_") or "command"
        kind = "thruster" if kind == "motor" and not hung else kind
        most = float(f"{frame[column].abs().max():.3g}")
        found.append(
            Actuator(
                name=name if name.isidentifier() else f"command_{name}",
                kind=kind, body="body", column="" if name == column else column,
                at=place if kind == "thruster" else (0.0, 0.0),
                full=most if kind != "servo" and most > counts else 1.0,
            )
        )  # fmt: skip
    return tuple(found) if len(found) <= len(WRENCH) else ()


def _actuator_kind(column: str) -> str | None:
    """Return the kind of actuator whose commands a column has, by its name."""
    return next((k for k, words in _ACTUATORS.items() if re.search(words, column.lower())), None)


def _plain(name: str) -> str:
    """Return a column's name for comparison: without its unit, in lower case, with dots."""
    return re.sub(r"[ /\\]+", ".", unit_in_name(name)[0].strip().lower())


def _stamps_of(plain: Mapping[str, str], column: object) -> str:
    """Return the column that has a column's stamps by its name, or an empty text."""
    base = plain.get(column_of(column))
    wanted = {f"{base}_time", f"{base}_stamp", f"{base}_t", f"time_{base}", f"t_{base}"}
    return next((name for name, text in plain.items() if text in wanted), "")
