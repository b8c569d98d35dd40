"""Options that commands share: of a recording, of a scene, of effect files and of an output.

Parameters
----------
scene : SCENE
    Scene file (.toml).
history : HISTORY
    Measured history (.csv, .parquet, .nc, ...); several files, or a folder
    of them, are one history.
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

import shlex
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

import typer

from pbrl_ppl.cli.terminal import check_file
from pbrl_ppl.errors import EffectError, GoalError
from pbrl_ppl.system.files import check_folder, check_regular

if TYPE_CHECKING:
    from pbrl_ppl.effects import Attached, Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

T = TypeVar("T")

OutputFile = Annotated[Path, typer.Option("-o", "--output", metavar="FILE")]
OutputFolder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR")]
Seed = Annotated[int, typer.Option(min=0)]
Count = Annotated[int, typer.Option(min=1)]
Transitions = Annotated[int, typer.Option(min=100)]
#: Of `history`, whose import takes long.
MOST_TRANSITIONS = 3000


@dataclass(frozen=True)
class Output:
    """Options of each command that can write a file; its path is checked before any work."""

    endings: ClassVar[tuple[str, ...]] = (".csv", ".parquet", ".nc")

    output: OutputFile | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.output is not None:
            check_file(self.output, self.endings, self.overwrite)


@dataclass(frozen=True)
class RecordingOutput(Output):
    """Options of a command that writes a recording."""

    output: OutputFile = field()


@dataclass(frozen=True)
class PosteriorOutput(RecordingOutput):
    """Options of a command that writes a posterior file.

    Parameters
    ----------
    output
        The posterior file (.nc).
    """

    endings = (".nc",)


@dataclass(frozen=True)
class TableOutput(RecordingOutput):
    """Options of a command that writes a table."""

    endings = (".csv",)


@dataclass(frozen=True)
class FolderOutput:
    """Options of a command that writes to a folder, which is checked before any work.

    Parameters
    ----------
    output
        Folder for the results.
    overwrite
        Write to a folder that is not empty.
    """

    output: OutputFolder
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_folder(self.output, self.overwrite)


@dataclass(frozen=True)
class EffectFiles:
    """Option of each command that looks effects up."""

    effect_file: list[Path] | None = None

    def catalogue(self) -> tuple[Effect, ...]:
        """Return the catalogue and after it the effects of effect files."""
        from pbrl_ppl.effects import catalogue

        return (*catalogue, *own_effects(self.effect_file))


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
class RecordingReading(EffectFiles, Columns):
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

    def __post_init__(self) -> None:
        self.settings()  # bad usage is reported before any file is read

    def settings(self) -> dict[str, Any]:
        """Return arguments of `history.read_recording`."""
        flags = {"estimate_velocities": self.estimate_velocities, "trim": self.trim}
        return self.layout() | flags

    def recording(self, paths: Sequence[Path], scene: Scene, *, resample: bool) -> History:
        """Return the history of files."""
        from pbrl_ppl.history import read_recording

        return read_recording(paths, scene, resample=resample, **self.settings())


@dataclass(frozen=True)
class PosteriorReading(RecordingReading):
    """Options of a command that reads a recording with the scene of a posterior.

    Parameters
    ----------
    resample
        Interpolate uneven samples to the scene's time step. There is no --time-step as in other
        commands, which sets another: a posterior holds for one time step.
    """

    resample: bool = False


@dataclass(frozen=True)
class SceneReading(RecordingReading):
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

    def read(self, scene: Path, histories: Sequence[Sequence[Path]]) -> tuple[Scene, list[History]]:
        """Return the scene and its histories, each of one file or more."""
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
        several = parameter.nargs != 1 or getattr(parameter, "multiple", False)
        items = list(map(str, value if several else (value,)))
        if parameter.param_type_name == "argument":
            words += items
        elif value is True:
            options.append(parameter.opts[0])
        else:
            options += chain.from_iterable((parameter.opts[0], item) for item in items)
    return shlex.join([*words, *options])


def given(values: Mapping[str, T | None]) -> dict[str, T]:
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


def only_body(bodies: Sequence[str], option: str, rest: str) -> str:
    """Return the body that an option leaves out; where there are several, it must have one."""
    if len(bodies) > 1:
        raise GoalError(f"{option}: say which body: {bodies[0]}{rest}")
    return bodies[0]


def pose(text: str, bodies: Sequence[str], option: str) -> tuple[str, list[float | None]]:
    """Return a body and its numbers from ``BODY=X,Y,THETA``.

    The body may be left out if there is one. A free coordinate, ``-``, is None.
    """
    name, separator, numbers = text.rpartition("=")
    name = name if separator else only_body(bodies, f"{option} {text}", f"={text}")
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


def own_effects(paths: Sequence[Path] | None) -> tuple[Effect, ...]:
    """Return the effects that effect files define, in their order.

    Raises
    ------
    EffectError
        If there is no such file, its code raises, it defines no effect, an effect has the name of
        a catalogue effect, or two have one name.
    """
    from pbrl_ppl.effects import catalogue

    effects: dict[str, Effect] = {}
    for path in paths or ():
        for effect in _defined(path):
            if effect in catalogue:  # imported by the file
                continue
            if effects.setdefault(effect.name, effect) is not effect:
                raise EffectError(
                    f"effect file {path}: there are two effects {effect.name}; rename one"
                )
    return tuple(effects.values())


def added_effects(
    scene: Scene, effects: Sequence[Effect]
) -> tuple[Scene, tuple[Effect | Attached, ...]]:
    """Return a scene without its own effects' names, and these effects on their bodies.

    An effect that the scene declares by name acts on those bodies, another one on every body that
    it applies to.
    """
    added: list[Effect | Attached] = []
    for effect in effects:
        declared = [body.name for body in scene.bodies if effect.name in body.effects]
        added += [effect.on(body) for body in declared] or [effect]
    names = {effect.name for effect in effects}
    bodies = tuple(
        replace(body, effects=tuple(name for name in body.effects if name not in names))
        for body in scene.bodies
    )
    return scene.replace(bodies=bodies), tuple(added)


def _defined(path: Path) -> list[Effect]:
    """Run a file, and return its effects at module level."""
    from pbrl_ppl.effects import Effect, check_names

    try:
        check_regular(path)
        source = path.read_bytes()
    except OSError as error:
        raise EffectError(
            f"effect file {path}: it cannot be read ({error.strerror}); give the path of a Python"
            " file"
        ) from None
    # no module of the program: where effects are pickled, their laws go along
    names: dict[str, object] = {"__name__": f"effect_file_{path.stem}", "__file__": str(path)}
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), names)
    except Exception as error:
        raise EffectError(
            f"effect file {path}{_line(error, path)}: {type(error).__name__}: {error}; fix the file"
        ) from error
    effects = [*dict.fromkeys(value for value in names.values() if isinstance(value, Effect))]
    if not effects:
        raise EffectError(
            f"effect file {path}: it has no Effect at module level, such as tether ="
            " pp.Effect(...); define one"
        )
    try:
        check_names(effects)
    except EffectError as error:
        raise EffectError(f"effect file {path}: {error}") from None
    return effects


def _line(error: Exception, path: Path) -> str:
    """Return the line of a file at which an error was raised, in words; none if it is unknown."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f", line {error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""
