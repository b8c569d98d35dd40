"""Self-contained pages of HTML: their sections, tables and pictures."""

from __future__ import annotations

import base64
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from pbrl_ppl.background import background
from pbrl_ppl.reporting import words
from pbrl_ppl.reporting.style import NARROW, WIDE, png

#: Text of a cell of a table, or text and a small note beside it.
Cell = str | tuple[str, str]
#: Draws a picture at a width (inches).
Draw = Callable[[float], Figure]


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


class Section:
    """A section of a page: its data, the template that shows them, and its pictures.

    A new section is a dataclass of its data, a template in ``templates/``, and an entry in a page's
    list of sections. Templates can use the functions of ``words.py`` as filters.

    Attributes
    ----------
    template : str
        Name of the template, without ``.html.jinja``; also the anchor that others link to.
    title : str
        Heading; none if empty.
    link : str
        Entry in the page's table of contents; none if empty.
    """

    template: str
    title: str = ""
    link: str = ""

    def context(self) -> Mapping[str, object]:
        """Return the values that the template shows, by name: the section's data, or more."""
        return vars(self)

    def pictures(self) -> Mapping[str, Draw]:
        """Return the pictures that the template shows, as ``picture.name``."""
        return {}


def render_page(title: str, header: Section, sections: Sequence[Section]) -> str:
    """Return a page of HTML; pictures are drawn twice, for a page and for a telephone.

    Parameters
    ----------
    title : str
        Title of the window.
    header : Section
        What stands above the table of contents.
    sections : sequence of Section
        What stands below it, in this order.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pbrl_ppl.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name, function in inspect.getmembers(words, inspect.isfunction):
        environment.filters.setdefault(name, function)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    parts = [header, *sections]
    contexts = [part.context() for part in parts]
    draws = [part.pictures() for part in parts]
    drawn = iter(_drawn([draw for pictures in draws for draw in pictures.values()]))
    shown = [
        Markup(
            environment.get_template(f"{part.template}.html.jinja").render(
                context, picture={name: next(drawn) for name in pictures}
            )
        )
        for part, context, pictures in zip(parts, contexts, draws, strict=True)
    ]
    return environment.get_template("page.html.jinja").render(
        title=title, header=shown[0], sections=list(zip(sections, shown[1:], strict=True))
    )


def _drawn(draws: Sequence[Draw]) -> list[Mapping[str, str]]:
    """Return pictures in both widths, drawn by two processes."""
    with background(lambda: [_picture(draw) for draw in draws[1::2]]) as others:
        pictures = {2 * i: _picture(draw) for i, draw in enumerate(draws[::2])}
        pictures |= {2 * i + 1: picture for i, picture in enumerate(others())}
    return [pictures[i] for i in range(len(draws))]


def _picture(draw: Draw) -> Mapping[str, str]:
    """Return a picture in both widths."""
    return {"wide": _address(draw(WIDE)), "narrow": _address(draw(NARROW))}


def _address(figure: Figure) -> str:
    """Return a picture as a data URL."""
    return "data:image/png;base64," + base64.b64encode(png(figure)).decode("ascii")
