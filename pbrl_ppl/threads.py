"""Work, counted and in parallel: threads, BLAS in one of them, and processes that end."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from threading import Thread, local
from typing import ParamSpec, Self, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

#: Takes a stage that begins, what was found, or counted work.
Say = Callable[[str], None]


def silent(said: str) -> None:
    """Show nothing."""


class Work(str):
    """A sentence on what is done now, and how much of it: a bar shows it, no log keeps it.

    Attributes
    ----------
    done, total : int
        Counted units. The work has ended once all are done.
    """

    done = total = 0

    def __new__(cls, sentence: str, done: int, total: int) -> Self:
        """Return the sentence with its counts."""
        work = super().__new__(cls, sentence)
        work.done, work.total = done, total
        return work


def counted(items: Iterable[T], total: int, sentence: str, say: Say) -> Iterator[T]:
    """Yield items, and report how many of a total are done: those that the next was asked after."""
    say(Work(sentence, 0, total))
    for done, item in enumerate(items, 1):
        yield item
        say(Work(sentence, done, total))


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


def in_parallel(
    function: Callable[[T], R], items: Iterable[T], sentence: str = "", say: Say = silent
) -> list[R]:
    """Return the function's values in the order of its arguments, a thread a processor.

    Simulations and linear algebra release the interpreter's lock. The ``sentence`` says what is
    done, and how many items are. What runs in one of these threads starts no others.
    """
    items = list(items)
    if in_worker():
        return list(counted(map(function, items), len(items), sentence, say))
    pool = ThreadPoolExecutor(processors(), initializer=setattr, initargs=(_THREAD, "works", True))
    with pool, _pools().limit(limits=1, user_api="blas"):
        return list(counted(pool.map(function, items), len(items), sentence, say))


_THREAD = local()


def in_worker() -> bool:
    """Return whether this thread is one of :func:`in_parallel`: all processors have work."""
    return getattr(_THREAD, "works", False)


def processors() -> int:
    """Return the number of processors."""
    return os.cpu_count() or 1


@cache
def _pools() -> ThreadpoolController:
    """Return the controller of the thread pools; finding them takes 2 ms."""
    return ThreadpoolController()


def obey_parent() -> None:
    """Leave interrupts to the parent, and end once it has ended: the initializer of a pool."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
