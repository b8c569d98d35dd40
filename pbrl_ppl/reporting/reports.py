"""Reports of a closed loop and of a posterior: their sections, and reports written to files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from pbrl_ppl.criticism import Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import PbrlError, PosteriorError
from pbrl_ppl.files import write_text
from pbrl_ppl.posterior import Idata, PosteriorRecord, compare, group, identify
from pbrl_ppl.reporting.motion import held_out_motions
from pbrl_ppl.reporting.page import Section, Source, render_page, templates
from pbrl_ppl.reporting.posterior_summary import (
    Parameters,
    coverage,
    most_dependent,
    pareto_k,
    recorded_poses,
)
from pbrl_ppl.reporting.words import plain

T = TypeVar("T")

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
    Section("predictions", "Posterior predictions", "Predictions"),
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
    added = [f"{e.effect}_{name}[{e.body}]" for e in loop.added for name in e.parameters]
    test = loop.held_out
    return render_page(
        plain(loop.verdict),
        "verdict",
        LOOP_SECTIONS,
        result=loop,
        source=source or Source(),
        motions=held_out_motions(loop),
        parameters=Parameters(loop.posterior_after, loop.catalogue, tuple(added)),
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
    k, why_no_k = _or_why(lambda: pareto_k(posterior))
    compared = compare(posterior, posterior) if k else None
    if k and compared is None:
        why_no_k = (
            f"Not available: leaving out one {k[2]} at a time gives no finite number; in some draws"
            " the likelihood is zero"
        )
        k = None
    return render_page(
        f"posterior of {', '.join(body.name for body in record.scene.moving)}",
        "posterior",
        POSTERIOR_SECTIONS,
        posterior=posterior,
        record=record,
        parameters=Parameters(posterior, effects),
        dependent=most_dependent(posterior),
        source=source or Source(command="render_posterior(pp.load_posterior(...))"),
        scene=record.scene,
        poses=recorded_poses(posterior),
        held_out=None,
        known=known,
        why_unknown=why_unknown,
        unfolded=True,
        covered=covered,
        why_uncovered=why_uncovered,
        pareto=k,
        compared=compared,
        why_no_k=why_no_k,
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
