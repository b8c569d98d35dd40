"""How a command is declared, and the options that commands share.

Parameters
----------
scene : SCENE
    Scene file (.toml).
history : HISTORY
    Measured history (.csv, .parquet, .nc).
posterior : POSTERIOR
    Posterior file (.nc); all that is needed.
columns : NAME=COLUMN,...
    Column names in the files (x=pos_x,time=t), or numbers (force_x=0); with several bodies in a
    row, cart.x=cart_px. Other columns are left out.
units : NAME=UNIT,...
    What columns are measured in, if not SI (x=mm,theta=deg).
start : BODY=X,Y,THETA
    Where a body starts (m, rad), at rest or with ,VX,VY,OMEGA; once a body.
noise : NAME=SD
    Known measurement noise of a state dimension (x=0.002, in m; repeat for others).
effect_file : FILE
    Python file (.py) whose Effect values at module level are effects of your own; it is run. Repeat
    for others.
seed
    Same seed, same answer.
overwrite
    Replace what exists.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin

import typer

from pbrl_ppl.cli import effect_files
from pbrl_ppl.cli.terminal import Result, interruptible, stages
from pbrl_ppl.errors import GoalError

if TYPE_CHECKING:
    from pbrl_ppl.effects import Attached, Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Result])


@dataclass(frozen=True)
class Command:
    """A command: its name, its place in the list of commands, and an example for its help."""

    name: str
    rank: int
    example: str
    function: Callable[..., None]


_COMMANDS: dict[str, Command] = {}


def command(
    name: str, rank: int, example: str, kept: str = "nothing was written"
) -> Callable[[F], F]:
    """Declare a function of this room to be a command, whose result is printed.

    An interrupt says what is ``kept``, in terms of the arguments. Every command has the options of
    `Printing`; its function takes those and the arguments ``progress`` and ``interrupts`` where it
    needs them.

    An argument that is a dataclass stands for the options that are its fields. The help of an
    argument, and after a colon what stands for its value, are in the docstring of the function or
    of the dataclass, or in that of this module. An argument without a default is one of the
    command, others are its options.
    """

    def declare(function: F) -> F:
        _COMMANDS[name] = Command(name, rank, example, _bound(function, kept))
        return function

    return declare


def commands() -> list[Command]:
    """Return the commands of all modules of this room, in the order of use."""
    package = importlib.import_module("pbrl_ppl.cli")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"pbrl_ppl.cli.{module.name}")
    return sorted(_COMMANDS.values(), key=lambda command: command.rank)


@dataclass(frozen=True)
class Printing:
    """Options of every command.

    Parameters
    ----------
    as_json
        Print one JSON object, and nothing else.
    quiet
        Show no progress.
    """

    as_json: Annotated[bool, typer.Option("--json")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q")] = False

    def run(self, function: Callable[..., Result], kept: str, given: Mapping[str, Any]) -> None:
        """Run a command with what it takes, and print its result."""
        taken = inspect.signature(function).parameters
        staged = stages(self.quiet) if "progress" in taken else nullcontext()
        with interruptible(kept.format(**given)) as interrupts, staged as progress:
            session = {"progress": progress, "interrupts": interrupts}
            known = {**given, **vars(self), **session}
            result = function(**{name: known[name] for name in taken})
        result.show(self.as_json)


def _bound(function: Callable[..., Result], kept: str) -> Callable[..., None]:
    """Return the function as Typer takes it: fields in place of dataclasses, each with its help."""
    summary, documented = _documented(function.__doc__)
    taken = inspect.signature(function, eval_str=True).parameters
    groups: dict[str, type] = {}
    parameters: list[inspect.Parameter] = []
    kinds = {name: parameter.annotation for name, parameter in taken.items()}
    for name, kind in (kinds | {"printing": Printing}).items():
        if isinstance(kind, type) and is_dataclass(kind):
            groups[name] = kind
            for base in kind.__mro__:
                documented = _documented(base.__doc__)[1] | documented
            parameters += inspect.signature(kind, eval_str=True).parameters.values()
        elif name not in ("as_json", "quiet", "progress", "interrupts"):
            parameters.append(taken[name])

    def call(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{field.name: given.pop(field.name) for field in fields(kind)})
        given.pop("printing").run(function, kept, given)

    documented = _documented(__doc__)[1] | documented
    declared = [_declared(each, *documented.get(each.name, ("", ""))) for each in parameters]
    call.__signature__ = inspect.Signature(declared)  # type: ignore[attr-defined]
    call.__doc__ = summary
    return call


def _declared(parameter: inspect.Parameter, metavar: str, said: str) -> inspect.Parameter:
    """Return a parameter with the declaration, metavar and help of an option or argument."""
    kind = parameter.annotation
    optional = [each for each in get_args(kind) if get_origin(each) is Annotated]
    if get_origin(kind) is Annotated:
        kind, info = get_args(kind)
    elif optional:  # Annotated[...] | None
        kind, info = get_args(optional[0])
        kind |= None
    elif kind is typer.Context:
        return parameter.replace(kind=parameter.KEYWORD_ONLY)
    elif parameter.default is parameter.empty:
        info = typer.Argument()
    else:
        info = typer.Option(f"--{parameter.name.replace('_', '-')}")
    info = copy(info)
    info.metavar, info.help = info.metavar or metavar or None, info.help or said or None
    return parameter.replace(annotation=Annotated[kind, info], kind=parameter.KEYWORD_ONLY)


def _documented(docstring: str | None) -> tuple[str, dict[str, tuple[str, str]]]:
    """Return a docstring up to its parameters, and the metavar and help of each of them."""
    text = inspect.cleandoc(docstring or "")
    summary, _, listed = text.partition("\n\nParameters\n----------\n")
    entries = re.findall(r"^(\w+)(?: : (.+))?\n((?:    .+(?:\n|$))+)", listed, re.MULTILINE)
    return summary, {name: (metavar, " ".join(said.split())) for name, metavar, said in entries}


OutputFile = Annotated[Path, typer.Option("-o", "--output", metavar="FILE")]
OutputFolder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR")]
Seed = Annotated[int, typer.Option(min=0)]
Count = Annotated[int, typer.Option(min=1)]


@dataclass(frozen=True)
class Columns:
    """Options of each command that reads a recording's columns."""

    columns: list[str] | None = None
    units: list[str] | None = None

    def layout(self) -> dict[str, Any]:
        """Return arguments of `History.load`: names, or numbers, and units of columns."""
        return {
            "columns": pairs(self.columns, "--columns", "x=pos_x", _number_or_name),
            "units": pairs(self.units, "--units", "x=mm", str),
        }


