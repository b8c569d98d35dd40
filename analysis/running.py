"""Shared code of the benchmarks: time limits, processes, the code's hash, parts, stored rows."""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pbrl_ppl as pp

#: Seconds in which a process ends after it was asked to.
_PATIENCE = 5.0


@contextmanager
def limited(limit: int, cure: str) -> Iterator[None]:
    """Stop code that takes longer than a number of seconds, where supported: in a main thread.

    0 is no limit. The message says what to do: ``cure``.
    """
    main = threading.current_thread() is threading.main_thread()
    if not limit or not main or not hasattr(signal, "SIGALRM"):
        yield
        return

    def stop(number: int, frame: object) -> None:
        raise TimeoutError(f"no end after {limit} s; {cure}")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(limit)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def begin_worker() -> None:
    """Leave Ctrl-C to the process that stops the workers, and start chains as anywhere else."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, end_worker)
    # a spawned process would spawn its chains too, and each would load PyMC again
    multiprocessing.set_start_method(None, force=True)


def end_worker(number: int, frame: object) -> None:
    """End a worker and the chains that it started, which would wait for it forever."""
    for child in multiprocessing.active_children():
        child.terminate()
    os._exit(1)


def apart(function: Callable[..., Any], *arguments: Any, limit: int) -> Any:
    """Return what a function returns in a process of its own; ``limit`` is in seconds, 0 is none.

    Raises
    ------
    TimeoutError
        If it takes longer.
    ChildProcessError
        If the process ends without a result.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sender, function, arguments))
    process.start()
    sender.close()
    try:
        if not receiver.poll(limit or None):
            raise TimeoutError(f"no end after {limit} s; allow more with --limit")
        found = receiver.recv()
        process.join(_PATIENCE)
        return found
    except EOFError:
        process.join(_PATIENCE)
        raise ChildProcessError(
            f"its process ended with exit code {process.exitcode}; it may be short of memory"
        ) from None
    finally:
        process.terminate()
        process.join(_PATIENCE)
        process.kill()
        process.join()


def _send(sender: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    begin_worker()
    sender.send(function(*arguments))


@cache
def sources() -> str:
    """Return a hash of the package's files, which may change within a version."""
    digest = hashlib.sha256()
    folder = Path(pp.__file__).parent
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def cache_file(folder: Path, name: str, settings: tuple[Any, ...]) -> Path:
    """Return the path of a case's row: its name, and a hash of version and settings."""
    text = repr((pp.__version__, *settings))
    return folder / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"


def save(row: Any, path: Path) -> None:
    """Write a row, a dataclass, atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(asdict(row)))
    partial.replace(path)


def part(text: str) -> tuple[int, int]:
    """Parse a part such as 1/3."""
    try:
        i, n = (int(number) for number in text.split("/"))
    except ValueError:
        i, n = 0, 0
    if not 1 <= i <= n:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected I/N with I from 1 to N: 1/3")
    return i, n
