"""Terminal and files: interrupts, warnings, output, checks of output paths."""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pbrl_ppl.errors import OutputError, printable
from pbrl_ppl.errors import in_a_line as in_a_line
from pbrl_ppl.system.files import json_values
from pbrl_ppl.system.threads import Progress as Progress

#: Exit codes: a failed log, a goal that was not reached, or effects that stay inseparable; bad
#: input or usage; chains that have not converged, so no verdict; an interrupt, as shells report it.
FAILED, BAD_INPUT, UNDECIDED, INTERRUPTED = 1, 2, 3, 130

#: Signals that end a command: Ctrl-C, and that of `timeout` and of job schedulers.
_ENDING = signal.SIGINT, signal.SIGTERM


class PlainConsole(Console):
    """Console without markup, to which names from files can be printed: they are escaped."""

    def __init__(self, **options: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text with what a terminal would obey as escapes."""
        return super().render_str(printable(text, kept="\n"), **options)


class Interrupts:
    """Whether a command was interrupted, and how long it then has to end."""

    def __init__(self) -> None:
        self.seen = False  # a sampler may catch one and return as if it had finished
        self.rescue: Callable[[], str] | None = None  # writes what was found, and says so
        self._going_on = threading.Event()

    def keep(self) -> None:
        """Let the command end by itself from now on: it keeps what it has so far."""
        self._going_on.set()

    def note(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal."""
        self.seen = True
        if sys.unraisablehook is sys.__unraisablehook__:
            sys.unraisablehook = lambda _: None  # of what is half made
        signal.default_int_handler(number, frame)

    def ended(self, state: str) -> int:
        """Print which results are kept after an interrupt, and return the exit code."""
        if self.rescue is not None:
            with suppress(OSError, OutputError):
                state = self.rescue()
        print(f"interrupted; {in_a_line(state)}", file=sys.stderr)  # noqa: T201
        return INTERRUPTED

    @contextmanager
    def enforced(self, state: str, patience: float = 1.5) -> Iterator[None]:
        """End the process if an interrupt has not ended the context after ``patience`` (s).

        Machine code and other threads run on until they are done: only the operating system's
        signal gets through to a thread that waits for it.
        """
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

        def watch() -> None:
            while (number := os.read(reader, 1)) and number[0] not in _ENDING:
                pass
            if number and not self._going_on.wait(patience):
                Console(stderr=True).show_cursor()
                os._exit(self.ended(state))

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            self._going_on.set()
            signal.set_wakeup_fd(before)
            os.close(writer)
            watcher.join()
            os.close(reader)


@contextmanager
def interruptible(state: str = "nothing was written") -> Iterator[Interrupts]:
    """Turn an interrupt into a message that says which results are kept, and an exit code."""
    interrupts = Interrupts()
    # a shell's background job ignores interrupts: leave it so
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    handled = handled and threading.current_thread() is threading.main_thread()
    if handled:
        before = {number: signal.signal(number, interrupts.note) for number in _ENDING}
    try:
        with interrupts.enforced(state) if handled else nullcontext():
            yield interrupts
    except typer.Exit:
        raise
    except BaseException as error:
        # what an interrupt broke off may have raised an error of its own
        if interrupts.seen or isinstance(error, KeyboardInterrupt):
            raise typer.Exit(interrupts.ended(state)) from None
        raise
    finally:
        if handled:
            for number, handler in before.items():
                signal.signal(number, handler or signal.SIG_DFL)


@contextmanager
def warnings_in_a_line() -> Iterator[None]:
    """Show each warning in one line, without its line of code."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        print(f"warning: {in_a_line(message)}", file=sys.stderr)  # noqa: T201

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        # these are for authors of libraries, not for users of a command
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        # a fast BLAS would change nothing here: the time goes into the engine
        warnings.filterwarnings("ignore", message="PyTensor could not link to a BLAS")
        warnings.showwarning = show
        yield


@contextmanager
def noted_warnings(hidden: str | None = None) -> Iterator[list[Warning | str]]:
    """Yield the warnings so far; show each at once, but those with the `hidden` text."""
    noted: list[Warning | str] = []
    with warnings.catch_warnings():
        show = warnings.showwarning

        def note(message: Warning | str, *place: Any, **options: Any) -> None:
            noted.append(message)
            if hidden is None or hidden not in str(message):
                show(message, *place, **options)

        warnings.showwarning = note
        yield noted


@dataclass(frozen=True)
class Result:
    """What a command prints at its end: one JSON object, or lines of text and tables.

    Parameters
    ----------
    contents : mapping of str to object
        The JSON object; numbers that are not finite become null.
    shown : iterable of str or Table
        Lines and tables for people.
    code : int
        Exit code.
    warning : str
        A last line on stderr.
    """

    contents: Mapping[str, object]
    shown: Iterable[str | Table]
    code: int = 0
    warning: str = ""

    def show(self, as_json: bool) -> None:
        """Print the result, and end the command with its exit code."""
        if as_json:
            typer.echo(json.dumps(json_values(self.contents), indent=1, allow_nan=False))
        # a file or a pipe has no width
        console = PlainConsole(width=None if sys.stdout.isatty() else 160)
        for each in () if as_json else self.shown:
            if isinstance(each, Table):
                console.print(each)
            else:
                typer.echo(printable(each))
        if self.warning:
            typer.echo(printable(self.warning), err=True)
        if self.code:
            raise typer.Exit(self.code)


def table(title: str | None, columns: Mapping[str, str], rows: Iterable[Sequence[object]]) -> Table:
    """Return a table whose columns have a format each; those that begin with < are text."""
    made = Table(title=title and printable(title), title_justify="left", box=None, pad_edge=False)
    for name, form in columns.items():
        left = form.startswith("<")
        made.add_column(name, justify="left" if left else "right", no_wrap=not left)
    for row in rows:
        cells = (f"{each:{form}}" for each, form in zip(row, columns.values(), strict=True))
        made.add_row(*map(printable, cells))
    return made


def sizes(numbers: Iterable[tuple[str, str]], units: Mapping[str, str]) -> str:
    """Return numbers by name with their units, of which "1" is none."""
    each = (f"{name} {text} {units[name].removesuffix('1')}" for name, text in numbers)
    return ", ".join(map(str.rstrip, each))


def check_file(path: Path, endings: tuple[str, ...], overwrite: bool) -> None:
    """Raise if a file has the wrong ending, exists already, or cannot be written.

    Raises
    ------
    OutputError
        Says which of these it is.
    """
    if path.suffix not in endings:
        raise OutputError(f"{path}: expected a name that ends in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path}: it is a folder; choose another name")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: it exists; choose another file, or pass --overwrite")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it, or choose another")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); choose another file"
        ) from None
