"""Command-line program: its commands and exit codes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated

import typer

from pbrl_ppl.cli.calibrate import calibrate
from pbrl_ppl.cli.check import check
from pbrl_ppl.cli.close_loop import close_loop
from pbrl_ppl.cli.plan import plan
from pbrl_ppl.cli.terminal import BAD_INPUT, interrupted, warnings_in_a_line
from pbrl_ppl.cli.update import update
from pbrl_ppl.errors import PbrlError

app = typer.Typer(
    name="pbrl-ppl",
    help="A physics engine as model prior, and a loop that closes on measured data.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("close-loop")(close_loop)
for command in (check, calibrate, update, plan):
    app.command()(command)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        0; 1 for a calibration that failed, a goal that was not reached, or some of many logs that
        failed; 2 for bad usage or bad input, with one message on stderr; 3 for a loop without a
        verdict; 130 if interrupted.
    """
    try:
        with warnings_in_a_line():
            app(args=None if argv is None else list(argv), prog_name="pbrl-ppl")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        return interrupted()
    except PbrlError as error:
        # one line, whatever the message quotes from a file
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        return BAD_INPUT
    return 0


def _show_version(value: bool) -> None:
    if value:
        try:
            typer.echo(f"pbrl-ppl {version('pbrl_ppl')}")
        except PackageNotFoundError:
            typer.echo("pbrl-ppl (not installed)")
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
