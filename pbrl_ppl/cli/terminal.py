"""Helpers of the commands: reading files, progress, interrupts, and messages in a line."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from pbrl_ppl.errors import OutputError

if TYPE_CHECKING:
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

#: Exit codes: a failed calibration, a failed log, or a goal that was not reached; bad input as for
#: bad usage; no verdict, for the chains have not converged; an interrupt as the shell has it.
FAILED, BAD_INPUT, UNDECIDED, INTERRUPTED = 1, 2, 3, 130

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.toml).")]
Velocities = Annotated[
    bool,
    typer.Option(
        "--estimate-velocities",
        help="Start predictions from velocities estimated from positions, if none were measured.",
    ),
]


def load_files(scene: Path, history: Path, estimate_velocities: bool) -> tuple[Scene, History]:
    """Read a scene and a history of it."""
    from pbrl_ppl.scene import Scene

    declared = Scene.load(scene)  # its errors come before pandas is loaded
    from pbrl_ppl.history import History

    return declared, History.load(history, declared, estimate_velocities=estimate_velocities)


def stated_noise(scene: Scene, given: list[str]) -> Scene:
    """The scene with errors of measuring from options such as ``x=0.002``."""
    return scene.replace(noise=dict(scene.noise) | noise_of(given))


def noise_of(given: list[str]) -> dict[str, float]:
    """Errors of measuring by state dimension, from options such as ``x=0.002``."""
    noise = {}
    for item in given:
        name, _, value = item.partition("=")
        try:
            noise[name.strip()] = float(value)
        except ValueError:
            raise typer.BadParameter(
                f"{item!r} is not NAME=VALUE, such as x=0.002", param_hint="--noise"
            ) from None
    return noise


def check_free(path: Path, overwrite: bool) -> None:
    """Refuse to write where there is a file, unless that is wanted."""
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: it exists; choose another file, or pass --overwrite")


@contextmanager
def stages(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show stages on stderr: a status line on a terminal, one line each elsewhere."""
    console = Console(stderr=True, quiet=quiet, highlight=False, markup=False)
    begin = time.monotonic()
    with console.status("starting") as status:

        def progress(stage: str) -> None:
            console.print(f"[{time.monotonic() - begin:5.1f} s] {stage}", soft_wrap=True)
            status.update(stage)

        yield progress


@contextmanager
def interruptible(state: str = "nothing was written") -> Iterator[None]:
    """Say what is left; results are renamed into place as the last thing."""
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(interrupted(state)) from None


def interrupted(state: str = "nothing was written") -> int:
    """Say what an interrupt left, and give the exit code."""
    print(f"interrupted; {state}", file=sys.stderr)  # noqa: T201
    return INTERRUPTED


@contextmanager
def warnings_in_a_line() -> Iterator[None]:
    """Show warnings without the line of code they are from."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)  # noqa: T201

    with warnings.catch_warnings():
        # for authors of libraries, not for users of a command
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        # a fast BLAS would change nothing here: the time goes into the engine
        warnings.filterwarnings("ignore", message="PyTensor could not link to a BLAS")
        warnings.showwarning = show
        yield
