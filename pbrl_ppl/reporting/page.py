"""Self-contained pages of HTML, each a list of sections."""

from __future__ import annotations

import base64
import re
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jinja2
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from pbrl_ppl.reporting import (
    effect_plots,
    error_plots,
    motion,
    posterior_plots,
    posterior_summary,
    residual_force,
    scene_plots,
    tables,
    words,
)
from pbrl_ppl.reporting.style import NARROW, WIDE, png

_MODULES = (
    words, tables, residual_force, motion, posterior_summary, effect_plots, error_plots,
    posterior_plots, scene_plots,
)  # fmt: skip


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


class Section(NamedTuple):
    """A section of a page; it is left out where its template gives nothing.

    A new section is a template in ``templates/`` and an entry in a page's list of sections.
    Templates can use the public names of this room's modules, functions also as filters, and draw
    their pictures: ``draw(plot_errors, result)``.

    Parameters
    ----------
    template : str
        Name of the template, without ``.html.jinja``; also the anchor that others link to.
    title : str
        Heading, itself a template; none if empty.
    link : str
        Entry in the page's table of contents; none if empty.
    """

    template: str
    title: str = ""
    link: str = ""


def templates() -> jinja2.Environment:
    """Return the templates, with the public names of this room's modules."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pbrl_ppl.reporting"),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    names = ChainMap(*map(vars, _MODULES))
    public = {name: value for name, value in names.items() if not name.startswith("_")}
    environment.globals |= public
    environment.filters = public | environment.filters
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment


def render_page(title: str, header: str, sections: Sequence[Section], **context: object) -> str:
    """Return a page of HTML; pictures are drawn twice, for a page and for a telephone.

    Parameters
    ----------
    title : str
        Title of the window.
    header : str
        Template of what stands above the table of contents.
    sections : sequence of Section
        What stands below it, in this order.
    **context
        Values that the templates show, by name.
    """
    environment = templates()
    draws: list[Callable[..., Figure]] = []

    def draw(plot: Callable[..., Figure], *data: object) -> Mapping[str, str]:
        """Return the places of a picture in both widths, which is drawn after all text."""
        draws.append(partial(plot, *data))
        return {width: f"\0{len(draws) - 1} {width}\0" for width in ("wide", "narrow")}

    def rendered(name: str) -> Markup:
        return Markup(environment.get_template(f"{name}.html.jinja").render(context, draw=draw))

    shown = [
        (section, environment.from_string(section.title).render(context), body)
        for section in sections
        if (body := rendered(section.template)).strip()
    ]
    page = environment.get_template("page.html.jinja").render(
        title=title, header=rendered(header), sections=shown
    )
    pictures = [picture(draw) for draw in draws]
    return re.sub(r"\0(\d+) (\w+)\0", lambda place: pictures[int(place[1])][place[2]], page)


def picture(draw: Callable[..., Figure]) -> Mapping[str, str]:
    """Return a picture in both widths, ``wide`` and ``narrow``, as data URLs."""
    sizes = {"wide": WIDE, "narrow": NARROW}
    with rc_context({"text.parse_math": False}):  # a $ is part of a name
        data = {name: base64.b64encode(png(draw(width=width))) for name, width in sizes.items()}
    return {name: f"data:image/png;base64,{code.decode('ascii')}" for name, code in data.items()}
