"""Command-line program: its commands and exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from pbrl_ppl import __version__
from pbrl_ppl.cli.options import commands
from pbrl_ppl.cli.terminal import BAD_INPUT, in_a_line, interrupted, warnings_in_a_line
from pbrl_ppl.errors import PbrlError

app = typer.Typer(
    name="pbrl-ppl",
    help="A physics engine as model prior, and a loop that closes on measured data.",
    epilog="Example: pbrl-ppl new --from shopping_cart. Exit codes: 0; 1 for a calibration that"
    " failed, a goal that was not reached, effects that stay inseparable or at least one log that"
    " failed; 2 for bad usage or input, with one message on stderr; 3 where chains have not"
    " converged; 130 after an interrupt.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for each in commands():
    app.command(each.name, epilog=f"Example: {each.example}")(each.function)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        0; 1 for a calibration that failed, a goal that was not reached, effects that no allowed
        actions are expected to tell apart, or at least one log that failed; 2 for bad usage or bad
        input, with one message on stderr; 3 where chains have not converged; 130 if interrupted.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")  # commands show no windows
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        with warnings_in_a_line():
            app(args=argv, prog_name="pbrl-ppl")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        return interrupted()
    except PbrlError as error:
        print(f"error: {in_a_line(error)}", file=sys.stderr)  # noqa: T201
        return BAD_INPUT
    return 0


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"pbrl-ppl {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and leave."
        ),
    ] = False,
) -> None:
    """Options before any command."""
