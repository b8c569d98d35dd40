"""The loop: ``pbrl-ppl close-loop``; ``demo`` on the package's recording; ``close-logs``."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, TypeVar

import cloudpickle
import typer

from pbrl_ppl.cli import options, terminal
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.new import models_folder
from pbrl_ppl.cli.terminal import Progress, Result
from pbrl_ppl.errors import OutputError
from pbrl_ppl.files import check_folder
from pbrl_ppl.threads import obey_parent

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Loop
    from pbrl_ppl.effects import Effect

P = ParamSpec("P")
T = TypeVar("T")

#: How a sentence on laws that were found begins.
_FOUND = "simulations name"


class Method(StrEnum):
    """Samplers of the loop's posteriors."""

    IMPORTANCE = "importance"
    METROPOLIS = "metropolis"
    LAPLACE = "laplace"


class Catalogue(StrEnum):
    """Laws that a loop tries."""

    COMMON = "common"
    ALL = "all"


@dataclass(frozen=True)
class Sampler:
    """Options of a command that samples the posteriors of a loop.

    Parameters
    ----------
    draws
        Posterior draws of each chain.
    method
        importance weights proposals by the engine; metropolis runs chains; laplace takes Gaussians
        at the modes, on which the verdict then stands.
    most_transitions
        Of a longer recording pieces are used, drawn by the seed; more take more time.
    catalogue
        common tries common laws alone, all tries unusual ones beside them from the start; by
        default unusual ones are tried last, and added if they explain all that is left.
    """

    seed: options.Seed = 1
    draws: Annotated[int | None, typer.Option(min=100)] = None
    method: Method = Method.IMPORTANCE
    most_transitions: options.Transitions = options.MOST_TRANSITIONS
    catalogue: Catalogue | None = None

    def settings(self, effects: Sequence[Effect]) -> dict[str, Any]:
        """Return arguments of `criticism.close_loop`, given the catalogue."""
        if self.catalogue is Catalogue.COMMON:
            effects = [effect for effect in effects if not effect.unusual]
        if self.catalogue is Catalogue.ALL:
            effects = [replace(effect, unusual="") for effect in effects]
        return vars(self) | {"method": self.method.value, "catalogue": tuple(effects)}


