"""Work in parallel: threads, BLAS in one of them, processes, and an executor's tasks."""

from __future__ import annotations

import multiprocessing as mp
import os
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from functools import cache, wraps
from multiprocessing.connection import Connection
from threading import Thread
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

K = TypeVar("K")
P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of many small matrices to run BLAS in one thread.

    Threads would spin while they wait for each other, which costs most of the time beside other
    work on the same processors.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _pools().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


def in_parallel(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Return the function's values in the order of its arguments, a thread a processor.

    Simulations and linear algebra release the interpreter's lock.
    """
    pool = ThreadPoolExecutor(processors())
    with pool, _pools().limit(limits=1, user_api="blas"):
        return list(pool.map(function, items))


def processors() -> int:
    """Return the number of processors."""
    return os.cpu_count() or 1


@cache
def _pools() -> ThreadpoolController:
    """Return the controller of the thread pools; finding them takes 2 ms."""
    return ThreadpoolController()


@contextmanager
def background(function: Callable[[], R]) -> Iterator[Callable[[], R]]:
    """Evaluate a function in a forked process, which ends with the context or its parent.

    Without processors to spare or without forks, the caller's process evaluates it when asked.

    Parameters
    ----------
    function : callable
        Takes nothing; its result can be pickled.

    Yields
    ------
    callable
        Waits for the result and returns it; raises what the function raised.

    Examples
    --------
    >>> with background(lambda: 6 * 7) as answer:
    ...     answer()
    42
    """
    if mp.cpu_count() < 2 or "fork" not in mp.get_all_start_methods():
        yield function
        return
    context = mp.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(function, sender))
    with warnings.catch_warnings():
        # of processes with threads: those of BLAS and of the engine wait between calls
        warnings.filterwarnings("ignore", message=".*fork.*", category=DeprecationWarning)
        process.start()
    sender.close()

    def result() -> R:
        try:
            succeeded, value = receiver.recv()
        except (EOFError, OSError):  # the process was killed, as by a lack of memory
            return function()
        if not succeeded:
            raise value
        answer: R = value
        return answer

    try:
        yield result
    finally:
        process.terminate()
        process.join()
        receiver.close()


def _send(function: Callable[[], object], sender: Connection) -> None:
    """Send whether the function succeeded, and its result or what it raised."""
    Thread(target=_end_with_parent, daemon=True).start()
    try:
        answer = True, function()
    except BaseException as error:
        answer = False, error
    sender.send(answer)
    sender.close()


def _end_with_parent() -> None:
    """End this process once its parent has ended, be it killed."""
    parent = mp.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


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
