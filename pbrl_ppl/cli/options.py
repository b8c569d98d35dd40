"""Options that commands share: their declarations, and how their values are read."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from pbrl_ppl.errors import GoalError

if TYPE_CHECKING:
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

T = TypeVar("T")

#: Trajectory ends that one warning names, at most.
_MOST_ENDS = 4

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
Substeps = Annotated[
    int | None, typer.Option(min=1, help="Engine steps per interval, in place of the scene's.")
]
Noise = Annotated[
    list[str] | None,
    typer.Option(
        "--noise",
        metavar="NAME=SD",
        help="Known measurement noise of a state dimension (x=0.002, in m; repeat for others).",
    ),
]
Velocities = Annotated[
    bool,
    typer.Option(
        "--estimate-velocities",
        help="Start predictions from velocities estimated from positions, if none were measured.",
    ),
]
Trim = Annotated[
    bool,
    typer.Option(
        "--trim",
        help="Leave out rows at a trajectory's ends that belong to no model: a body still held, an"
        " abrupt stop.",
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
        help="Interpolate uneven samples to the scene's time step. There is no --time-step as in"
        " other commands, which sets another: a posterior holds for one time step.",
    ),
]
Starts = Annotated[
    list[str] | None,
    typer.Option(
        metavar="BODY=X,Y,THETA",
        help="Where a body starts (m, rad), at rest or with ,VX,VY,OMEGA; once a body.",
    ),
]


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
            for each in value if isinstance(value, (list, tuple)) else (value,):
                options += [parameter.opts[0], str(each)]
    return shlex.join([*words, *options])


def named_numbers(given: list[str] | None, option: str, example: str) -> dict[str, float]:
    """Return numbers by name from options such as ``x=0.002``."""
    return dict(_pairs(given, option, example, float))


def noise_of(given: list[str] | None) -> dict[str, float]:
    """Return standard deviations by state dimension from ``--noise``."""
    return named_numbers(given, "--noise", "x=0.002")


def columns_of(given: list[str] | None) -> dict[str, str | float]:
    """Return column names, or numbers, from options such as ``x=pos_x,force_x=0``."""
    return dict(_pairs(given, "--columns", "x=pos_x", _number_or_name))


def _number_or_name(text: str) -> str | float:
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() else number


def units_of(given: list[str] | None) -> dict[str, str]:
    """Return units from options such as ``x=mm,theta=deg``."""
    return dict(_pairs(given, "--units", "x=mm", str))


def _pairs(
    given: list[str] | None, option: str, example: str, kind: Callable[[str], T]
) -> list[tuple[str, T]]:
    """Return names and values from ``NAME=VALUE,...``."""
    pairs = []
    for item in ",".join(given).split(",") if given else ():
        name, _, value = (part.strip() for part in item.partition("="))
        try:
            if not (name and value):
                raise ValueError
            pairs.append((name, kind(value)))
        except ValueError:
            message = f"{item!r} is not NAME=VALUE, such as {example}"
            raise typer.BadParameter(message, param_hint=option) from None
    return pairs


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


def starts_of(given: list[str] | None, bodies: Sequence[str]) -> dict[str, list[float]]:
    """Return the start of each body from ``--start``."""
    starts: dict[str, list[float]] = {}
    for text in given or ():
        name, values = pose(text, bodies, "--start")
        starts[name] = [value for value in values if value is not None]
        if len(starts[name]) < len(values):
            raise GoalError(f"--start {text}: a start has no free coordinates; give a number for -")
    return starts


@dataclass(frozen=True)
class Reading:
    """Settings for reading histories: the values of ``--columns``, ``--units`` and others.

    Parameters
    ----------
    columns, units : list of str, optional
        As typed.
    estimate_velocities : bool
        Whether velocities may be estimated from positions.
    trim : bool, optional
        Whether rows at a trajectory's ends that belong to no model are left out, or only warned of;
        None does not look for them.
    resample : bool
        Whether uneven samples are interpolated to the time step.
    """

    columns: list[str] | None = None
    units: list[str] | None = None
    estimate_velocities: bool = False
    trim: bool | None = None
    resample: bool = False

    def __post_init__(self) -> None:
        columns_of(self.columns)  # bad usage is reported before any file is read
        units_of(self.units)

    def history(self, path: Path, scene: Scene) -> History:
        """Read one history of a scene."""
        from pbrl_ppl.history import History

        return History.load(
            path,
            scene,
            estimate_velocities=self.estimate_velocities,
            columns=columns_of(self.columns),
            units=units_of(self.units),
            resample=self.resample,
        )

    def trimmed(self, history: History, scene: Scene, path: Path) -> History:
        """Return the history without strange rows at trajectory ends, or warn of them."""
        if self.trim is None:
            return history
        trim = self.trim or (scene.recording is not None and scene.recording.trim)
        from pbrl_ppl.history import strange_ends, trimmed

        ends = strange_ends(history, scene)
        if not ends:
            return history
        named = "; ".join(str(end) for end in ends[:_MOST_ENDS])
        more = f"; and {len(ends) - _MOST_ENDS} more" if len(ends) > _MOST_ENDS else ""
        cure = "no command or contact explains it: --trim leaves the rows out"
        cure = "left out" if trim else cure
        warnings.warn(f"history {path}: {named}{more}: {cure}", stacklevel=2)
        return trimmed(history, ends) if trim else history


def load(
    scene: Path,
    histories: Sequence[Path],
    reading: Reading,
    *,
    time_step: float | None = None,
    noise: list[str] | None = None,
    substeps: int | None = None,
) -> tuple[Scene, list[History]]:
    """Read a scene, change it as options say, and read its histories.

    Warns where velocities and changes of positions differ by the factor of a unit.
    """
    from pbrl_ppl.scene import Scene

    declared = Scene.load(scene)  # its errors come before pandas is loaded
    if time_step is not None:
        declared = declared.replace(time_step=time_step)
    from pbrl_ppl.history import unit_mismatches

    loaded = [reading.history(path, declared) for path in histories]
    for path, history in zip(histories, loaded, strict=True):
        for sentence in unit_mismatches(history):
            warnings.warn(f"history {path}: {sentence}", stacklevel=2)
    loaded = [
        reading.trimmed(history, declared, path)
        for path, history in zip(histories, loaded, strict=True)
    ]
    declared = declared.replace(noise=dict(declared.noise) | noise_of(noise))
    if substeps is not None:
        declared = declared.replace(substeps=substeps)
    return declared, loaded
