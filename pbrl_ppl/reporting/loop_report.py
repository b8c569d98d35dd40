"""Report of a closed loop: its sections, and reports written to files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pbrl_ppl.criticism import Loop
from pbrl_ppl.files import write_text
from pbrl_ppl.reporting import effect_plots, error_plots, loop_tables
from pbrl_ppl.reporting.evidence import Evidence, Law, find_evidence, find_laws
from pbrl_ppl.reporting.motion import Motion, animation, divergence_in_words, held_out_motions
from pbrl_ppl.reporting.page import Draw, Section, Source, render_page
from pbrl_ppl.reporting.posterior_report import render_posterior
from pbrl_ppl.reporting.posterior_sections import (
    Informed,
    Parameters,
    Recording,
    Sampler,
    Words,
    recorded_poses,
)
from pbrl_ppl.reporting.style import UNITS
from pbrl_ppl.reporting.words import accepted, gains_in_words, plain


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
    source = source or Source()
    parameters = _parameters(loop)
    motions = held_out_motions(loop)
    header = Verdict(loop, parameters, motions, source)
    return render_page(
        plain(loop.verdict), header, loop_sections(loop, parameters, motions, source)
    )


def _parameters(loop: Loop) -> Parameters:
    """Return the summary of the revised model's parameters, those of added effects first."""
    added = [f"{e.effect}_{name}[{e.body}]" for e in loop.added for name in e.parameters]
    return Parameters(loop.posterior_after, loop.catalogue, tuple(added))


def loop_sections(
    loop: Loop, parameters: Parameters, motions: Sequence[Motion], source: Source
) -> list[Section]:
    """Return the sections of a loop's report, in their order."""
    evidence = find_evidence(loop) if accepted(loop) else None
    poses = recorded_poses(loop.posterior_before)
    test = loop.held_out
    later = None if test is None else test.dataset["start"].to_numpy()[..., :3]
    sections = [
        motions and HeldOutMotions(loop, motions),
        Rollout(loop),
        None if poses is None else Recording(loop.scene, poses, later),
        loop.rungs and Search(loop),
        None if evidence is None else EvidenceByTransition(evidence),
        loop.unexplained and UnexplainedResidual(loop, find_laws(loop)),
        HeldOutErrors(loop),
        ResidualTests(loop),
        Candidates(loop),
        ModelParameters(loop, parameters),
        loop.identifiability and Informed(parameters, loop.identifiability),
        EngineAccuracy(loop),
        Sampler(parameters),
        Words(parameters),
        Provenance(loop, source),
    ]
    return [section for section in sections if isinstance(section, Section)]


@dataclass(frozen=True, eq=False)
class LoopSection(Section):
    """Section that shows a closed loop; templates read it as ``result``."""

    loop: Loop

    @property
    def model(self) -> str:
        """The model of which the page says what remains: revised, or declared."""
        return "revised" if self.loop.added else "declared"

    def context(self) -> Mapping[str, object]:
        seconds = self.loop.rollout_horizon * self.loop.scene.time_step
        return vars(self) | {"result": self.loop, "model": self.model, "seconds": seconds}


@dataclass(frozen=True, eq=False)
class Verdict(LoopSection):
    """Header: the verdict, added effects and their sizes, what remains, how well it predicts."""

    parameters: Parameters
    motions: Sequence[Motion]
    source: Source

    template = "verdict"

    def context(self) -> Mapping[str, object]:
        loop = self.loop
        return {
            **super().context(),
            "diverging": divergence_in_words(self.motions),
            "gains": gains_in_words(loop.before.rollout_rmse, loop.after.rollout_rmse, UNITS),
        }


@dataclass(frozen=True, eq=False)
class HeldOutMotions(LoopSection):
    """Moving picture of held-out motions, measured and predicted."""

    motions: Sequence[Motion]

    template = "motions"
    title = "Measured and predicted motion"
    link = "Motion"

    def context(self) -> Mapping[str, object]:
        return {
            **super().context(),
            "motion": animation(self.loop, self.motions),
            "diverging": divergence_in_words(self.motions),
        }


class Rollout(LoopSection):
    """Curves of one held-out trajectory."""

    template = "rollout"

    def pictures(self) -> Mapping[str, Draw]:
        return {"rollout": partial(error_plots.plot_rollout, self.loop)}