@command("close-loop", 5, "pbrl-ppl close-loop scene.toml train.csv -o report/")
def close_loop(
    context: typer.Context,
    scene: Path,
    train: Path,
    to: options.FolderOutput,
    reading: options.SceneReading,
    sampler: Sampler,
    progress: Progress,
    interrupts: terminal.Interrupts,
    test: Path | None = None,
) -> Result:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict.

    Parameters
    ----------
    train : TRAIN
        Measured history (.csv, .parquet, .nc).
    test : TEST
        Held-out history; without it, a quarter of TRAIN's trajectories.
    """
    progress("reading the scene and the histories")
    paths = [train] if test is None else [train, test]
    declared, histories = reading.read(scene, paths)
    progress("loading the sampler")
    import pbrl_ppl.reporting as report
    from pbrl_ppl import criticism

    output = to.output
    check_folder(output, True, criticism.FILES)
    settings = sampler.settings(reading.catalogue())
    run = partial(criticism.close_loop, declared, *histories, **settings)
    loop, stopped = _finished(run, progress, interrupts)
    progress("writing the report")
    files = str(scene), str(train), str(test or "")
    source = report.Source(*files, options.command_line(context))
    loop.save(output, to.overwrite, page=report.render(loop, source))
    contents = loop.to_dict() | {"report": output / "report.html"}
    undecided = terminal.UNDECIDED if loop.verdict == criticism.NOT_CONVERGED else 0
    code = terminal.INTERRUPTED if stopped else undecided
    return Result(contents, report.in_brief(loop, output), code)


def _finished(
    run: Callable[..., Loop], progress: Progress, interrupts: terminal.Interrupts
) -> tuple[Loop, bool]:
    """Return the loop, with Gaussians at the modes if it is interrupted while it samples.

    The second value is whether it was. An earlier interrupt ends the command, and says what was
    found.
    """
    from pbrl_ppl import criticism

    names: list[str] = []

    def noted(stage: str) -> None:
        progress(stage)
        if stage.startswith(_FOUND):
            names.append(stage)
        if stage == criticism.Stage.SAMPLE:
            interrupts.keep()

    try:
        return run(progress=noted), False
    except criticism.LoopInterrupted as interrupt:
        progress("interrupted: Gaussians at the modes instead; once more ends without a report")
        return interrupt.finish(), True
    except KeyboardInterrupt:
        so_far = f"so far: {'; '.join(names)}; " if names else ""
        advice = "--method laplace, fewer rows or a coarser log take less time"
        raise typer.Exit(terminal.interrupted(f"nothing was written; {so_far}{advice}")) from None


@command("demo", 0, "pbrl-ppl demo")
def demo(
    context: typer.Context,
    progress: Progress,
    interrupts: terminal.Interrupts,
    as_json: bool,
    quiet: bool,
    output: options.OutputFolder = Path("pbrl-ppl-demo"),
    method: Method = Method.LAPLACE,
    seed: options.Seed = 1,
    overwrite: bool = False,
) -> Result:
    """Close the loop on a recording that comes with the package, and write its report.

    A shopping cart is pushed. Its castor resists turning, which the scene does not declare.

    Parameters
    ----------
    output
        Folder for the results.
    method
        laplace takes seconds; importance and metropolis draw from the posterior itself, in minutes.
    overwrite
        Write to a folder that is not empty.
    """
    cart = models_folder() / "shopping_cart"
    to, sampler = options.FolderOutput(output, overwrite), Sampler(seed, method=method)
    if not (as_json or quiet):
        typer.echo(
            "A shopping cart is pushed; the scene does not declare that its castor resists turning."
            "\nThis takes some 30 s on an idle machine, the first time a minute more to compile."
        )
    train, test = (cart / "recorded" / f"{name}.csv" for name in ("train", "test"))
    result = close_loop(
        context, cart / "scene.toml", train, to, options.SceneReading(), sampler, progress,
        interrupts, test,
    )  # fmt: skip
    if quiet or result.code:
        return result
    last = "With a recording of yours: pbrl-ppl new scene.toml --history train.csv"
    return replace(result, shown=[*result.shown, last])


@command(
    "close-logs", 6, "pbrl-ppl close-logs logs.csv -o results/ --jobs 4",
    kept="finished logs are in {output}; the same command goes on",
)  # fmt: skip
def close_logs(
    context: typer.Context,
    manifest: Path,
    output: options.OutputFolder,
    reading: options.SceneReading,
    sampler: Sampler,
    progress: Progress,
    overwrite: bool = False,
    jobs: options.Count = 1,
    scheduler: str | None = None,
) -> Result:
    """Close the loop on each log of a manifest, and report which effects are where.

    The same command goes on after an interrupt. Exits with 1 if some logs failed.

    Parameters
    ----------
    manifest : MANIFEST
        A CSV file with the columns name, scene, train, test, kind.
    output
        Folder for the results.
    overwrite
        Run finished logs again.
    jobs
        Logs at a time.
    scheduler : ADDRESS
        A Dask scheduler that has the workers.
    """
    check_folder(output, overwrite=True)
    progress("reading the manifest")
    import pbrl_ppl.reporting as report

    logs = report.read_manifest(manifest)  # its errors come before a cluster is sought
    settings = sampler.settings(reading.catalogue())
    if not (reading.effect_file or sampler.catalogue):
        del settings["catalogue"]
    with _executor(jobs, scheduler) as executor:
        loops = report.close_loop_many(
            logs, output, executor=executor, progress=progress, again=overwrite,
            source=report.Source(command=options.command_line(context)),
            **settings, **reading.scene_settings(), **reading.settings(),
        )  # fmt: skip
    effects = loops.effects().drop_duplicates(["name", "effect", "body"])
    lines = [
        f"{effect}[{body}]: {', '.join(rows['name'])}"
        for (effect, body), rows in effects.groupby(["effect", "body"], sort=False)
    ]
    page = output / "index.html"
    lines += [report.in_words(loops.rows), f"page: {page}"]
    return Result({"page": page, "logs": loops.rows}, lines, terminal.FAILED if loops.failed else 0)


def _executor(jobs: int, scheduler: str | None) -> AbstractContextManager[Executor | None]:
    """Return the executor of a Dask cluster, processes of this machine, or None, as a context."""
    if scheduler is not None:
        return _cluster(scheduler)
    # close_loop_many cancels what has not begun
    return nullcontext() if jobs == 1 else OneProcessEach(jobs)


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

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Schedule a call."""
        return super().submit(_in_a_process, partial(fn, *args, **kwargs))


def _in_a_process(function: partial[T]) -> T:
    # the laws of an effect file are functions of no module that another process could import
    call = cloudpickle.dumps(function)
    made: T
    try:
        made = _in_a_new_one(call)
    except BrokenProcessPool:
        made = _in_a_new_one(call)
    return made


def _in_a_new_one(call: bytes) -> Any:
    with ProcessPoolExecutor(1, get_context("spawn"), obey_parent) as pool:
        return pool.submit(_called, call).result()


def _called(call: bytes) -> object:
    return pickle.loads(call)()
