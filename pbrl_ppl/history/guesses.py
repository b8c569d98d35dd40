"""Columns that a recording's names give away, for a scene that is written from it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pandas as pd

from pbrl_ppl.history.clocks import TIMES, Say
from pbrl_ppl.history.derived import derived_columns, with_derived
from pbrl_ppl.history.files import COLUMNS
from pbrl_ppl.history.text import unit_in_name
from pbrl_ppl.scene import Actuator, Recording, Shape, column_of
from pbrl_ppl.state import WRENCH

Actuators = tuple[Actuator, ...]

#: Names, in lower case, of each column of a history: of a message's field the last two parts.
_GUESSES = {
    "time": ("header.stamp", *TIMES),
    "x": ("position.x", "pos_x", "px", "x"),
    "y": ("position.y", "pos_y", "py", "y"),
    "theta": ("yaw", "theta", "angle"),
    "force_x": ("force.x", "force_x", "fx"),
    "force_y": ("force.y", "force_y", "fy"),
    "torque": ("torque.z", "torque", "tau"),
}


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
    tables = [with_derived(frame, lambda _: None)]
    if commands is not None:
        tables.append(commands)
    plain = {str(name): _plain(str(name)) for table in tables for name in table.columns}
    known = dict(layout.columns)
    found: dict[str, str] = {}
    for key, guesses in _GUESSES.items():
        if key in known or key in plain or (key == "time" and "duration" in known):
            continue
        hits = ([n for n, text in plain.items() if f".{text}".endswith(f".{g}")] for g in guesses)
        hit = next((names for names in hits if names), [])
        if len(hit) == 1:
            found[key] = hit[0]
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
    "motor": r"motor|duty|pwm|volt|throttle|current",
}


def guessed_actuators(
    frame: pd.DataFrame, layout: Recording, shape: Shape, hung: bool
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
    """
    if any(name in WRENCH for name in (*dict(layout.columns), *frame.columns)):
        return ()
    found = []
    for column in unused_columns(frame, layout):
        text = column.lower()
        kind = next((k for k, words in _ACTUATORS.items() if re.search(words, text)), None)
        if kind is None or not (hung or kind != "servo"):
            continue
        side = float("left" in text) - float("right" in text)
        *_, low, high = shape.bounds
        place = (0.0, round(side * 0.4 * (high - low), 6))
        name = re.sub(r"\W+", "_", column).strip("_") or "command"
        kind = "thruster" if kind == "motor" and not hung else kind
        found.append(
            Actuator(
                name=name if name.isidentifier() else f"command_{name}",
                kind=kind, body="body", column="" if name == column else column,
                at=place if kind == "thruster" else (0.0, 0.0),
            )
        )  # fmt: skip
    return tuple(found) if len(found) <= len(WRENCH) else ()


def _plain(name: str) -> str:
    """Return a column's name for comparison: without its unit, in lower case, with dots."""
    return re.sub(r"[ /\\]+", ".", unit_in_name(name)[0].strip().lower())


def _stamps_of(plain: Mapping[str, str], column: Any) -> str:
    """Return the column that has a column's stamps by its name, or an empty text."""
    base = plain.get(column_of(column))
    wanted = {f"{base}_time", f"{base}_stamp", f"{base}_t", f"time_{base}", f"t_{base}"}
    return next((name for name, text in plain.items() if text in wanted), "")
