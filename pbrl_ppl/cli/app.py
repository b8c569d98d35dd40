"""Command-line program: how a command is declared, the commands and their exit codes."""

from __future__ import annotations

import gc
import inspect
import multiprocessing
import os
import platform
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import typer

from pbrl_ppl import __version__
from pbrl_ppl.cli import options, terminal
from pbrl_ppl.cli.terminal import Result, in_a_line
from pbrl_ppl.errors import OutputError, PbrlError, printable
from pbrl_ppl.system.files import only_writer

F = TypeVar("F", bound=Callable[..., Result])

app = typer.Typer(
    name="pbrl-ppl",
    help="A physics engine as model prior, and a loop that closes on measured data.",
    epilog="Example: pbrl-ppl new --from shopping_cart. Exit codes: 0; 1 for a goal that was not"
    " reached, effects that stay inseparable or at least one log that failed; 2 for bad usage or"
    " input, with one message on stderr; 3 where chains have not converged; 130 after an"
    " interrupt.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

#: Places of commands in the list of commands.
_RANKS: dict[str | None, int] = {}


def command(
    name: str, rank: int, example: str, kept: str = "nothing was written"
) -> Callable[[F], F]:
    """Declare a function of this room to be a command, whose result is printed.

    The ``rank`` is its place in the list of commands, the ``example`` is for its help. An interrupt
    says what is ``kept``, in terms of the arguments. Every command has the options of `Printing`;
    its function takes those and the arguments ``progress`` and ``interrupts`` where it needs them.

    An argument that is a dataclass stands for the options that are its fields. The help of an
    argument, and after a colon what stands for its value, are in the docstring of the function or
    of the dataclass, or in that of `options`. An argument without a default is one of the command,
    others are its options.
    """

    def declare(function: F) -> F:
        app.command(name, epilog=f"Example: {example}")(_bound(function, kept))
        _RANKS[name] = rank
        app.registered_commands.sort(key=lambda each: _RANKS[each.name])
        return function

    return declare


@dataclass(frozen=True)
class Printing:
    """Options of every command.

    Parameters
    ----------
    as_json
        Print one JSON object, and nothing else.
    quiet
        Show no progress.
    """

    as_json: Annotated[bool, typer.Option("--json")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q")] = False

    def run(self, function: Callable[..., Result], kept: str, given: Mapping[str, object]) -> None:
        """Run a command with what it takes, and print its result."""
        taken = inspect.signature(function).parameters
        staged = terminal.Progress(self.quiet) if "progress" in taken else nullcontext()
        output: Any = given.get("output", getattr(given.get("to"), "output", None))
        with (
            terminal.interruptible(kept.format(**given)) as interrupts,
            nullcontext() if output is None else only_writer(output),
            staged as progress,
        ):
            session = {"progress": progress, "interrupts": interrupts}
            known = {**given, **vars(self), **session}
            result = function(**{name: known[name] for name in taken})
        result.show(self.as_json)


def _bound(function: Callable[..., Result], kept: str) -> Callable[..., None]:
    """Return the function as Typer takes it: fields in place of dataclasses, each with its help."""
    summary, documented = _documented(function.__doc__)
    taken = inspect.signature(function, eval_str=True).parameters
    groups: dict[str, type] = {}
    parameters: list[inspect.Parameter] = []
    kinds = {name: parameter.annotation for name, parameter in taken.items()}
    for name, kind in (kinds | {"printing": Printing}).items():
        if is_dataclass(kind):
            group = groups[name] = cast(type, kind)
            for base in group.__mro__:
                documented = _documented(base.__doc__)[1] | documented
            hints = get_type_hints(group, include_extras=True)  # each in the module of its class
            declared = inspect.signature(group).parameters.values()
            parameters += [each.replace(annotation=hints[each.name]) for each in declared]
        elif name not in ("as_json", "quiet", "progress", "interrupts"):
            parameters.append(taken[name])

    def call(**given: object) -> None:
        values = {
            name: kind(**{field.name: given.pop(field.name) for field in fields(kind)})
            for name, kind in groups.items()
        }
        printing: Printing = values.pop("printing")
        printing.run(function, kept, given | values)

    documented = _documented(options.__doc__)[1] | documented
    parameters = [_declared(each, *documented.get(each.name, ("", ""))) for each in parameters]
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__doc__ = summary
    return call


def _declared(parameter: inspect.Parameter, metavar: str, said: str) -> inspect.Parameter:
    """Return a parameter with the declaration, metavar and help of an option or argument."""
    kind = parameter.annotation
    optional = [each for each in get_args(kind) if get_origin(each) is Annotated]
    if get_origin(kind) is Annotated:
        kind, info = get_args(kind)
    elif optional:  # Annotated[...] | None
        kind, info = get_args(optional[0])
        kind |= None
    elif kind is typer.Context:
        return parameter.replace(kind=parameter.KEYWORD_ONLY)
    elif parameter.default is parameter.empty:
        info = typer.Argument()
    else:
        info = typer.Option(f"--{parameter.name.replace('_', '-')}")
    info = copy(info)
    info.metavar, info.help = info.metavar or metavar or None, info.help or said or None
    return parameter.replace(annotation=Annotated[kind, info], kind=parameter.KEYWORD_ONLY)


def _documented(docstring: str | None) -> tuple[str, dict[str, tuple[str, str]]]:
    """Return a docstring up to its parameters, and the metavar and help of each of them."""
    text = inspect.cleandoc(docstring or "")
    summary, _, listed = text.partition("\n\nParameters\n----------\n")
    entries = re.findall(r"^(\w+)(?: : (.+))?\n((?:    .+(?:\n|$))+)", listed, re.MULTILINE)
    return summary, {name: (metavar, " ".join(said.split())) for name, metavar, said in entries}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        0; 1 for a goal that was not reached, effects that no allowed actions are expected to tell
        apart, or at least one log that failed; 2 for bad usage or bad input, with one message on
        stderr; 3 where chains have not converged; 130 if interrupted.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")  # commands show no windows
    if argv is None:
        gc.set_threshold(100_000, 20, 20)  # compilation makes millions of objects that stay
    if argv is None and "forkserver" in multiprocessing.get_all_start_methods():
        # a fork of this process, by PyMC's chains, could copy a lock that a thread holds
        multiprocessing.set_start_method("forkserver", force=True)
        multiprocessing.set_forkserver_preload(["pymc"])
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        for argument in argv:  # a report shows them, names of files mostly
            if printable(argument) != argument:
                raise OutputError(
                    f"argument '{argument}': it has control characters; rename the file, or leave"
                    " them out"
                )
        with terminal.warnings_in_a_line():
            app(args=argv, prog_name="pbrl-ppl")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        return terminal.Interrupts().ended("nothing was written")
    except PbrlError as error:
        print(f"error: {in_a_line(error)}", file=sys.stderr)  # noqa: T201
        return terminal.BAD_INPUT
    return 0


def _show_version(context: typer.Context, value: bool) -> None:
    if not value:
        return
    typer.echo(f"pbrl-ppl {__version__}")
    if not context.params.get("verbose"):
        raise typer.Exit
    from pbrl_ppl.posterior import versions

    folder, fault = str(Path(__file__).parents[1]), _engine_fault()
    shown = versions() | {"platform": platform.platform(), "folder": folder}
    shown["engine"] = fault or "compiled, works"
    for name, text in shown.items():
        typer.echo(f"{name:12} {printable(text)}")
    raise typer.Exit(terminal.FAILED if fault else 0)


def _engine_fault() -> str:
    """Return what is wrong with the compiled engine, which pushes a puck; "" where it works."""
    import numpy as np

    from pbrl_ppl.physics import Physics
    from pbrl_ppl.scene import Body, Scene, Shape

    puck = Body("puck", Shape.circle(0.1), known=(("mass", 2.0), ("r", 0.0), ("mu_c", 0.0)))
    push = np.array([[[[4.0, 0.0, 0.0]]]])
    try:
        physics = Physics(Scene(time_step=0.5, bodies=(puck,)), engine="chipmunk")
        speed = physics.predict(np.zeros(0), np.zeros((1, 1, 6)), push)[0, 0, 0, 3]
    except PbrlError as error:
        return in_a_line(error)
    wrong = not abs(speed - 1.0) < 1e-9
    return f"wrong: {speed:g} m/s where 1 is right; please report this" if wrong else ""


@app.callback()
def _options(
    # eager: known before --version is
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", "-v", is_eager=True,
            help="With --version: also of the packages, and whether the compiled engine works.",
        ),
    ] = False,
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, help="Show the version and leave."),
    ] = False,
) -> None:  # fmt: skip
    """Options before any command."""
