"""How a command is declared, and the options that commands share."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict, TypeVar, get_type_hints

import typer

from pbrl_ppl.cli import effect_files
from pbrl_ppl.errors import GoalError

if TYPE_CHECKING:
    from pbrl_ppl.effects import Attached, Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., None])


@dataclass(frozen=True)
class Command:
    """A command: its name, its place in the list of commands, and an example for its help."""

    name: str
    rank: int
    example: str
    function: Callable[..., None]


_COMMANDS: dict[str, Command] = {}


def command(name: str, rank: int, example: str) -> Callable[[F], F]:
    """Declare a function of this room to be a command.

    An argument that is a dataclass stands for the options that are its fields.
    """

    def declare(function: F) -> F:
        _COMMANDS[name] = Command(name, rank, example, _with_fields(function))
        return function

    return declare


def commands() -> list[Command]:
    """Return the commands of all modules of this room, in the order of use."""
    package = importlib.import_module("pbrl_ppl.cli")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"pbrl_ppl.cli.{module.name}")
    return sorted(_COMMANDS.values(), key=lambda command: command.rank)


def _with_fields(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function that takes the fields of dataclasses in place of dataclasses."""
    groups, parameters = {}, []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        kind = parameter.annotation
        if not (isinstance(kind, type) and is_dataclass(kind)):
            parameters.append(parameter.replace(kind=parameter.KEYWORD_ONLY))
            continue
        groups[parameter.name] = kind
        hints = get_type_hints(kind, include_extras=True)
        parameters += [
            parameter.replace(
                name=field.name, default=field.default, annotation=hints[field.name],
                kind=parameter.KEYWORD_ONLY,
            )
            for field in fields(kind)
        ]  # fmt: skip

    def call(**given: object) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{field.name: given.pop(field.name) for field in fields(kind)})
        function(**given)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__doc__ = function.__doc__
    return call


SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.toml).")]
HistoryFile = Annotated[
    Path, typer.Argument(metavar="HISTORY", help="Measured history (.csv, .parquet, .nc).")
]
PosteriorFile = Annotated[
    Path, typer.Argument(metavar="POSTERIOR", help="Posterior file (.nc); all that is needed.")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same answer.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object, and nothing else.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what exists.")]
Noise = Annotated[
    list[str] | None,
    typer.Option(
        "--noise",
        metavar="NAME=SD",
        help="Known measurement noise of a state dimension (x=0.002, in m; repeat for others).",
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=COLUMN,...",
        help="Column names in the files (x=pos_x,time=t), or numbers (force_x=0); with several"
        " bodies in a row, cart.x=cart_px. Other columns are left out.",
    ),
]
Units = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=UNIT,...", help="What columns are measured in, if not SI (x=mm,theta=deg)."
    ),
]
Starts = Annotated[
    list[str] | None,
    typer.Option(
        metavar="BODY=X,Y,THETA",
        help="Where a body starts (m, rad), at rest or with ,VX,VY,OMEGA; once a body.",
    ),
]


class ReadingSettings(TypedDict):
    """Arguments of `history.read_recording`."""

    columns: dict[str, str | float]
    units: dict[str, str]
    estimate_velocities: bool
    trim: bool
    resample: bool


class SceneSettings(TypedDict):
    """Arguments of `history.read_scene`."""

    noise: dict[str, float]
    substeps: int | None
    time_step: float | None


@dataclass(frozen=True)
class Reading:
    """Options of each command that reads a recording.

    Each is in place of what the scene file's ``[recording]`` says.
    """

    columns: Columns = None
    units: Units = None
    estimate_velocities: Annotated[
        bool,
        typer.Option(
            "--estimate-velocities",
            help="Start predictions from velocities estimated from positions, if none were"
            " measured.",
        ),
    ] = False
    trim: Annotated[
        bool,
        typer.Option(
            "--trim",
            help="Leave out rows at a trajectory's ends that belong to no model: a body still held,"
            " an abrupt stop.",
        ),
    ] = False
    effect_file: effect_files.EffectFiles = None

    def __post_init__(self) -> None:
        self.settings()  # bad usage is reported before any file is read

    def settings(self, resample: bool = False) -> ReadingSettings:
        """Return what the options say of a recording."""
        return {
            "columns": columns_of(self.columns),
            "units": units_of(self.units),
            "estimate_velocities": self.estimate_velocities,
            "trim": self.trim,
            "resample": resample,
        }

    def catalogue(self) -> tuple[Effect, ...]:
        """Return the catalogue and after it the effects of effect files."""
        return effect_files.with_catalogue(self.effect_file)

    def with_effects(self, scene: Scene) -> tuple[Scene, tuple[Effect | Attached, ...]]:
        """Return a scene and the effects of effect files on its bodies."""
        return effect_files.added_effects(scene, effect_files.own_effects(self.effect_file))


