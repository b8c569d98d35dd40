"""``pbrl-ppl close-loop``, on one log or on many."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbrl_ppl.cli import effect_files, options
from pbrl_ppl.cli.commands import command
from pbrl_ppl.cli.terminal import (
    FAILED,
    INTERRUPTED,
    UNDECIDED,
    check_can_make,
    interrupted,
    interruptible,
    print_result,
    stages,
)
from pbrl_ppl.errors import OutputError

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Loop
    from pbrl_ppl.history import History
    from pbrl_ppl.reporting import Source
    from pbrl_ppl.scene import Scene


#: How sentences on found effects begin.
_FOUND = ("simulations name", "added")


class Method(StrEnum):
    """Samplers of the loop's posteriors."""

    IMPORTANCE = "importance"
    METROPOLIS = "metropolis"
    LAPLACE = "laplace"


@command("close-loop", 5, "pbrl-ppl close-loop scene.toml train.csv -o report/")
def close_loop(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")
    ],
    scene: Annotated[
        Path | None, typer.Argument(metavar="SCENE", help="Scene file (.toml).")
    ] = None,
    train: Annotated[
        Path | None,
        typer.Argument(metavar="TRAIN", help="Measured history (.csv, .parquet, .nc)."),
    ] = None,
    test: Annotated[
        Path | None,
        typer.Option(
            metavar="TEST",
            help="Held-out history; without it, a quarter of TRAIN's trajectories.",
        ),
    ] = None,
    seed: options.Seed = 1,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite",
            help="Write to a folder that has content; with --many, run finished logs again.",
        ),
    ] = False,
    substeps: options.Substeps = None,
    draws: Annotated[
        int | None, typer.Option(min=100, help="Posterior draws of each chain.")
    ] = None,
    method: Annotated[
        Method,
        typer.Option(
            help="importance weights particles of a cheaper posterior by the engine; metropolis"
            " runs chains; laplace takes Gaussians at the modes, on which the verdict then stands."
        ),
    ] = Method.IMPORTANCE,
    effect_file: effect_files.EffectFiles = None,
    noise: options.Noise = None,
    estimate_velocities: options.Velocities = False,
    columns: options.Columns = None,
    units: options.Units = None,
    time_step: options.TimeStep = None,
    trim: options.Trim = False,
    many: Annotated[
        Path | None,
        typer.Option(
            metavar="MANIFEST",
            help="Many logs in place of SCENE and TRAIN: a CSV file with the columns name, scene,"
            " train, test, kind. The same command goes on after an interrupt.",
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Logs at a time, with --many.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A Dask scheduler that has the workers, for --many."),
    ] = None,
    learn_remainder: Annotated[
        bool,
        typer.Option(
            "--learn-remainder",
            help="Where something stays unexplained, learn a force for it, into remainder.nc; it"
            " gets no name.",
        ),
    ] = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict. With --many, exits with
    1 if some logs failed.
    """
    if many is not None:
        if not (scene is train is test is None):
            raise typer.BadParameter("SCENE, TRAIN and --test are in the manifest, with --many")
        for name, given in (
            ("--trim", trim),
            ("--learn-remainder", learn_remainder),
            ("--effect-file", effect_file),
        ):
            if given:
                raise typer.BadParameter(f"{name} is for one log; omit it, or omit --many")
        _close_many(
            many, output, jobs=jobs, scheduler=scheduler, as_json=as_json, quiet=quiet,
            again=overwrite, seed=seed, substeps=substeps, draws=draws,
            method=method.value, noise=options.noise_of(noise),
            columns=options.columns_of(columns), units=options.units_of(units), time_step=time_step,
            estimate_velocities=estimate_velocities, command=options.command_line(context),
        )  # fmt: skip
        return
    if scene is None or train is None:
        raise typer.BadParameter("expected SCENE and TRAIN, or --many MANIFEST")
    if jobs > 1 or scheduler is not None:
        raise typer.BadParameter("--jobs and --scheduler are for --many")
    reading = options.Reading(columns, units, estimate_velocities, trim, time_step is not None)
    with interruptible(), stages(quiet) as progress:
        check_can_make(output)  # before the long work, which would be lost
        progress("reading the scene and the histories")
        paths = [train] if test is None else [train, test]
        declared, histories = options.load(
            scene, paths, reading, time_step=time_step, noise=noise, substeps=substeps
        )
        catalogue = {"catalogue": effect_files.with_catalogue(effect_file)} if effect_file else {}
        progress("loading the sampler")
        import pbrl_ppl.reporting as report
        from pbrl_ppl import criticism

        criticism.check_folder(output, overwrite)
        if learn_remainder:
            criticism.check_scikit_learn()
        loop, stopped = _finished(
            declared, histories, progress, seed=seed, draws=draws, method=method.value, **catalogue,
        )  # fmt: skip
        progress("writing the report")
        source = report.Source(
            str(scene), str(train), str(test or ""), options.command_line(context)
        )
        loop.save(output, overwrite, page=report.render(loop, source))
        remainder = _remainder(loop, output, source, seed, progress) if learn_remainder else {}
    words = remainder["learned_remainder"]["words"] if remainder else ""
    print_result(
        as_json,
        loop.to_dict() | {"report": output / "report.html"} | remainder,
        report.in_brief(loop, output, words),
    )
    if stopped:
        raise typer.Exit(INTERRUPTED)
    if loop.verdict == criticism.NOT_CONVERGED:
        raise typer.Exit(UNDECIDED)


def _finished(
    scene: Scene, histories: Sequence[History], progress: Callable[[str], None], **settings: Any
) -> tuple[Loop, bool]:
    """Return the loop, with Gaussians at the modes if it is interrupted while it samples.

    The second value is whether it was. An earlier interrupt ends the command, and says what was
    found.
    """
    from pbrl_ppl import criticism

    found: list[str] = []

    def noted(stage: str) -> None:
        progress(stage)
        if stage.startswith(_FOUND):
            found.append(stage)

    try:
        return criticism.close_loop(scene, *histories, progress=noted, **settings), False
    except criticism.LoopInterrupted as interrupt:
        progress("interrupted: Gaussians at the modes instead; once more ends without a report")
        return interrupt.finish(), True
    except KeyboardInterrupt:
        so_far = f"so far: {'; '.join(found)}; " if found else ""
        advice = "--method laplace, fewer rows or a coarser log take less time"
        raise typer.Exit(interrupted(f"nothing was written; {so_far}{advice}")) from None


def _remainder(
    loop: Loop, folder: Path, source: Source, seed: int, progress: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Learn a force for the residual and save it with the results, or return why there is none."""
    from pbrl_ppl.errors import FitError
    from pbrl_ppl.reporting import render

    path = folder / "remainder.nc"
    path.unlink(missing_ok=True)  # of an earlier run
    try:
        loop = replace(loop, remainder=loop.learn_remainder(seed=seed, progress=progress))
    except FitError as error:
        return {"learned_remainder": {"words": str(error), "posterior": None}}
    progress("writing the report with it")
    loop.save(folder, overwrite=True, page=render(loop, source))
    return {"learned_remainder": {"words": loop.remainder_words, "posterior": path}}


def _close_many(
    manifest: Path,
    output: Path,
    *,
    command: str,
    jobs: int,
    scheduler: str | None,
    as_json: bool,
    quiet: bool,
    **settings: Any,
) -> None:
    """Close the loop on each log of a manifest, and print which effects are where."""
    kept = f"finished logs are in {output}; the same command goes on"
    with interruptible(kept), stages(quiet) as progress:
        check_can_make(output)
        progress("reading the manifest")
        import pbrl_ppl.reporting as report

        logs = report.read_manifest(manifest)  # its errors come before a cluster is sought
        with _executor(jobs, scheduler) as executor:
            loops = report.close_loop_many(
                logs,
                output,
                executor=executor,
                progress=progress,
                source=report.Source(command=command),
                **settings,
            )
    effects = loops.effects().drop_duplicates(["name", "effect", "body"])
    found = [
        f"{effect}[{body}]: {', '.join(each['name'])}"
        for (effect, body), each in effects.groupby(["effect", "body"], sort=False)
    ]
    page = output / "index.html"
    print_result(
        as_json,
        {"page": page, "logs": loops.rows},
        [*found, report.in_words(loops.rows), f"page: {page}"],
    )
    if loops.failed:
        raise typer.Exit(FAILED)


@contextmanager
def _executor(jobs: int, scheduler: str | None) -> Iterator[Executor | None]:
    """Yield the executor of a Dask cluster, processes of this machine, or None."""
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
    elif jobs == 1:
        yield None
    else:
        with OneProcessEach(jobs) as pool:  # close_loop_many cancels what has not begun
            yield pool


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    """Yield the executor of a running Dask scheduler."""
    try:
        from distributed import Client
    except ImportError:
        raise OutputError(
            "--scheduler needs Dask distributed, which is not installed: pip install"
            " 'pbrl_ppl[many]', here and where the workers run"
        ) from None
    try:
        client = Client(scheduler, timeout=10)
    except (OSError, ValueError) as error:
        raise OutputError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({error}); expected an"
            " address such as tcp://host:8786"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            typer.echo(f"no worker at {scheduler} yet; waiting for one", err=True)
        yield client.get_executor(pure=False)


class OneProcessEach(ThreadPoolExecutor):
    """Executor that runs each call in a fresh process.

    A process that dies, out of memory for instance, does not take others with it, as in a pool; its
    call is tried once more. PyMC's threads do not survive a fork, so processes are spawned.
    """

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Schedule a call that can be pickled."""
        return super().submit(_in_a_process, fn, *args, **kwargs)


def _in_a_process(fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    for again in (True, False):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                return pool.submit(fn, *args, **kwargs).result()
            except BrokenProcessPool:
                if not again:
                    raise
    return None