class Search(LoopSection):
    """Best subsets of missing laws on simulated pieces of each length, and what was accepted."""

    template = "search"
    title = "Search for missing laws"
    link = "Search"

    def context(self) -> Mapping[str, object]:
        return {**super().context(), "tables": loop_tables.search_tables(self.loop)}

    def pictures(self) -> Mapping[str, Draw]:
        return {"search": partial(effect_plots.plot_search, self.loop)}


@dataclass(frozen=True, eq=False)
class EvidenceByTransition(Section):
    """Evidence for the added effects, by measured number and by transition."""

    evidence: Evidence

    template = "evidence"
    title = "Evidence for the added effects"
    link = "Evidence"

    def context(self) -> Mapping[str, object]:
        return vars(self) | {"carriers": loop_tables.carrier_table(self.evidence)}

    def pictures(self) -> Mapping[str, Draw]:
        return {"evidence": partial(effect_plots.plot_evidence, self.evidence)}


@dataclass(frozen=True, eq=False)
class UnexplainedResidual(LoopSection):
    """The unexplained residual, against the recorded quantities that it depends on."""

    laws: Sequence[Law]

    template = "unexplained"
    title = "The unexplained residual"
    link = "Unexplained"

    def pictures(self) -> Mapping[str, Draw]:
        return {"laws": partial(effect_plots.plot_laws, self.laws)} if self.laws else {}


class HeldOutErrors(LoopSection):
    """Held-out errors, as bars, numbers and residuals."""

    template = "errors"
    title = "Errors on held-out recordings"
    link = "Errors"

    def context(self) -> Mapping[str, object]:
        loop = self.loop
        return {
            **super().context(),
            "errors": loop_tables.error_tables(loop),
            "loo": loop.loo and loop_tables.loo_table(loop.loo, loop_tables.models_of(loop)),
        }

    def pictures(self) -> Mapping[str, Draw]:
        return {
            "errors": partial(error_plots.plot_errors, self.loop),
            "residuals": partial(error_plots.plot_residuals, self.loop),
        }


class ResidualTests(LoopSection):
    """Unexplained acceleration and tests of the residual."""

    template = "tests"
    title = "Residual tests"
    link = title

    def context(self) -> Mapping[str, object]:
        return {
            "acceleration": loop_tables.acceleration_table(self.loop),
            "tests": loop_tables.residual_test_table(self.loop),
        }

    def pictures(self) -> Mapping[str, Draw]:
        return {
            "correlations": partial(error_plots.plot_correlations, self.loop),
            "growth": partial(error_plots.plot_growth, self.loop),
        }


class Candidates(LoopSection):
    """Scores, estimates and detection limits of all candidate effects."""

    template = "candidates"
    title = "What could be missing: all candidates"
    link = "Candidates"

    def context(self) -> Mapping[str, object]:
        return {
            **super().context(),
            "candidates": loop_tables.candidate_table(self.loop),
            "hardly": effect_plots.HARDLY,
            "most": effect_plots.MOST_CANDIDATES,
        }

    def pictures(self) -> Mapping[str, Draw]:
        draw = partial(effect_plots.plot_candidates, self.loop)
        return {"candidates": draw} if self.loop.candidates else {}


@dataclass(frozen=True, eq=False)
class ModelParameters(LoopSection):
    """Posterior of the model's parameters, those of added effects as pictures."""

    parameters: Parameters

    template = "model"
    link = "Parameters"

    @property
    def title(self) -> str:  # type: ignore[override]
        return f"What the {self.model} model knows"

    def context(self) -> Mapping[str, object]:
        return {**super().context(), "parameters": self.parameters.table()}

    def pictures(self) -> Mapping[str, Draw]:
        return {"added": partial(effect_plots.plot_added, self.loop)} if accepted(self.loop) else {}


class EngineAccuracy(LoopSection):
    """Numerical error of the engine beside the measurement noise."""

    template = "accuracy"
    title = "Is the engine accurate enough?"


@dataclass(frozen=True, eq=False)
class Provenance(LoopSection):
    """The command that makes the page again; seed, data and versions."""

    source: Source

    template = "source"
    title = "Where this came from"
    link = "Source"