@dataclass(frozen=True)
class Reading(Columns):
    """Options of each command that reads a recording.

    Each is in place of what the scene file's ``[recording]`` says.

    Parameters
    ----------
    estimate_velocities
        Start predictions from velocities estimated from positions, if none were measured.
    trim
        Leave out rows at a trajectory's ends that belong to no model: a body still held, an abrupt
        stop.
    """

    estimate_velocities: bool = False
    trim: bool = False
    effect_file: list[Path] | None = None

    def __post_init__(self) -> None:
        self.settings()  # bad usage is reported before any file is read

    def settings(self) -> dict[str, Any]:
        """Return arguments of `history.read_recording`."""
        flags = {"estimate_velocities": self.estimate_velocities, "trim": self.trim}
        return self.layout() | flags

    def recording(self, path: Path, scene: Scene, *, resample: bool) -> History:
        """Return the history of a file."""
        from pbrl_ppl.history import read_recording

        return read_recording(path, scene, resample=resample, **self.settings())

    def catalogue(self) -> tuple[Effect, ...]:
        """Return the catalogue and after it the effects of effect files."""
        return effect_files.with_catalogue(self.effect_file)

    def with_effects(self, scene: Scene) -> tuple[Scene, tuple[Effect | Attached, ...]]:
        """Return a scene and the effects of effect files on its bodies."""
        return effect_files.added_effects(scene, effect_files.own_effects(self.effect_file))


