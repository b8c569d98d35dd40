"""Command line: ``pbrl-ppl close-loop`` and ``pbrl-ppl check``.

Imports of the package stand inside the functions: PyMC takes seconds to load, and ``--help`` or a
mistyped path should not wait for it.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from pbrl_ppl.errors import PbrlError

if TYPE_CHECKING:
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene

#: Exit codes: bad input as for bad usage, and an interruption as the shell has it.
BAD_INPUT, INTERRUPTED = 2, 130

app = typer.Typer(
    name="pbrl-ppl",
    help="A physics engine as model prior, and a loop that closes on measured data.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.toml).")]
_Velocities = Annotated[
    bool,
    typer.Option(
        "--estimate-velocities",
        help="Start predictions from velocities estimated from positions, if none were measured.",
    ),
]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        0; 2 for bad usage or bad input, with one message on stderr; 130 if interrupted.
    """
    try:
        with _warnings_in_a_line():
            app(args=None if argv is None else list(argv), prog_name="pbrl-ppl")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        return _interrupted()
    except PbrlError as error:
        # one line, whatever the message quotes from a file
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        return BAD_INPUT
    return 0


def _show_version(value: bool) -> None:
    if value:
        try:
            typer.echo(f"pbrl-ppl {version('pbrl_ppl')}")
        except PackageNotFoundError:
            typer.echo("pbrl-ppl (not installed)")
        raise typer.Exit


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and leave."
        ),
    ] = False,
) -> None:
    """Options before any command."""


@app.command("close-loop")
def close_loop(
    scene: _SceneFile,
    train: Annotated[
        Path, typer.Argument(metavar="TRAIN", help="Measured history (.csv, .parquet, .nc).")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")
    ],
    test: Annotated[
        Path | None,
        typer.Option(
            metavar="TEST",
            help="Held-out history; without it, a quarter of TRAIN's trajectories.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write to a folder that has content.")
    ] = False,
    substeps: Annotated[
        int | None, typer.Option(min=1, help="Engine steps per interval, for the scene's.")
    ] = None,
    horizon: Annotated[
        int | None, typer.Option(min=1, help="Intervals predicted at once; chosen if not given.")
    ] = None,
    draws: Annotated[
        int | None, typer.Option(min=100, help="Posterior draws of each chain.")
    ] = None,
    estimate_velocities: _Velocities = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Find what the declared model lacks, add it, refit, and report before and after."""
    with _interruptible(), _stages(quiet) as progress:
        progress("reading the scene and the histories")
        declared, history = _load(scene, train, estimate_velocities)
        held_out = None
        if test is not None:
            _, held_out = _load(scene, test, estimate_velocities)
        if substeps is not None:
            declared = declared.replace(substeps=substeps)
        progress("loading the sampler")
        # nobody is there to see a window
        os.environ.setdefault("MPLBACKEND", "Agg")
        from pbrl_ppl import report

        # before the long work, which would be lost
        report.check_folder(output, overwrite)
        options = {"draws": draws, "horizon": horizon}
        given = {name: value for name, value in options.items() if value is not None}
        loop = report.close_loop(declared, history, held_out, seed=seed, progress=progress, **given)
        progress("writing the report")
        loop.save(output, overwrite=overwrite)
    typer.echo(report.verdict_in_words(loop.findings))
    typer.echo(f"report: {output / 'report.html'}")


@app.command()
def check(
    scene: _SceneFile,
    history: Annotated[
        Path, typer.Argument(metavar="HISTORY", help="Measured history (.csv, .parquet, .nc).")
    ],
    estimate_velocities: _Velocities = False,
) -> None:
    """Read a scene and a history, and show what is in them and what is missing."""
    with _interruptible():
        declared, loaded = _load(scene, history, estimate_velocities)
        from pbrl_ppl.physics import check_history

        check_history(declared, loaded, loaded.segments(1))
        console = Console(highlight=False)
        console.print(_contents(declared, loaded))
        console.print(_cells(loaded))


def _load(scene: Path, history: Path, estimate_velocities: bool) -> tuple[Scene, History]:
    from pbrl_ppl.scene import Scene

    declared = Scene.load(scene)  # its errors come before pandas is loaded
    from pbrl_ppl.history import History

    return declared, History.load(history, declared, estimate_velocities=estimate_velocities)


def _contents(scene: Scene, history: History) -> Table:
    rows = history.dataset["n_rows"].to_numpy()
    intervals = (
        f"{rows.min() - 1}" if rows.min() == rows.max() else f"{rows.min() - 1} to {rows.max() - 1}"
    )
    table = Table(show_header=False, box=None)
    for name, value in (
        ("moving bodies", ", ".join(body.name for body in scene.dynamic)),
        ("walls, joints", f"{len(scene.walls)}, {len(scene.joints)}"),
        ("trajectories", f"{history.n_trajectories}"),
        ("transitions", f"{history.n_transitions} ({intervals} in a trajectory)"),
        ("time step", f"{scene.time_step:g} s, {scene.substeps} engine steps"),
    ):
        table.add_row(name, value)
    return table


def _cells(history: History) -> Table:
    """Share of missing cells, by body and state dimension."""
    dataset = history.dataset
    # rows after a trajectory's end are padding, not missing measurements
    real = dataset["time"] < dataset["n_rows"]
    missing = dataset["observed"].isnull() & real
    table = Table(title="missing measurements", title_justify="left")
    table.add_column("body")
    for name in dataset["state"].to_numpy():
        table.add_column(str(name), justify="right")
    total = int(real.sum())
    for body in history.bodies:
        counts = missing.sel(body=body).sum(("trajectory", "time")).to_numpy()
        cells = ("none" if n == 0 else "all" if n == total else f"{n} of {total}" for n in counts)
        table.add_row(body, *cells)
    return table


@contextmanager
def _stages(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show stages on stderr: a status line on a terminal, one line each elsewhere."""
    console = Console(stderr=True, quiet=quiet, highlight=False, markup=False)
    begin = time.monotonic()
    with console.status("starting") as status:

        def progress(stage: str) -> None:
            console.print(f"[{time.monotonic() - begin:5.1f} s] {stage}", soft_wrap=True)
            status.update(stage)

        yield progress


@contextmanager
def _interruptible() -> Iterator[None]:
    """Say that nothing was written; results are renamed into place as the last thing."""
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(_interrupted()) from None


def _interrupted() -> int:
    print("interrupted; nothing was written", file=sys.stderr)  # noqa: T201
    return INTERRUPTED


@contextmanager
def _warnings_in_a_line() -> Iterator[None]:
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
