"""Spawned processes to run episodes in, ended at once by an interrupt or error; their tasks."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import TypeVar

from episodes.world import EpisodeError

K = TypeVar("K")
R = TypeVar("R")


@contextmanager
def processes(workers: int | None = None) -> Iterator[Executor]:
    """Return a context with an executor of spawned processes: PyMC's threads do not survive a fork.

    Only the caller receives Ctrl-C, and keeps finished results.

    Parameters
    ----------
    workers : int, optional
        Number of processes; as many as there are processors by default.

    Raises
    ------
    EpisodeError
        If ``workers`` is below 1, or a process ended before its call.

    Examples
    --------
    ::

        if __name__ == "__main__":  # each process imports the script
            with processes(2) as executor:
                futures = [executor.submit(trial, seed) for seed in range(10)]
    """
    workers = processors() if workers is None else workers
    if workers < 1:
        raise EpisodeError(f"workers is {workers}, expected at least 1")
    others = set(active_children())
    ignored = (signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes
    pool = ProcessPoolExecutor(workers, get_context("spawn"), signal.signal, ignored)
    try:
        yield pool
    except BaseException as error:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()
        if isinstance(error, BrokenProcessPool):
            raise EpisodeError(
                "a process ended before its call: see its output above, or it was short of memory"
                " (give fewer workers). Calls must be of functions in a module, and a script must"
                ' make them under if __name__ == "__main__":, for each process imports it'
            ) from None
        raise
    pool.shutdown()


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # on Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def as_ended(
    tasks: Mapping[K, Callable[[], R]], executor: Executor | None
) -> Generator[tuple[K, Callable[[], R]]]:
    """Yield each task's key, and a call that returns its result or raises its error.

    In the order in which they end; tasks that have not begun are cancelled with the iteration.

    Parameters
    ----------
    tasks : mapping of callable
        Each takes nothing; with an executor of processes they can be pickled.
    executor : Executor, optional
        Runs them; without one, the caller's call does.

    Examples
    --------
    >>> {key: result() for key, result in as_ended({"a": int, "b": str}, None)}
    {'a': 0, 'b': ''}
    """
    if executor is None:
        yield from tasks.items()
        return
    futures = {executor.submit(task): key for key, task in tasks.items()}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result
    finally:
        for future in futures:
            future.cancel()
