"""Command line: ``pbrl-ppl close-loop``, ``check``, ``calibrate``, ``update`` and ``plan``.

Imports of the package stand inside the functions: PyMC takes seconds to load, and ``--help`` or a
mistyped path should not wait for it.
"""

from __future__ import annotations

import json
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

from pbrl_ppl.errors import GoalError, OutputError, PbrlError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from pbrl_ppl.history import History
    from pbrl_ppl.ranks import Calibration
    from pbrl_ppl.scene import Scene

#: Exit codes: a failed calibration or a goal that was not reached; bad input as for bad usage; an
#: interrupt as the shell has it.
FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

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
        0; 1 for a calibration that failed or a goal that was not reached; 2 for bad usage or bad
        input, with one message on stderr; 130 if interrupted.
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


@app.command()
def calibrate(
    scene: _SceneFile,
    history: Annotated[
        Path, typer.Argument(metavar="HISTORY", help="History whose design is kept (.csv, ...).")
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="DIR", help="Folder for results; goes on there."),
    ],
    replications: Annotated[int, typer.Option(min=2, help="Simulated histories.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    draws: Annotated[int, typer.Option(min=100, help="Posterior draws of each chain.")] = 1500,
    estimate_velocities: _Velocities = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Simulate from the prior, fit, and test whether the true values' ranks are uniform."""
    with _interruptible(f"finished replications are in {output}; the same command goes on"):
        declared, design = _load(scene, history, estimate_velocities)
        os.environ.setdefault("MPLBACKEND", "Agg")
        from pbrl_ppl import calibration, plots
        from pbrl_ppl.history_files import write_atomically

        with _pool(jobs) as executor:
            result = calibration.calibrate(
                declared, design, replications=replications, seed=seed, draws=draws, folder=output,
                executor=executor, progress=not quiet,
            )  # fmt: skip
        result.save(output / "ranks.nc")
        write_atomically(output / "table.csv", result.table().to_csv)
        picture = plots.png(plots.plot_calibration(result))
        write_atomically(output / "ranks.png", lambda to: to.write_bytes(picture))
    typer.echo(_calibrated(result))
    typer.echo(f"{'passed' if result.passed else 'failed'}: {output / 'ranks.png'}")
    if not result.passed:
        raise typer.Exit(FAILED)


@app.command()
def update(
    posterior: Annotated[
        Path, typer.Argument(metavar="POSTERIOR", help="Posterior file (.nc); it has the scene.")
    ],
    history: Annotated[
        Path, typer.Argument(metavar="HISTORY", help="What was recorded since (.csv, ...).")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="The new posterior file.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that exists.")
    ] = False,
    estimate_velocities: _Velocities = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Bring a posterior up to date with new transitions, without a fit from scratch."""
    with _interruptible(), _stages(quiet) as progress:
        _check_free(output, overwrite)
        progress("reading the posterior and the history")
        from pbrl_ppl.history import History
        from pbrl_ppl.posterior import load_posterior, save_posterior, scene_of

        idata = load_posterior(posterior)
        new = History.load(history, scene_of(idata), estimate_velocities=estimate_velocities)
        progress("updating")
        from pbrl_ppl import updating

        idata = updating.update(idata, new, seed=seed, progress=False)
        save_posterior(idata, output)
        (*_, last) = json.loads(idata.attrs["updates"])
    typer.echo(
        f"{last['did']}: {last['transitions']} transitions, the weights worth {last['share']:.0%}"
        " of the draws"
    )
    typer.echo(f"posterior: {output}")


@app.command()
def plan(
    posterior: Annotated[
        Path, typer.Argument(metavar="POSTERIOR", help="Posterior file (.nc); all that is needed.")
    ],
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BODY=X,Y,THETA",
            help="Where a body starts (m, rad), at rest or with ,VX,VY,OMEGA; once a body.",
        ),
    ] = None,
    goal: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BODY=X,Y,THETA",
            help="Where a body should be, - where free; once a body. Or a goal file (.toml).",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="The plan (.csv).")
    ] = None,
    actions: Annotated[
        Path | None,
        typer.Option(help="Actions (.toml); such as the posterior's data were recorded with."),
    ] = None,
    method: Annotated[str, typer.Option(help="astar or mppi.")] = "astar",
    draws: Annotated[
        int | None, typer.Option(min=1, help="Posterior draws to plan with; the MAP if not given.")
    ] = None,
    tail: Annotated[
        float, typer.Option(help="Share of the worst draws that count; 1 is the expectation.")
    ] = 1.0,
    noise: Annotated[bool, typer.Option("--noise", help="Plan with Eq. 13's noise.")] = False,
    tolerance: Annotated[float | None, typer.Option(help="How near is there (m).")] = None,
    angle_tolerance: Annotated[float | None, typer.Option(help="How near is there (rad).")] = None,
    contact_penalty: Annotated[
        float | None, typer.Option(help="Cost of a second in contact (s); inf forbids it.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Limit of the search (s).")] = 60.0,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    animate: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Show the plan as a picture that moves (.gif)."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that exist.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Plan from a start to a goal with a posterior file, and nothing else."""
    with _interruptible(), _stages(quiet) as progress:
        if output is None and animate is None:
            raise GoalError("plan: say where it should be written: -o plan.csv")
        for path, ending in ((output, ".csv"), (animate, ".gif")):
            if path is not None:
                _check_output(path, ending, overwrite)
        progress("reading the posterior")
        from pbrl_ppl.planning.actions import ActionSet
        from pbrl_ppl.planning.goals import Goal
        from pbrl_ppl.planning.plan import plan as make_plan
        from pbrl_ppl.posterior import load_posterior, scene_of

        idata = load_posterior(posterior)
        only = [body.name for body in scene_of(idata).dynamic]
        options = {
            "tolerance": tolerance,
            "angle_tolerance": angle_tolerance,
            "contact_penalty": contact_penalty,
        }
        given = {name: value for name, value in options.items() if value is not None}
        if goal and goal[0].endswith(".toml"):
            if len(goal) > 1 or given:
                raise GoalError("--goal: a file has the whole goal; drop the other options of it")
            wanted = Goal.load(goal[0])
        else:
            wanted = Goal.of(dict(_pose(text, only, "--goal") for text in goal or ()), **given)
        places = dict(_pose(text, only, "--start") for text in start or ())
        allowed = None if actions is None else ActionSet.load(actions)
        progress("planning")
        result = make_plan(
            idata, places, wanted, allowed, method=method, draws=draws, tail=tail, noise=noise,
            seconds=seconds, seed=seed, progress=progress,
        )  # fmt: skip
        if output is not None:
            result.save(output)
        if animate is not None:
            progress("drawing")
            os.environ.setdefault("MPLBACKEND", "Agg")
            from pbrl_ppl.scene_plots import animate_plan

            animate_plan(result, animate)
    typer.echo(result.in_words())
    for path in (output, animate):
        if path is not None:
            typer.echo(f"plan: {path}")
    if not result.reached:
        raise typer.Exit(FAILED)


def _pose(text: str, bodies: Sequence[str], option: str) -> tuple[str, list[float]]:
    """A body and its numbers from ``BODY=X,Y,THETA``; the body may be left out if there is one.

    A coordinate that is free, ``-``, is None.
    """
    name, separator, numbers = text.rpartition("=")
    if not separator:
        if len(bodies) > 1:
            raise GoalError(f"{option} {text}: say which body: {bodies[0]}={text}")
        name = bodies[0]
    values = []
    for number in numbers.split(","):
        try:
            values.append(None if number.strip() == "-" else float(number))
        except ValueError:
            raise GoalError(
                f"{option} {text}: {number.strip()!r} is not a number; expected BODY=X,Y,THETA"
            ) from None
    if option == "--start" and None in values:
        raise GoalError(f"{option} {text}: a start has no free coordinates; give a number for -")
    return name.strip(), values  # type: ignore[return-value]


def _check_free(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: it exists; choose another file, or pass --overwrite")


def _check_output(path: Path, ending: str, overwrite: bool) -> None:
    """Refuse an output before the long work whose result would be lost."""
    if path.suffix != ending:
        raise OutputError(f"{path}: expected a name that ends in {ending}")
    _check_free(path, overwrite)
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it, or choose another")


@contextmanager
def _pool(jobs: int) -> Iterator[Executor | None]:
    """Fresh processes: PyMC's threads do not survive a fork."""
    if jobs == 1:
        yield None
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield pool


def _calibrated(calibration: Calibration) -> str:
    """The table's columns that matter, and what they should be."""
    rows, data = calibration.table(), calibration.dataset
    head = rows.iloc[0]
    columns = ["p_holm", "coverage_50", "coverage_90", "ess", "r_hat", "passed"]
    short = int((data["size"] < data["size"].max()).any("parameter").sum())
    ranges = (f"{head[f'low_{level}']:.3g} to {head[f'high_{level}']:.3g}" for level in (50, 90))
    return (
        rows[columns].to_string(float_format="{:.4g}".format, index_names=False)
        + f"\n{data.sizes['replication']} replications, {short} with too few effective draws;"
        " expected of a right sampler: p_holm at least 0.01, coverages in " + ", ".join(ranges)
    )


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
def _interruptible(state: str = "nothing was written") -> Iterator[None]:
    """Say what is left; results are renamed into place as the last thing."""
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(_interrupted(state)) from None


def _interrupted(state: str = "nothing was written") -> int:
    print(f"interrupted; {state}", file=sys.stderr)  # noqa: T201
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
