"""Self-contained pages of HTML: their template, tables and pictures."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from pbrl_ppl.background import background
from pbrl_ppl.reporting.style import NARROW, WIDE, png
from pbrl_ppl.reporting.words import (
    change,
    digits_of,
    joined,
    number,
    p_equals,
    percent,
    plain,
    quantity,
)

#: Text of a cell of a table, or text and a small note beside it.
Cell = str | tuple[str, str]


@dataclass(frozen=True)
class Source:
    """Files and command behind a page, for a reader who wants to reproduce it.

    Parameters
    ----------
    scene, train, test : str
        Names of the files, empty where there are none.
    command : str
        Command that makes the page again, at a shell or in Python.
    """

    scene: str = ""
    train: str = ""
    test: str = ""
    command: str = ""


@dataclass(frozen=True)
class Table:
    """A table as a page shows it; on a telephone each row becomes a card.

    Parameters
    ----------
    caption : str
        Title of the table.
    columns : sequence of str
        Their heads.
    rows : sequence of sequence
        Cells, as many as there are columns.
    words : tuple of int
        Columns that hold words; others hold numbers, and the first one the row's name.
    marks : sequence of str
        ``added`` or ``bad`` for rows that stand out; as many as rows, or none.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    words: tuple[int, ...] = ()
    marks: Sequence[str] = ()

    @property
    def marked(self) -> list[tuple[str, list[tuple[int, str, str, str]]]]:
        """Rows with their mark; of each cell: column number, head, text and note."""
        result = []
        for mark, row in zip(self.marks or [""] * len(self.rows), self.rows, strict=True):
            cells = [cell if isinstance(cell, tuple) else (cell, "") for cell in row]
            heads = enumerate(zip(self.columns, cells, strict=True))
            result.append((mark, [(place, head, *cell) for place, (head, cell) in heads]))
        return result


def render_page(
    template: str, pictures: Mapping[str, Callable[[float], Figure]], **values: Any
) -> str:
    """Render a template; pictures are drawn twice, for a page and for a telephone.

    Parameters
    ----------
    template : str
        Its name in this folder.
    pictures : dict of str to callable
        Draws a picture at a width (inches).
    **values : object
        Values that the template shows.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pbrl_ppl", "reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for words in (number, percent, p_equals, plain, joined, change, quantity):
        environment.filters[words.__name__] = words
    environment.filters["data"] = _data
    names = list(pictures)

    def drawn(chosen: list[str]) -> dict[str, dict[str, str]]:
        return {name: _picture(pictures[name]) for name in chosen}

    with background(partial(drawn, names[1::2])) as others:
        picture = drawn(names[::2]) | others()
    return environment.get_template(template).render(picture=picture, digits_of=digits_of, **values)


def _picture(draw: Callable[[float], Figure]) -> dict[str, str]:
    """Return a picture in both widths."""
    return {"wide": _address(draw(WIDE)), "narrow": _address(draw(NARROW))}


def _address(figure: Figure) -> str:
    """Return a picture as a data URL."""
    return "data:image/png;base64," + base64.b64encode(png(figure)).decode("ascii")


def _data(value: Any) -> Markup:
    """Return JSON for a script element, escaped so that no text can end it."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(text)
