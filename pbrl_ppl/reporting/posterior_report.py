"""Report of any posterior file: what is known, whether it can be relied on, and how it predicts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import PbrlError, PosteriorError
from pbrl_ppl.posterior import Idata, PosteriorRecord, compare, group, identify
from pbrl_ppl.reporting.page import Section, Source, render_page
from pbrl_ppl.reporting.posterior_summary import (
    Parameters,
    coverage,
    most_dependent,
    pareto_k,
    recorded_poses,
)

T = TypeVar("T")

SECTIONS = (
    Section("parameters", "Parameters", "Parameters"),
    Section("scene", "The scene and the recording", "Scene"),
    Section("identifiability", "What the data say", "What the data say"),
    Section("sampler", "Did the sampler work?", "Sampler"),
    Section("predictions", "Posterior predictions", "Predictions"),
    Section("loo", "Leave-one-out cross-validation", "LOO"),
    Section("words", "What the words mean", "Words"),
    Section("origin", "Where this came from", "Source"),
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
    return render_page(
        f"posterior of {', '.join(body.name for body in record.scene.moving)}",
        "posterior",
        SECTIONS,
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
        compared=k and compare(posterior, posterior),
        why_no_k=why_no_k,
        sizes={**group(posterior, "observed_data").sizes, **sizes},
    )


def _or_why(compute: Callable[[], T]) -> tuple[T | None, str]:
    """Return the result of a computation; if it fails, None and the reason for the page."""
    try:
        return compute(), ""
    except PbrlError as error:
        return None, f"Not available: {error}"
