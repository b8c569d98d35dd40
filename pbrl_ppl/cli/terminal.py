"""Terminal and files: progress, interrupts, warnings, output, checks of output paths."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pbrl_ppl.errors import OutputError

if TYPE_CHECKING:
    from pbrl_ppl.scene import Scene

#: Exit codes: a failed calibration, a failed log, a goal that was not reached, or effects that stay
#: inseparable; bad input as for bad usage; no verdict, for the chains have not converged; an
#: interrupt as the shell has it.
FAILED, BAD_INPUT, UNDECIDED, INTERRUPTED = 1, 2, 3, 130

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.toml).")]
HistoryFile = Annotated[
    Path, typer.Argument(metavar="HISTORY", help="Measured history (.csv, .parquet, .nc).")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same answer.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object, and nothing else.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what exists.")]
Substeps = Annotated[
    int | None, typer.Option(min=1, help="Engine steps per interval, for the scene's.")
]
Errors = Annotated[
    list[str] | None,
    typer.Option(
        "--noise",
        metavar="NAME=SD",
        help="Known error of measuring a state dimension (x=0.002, in m; repeat for others).",
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

#: What messages for Python advise besides, by the argument that it takes: left out of a command's
#: messages if it has no such option.
_ADVICE = {"thin": " or thin=", "resume": ", or go on with resume= this posterior"}
#: An argument named in a message for Python.
_ARGUMENT = re.compile(r"\b([a-z_]+)=(?:True\b)?(?=[\s,;.)]|$)")


def named_numbers(given: list[str] | None, option: str, example: str) -> dict[str, float]:
    """Numbers by name from options such as ``x=0.002``."""
    numbers = {}
    for item in given or []:
        name, _, value = item.rpartition("=")
        try:
            numbers[name.strip()] = float(value)
        except ValueError:
            name = ""
        if not name.strip():
            raise typer.BadParameter(
                f"{item!r} is not NAME=VALUE, such as {example}", param_hint=option
            )
    return numbers


def stated_noise(scene: Scene, given: list[str] | None) -> Scene:
    """The scene with errors of measuring from options such as ``x=0.002``."""
    return scene.replace(noise=dict(scene.noise) | named_numbers(given, "--noise", "x=0.002"))


def with_substeps(scene: Scene, substeps: int | None) -> Scene:
    """The scene with engine steps from the option, if it was given."""
    return scene if substeps is None else scene.replace(substeps=substeps)


@contextmanager
def stages(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show stages on stderr with the time elapsed: on a terminal the present one runs on."""
    console = Console(stderr=True, quiet=quiet, highlight=False, markup=False)
    running = Stage()
    with console.status(running):

        def progress(stage: str) -> None:
            console.print(f"[{running.elapsed:5.1f} s] {stage}", soft_wrap=True)
            running.name = stage

        yield progress


class Stage:
    """The present stage and the time elapsed, as a status line that is drawn again and again."""

    def __init__(self) -> None:
        self.name, self._begin = "starting", time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._begin

    def __rich__(self) -> Text:
        return Text(f"{self.name}, {self.elapsed:.0f} s")


@contextmanager
def interruptible(state: str = "nothing was written") -> Iterator[list[int]]:
    """Say what is left; results are renamed into place as the last thing.

    Yields the interrupts so far: a sampler may end at one as if nothing had happened.
    """
    seen: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        signal.default_int_handler(number, frame)

    # in the background interrupts are ignored, and stay so
    own = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    own = own and threading.current_thread() is threading.main_thread()
    if own:
        signal.signal(signal.SIGINT, note)
    try:
        yield seen
    except KeyboardInterrupt:
        raise typer.Exit(interrupted(state)) from None
    finally:
        if own:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def interrupted(state: str = "nothing was written") -> int:
    """Say what an interrupt left, and give the exit code."""
    print(f"interrupted; {state}", file=sys.stderr)  # noqa: T201
    return INTERRUPTED


def in_options(message: str, options: Collection[str]) -> str:
    """A message for Python in one line and in the words of a command: its options.

    Parameters
    ----------
    message : str
        Names arguments as ``draws=`` or ``estimate_velocities=True``.
    options : collection of str
        The command's, as ``--draws``.

    Examples
    --------
    >>> in_options("raise draws= or thin=, or measure y", ["--draws"])
    'raise --draws, or measure y'
    """
    message = " ".join(message.split())
    for name, words in _ADVICE.items():
        if f"--{name}" not in options:
            message = message.replace(words, "")

    def option(match: re.Match[str]) -> str:
        name = f"--{match[1].replace('_', '-')}"
        return name if name in options else match[0]

    return _ARGUMENT.sub(option, message)


@contextmanager
def warnings_in_a_line(options: Collection[str] = ()) -> Iterator[None]:
    """Show warnings without the line of code they are from, in a command's words."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        print(f"warning: {in_options(str(message), options)}", file=sys.stderr)  # noqa: T201

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        # for authors of libraries, not for users of a command
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        # a fast BLAS would change nothing here: the time goes into the engine
        warnings.filterwarnings("ignore", message="PyTensor could not link to a BLAS")
        warnings.showwarning = show
        yield


_WIDE = 160


def print_json(contents: Mapping[str, Any]) -> None:
    """Print one JSON object; numbers that are not finite become null."""
    typer.echo(json.dumps(_plain(contents), indent=1, allow_nan=False))


def print_table(title: str | None, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column is text; of the others, those that begin with < are too."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for i, name in enumerate(columns):
        left = i == 0 or name.startswith("<")
        table.add_column(
            name.removeprefix("<"), justify="left" if left else "right", no_wrap=not left
        )
    for row in rows:
        table.add_row(*row)
    # a file or a pipe is as wide as it need be
    width = None if sys.stdout.isatty() else _WIDE
    Console(highlight=False, markup=False, width=width).print(table)


def _plain(value: Any) -> Any:
    """Values that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy's
        value = value.tolist()
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def check_file(path: Path, endings: tuple[str, ...], overwrite: bool) -> None:
    """Refuse a file that has the wrong ending, exists already, or cannot be written.

    Raises
    ------
    OutputError
        Says which.
    """
    if path.suffix not in endings:
        raise OutputError(f"{path}: expected a name that ends in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path}: it is a folder; choose another name")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: it exists; choose another file, or pass --overwrite")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it, or choose another")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.stem}."):
            pass
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); choose another file"
        ) from None


def check_can_make(folder: Path) -> None:
    """Refuse a folder that cannot be made or written: it is tried, and nothing stays.

    Raises
    ------
    OutputError
        If it cannot.
    """
    made: list[Path] = []
    try:
        for each in reversed((folder, *folder.parents)):
            if not each.exists():
                each.mkdir()
                made.append(each)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (NotADirectoryError, FileExistsError):
        pass  # a file is in the way, and `report.check_folder` says which
    except OSError as error:
        raise OutputError(
            f"output folder {folder}: it cannot be made or written ({error.strerror}); choose"
            " another path"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            for each in reversed(made):
                each.rmdir()
