"""Work, counted, shown and in parallel: BLAS in one thread, and processes that end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, wraps
from threading import Event, Thread, local
from typing import ParamSpec, Self, TypeVar

from threadpoolctl import ThreadpoolController

from pbrl_ppl.errors import in_a_line

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


class Progress:
    """Context that shows on stderr what it is called with.

    A stage or what was found is a line with the time elapsed. At a terminal a bar has the share of
    counted work that is done and the time left for it at its measured speed; it pulses while
    nothing is counted. Elsewhere a line is written ``every`` so many seconds: a log is never silent
    for long.

    Attributes
    ----------
    stages : tuple of str
        The stages of a command if they are known, which are numbered; other sentences are then of
        what was found.
    """

    def __init__(self, quiet: bool, every: float = 60.0) -> None:
        from rich import progress as bars
        from rich.console import Console

        console = Console(stderr=True, quiet=quiet, highlight=False, markup=False, emoji=False)
        self._bar = bars.Progress(
            bars.TextColumn("{task.description}", markup=False), bars.BarColumn(20),
            bars.TaskProgressColumn(), bars.TimeRemainingColumn(), console=console,
            transient=True, disable=quiet or not console.is_interactive, speed_estimate_period=1e9,
        )  # fmt: skip
        self.stages: tuple[str, ...] = ()
        self._stage = self._work = Work("working", 0, 0)
        self._task, self._number = self._bar.add_task(self._stage, total=None), 0
        self._begin, self._ended = time.monotonic(), Event()
        pause = None if quiet or console.is_interactive else every
        self._writer = Thread(target=self._write, args=[pause], daemon=True)

    def __enter__(self) -> Self:
        """Begin to show the bar, or to write lines."""
        self._bar.start()
        self._writer.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar away."""
        self._ended.set()
        self._writer.join()
        self._bar.stop()

    def __call__(self, said: str) -> None:
        """Show a stage that begins, what was found, or counted work."""
        work = said if isinstance(said, Work) else Work(said, 0, 0)
        if work is not said:
            self._bar.console.print(self._line(said), soft_wrap=True)
            if self.stages and said not in self.stages:
                return
            self._stage = work
            if self.stages:  # one may come again
                self._number = max(self._number, self.stages.index(said) + 1)
        work = work if work.done < work.total else self._stage
        before, self._work = self._work, work
        if (work, work.total) != (before, before.total) or work.done < before.done:
            number = f"{self._number} of {len(self.stages)}: " if self._number else ""
            self._bar.remove_task(self._task)
            self._task = self._bar.add_task(number + in_a_line(work), total=work.total or None)
        self._bar.update(self._task, completed=work.done)

    def _line(self, said: str) -> str:
        """Return a line of a log."""
        return f"[{time.monotonic() - self._begin:5.1f} s] {in_a_line(said)}"

    def _write(self, every: float | None) -> None:
        """Write ``every`` so many seconds what goes on; the console may be at work."""
        while not self._ended.wait(every):
            work = self._work
            done = f", {work.done / work.total:.0%} done" if work.total else ""
            with suppress(OSError):
                os.write(2, f"{self._line(work)}: still running{done}\n".encode())


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
