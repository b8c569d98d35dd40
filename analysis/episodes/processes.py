"""Spawned processes to run episodes in; an interrupt or an error ends them at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context

from episodes.world import EpisodeError


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
