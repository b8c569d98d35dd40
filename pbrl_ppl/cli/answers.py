"""Answers of the commands: words for people, or one JSON object for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

_WIDE = 160


def print_json(contents: Mapping[str, Any]) -> None:
    """Print one JSON object; numbers that are not finite become null."""
    typer.echo(json.dumps(_plain(contents), indent=1, allow_nan=False))


def print_table(title: str | None, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column is text; of the others, those that begin with < are too."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for i, name in enumerate(columns):
        left = i == 0 or name.startswith("<")
        table.add_column(
            name.removeprefix("<"), justify="left" if left else "right", no_wrap=not left
        )
    for row in rows:
        table.add_row(*row)
    # a file or a pipe is as wide as it need be
    width = None if sys.stdout.isatty() else _WIDE
    Console(highlight=False, markup=False, width=width).print(table)


def _plain(value: Any) -> Any:
    """Values that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy's
        value = value.tolist()
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
