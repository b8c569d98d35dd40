"""Report of a closed loop: its sections, and reports written to files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pbrl_ppl.criticism import Loop
from pbrl_ppl.files import write_text
from pbrl_ppl.reporting.motion import held_out_motions
from pbrl_ppl.reporting.page import Section, Source, render_page, templates
from pbrl_ppl.reporting.posterior_report import render_posterior
from pbrl_ppl.reporting.posterior_summary import Parameters, recorded_poses
from pbrl_ppl.reporting.words import plain

SECTIONS = (
    Section("motions", "Measured and predicted motion", "Motion"),
    Section("rollout"),
    Section("scene", "The scene and the recording", "Scene"),
    Section("search", "Search for missing laws", "Search"),
    Section("evidence", "Evidence for the added effects", "Evidence"),
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
    test = loop.held_out
    return render_page(
        plain(loop.verdict),
        "verdict",
        SECTIONS,
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


def in_brief(loop: Loop, folder: str | Path, remainder: str = "") -> list[str]:
    """Return a summary of a closed loop in about ten lines.

    Parameters
    ----------
    loop : Loop
        Result of :func:`pbrl_ppl.close_loop`.
    folder : str or pathlib.Path
        Folder of the results, to name in commands.
    remainder : str
        What a learned remainder does, or why there is none; empty if none was requested.
    """
    brief = templates().get_template("brief.txt.jinja")
    text = brief.render(result=loop, folder=Path(folder), remainder=remainder)
    return [line.rstrip() for line in text.splitlines() if line.strip()]