@dataclass(frozen=True)
class PosteriorReading(Reading):
    """Options of a command that reads a recording with the scene of a posterior."""

    resample: Annotated[
        bool,
        typer.Option(
            "--resample",
            help="Interpolate uneven samples to the scene's time step. There is no --time-step as"
            " in other commands, which sets another: a posterior holds for one time step.",
        ),
    ] = False

    def recording(self, path: Path, scene: Scene) -> History:
        """Return the history of a file."""
        from pbrl_ppl.history import read_recording

        return read_recording(path, scene, **self.settings(self.resample))


@dataclass(frozen=True)
class SceneReading(Reading):
    """Options of a command that reads a scene file and recordings."""

    noise: Noise = None
    substeps: Annotated[
        int | None, typer.Option(min=1, help="Engine steps per interval, in place of the scene's.")
    ] = None
    time_step: Annotated[
        float | None,
        typer.Option(
            min=1e-9,
            metavar="SECONDS",
            help="In place of the scene's time_step; uneven samples are interpolated to it.",
        ),
    ] = None

    def scene_settings(self) -> SceneSettings:
        """Return what the options say of a scene."""
        return {
            "noise": noise_of(self.noise),
            "substeps": self.substeps,
            "time_step": self.time_step,
        }

    def read(self, scene: Path, histories: Sequence[Path]) -> tuple[Scene, list[History]]:
        """Return the scene and its histories."""
        from pbrl_ppl.history import read_recording, read_scene

        declared = read_scene(scene, **self.scene_settings())
        settings = self.settings(self.time_step is not None)
        return declared, [read_recording(path, declared, **settings) for path in histories]


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


def noise_of(texts: list[str] | None) -> dict[str, float]:
    """Return standard deviations by state dimension from ``--noise``."""
    return dict(pairs(texts, "--noise", "x=0.002", float))


def columns_of(texts: list[str] | None) -> dict[str, str | float]:
    """Return column names, or numbers, from options such as ``x=pos_x,force_x=0``."""
    return dict(pairs(texts, "--columns", "x=pos_x", _number_or_name))


def units_of(texts: list[str] | None) -> dict[str, str]:
    """Return units from options such as ``x=mm,theta=deg``."""
    return dict(pairs(texts, "--units", "x=mm", str))


def _number_or_name(text: str) -> str | float:
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() else number


def pairs(
    texts: list[str] | None, option: str, example: str, kind: Callable[[str], T]
) -> list[tuple[str, T]]:
    """Return names and values from ``NAME=VALUE,...``."""
    pairs_read = []
    for item in ",".join(texts).split(",") if texts else ():
        name, _, value = (part.strip() for part in item.partition("="))
        try:
            if not (name and value):
                raise ValueError
            pairs_read.append((name, kind(value)))
        except ValueError:
            message = f"{item!r} is not NAME=VALUE, such as {example}"
            raise typer.BadParameter(message, param_hint=option) from None
    return pairs_read


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
    for number in numbers.split(","):
        try:
            values.append(None if number.strip() == "-" else float(number))
        except ValueError:
            raise GoalError(
                f"{option} {text}: {number.strip()!r} is not a number; expected BODY=X,Y,THETA"
            ) from None
    return name.strip(), values


def starts_of(texts: list[str] | None, bodies: Sequence[str]) -> dict[str, list[float]]:
    """Return the start of each body from ``--start``."""
    starts: dict[str, list[float]] = {}
    for text in texts or ():
        name, values = pose(text, bodies, "--start")
        starts[name] = [value for value in values if value is not None]
        if len(starts[name]) < len(values):
            raise GoalError(f"--start {text}: a start has no free coordinates; give a number for -")
    return starts
