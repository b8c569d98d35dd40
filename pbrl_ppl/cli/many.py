"""``pbrl-ppl close-loop --many``: a manifest of logs, over processes or a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.outputs import check_can_make
from pbrl_ppl.cli.terminal import FAILED, interruptible, stages
from pbrl_ppl.errors import OutputError


def close_loop_many(
    manifest: Path,
    output: Path,
    *,
    command: str,
    jobs: int,
    scheduler: str | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Close the loop on each log of a manifest, and say which effects are where."""
    kept = f"finished logs are in {output}; the same command goes on"
    with interruptible(kept), stages(quiet) as progress:
        check_can_make(output)
        progress("reading the manifest")
        os.environ.setdefault("MPLBACKEND", "Agg")
        import pbrl_ppl.report as report

        logs = report.read_manifest(manifest)  # its errors come before a cluster is looked for
        with _executor(jobs, scheduler) as executor:
            loops = report.close_loop_many(
                logs,
                output,
                executor=executor,
                progress=progress,
                source=report.Source(command=command),
                **options,
            )
    if as_json:
        print_json({"page": output / "index.html", "logs": loops.rows})
        if loops.failed:
            raise typer.Exit(FAILED)
        return
    effects = loops.effects().drop_duplicates(["name", "effect", "body"])
    for (effect, body), own in effects.groupby(["effect", "body"], sort=False):
        typer.echo(f"{effect}[{body}]: {', '.join(own['name'])}")
    typer.echo(report.in_words(loops.rows))
    typer.echo(f"page: {output / 'index.html'}")
    if loops.failed:
        raise typer.Exit(FAILED)


@contextmanager
def _executor(jobs: int, scheduler: str | None) -> Iterator[Executor | None]:
    """A Dask cluster's, processes of this machine, or none."""
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
    elif jobs == 1:
        yield None
    else:
        pool = OneProcessEach(jobs)
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    """The executor of a running Dask scheduler."""
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
    """Runs each call in a fresh process of its own, so many at a time.

    One that dies, for want of memory say, takes no other with it, as it would in a pool; it is
    tried once more. Fresh ones, for PyMC's threads do not survive a fork.

    Parameters
    ----------
    jobs : int
        Processes at a time.
    """

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs)

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
