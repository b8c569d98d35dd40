"""The commands: each module of this room declares its own."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import TypeVar, get_type_hints

F = TypeVar("F", bound=Callable[..., None])


@dataclass(frozen=True)
class Command:
    """A command: its name, its place in the list of commands, and an example for its help."""

    name: str
    rank: int
    example: str
    function: Callable[..., None]


_COMMANDS: dict[str, Command] = {}


def command(name: str, rank: int, example: str) -> Callable[[F], F]:
    """Declare a function of this room to be a command.

    An argument that is a dataclass stands for the options that are its fields.
    """

    def declare(function: F) -> F:
        _COMMANDS[name] = Command(name, rank, example, _with_fields(function))
        return function

    return declare


def commands() -> list[Command]:
    """Return the commands of all modules of this room, in the order of use."""
    package = importlib.import_module("pbrl_ppl.cli")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"pbrl_ppl.cli.{module.name}")
    return sorted(_COMMANDS.values(), key=lambda each: each.rank)


def _with_fields(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function that takes the fields of dataclasses in place of dataclasses."""
    groups, parameters = {}, []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        kind = parameter.annotation
        if not (isinstance(kind, type) and is_dataclass(kind)):
            parameters.append(parameter.replace(kind=parameter.KEYWORD_ONLY))
            continue
        groups[parameter.name] = kind
        hints = get_type_hints(kind, include_extras=True)
        parameters += [
            parameter.replace(
                name=field.name, default=field.default, annotation=hints[field.name],
                kind=parameter.KEYWORD_ONLY,
            )
            for field in fields(kind)
        ]  # fmt: skip

    def call(**given: object) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{field.name: given.pop(field.name) for field in fields(kind)})
        function(**given)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__doc__ = function.__doc__
    return call
