"""The commands: each module of this room declares its own."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

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
    """Declare a function of this room to be a command."""

    def declare(function: F) -> F:
        _COMMANDS[name] = Command(name, rank, example, function)
        return function

    return declare


def commands() -> list[Command]:
    """Return the commands of all modules of this room, in the order of use."""
    package = importlib.import_module("pbrl_ppl.cli")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"pbrl_ppl.cli.{module.name}")
    return sorted(_COMMANDS.values(), key=lambda each: each.rank)
