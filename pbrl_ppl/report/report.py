"""Report: the findings of a closed loop as a page of HTML."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pbrl_ppl.criticism import Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.history import History
from pbrl_ppl.posterior import group
from pbrl_ppl.report.effect_plots import (
    HARDLY,
    MOST_CANDIDATES,
    plot_added,
    plot_candidates,
    plot_evidence,
    plot_laws,
)
from pbrl_ppl.report.error_plots import (
    plot_correlations,
    plot_errors,
    plot_growth,
    plot_residuals,
    plot_rollout,
)
from pbrl_ppl.report.evidence import find_evidence, find_laws
from pbrl_ppl.report.loop_tables import (
    acceleration_table,
    candidate_table,
    carrier_table,
    error_tables,
    loo_table,
    models_of,
    residual_test_table,
)
from pbrl_ppl.report.motion import animation, held_out_motions
from pbrl_ppl.report.page import Source, render_page
from pbrl_ppl.report.posterior_plots import most_interesting, plot_rank, plot_trace, summary
from pbrl_ppl.report.posterior_tables import (
    STATISTICS,
    parameter_table,
    posterior_rows,
    sampler_in_words,
    width_table,
)
from pbrl_ppl.report.scene_plots import plot_recording
from pbrl_ppl.report.style import UNITS
from pbrl_ppl.report.words import (
    accepted,
    depends_on_records,
    error_in_words,
    gains_in_words,
    left_out_in_words,
    rejected_in_words,
    verdict_in_words,
)

Array = NDArray[np.float64]


def render(
    findings: Loop,
    held_out: History | None = None,
    effects: Iterable[Effect] = full_catalogue,
    source: Source | None = None,
    remainder: str = "",
) -> str:
    """Render the report: one page of HTML that needs nothing else.

    Parameters
    ----------
    findings : Loop
        What was found.
    held_out : History, optional
        What errors were measured on, for the moving picture; without it, the findings' own
        trajectory is played.
    effects : iterable of Effect
        Where the names of effects are looked up.
    source : Source, optional
        Names of the files, and the command that makes the page again.
    remainder : str
        What a learned remainder does, in a sentence, where one was learned.
    """
    effects = tuple(effects)
    table = summary(findings.posterior_after)
    parameters = most_interesting(
        table,
        (f"{e.effect}_{name}[{e.body}]" for e in findings.added for name in e.parameters),
    )
    units = {
        f"{added.effect}_{name}": e.unit
        for added in findings.added
        for name, e in added.parameters.items()
    }
    rows = posterior_rows(
        table, effects, units, method=str(findings.posterior_after.attrs.get("method", ""))
    )
    evidence = find_evidence(findings, effects) if accepted(findings) else None
    laws = find_laws(findings, effects)
    poses = recorded_poses(findings.posterior_before)
    pictures: dict[str, Callable[[float], Figure]] = {
        "rollout": partial(plot_rollout, findings),
        "errors": partial(plot_errors, findings),
        "residuals": partial(plot_residuals, findings),
        "correlations": partial(plot_correlations, findings),
        "growth": partial(plot_growth, findings),
        "trace": partial(plot_trace, findings.posterior_after, parameters),
        "rank": partial(plot_rank, findings.posterior_after, parameters),
    }
    if poses is not None:
        later = None if held_out is None else held_out.dataset["start"].to_numpy()[..., :3]
        pictures["scene"] = partial(plot_recording, findings.scene, poses, later)
    if evidence is not None:
        pictures["evidence"] = partial(plot_evidence, evidence)
    if laws:
        pictures["laws"] = partial(plot_laws, laws)
    if findings.candidates:
        pictures["candidates"] = partial(plot_candidates, findings)
    if accepted(findings):
        pictures["added"] = partial(plot_added, findings)
    known = findings.identifiability
    return render_page(
        "report.html.jinja",
        pictures,
        findings=findings,
        source=source or Source(),
        motion=animation(findings, held_out_motions(findings, held_out, effects)),
        verdict=verdict_in_words(findings),
        accepted=accepted(findings),
        note=error_in_words(findings),
        rejected=rejected_in_words(findings),
        left_out=left_out_in_words(findings),
        depends=depends_on_records(findings),
        remainder=remainder,
        gains=gains_in_words(findings.before.rollout_rmse, findings.after.rollout_rmse, UNITS),
        evidence=evidence,
        carriers=None if evidence is None else carrier_table(evidence),
        laws=laws,
        errors=error_tables(findings),
        loo=findings.loo and loo_table(findings.loo, models_of(findings)),
        acceleration=acceleration_table(findings),
        tests=residual_test_table(findings),
        candidates=candidate_table(findings, effects),
        posterior=parameter_table(rows, "Posterior of all parameters"),
        count=len(rows),
        bad=[row for row in rows if row["failed"]],
        sampled=sampler_in_words(rows),
        widths=known
        and width_table(
            findings.posterior_after, known, {row["label"]: row["unit"] for row in rows}
        ),
        shown=parameters,
        hardly=HARDLY,
        most=MOST_CANDIDATES,
        meanings={row["label"]: row["meaning"] for row in rows if row["meaning"]},
        statistics=STATISTICS,
    )


def recorded_poses(posterior: Any) -> Array | None:
    """Return the recorded poses that a posterior holds, shape (trajectory, time, body, 3)."""
    if "scene" not in posterior.attrs:
        return None
    given = group(posterior, "constant_data")
    if "recorded_start" in given:
        return np.asarray(given["recorded_start"].to_numpy()[..., :3])
    # single transitions: the start of each, in order
    return np.asarray(given["start"].to_numpy()[None, ..., :3])
