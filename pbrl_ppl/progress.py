"""Bar of the work that is done, or lines of a log where there is no terminal."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from typing import Self

from rich import progress as bars
from rich.console import Console

from pbrl_ppl.errors import in_a_line
from pbrl_ppl.threads import Work


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
        console = Console(stderr=True, quiet=quiet, highlight=False, markup=False, emoji=False)
        self._bar = bars.Progress(
            bars.TextColumn("{task.description}", markup=False), bars.BarColumn(20),
            bars.TaskProgressColumn(), bars.TimeRemainingColumn(), console=console,
            transient=True, disable=quiet or not console.is_interactive, speed_estimate_period=1e9,
        )  # fmt: skip
        self.stages: tuple[str, ...] = ()
        self._stage = self._work = Work("working", 0, 0)
        self._task, self._number = self._bar.add_task(self._stage, total=None), 0
        self._begin, self._ended = time.monotonic(), threading.Event()
        pause = None if quiet or console.is_interactive else every
        self._writer = threading.Thread(target=self._write, args=[pause], daemon=True)

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
