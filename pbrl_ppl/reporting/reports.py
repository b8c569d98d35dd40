"""Reports, self-contained pages of HTML: their sections, and how they are rendered."""

from __future__ import annotations

import base64
from collections import ChainMap, Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import quote

import jinja2
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from pbrl_ppl.criticism import NOT_CONVERGED, Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import PbrlError, PosteriorError
from pbrl_ppl.posterior import Idata, PosteriorRecord, compare, group, identify
from pbrl_ppl.reporting import (
    loop_plots,
    motion,
    posteriors,
    residual_force,
    scene_plots,
    tables,
    words,
)
from pbrl_ppl.reporting.motion import held_out_motions
from pbrl_ppl.reporting.posteriors import Parameters, coverage, recorded_poses
from pbrl_ppl.reporting.style import png
from pbrl_ppl.reporting.tables import tabulate
from pbrl_ppl.reporting.words import added_labels, error, listed, plain
from pbrl_ppl.system.files import write_text

T = TypeVar("T")

#: Stands for the verdict of a log without a report.
FAILED = "failed"

#: Modules whose public names templates can use.
_MODULES = (words, tables, residual_force, motion, posteriors, loop_plots, scene_plots)


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
    """Return a page of HTML.

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

    def rendered(name: str) -> Markup:
        template = environment.get_template(f"{name}.html.jinja")
        return Markup(template.render(context, draw=picture))

    shown = [
        (section, environment.from_string(section.title).render(context), body)
        for section in sections
        if (body := rendered(section.template)).strip()
    ]
    return environment.get_template("page.html.jinja").render(
        title=title, header=rendered(header), sections=shown
    )


def picture(plot: Callable[..., Figure], *data: object) -> str:
    """Return what a function plots of data as a data URL."""
    # a $ is part of a name
    with rc_context({"text.parse_math": False, "axes.titlesize": 9}):
        code = base64.b64encode(png(plot(*data))).decode("ascii")
    return f"data:image/png;base64,{code}"


LOOP_SECTIONS = (
    Section("motions", "Measured and predicted motion", "Motion"),
    Section("rollout"),
    Section("scene", "The scene and the recording", "Scene"),
    Section("search", "Search for missing laws", "Search"),
    Section("unexplained", "The unexplained residual", "Unexplained"),
    Section("errors", "Errors on held-out recordings", "Errors"),
    Section("tests", "Residual tests", "Residual tests"),
    Section("candidates", "What could be missing: all candidates", "Candidates"),
    Section("model", "What the {{ result | model_of }} model knows", "Parameters"),
    Section("identifiability", "Identifiability"),
    Section("accuracy", "Is the engine accurate enough?"),
    Section("sampler", "Sampler diagnostics", "Sampler"),
    Section("words", "What the words mean", "Words"),
    Section("source", "Where this came from", "Source"),
)

POSTERIOR_SECTIONS = (
    Section("parameters", "Parameters", "Parameters"),
    Section("scene", "The scene and the recording", "Scene"),
    Section("identifiability", "What the data say", "What the data say"),
    Section("sampler", "Did the sampler work?", "Sampler"),
    Section("loo", "Leave-one-out cross-validation", "LOO"),
    Section("words", "What the words mean", "Words"),
    Section("origin", "Where this came from", "Source"),
)


def render_without_verdict(said: Iterable[str], advice: str, source: Source) -> str:
    """Return the page of a loop that was interrupted: what was ``said`` so far, and no verdict.

    Parameters
    ----------
    said : iterable of str
        Sentences on what was found, in order.
    advice : str
        What takes less time.
    source : Source
        Names of the files, and the command that makes the page again.
    """
    sections = [Section("interrupted", "What was found so far")]
    known = {"said": list(said), "advice": advice, "source": source}
    return render_page("interrupted: no verdict", "interrupted_header", sections, **known)


def report(found: Loop | Idata, path: str | Path, *, source: Source | None = None) -> Path:
    """Write the report of a closed loop or of a posterior as one self-contained page.

    Parameters
    ----------
    found : Loop, InferenceData or DataTree
        Result of :func:`pbrl_ppl.close_loop`, or a posterior.
    path : str or pathlib.Path
        Written whole or not at all.
    source : Source, optional
        Names of the files, and the command that makes the page again.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    OutputError
        If the file cannot be written.
    PosteriorError
        If the posterior lacks what its report shows.

    Examples
    --------
    ::

        pp.report(pp.close_loop(scene, train, test, seed=1), "report.html")
        pp.report(pp.load_posterior("cart.nc"), "cart.html")
    """
    page = (
        render(found, source) if isinstance(found, Loop) else render_posterior(found, source=source)
    )
    write_text(Path(path), page)
    return Path(path)


def render(loop: Loop, source: Source | None = None) -> str:
    """Return the report of a closed loop as one self-contained page of HTML.

    Parameters
    ----------
    loop : Loop
        Result of :func:`pbrl_ppl.close_loop`.
    source : Source, optional
        Names of the files, and the command that makes the page again.
    """
    test = loop.held_out
    return render_page(
        plain(loop.verdict),
        "verdict",
        LOOP_SECTIONS,
        result=loop,
        source=source or Source(),
        motions=held_out_motions(loop),
        parameters=Parameters(loop.posterior_after, loop.catalogue, added_labels(loop)),
        scene=loop.scene,
        poses=recorded_poses(loop.posterior_before),
        held_out=None if test is None else test.dataset["start"].to_numpy()[..., :3],
        known=loop.identifiability,
        why_unknown="",
        unfolded=False,
    )


def render_posterior(
    posterior: Idata, effects: Iterable[Effect] = full_catalogue, source: Source | None = None
) -> str:
    """Render the report of a posterior: one page of HTML that needs nothing else.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, :func:`pbrl_ppl.update` or read from a file.
    effects : iterable of Effect
        Where the names of its effects are looked up; add your own to the package's.
    source : Source, optional
        The command that makes the page again.

    Returns
    -------
    str
        The page.

    Raises
    ------
    PosteriorError
        If it lacks a group, or has fewer than 100 draws, as one of a mode alone.

    Examples
    --------
    ::

        page = render_posterior(pp.load_posterior("cart.nc"))
        Path("cart.html").write_text(page, encoding="utf-8")
    """
    effects, least = tuple(effects), 100  # for diagnostics of chains and cross-validation
    sizes = group(posterior, "posterior").sizes
    if sizes["chain"] * sizes["draw"] < least:
        raise PosteriorError(
            f"posterior: it has {sizes['chain'] * sizes['draw']} draws, a report needs at least"
            f" {least}; fit with a method that draws, and more draws"
        )
    record = PosteriorRecord.of(posterior)
    known, why_unknown = _or_why(lambda: identify(posterior, effects=effects))
    covered, why_uncovered = _or_why(lambda: coverage(posterior))
    compared, why_not_compared = _or_why(lambda: compare(posterior, posterior))
    return render_page(
        f"posterior of {', '.join(body.name for body in record.scene.moving)}",
        "posterior",
        POSTERIOR_SECTIONS,
        posterior=posterior,
        record=record,
        parameters=Parameters(posterior, effects),
        source=source or Source(command="render_posterior(pp.load_posterior(...))"),
        scene=record.scene,
        poses=recorded_poses(posterior),
        held_out=None,
        known=known,
        why_unknown=why_unknown,
        unfolded=True,
        covered=covered,
        why_uncovered=why_uncovered,
        compared=compared,
        why_not_compared=why_not_compared,
        sizes={**group(posterior, "observed_data").sizes, **sizes},
    )


def _or_why(compute: Callable[[], T]) -> tuple[T | None, str]:
    """Return the result of a computation; if it fails, None and the reason for the page."""
    try:
        return compute(), ""
    except PbrlError as error:
        return None, f"Not available: {error}"


def in_brief(loop: Loop, folder: str | Path) -> list[str]:
    """Return a summary of a closed loop in about ten lines.

    Parameters
    ----------
    loop : Loop
        Result of :func:`pbrl_ppl.close_loop`.
    folder : str or pathlib.Path
        Folder of the results, to name in commands.
    """
    brief = templates().get_template("brief.txt.jinja")
    text = brief.render(result=loop, folder=Path(folder))
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def render_logs(rows: Sequence[Mapping[str, Any]], command: str) -> str:
    """Return one page of HTML with a row a log.

    Parameters
    ----------
    rows : sequence of mapping
        Of each log its name (``log``), which is its folder's beside the page, ``verdict``, laws
        (``added``), ``error_before`` and ``error_after`` (in units of the noise) and ``warnings``;
        of one that failed ``message``.
    command : str
        Command that makes the page again.
    """

    def named(row: Mapping[str, Any]) -> str:
        link = Markup('<a href="{}/report.html">{}</a>').format(quote(row["log"]), row["log"])
        return row["log"] if row["verdict"] == FAILED else link

    table = tabulate(
        "All logs",
        rows,
        {
            "Log": named,
            "Verdict": lambda row: row["verdict"].replace("-", " "),
            "Added laws, or what went wrong": lambda row: (
                row.get("message") or listed(map(plain, row["added"]))
            ),
            "Error before": lambda row: error(row.get("error_before")),
            "Error after": lambda row: error(row.get("error_after")),
            "Warnings": lambda row: "; ".join(row["warnings"]),
        },
        {"Verdict", "Added laws, or what went wrong", "Warnings"},
        lambda row: "bad" * (row["verdict"] in (FAILED, NOT_CONVERGED)),
    )
    shown = {"count": len(rows), "verdicts": count_verdicts(rows), "logs": table}
    sections = [Section("logs", "Logs")]
    return render_page(f"{len(rows)} logs", "logs_header", sections, command=command, **shown)


def count_verdicts(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return how many logs had which verdict, as ``1 adequate, 2 failed``."""
    counts = Counter(row["verdict"] for row in rows)
    return ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
