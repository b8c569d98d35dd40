"""Report of any posterior file: what is known, whether it can be relied on, and how it predicts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import PbrlError, PosteriorError
from pbrl_ppl.posterior import (
    Idata,
    Identifiability,
    PosteriorRecord,
    compare,
    group,
    groups,
    identify,
    scalars,
    scene_of,
)
from pbrl_ppl.reporting.loop_tables import loo_table
from pbrl_ppl.reporting.page import Draw, Section, Source, Table, render_page
from pbrl_ppl.reporting.posterior_plots import (
    Coverage,
    coverage,
    most_dependent,
    pareto_k,
    plot_pairs,
    plot_pareto,
    plot_predictions,
    plot_prior,
)
from pbrl_ppl.reporting.posterior_sections import (
    Informed,
    Parameters,
    Recording,
    Sampler,
    Words,
    recorded_poses,
)
from pbrl_ppl.reporting.words import plain
from pbrl_ppl.state import Floats

T = TypeVar("T")


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
    scene, parameters = scene_of(posterior), Parameters(posterior, effects)
    known, why_unknown = _or_why(lambda: identify(posterior, effects=effects))
    covered, why_uncovered = _or_why(lambda: coverage(posterior))
    k, why_no_k = _or_why(lambda: pareto_k(posterior))
    predictions = Predictions(posterior, covered or {}, why_uncovered)
    poses = recorded_poses(posterior)
    drawn = poses is not None and np.isfinite(poses[..., :2]).any()
    sections = [
        AllParameters(parameters),
        Recording(scene, poses) if poses is not None and drawn else None,
        Informed(parameters, known, why_unknown, "What the data say", "What the data say", True),
        Sampler(parameters, "Did the sampler work?", True),
        predictions,
        LeaveOneOut(posterior, k, why_no_k),
        Words(parameters),
        Origin(posterior, source or Source(command="render_posterior(pp.load_posterior(...))")),
    ]
    return render_page(
        f"posterior of {', '.join(body.name for body in scene.moving)}",
        PosteriorHeader(parameters, known, predictions),
        [section for section in sections if section is not None],
    )


def _or_why(compute: Callable[[], T]) -> tuple[T | None, str]:
    """Return the result of a computation; if it fails, None and the reason for the page."""
    try:
        return compute(), ""
    except PbrlError as error:
        return None, f"Not available: {error}"


@dataclass(frozen=True, eq=False)
class AllParameters(Section):
    """Table of all parameters; at most ``most`` are drawn over their priors."""

    parameters: Parameters
    most: int = 12

    template = "parameters"
    title = "Parameters"
    link = title

    @cached_property
    def pairs(self) -> list[str]:
        """The parameters that depend most on each other."""
        return most_dependent(self.parameters.posterior)

    @cached_property
    def priors(self) -> list[str]:
        """The parameters that are drawn over their prior: those that move, if any does."""
        draws = scalars(self.parameters.posterior)
        moving = [str(name) for name, v in draws.items() if float(v.max() - v.min()) > 0]
        return (moving or list(map(str, draws)))[: self.most]

    def context(self) -> Mapping[str, object]:
        return {
            "parameters": self.parameters.table(),
            "has_prior": "prior" in groups(self.parameters.posterior),
            "shown_priors": self.priors,
            "count": len(self.parameters.summary),
            "pairs": self.pairs,
        }

    def pictures(self) -> Mapping[str, Draw]:
        posterior = self.parameters.posterior
        pairs = {"pairs": partial(plot_pairs, posterior, self.pairs)} if self.pairs else {}
        return {"prior": partial(plot_prior, posterior, self.priors)} | pairs


@dataclass(frozen=True, eq=False)
class Predictions(Section):
    """Coverage of leave-one-out predictions."""

    posterior: Idata
    covered: Mapping[str, Coverage]
    why_not: str

    template = "predictions"
    title = "Posterior predictions"
    link = "Predictions"

    def sentence(self) -> str:
        """Return the coverage in a sentence, or why there is none."""
        if not self.covered:
            return self.why_not or "It holds no predictions."
        inside = [coverage.wide for coverage in self.covered.values()]
        return (
            f"Intervals that should hold 94 % of measurements hold {100 * min(inside):.0f} to"
            f" {100 * max(inside):.0f} % of them, in {len(inside)} state dimensions, each"
            " transition predicted without itself."
        )

    def context(self) -> Mapping[str, object]:
        rows = [
            (name, f"{100 * one.half:.1f} %", f"{100 * one.wide:.1f} %", str(one.measurements))
            for name, one in self.covered.items()
        ]
        table = Table(
            "Measurements inside leave-one-out predictions",
            ("State dimension", "In the central 50 %", "In the central 94 %", "Measurements"),
            rows,
        )
        return {"covered": table if rows else None, "why_not": self.why_not}

    def pictures(self) -> Mapping[str, Draw]:
        return {"predictions": partial(plot_predictions, self.posterior)} if self.covered else {}


@dataclass(frozen=True, eq=False)
class LeaveOneOut(Section):
    """Leave-one-out cross-validation, with its Pareto k."""

    posterior: Idata
    k: tuple[Floats, float, str] | None
    why_not: str

    template = "loo"
    title = "Leave-one-out cross-validation"
    link = "LOO"

    def context(self) -> Mapping[str, object]:
        compared = None if self.k is None else compare(self.posterior, self.posterior)
        return vars(self) | {"loo": compared and loo_table(compared, ["Value"])}

    def pictures(self) -> Mapping[str, Draw]:
        return {} if self.k is None else {"pareto": partial(plot_pareto, *self.k)}


@dataclass(frozen=True, eq=False)
class Origin(Section):
    """Commands that make the page and the posterior again; seed, data, versions, scene."""

    posterior: Idata
    source: Source

    template = "origin"
    title = "Where this came from"
    link = "Source"

    def context(self) -> Mapping[str, object]:
        record = PosteriorRecord.of(self.posterior)
        attributes = record.attributes()
        names = ("seed", "data_sha256", "method", "substeps", "horizon", "updates")
        versions = ", ".join(f"{name} {number}" for name, number in record.versions.items())
        return {
            "source": self.source,
            "refit": _refit(self.posterior),
            "origin": {name: str(attributes[name]) for name in names if name in attributes}
            | {"versions": versions},
            "scene_toml": record.scene.to_toml(),
        }


@dataclass(frozen=True, eq=False)
class PosteriorHeader(Section):
    """Header: what the data inform, whether the sampler worked, whether the model predicts."""

    parameters: Parameters
    known: Identifiability | None
    predictions: Predictions

    template = "posterior"

    def context(self) -> Mapping[str, object]:
        posterior = self.parameters.posterior
        return {
            "failed": len(self.parameters.failed),
            "headline": _headline(posterior, self.known),
            "diagnosis": self.parameters.diagnosis(),
            "sentences": self.known.sentences if self.known else (),
            "predicts": self.predictions.sentence(),
            "warnings": _warned(posterior, self.known is not None),
            "about": _about(posterior),
        }


def _headline(posterior: Idata, informed_by: Identifiability | None) -> str:
    record = PosteriorRecord.of(posterior)
    bodies = ", ".join(body.name for body in record.scene.dynamic)
    effects = [f"{plain(name)} of {body}" for name, body in record.effects]
    text = f"Posterior of {bodies}{' with ' + ', '.join(effects) if effects else ''}"
    if informed_by is None:
        return f"{text}: {len(scalars(posterior).data_vars)} parameters"
    verdicts = [width.verdict for width in informed_by.parameters]
    informed, weak, kept = map(verdicts.count, ("informed", "weak", "prior only"))
    text += f". The data inform {informed} of {len(verdicts)} parameters"
    if weak:
        text += f", {weak} more weakly"
    if kept:
        text += f"; {kept} {'keep their' if kept > 1 else 'keeps its'} prior"
    return f"{text}."


def _warned(posterior: Idata, identified: bool) -> list[str]:
    """Return the warnings of the fit, without those that other parts of the page cover."""
    every = PosteriorRecord.of(posterior).warnings or ()
    covered = ["have not converged", "draws are too few", *["say nothing about"] * identified]
    return [sentence for sentence in every if not any(words in sentence for words in covered)]


def _about(posterior: Idata) -> str:
    record, sizes = PosteriorRecord.of(posterior), group(posterior, "posterior").sizes
    transitions = group(posterior, "observed_data").sizes["transition"]
    names = {"trajectories": "whole trajectories", "transitions": "transitions, Eq. 11"}
    likelihood = names.get(record.likelihood_name, "simulations")
    if record.horizon > 1:
        kind = "simulations" if likelihood == "simulations" else "segments"
        likelihood = f"{kind} of {record.horizon} intervals"
    return (
        f"{transitions} transitions; likelihood of {likelihood}; sampler"
        f" {record.method}, {sizes['chain']} chains of {sizes['draw']} draws."
    )


def _refit(posterior: Idata) -> str:
    """Return the lines of Python that make the posterior again from its recording."""
    record, sizes = PosteriorRecord.of(posterior), group(posterior, "posterior").sizes
    options = []
    name = record.likelihood_name
    if name != "transitions":
        options.append(f'likelihood="{name}"')
    elif record.horizon > 1:
        options.append(f"horizon={record.horizon}")
    if record.scalar_sigma:
        options.append('sigma="scalar"')
    if record.nu is not None:
        options.append(f"nu={record.nu:g}")
    if record.library is not None:
        options.append("library=...")
    options.append(f"substeps={record.substeps}")
    lines = [
        "import pbrl_ppl as pp",
        "scene = pp.Scene.load(...)  # as below",
        "history = pp.History.load(..., scene)",
        f"model = pp.physics_model(scene, history, {', '.join(options)})",
        f"idata = pp.fit(model, method={record.method!r}, seed={record.seed},"
        f" draws={sizes['draw']}, chains={sizes['chain']})",
    ]
    if record.updates is not None:
        lines.append("# and updates since, which attrs['updates'] lists")
    return "\n".join(lines)
