"""``pbrl-ppl close-logs``: the loop on each log of a manifest."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cloudpickle
import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.close_loop import Draws, Method
from pbrl_ppl.cli.options import command
from pbrl_ppl.cli.terminal import FAILED, Progress, Result, check_can_make
from pbrl_ppl.errors import OutputError


@command(
    "close-logs", 6, "pbrl-ppl close-logs logs.csv -o results/ --jobs 4",
    kept="finished logs are in {output}; the same command goes on",
)  # fmt: skip
def close_logs(
    context: typer.Context,
    manifest: Path,
    output: options.OutputFolder,
    reading: options.SceneReading,
    progress: Progress,
    seed: options.Seed = 1,
    overwrite: bool = False,
    draws: Draws = None,
    method: Method = Method.IMPORTANCE,
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
    draws
        Posterior draws of each chain.
    method
        importance weights proposals by the engine; metropolis runs chains; laplace takes Gaussians
        at the modes, on which the verdict then stands.
    jobs
        Logs at a time.
    scheduler : ADDRESS
        A Dask scheduler that has the workers.
    """
    check_can_make(output)
    progress("reading the manifest")
    import pbrl_ppl.reporting as report

    catalogue = reading.catalogue() if reading.effect_file else None
    logs = report.read_manifest(manifest)  # its errors come before a cluster is sought
    with _executor(jobs, scheduler) as executor:
        loops = report.close_loop_many(
            logs, output, executor=executor, progress=progress, again=overwrite, seed=seed,
            source=report.Source(command=options.command_line(context)), draws=draws,
            method=method.value, catalogue=catalogue, **reading.scene_settings(),
            **reading.settings(),
        )  # fmt: skip
    effects = loops.effects().drop_duplicates(["name", "effect", "body"])
    lines = [
        f"{effect}[{body}]: {', '.join(rows['name'])}"
        for (effect, body), rows in effects.groupby(["effect", "body"], sort=False)
    ]
    page = output / "index.html"
    lines += [report.in_words(loops.rows), f"page: {page}"]
    return Result({"page": page, "logs": loops.rows}, lines, FAILED if loops.failed else 0)


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

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Schedule a call."""
        return super().submit(_in_a_process, fn, *args, **kwargs)


def _in_a_process(fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    # the laws of an effect file are functions of no module that another process could import
    call = cloudpickle.dumps(partial(fn, *args, **kwargs))
    for again in (True, False):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                return pool.submit(_called, call).result()
            except BrokenProcessPool:
                if not again:
                    raise
    return None


def _called(call: bytes) -> Any:
    return pickle.loads(call)()
