"""Commands run apart, with limits, and the faults that their output shows."""

from __future__ import annotations

import math
import os
import re
import resource
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

#: Seconds without a line of output that count as silence.
SILENCE = 300.0
#: What a message to a user does not contain: names of Python's and NumPy's own errors.
_INTERNAL = re.compile(
    r"\b(KeyError|IndexError|TypeError|AttributeError|ZeroDivisionError|RuntimeWarning"
    r"|LinAlgError|broadcast|NoneType|Errno|object at 0x|nan\b.*\bnan\b|invalid value encountered"
    r"|divide by zero|overflow encountered|underflow encountered|Mean of empty slice"
    r"|Degrees of freedom|singular matrix)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Ran:
    """What a command did.

    Parameters
    ----------
    argv : tuple of str
        Its arguments.
    code : int
        Exit code; minus the signal's number if a signal ended it.
    out, err : str
        What it wrote.
    seconds : float
        Time until its end.
    silent : float
        The longest time (s) without a line on stderr or stdout.
    peak : float
        Peak memory (MB).
    process : int
        Its process, which was the first of its session.
    after : float
        Time (s) from the signal that killed it to its end; NaN without one.
    cpu : float
        Processor seconds, its children's among them.
    """

    argv: tuple[str, ...]
    code: int
    out: str
    err: str
    seconds: float
    silent: float
    peak: float
    process: int = 0
    after: float = math.nan
    cpu: float = 0.0

    def fault(self, codes: Sequence[int] = (0,)) -> str:
        """Return what is wrong with it, or nothing; ``codes`` are exit codes that are right."""
        if "Traceback (most recent call last)" in self.err + self.out:
            return "traceback"
        if self.silent > SILENCE:
            return f"silence of {self.silent:.0f} s"
        if self.code < 0:
            return f"ended by signal {-self.code}"
        errors = [line for line in self.err.splitlines() if line.startswith("error: ")]
        if self.code == 2 and len(errors) != 1 and "Usage:" not in self.err:
            return f"{len(errors)} error messages"
        told = [line for line in self.err.splitlines() if line.startswith(("error: ", "warning: "))]
        internal = [found for line in told if (found := _INTERNAL.search(line))]
        if internal:
            return f"internal message: {internal[0].string.strip()[:300]}"
        if self.code not in codes:
            return f"exit code {self.code}: {' '.join(errors)[:300] or self.err[-300:]}"
        return ""


def warm() -> None:
    """Import what commands import, so that a forked child begins at once."""
    import pymc  # noqa: F401

    import pbrl_ppl.cli
    import pbrl_ppl.criticism
    import pbrl_ppl.planning
    import pbrl_ppl.reporting
    import pbrl_ppl.sampling  # noqa: F401


def run(
    argv: Sequence[str],
    folder: Path,
    limit: float = 900.0,
    memory: float | None = None,
    kill: Callable[[float], bool] | None = None,
    by: int = signal.SIGKILL,
    program: Callable[[list[str]], int] | None = None,
) -> Ran:
    """Run a command of ``pbrl-ppl`` in a forked child of this process.

    Parameters
    ----------
    argv : sequence of str
        Arguments without the program's name.
    folder : Path
        Its working directory, which gets its output.
    limit : float
        Seconds after which it is killed, with its children.
    memory : float, optional
        Most address space (MB) that it may take beyond what this process has.
    kill : callable, optional
        Takes the seconds since the begin; once it is true the process is killed, without its
        children.
    by : int
        Signal that kills it; SIGINT goes to its children too, as from a terminal.
    program : callable, optional
        In place of ``pbrl-ppl``: takes the arguments, and returns the exit code.
    """
    out, err = folder / ".stdout", folder / ".stderr"
    begin = time.monotonic()
    child = os.fork()
    if not child:
        _become(argv, folder, out, err, memory, program)
    silent, size, last, sent = 0.0, 0, begin, math.nan
    while True:
        ended, status, usage = os.wait4(child, os.WNOHANG)
        now = time.monotonic()
        written = sum(path.stat().st_size for path in (out, err) if path.exists())
        if written != size:
            size, last = written, now
        silent = max(silent, now - last)
        if ended:
            break
        if now - begin > limit:
            os.killpg(child, signal.SIGKILL)
        if kill is not None and math.isnan(sent) and kill(now - begin):
            try:
                (os.killpg if by == signal.SIGINT else os.kill)(child, by)
            except ProcessLookupError:  # it is not yet the first of its session
                os.kill(child, by)
            sent = now
        time.sleep(0.02 if kill is None else 0.001)
    code = os.waitstatus_to_exitcode(status)
    texts = (path.read_text(errors="replace") if path.exists() else "" for path in (out, err))
    peak, cpu = usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime
    return Ran(tuple(argv), code, *texts, now - begin, silent, peak, child, now - sent, cpu)


def _become(
    argv: Sequence[str],
    folder: Path,
    out: Path,
    err: Path,
    memory: float | None,
    program: Callable[[list[str]], int] | None,
) -> None:
    """Run the command in this process, a new session's first, and end."""
    code = 70
    try:
        os.setsid()
        os.chdir(folder)
        for path, number in ((out, 1), (err, 2)):
            opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(opened, number)
            os.close(opened)
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if memory is not None:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            most = pages * os.sysconf("SC_PAGE_SIZE") + int(memory * 2**20)
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        from pbrl_ppl.cli import main

        code = (program or main)(list(argv))
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
