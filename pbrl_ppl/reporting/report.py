"""Reports of closed loops, as a page of HTML, and reports written to files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from pbrl_ppl.criticism import Loop
from pbrl_ppl.files import write_text
from pbrl_ppl.reporting.effect_plots import (
    HARDLY,
    MOST_CANDIDATES,
    plot_added,
    plot_candidates,
    plot_evidence,
    plot_laws,
)
from pbrl_ppl.reporting.error_plots import (
    plot_correlations,
    plot_errors,
    plot_growth,
    plot_residuals,
    plot_rollout,
)
from pbrl_ppl.reporting.evidence import find_evidence, find_laws
from pbrl_ppl.reporting.loop_tables import (
    acceleration_table,
    candidate_table,
    carrier_table,
    error_tables,
    loo_table,
    models_of,
    residual_test_table,
)
from pbrl_ppl.reporting.motion import animation, divergence_in_words, held_out_motions
from pbrl_ppl.reporting.page import Source, render_page
from pbrl_ppl.reporting.posterior_plots import plot_rank, plot_trace
from pbrl_ppl.reporting.posterior_report import recorded_poses, render_posterior
from pbrl_ppl.reporting.posterior_tables import parameter_section
from pbrl_ppl.reporting.scene_plots import plot_recording
from pbrl_ppl.reporting.style import UNITS
from pbrl_ppl.reporting.words import (
    accepted,
    caution_in_words,
    depends_on_records,
    error_in_words,
    gains_in_words,
    has_size,
    held_out_in_words,
    left_out_in_words,
    rejected_in_words,
    remains_in_words,
    verdict_in_words,
)


def report(found: Any, path: str | Path, *, source: Source | None = None) -> Path:
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
    page = render if isinstance(found, Loop) else render_posterior
    write_text(Path(path), page(found, source=source))
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
    section = parameter_section(loop.posterior_after, loop.catalogue, loop.identifiability, added)
    evidence = find_evidence(loop) if accepted(loop) else None
    laws = find_laws(loop)
    poses = recorded_poses(loop.posterior_before)
    motions = held_out_motions(loop)
    pictures: dict[str, Callable[[float], Figure]] = {
        "rollout": partial(plot_rollout, loop),
        "errors": partial(plot_errors, loop),
        "residuals": partial(plot_residuals, loop),
        "correlations": partial(plot_correlations, loop),
        "growth": partial(plot_growth, loop),
        "trace": partial(plot_trace, loop.posterior_after, section["shown"]),
        "rank": partial(plot_rank, loop.posterior_after, section["shown"]),
    }
    if poses is not None:
        test = loop.held_out
        later = None if test is None else test.dataset["start"].to_numpy()[..., :3]
        pictures["scene"] = partial(plot_recording, loop.scene, poses, later)
    if evidence is not None:
        pictures["evidence"] = partial(plot_evidence, evidence)
    if laws:
        pictures["laws"] = partial(plot_laws, laws)
    if loop.candidates:
        pictures["candidates"] = partial(plot_candidates, loop)
    if accepted(loop):
        pictures["added"] = partial(plot_added, loop)
    return render_page(
        "report.html.jinja",
        pictures,
        result=loop,
        source=source or Source(),
        motion=animation(loop, motions),
        diverging=divergence_in_words(motions),
        verdict=verdict_in_words(loop),
        remains=remains_in_words(loop),
        held_out=held_out_in_words(loop),
        accepted=accepted(loop),
        has_size=has_size,
        caution=caution_in_words(loop),
        note=error_in_words(loop),
        rejected=rejected_in_words(loop),
        left_out=left_out_in_words(loop),
        depends=depends_on_records(loop),
        remainder=loop.remainder_words,
        gains=gains_in_words(loop.before.rollout_rmse, loop.after.rollout_rmse, UNITS),
        evidence=evidence,
        carriers=None if evidence is None else carrier_table(evidence),
        laws=laws,
        errors=error_tables(loop),
        loo=loop.loo and loo_table(loop.loo, models_of(loop)),
        acceleration=acceleration_table(loop),
        tests=residual_test_table(loop),
        candidates=candidate_table(loop),
        hardly=HARDLY,
        most=MOST_CANDIDATES,
        **section,
    )
