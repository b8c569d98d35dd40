"""Options that commands share, and how they are read."""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

#: Ends of trajectories that a message names, at most.
_NAMED = 4

Columns = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=COLUMN,...",
        help="The files' own column names (x=pos_x,time=t), or numbers (force_x=0); with several"
        " bodies in a row, cart.x=cart_px. Other columns are left out.",
    ),
]
Units = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=UNIT,...", help="What columns are measured in, if not SI (x=mm,theta=deg)."
    ),
]
TimeStep = Annotated[
    float | None,
    typer.Option(
        min=1e-9,
        metavar="SECONDS",
        help="In place of the scene's time_step; uneven samples are interpolated to it.",
    ),
]

Resample = Annotated[
    bool,
    typer.Option(
        "--resample",
        help="Interpolate uneven samples to the scene's time step. There is no --time-step as of"
        " other commands, which sets another: a posterior is of its own.",
    ),
]


def columns_of(given: list[str]) -> dict[str, str | float]:
    """Column names, or numbers, from options such as ``x=pos_x,force_x=0``."""
    columns: dict[str, str | float] = {}
    for name, value in _pairs(given, "--columns", "x=pos_x"):
        try:
            columns[name] = float(value)
        except ValueError:
            columns[name] = value
    return columns


def units_of(given: list[str]) -> dict[str, str]:
    """Units from options such as ``x=mm,theta=deg``."""
    return dict(_pairs(given, "--units", "x=mm"))


def _pairs(given: list[str], option: str, example: str) -> list[tuple[str, str]]:
    pairs = []
    for item in ",".join(given).split(",") if given else ():
        name, equals, value = (part.strip() for part in item.partition("="))
        if not (name and equals and value):
            raise typer.BadParameter(
                f"{item!r} is not NAME=VALUE, such as {example}", param_hint=option
            )
        pairs.append((name, value))
    return pairs


def load_own(
    scene: Path,
    *histories: Path,
    estimate_velocities: bool = False,
    columns: list[str] | None = None,
    units: list[str] | None = None,
    time_step: float | None = None,
    trim: bool | None = None,
) -> tuple[Scene, list[History]]:
    """Read a scene, with another time step if given, and histories of it.

    Warns where velocities and changes of positions differ by the factor of a unit, and of rows at
    a trajectory's ends that belong to no model; with ``trim`` those are left out, with None they
    are not looked for.
    """
    from pbrl_ppl.scene import Scene

    names, measures = columns_of(columns or []), units_of(units or [])
    declared = Scene.load(scene)  # its errors come before pandas is loaded
    if time_step is not None:
        declared = declared.replace(time_step=time_step)
    from pbrl_ppl.history import History, unit_mismatches

    loaded = [
        History.load(
            path,
            declared,
            estimate_velocities=estimate_velocities,
            columns=names,
            units=measures,
            resample=time_step is not None,
        )
        for path in histories
    ]
    for path, history in zip(histories, loaded, strict=True):
        for sentence in unit_mismatches(history):
            warnings.warn(f"history {path}: {sentence}", stacklevel=2)
    if trim is not None:
        loaded = [
            without_ends(history, declared, f"history {path}", trim=trim)
            for path, history in zip(histories, loaded, strict=True)
        ]
    return declared, loaded


def without_ends(history: History, scene: Scene, source: str, *, trim: bool) -> History:
    """The history without the rows at its ends that belong to no model, or with a warning of them.

    Parameters
    ----------
    history : History
        As read.
    scene : Scene
        The declared scene.
    source : str
        What to call the history.
    trim : bool
        Whether the rows are left out.
    """
    from pbrl_ppl.history import strange_ends, trimmed

    ends = strange_ends(history, scene)
    if not ends:
        return history
    named = "; ".join(str(end) for end in ends[:_NAMED])
    more = f"; and {len(ends) - _NAMED} more" if len(ends) > _NAMED else ""
    cure = "left out" if trim else "no command or contact explains it: --trim leaves the rows out"
    warnings.warn(f"{source}: {named}{more}: {cure}", stacklevel=2)
    return trimmed(history, ends) if trim else history


def command_line(context: typer.Context) -> str:
    """Write a command with its arguments and the options that are not at their defaults.

    Parameters
    ----------
    context : typer.Context
        Of the command; Typer gives it to a parameter of that type.
    """
    words = ["pbrl-ppl", str(context.info_name)]
    options = []
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if value is None or value is False:
            continue
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif value is True:
            options.append(parameter.opts[0])
        else:
            for each in value if isinstance(value, (list, tuple)) else (value,):
                options += [parameter.opts[0], str(each)]
    return shlex.join([*words, *options])