@dataclass(frozen=True)
class PosteriorReading(Reading):
    """Options of a command that reads a recording with the scene of a posterior.

    Parameters
    ----------
    resample
        Interpolate uneven samples to the scene's time step. There is no --time-step as in other
        commands, which sets another: a posterior holds for one time step.
    """

    resample: bool = False


@dataclass(frozen=True)
class SceneReading(Reading):
    """Options of a command that reads a scene file and recordings.

    Parameters
    ----------
    substeps
        Engine steps per interval, in place of the scene's.
    time_step : SECONDS
        In place of the scene's time_step; uneven samples are interpolated to it.
    """

    noise: list[str] | None = None
    substeps: Count | None = None
    time_step: Annotated[float | None, typer.Option(min=1e-9)] = None

    def scene_settings(self) -> dict[str, Any]:
        """Return arguments of `history.read_scene`: what the options say of a scene."""
        noise = noise_of(self.noise)
        return {"noise": noise, "substeps": self.substeps, "time_step": self.time_step}

    def read(self, scene: Path, histories: Sequence[Path]) -> tuple[Scene, list[History]]:
        """Return the scene and its histories."""
        from pbrl_ppl.history import read_scene

        declared, resample = read_scene(scene, **self.scene_settings()), self.time_step is not None
        return declared, [self.recording(each, declared, resample=resample) for each in histories]


def command_line(context: typer.Context) -> str:
    """Return the command that runs, with its arguments and options, as one would type it again."""
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
            for item in value if isinstance(value, (list, tuple)) else (value,):
                options += [parameter.opts[0], str(item)]
    return shlex.join([*words, *options])


def given(**values: Any) -> dict[str, Any]:
    """Return the options that were given: all but None."""
    return {name: value for name, value in values.items() if value is not None}


def noise_of(texts: list[str] | None) -> dict[str, float]:
    """Return standard deviations by state dimension from ``--noise``."""
    return pairs(texts, "--noise", "x=0.002", float)


def _number_or_name(text: str) -> str | float:
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() else number


def pairs(
    texts: list[str] | None, option: str, example: str, kind: Callable[[str], T]
) -> dict[str, T]:
    """Return values by name from ``NAME=VALUE,...``."""
    values = {}
    for item in ",".join(texts).split(",") if texts else ():
        name, _, value = (part.strip() for part in item.partition("="))
        try:
            if not (name and value):
                raise ValueError
            values[name] = kind(value)
        except ValueError:
            message = f"{item!r} is not NAME=VALUE, such as {example}"
            raise typer.BadParameter(message, param_hint=option) from None
    return values


def pose(text: str, bodies: Sequence[str], option: str) -> tuple[str, list[float | None]]:
    """Return a body and its numbers from ``BODY=X,Y,THETA``.

    The body may be left out if there is one. A free coordinate, ``-``, is None.
    """
    name, separator, numbers = text.rpartition("=")
    if not separator:
        if len(bodies) > 1:
            raise GoalError(f"{option} {text}: say which body: {bodies[0]}={text}")
        name = bodies[0]
    values: list[float | None] = []
    for number in map(str.strip, numbers.split(",")):
        try:
            values.append(None if number == "-" else float(number))
        except ValueError:
            why = f"{number!r} is not a number; expected BODY=X,Y,THETA"
            raise GoalError(f"{option} {text}: {why}") from None
    return name.strip(), values


def starts_of(texts: list[str] | None, bodies: Sequence[str]) -> dict[str, list[float]]:
    """Return the start of each body from ``--start``."""
    starts: dict[str, list[float]] = {}
    for text in texts or ():
        name, values = pose(text, bodies, "--start")
        starts[name] = [value for value in values if value is not None]
        if None in values:
            raise GoalError(f"--start {text}: a start has no free coordinates; give a number for -")
    return starts
