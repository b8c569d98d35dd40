"""Sections of a posterior in every report: scene, what the data inform, sampler, glossary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd

from pbrl_ppl.effects import Effect
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.posterior import (
    Idata,
    Identifiability,
    group,
    interval,
    scalars,
    stored_fields,
)
from pbrl_ppl.reporting.page import Draw, Section, Table
from pbrl_ppl.reporting.posterior_plots import (
    most_interesting,
    plot_rank,
    plot_trace,
    prior_draws,
    summary,
)
from pbrl_ppl.reporting.scene_plots import plot_recording
from pbrl_ppl.reporting.style import UNITS, acceleration_unit
from pbrl_ppl.reporting.words import digits_of, number, plain
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

#: Of parameters, by the variable's name.
PARAMETERS = {
    "mass": "mass",
    "r": "elasticity in contacts: 0 keeps no speed, 1 all of it",
    "mu_c": "friction where it touches others",
    "w_x": "place of the wheel along the body",
    "w_y": "place of the wheel across the body",
    "w_theta": "direction in which the wheel rolls",
    "mu_x": "friction of the wheel along that direction",
    "mu_y": "friction of the wheel across it",
    "i_a": "number of the first body that a joint joins",
    "i_b": "number of the second; the same one means no joint",
    "a_x": "anchor of a joint on its first body, along it",
    "a_y": "anchor of a joint on its first body, across it",
    "b_x": "anchor of a joint on its second body, along it",
    "b_y": "anchor of a joint on its second body, across it",
    "sigma": "typical error of measuring it (standard deviation)",
    "unexplained_acceleration": "typical acceleration that nothing in the model explains",
    "contact_acceleration": "the same, on top, where bodies touch",
}

#: Of statistics, in the order in which a reader meets them.
STATISTICS = {
    "posterior": "What is believed of a parameter after the data; the prior is what was before.",
    "94 % interval": "The narrowest interval that holds 94 % of the posterior's probability.",
    "sd": "Standard deviation: the typical distance from the mean.",
    "score": "How strongly the model's errors look as a missing effect would make them look; a"
    " statistic that chance alone keeps about as small as its degrees of freedom.",
    "p": "How often chance alone would bring a result as strong.",
    "nat": "Unit of evidence: one nat makes the data e = 2.7 times as likely.",
    "elpd": "Expected log predictive density: how likely data are under a model that has not seen"
    " them, in nats; more is better.",
    "LOO": "Leave-one-out cross-validation: elpd of each transition given all others; of whole"
    " trajectories leave-one-trajectory-out, elpd of each trajectory given all others.",
    "Pareto k": "Of LOO: how far leaving one out changes the posterior; above the threshold,"
    " LOO is not to be relied on. Of importance sampling: how heavy the tail of the proposals'"
    " weights is; above 0.7, the proposals miss a part of the posterior, and chains are run.",
    "R-hat": "Spread of all chains over that within one; 1 if they agree, at most 1.01 is wanted.",
    "ESS": "Effective sample size: how many independent draws the chains are worth; at least 400"
    " are wanted.",
    "noise floor": "Error that a perfect model would have, from the noise of the measurements.",
    "transition": "One interval of the recording: a state, a command, the next state.",
}


def meaning(label: str, effects: Iterable[Effect]) -> str:
    """Return the meaning of a parameter such as ``mass[cart]`` in words; empty if unknown."""
    name = label.partition("[")[0]
    if name in PARAMETERS:
        return PARAMETERS[name]
    for effect in effects:
        for parameter in effect.parameters:
            if effect.variable(parameter) == name:
                return f"{plain(parameter.name)} of the effect {plain(effect.name)}"
    return ""


@dataclass(frozen=True, eq=False)
class Parameters:
    """Summary of a posterior's parameters and of the chains that it comes from.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.
    effects : tuple of Effect
        Where the names of its effects are looked up.
    first : tuple of str
        Labels of parameters to show first.
    good_r_hat, good_ess : float
        Chains are good up to this R-hat and from this effective sample size on.
    rough_r_hat, rough_ess : float
        Up to these they are good enough for a verdict, and for the first digits of an interval.
    """

    posterior: Idata
    effects: tuple[Effect, ...]
    first: tuple[str, ...] = ()
    good_r_hat: float = 1.01
    good_ess: float = 400.0
    rough_r_hat: float = 1.05
    rough_ess: float = 100.0

    @cached_property
    def sampler(self) -> dict[str, Any]:
        """What the posterior's record says of its draws: method, weights and proposals."""
        return stored_fields(self.posterior, ("method", "pareto_k", "importance_ess", "proposals"))

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Summary by parameter, with ``unit``, ``meaning``, ``wrong`` (words) and ``failed``."""
        table = summary(self.posterior)
        table["meaning"] = [meaning(label, self.effects) for label in table.index]
        table["unit"] = [self._unit(label) for label in table.index]
        ess = table[["ess_bulk", "ess_tail"]].min(axis=1)
        # written so that a value that is not a number counts as bad
        agree = table["r_hat"] <= (self.rough_r_hat if self.weighted else self.good_r_hat)
        table["wrong"] = [
            [f"R-hat {number(r_hat, 4)}"] * (self.chains and not fine)
            + [f"effective sample size {number(size)}"]
            * (self.chains and not size >= self.good_ess)
            for r_hat, fine, size in zip(table["r_hat"], agree, ess, strict=True)
        ]
        good = (table["r_hat"] <= self.rough_r_hat) & (ess >= self.rough_ess)
        table["failed"] = ~good & self.chains
        return table

    @property
    def chains(self) -> bool:
        """Whether there are chains to compare: draws of Laplace's approximation are independent."""
        return self.sampler.get("method") != "laplace"

    @property
    def weighted(self) -> bool:
        """Whether the draws are of importance sampling: R-hat of few of them is often too large."""
        return "importance_ess" in self.sampler

    @property
    def failed(self) -> pd.DataFrame:
        """The parameters that did not converge."""
        return self.summary[self.summary["failed"]]

    @property
    def shown(self) -> list[str]:
        """Labels of the parameters whose chains are drawn."""
        return most_interesting(self.summary, self.first)

    def _unit(self, label: str) -> str:
        """Return a parameter's unit; empty without one."""
        name, _, place = label.rstrip("]").partition("[")
        if name == "sigma":
            return UNITS.get(place, "")
        if name in ("unexplained_acceleration", "contact_acceleration"):
            return acceleration_unit(place)
        known = {**BODY_PARAMETERS, **JOINT_ANCHORS}
        known |= {effect.variable(p): p.unit for effect in self.effects for p in effect.parameters}
        return known.get(name, "").removesuffix("1")

    def table(self) -> Table:
        """Tabulate the posterior of all parameters, in their units."""
        return Table(
            "Posterior of all parameters",
            ("Parameter", "Mean", "sd", "94 % interval", "Unit", "R-hat", "ESS bulk", "ESS tail"),
            [
                (
                    (str(label), row["meaning"]),
                    number(row["mean"]),
                    number(row["sd"]),
                    _span(row["lower"], row["upper"]),
                    row["unit"],
                    number(row["r_hat"], 4),
                    number(row["ess_bulk"]),
                    number(row["ess_tail"]),
                )
                for label, row in self.summary.iterrows()
            ],
            words=(4,),
            marks=["bad" if wrong else "" for wrong in self.summary["wrong"]],
        )

    def diagnosis(self) -> tuple[str, str]:
        """Return the verdict on the sampler, in a word and a sentence, by its worst diagnostics."""
        if not self.chains:
            return "No chains.", (
                "Independent draws of Laplace's approximation: as good as that is."
            )
        table, count = self.summary, len(self.summary)
        ess = table[["ess_bulk", "ess_tail"]].min(axis=1)
        hats = table["r_hat"].fillna(np.inf)
        failed, rough = len(self.failed), int(table["wrong"].astype(bool).sum())
        sentences = (
            f"The largest R-hat of {count} parameters is {number(hats.max(), 4)} (at most"
            f" {self.good_r_hat} is wanted), the smallest effective sample size"
            f" {number(ess.min())} (at least {self.good_ess:.0f})."
            f"{_weights_in_words(self.sampler)}"
        )
        agree = "The draws suffice" if self.weighted else "The chains agree"
        if failed:
            return "Not converged.", f"{failed} of {count} parameters did not converge. {sentences}"
        if rough:
            return "Well enough.", (
                f"{agree}, but {rough} of {count} parameters have fewer effective draws"
                f" or a larger R-hat than is wanted: the last digits of their intervals are rough."
                f" {sentences} With R-hat up to {self.rough_r_hat} and from {self.rough_ess:.0f}"
                " effective draws on conclusions stand; for more digits take more draws."
            )
        return "Yes.", f"{agree}{'' if self.weighted else ' and are long enough'}. {sentences}"


def _span(low: float, high: float) -> str:
    """Return an interval as text, with the digits that tell its ends apart."""
    digits = min(digits_of(low, high), 6)
    return f"{number(low, digits)} to {number(high, digits)}"


def _weights_in_words(sampler: Mapping[str, Any]) -> str:
    """Return the quality of importance weights; empty for chains."""
    k, size = sampler.get("pareto_k"), sampler.get("importance_ess")
    if k is None or size is None:
        return ""
    return (
        f" The draws are resampled proposals of {sampler.get('proposals') or 'another density'}:"
        f" Pareto k of their weights is {number(k)} (above 0.7 the proposals would miss a part"
        f" of the posterior), and by their weights the draws are worth {number(size)} independent"
        " ones."
    )


def recorded_poses(posterior: Idata) -> Floats | None:
    """Return the recorded poses that a posterior holds, shape (trajectory, time, body, 3)."""
    if "scene" not in posterior.attrs:
        return None
    constants = group(posterior, "constant_data")
    if "recorded_start" in constants:
        return np.asarray(constants["recorded_start"].to_numpy()[..., :3])
    # single transitions: the start of each, in order
    return np.asarray(constants["start"].to_numpy()[None, ..., :3])


@dataclass(frozen=True, eq=False)
class Recording(Section):
    """The scene from above, with the recorded paths.

    Parameters
    ----------
    scene : Scene
        Shapes and walls.
    poses, held_out : ndarray, optional
        As of `plot_recording`.
    """

    scene: Scene
    poses: Floats
    held_out: Floats | None = None

    template = "scene"
    title = "The scene and the recording"
    link = "Scene"

    def pictures(self) -> Mapping[str, Draw]:
        return {"scene": partial(plot_recording, self.scene, self.poses, self.held_out)}


@dataclass(frozen=True, eq=False)
class Informed(Section):
    """Which parameters the data inform, and by how much.

    Parameters
    ----------
    parameters : Parameters
        The posterior's.
    known : Identifiability or None
        What the data inform, if that could be computed.
    why_not : str
        Why it could not.
    title, link : str
        Heading, and the entry in the table of contents.
    unfolded : bool
        Whether the table is shown at once.
    """

    parameters: Parameters
    known: Identifiability | None
    why_not: str = ""
    title: str = "Identifiability"
    link: str = ""
    unfolded: bool = False

    template = "identifiability"

    def context(self) -> Mapping[str, object]:
        return vars(self) | {"widths": self.known and self._widths(self.known)}

    def _widths(self, known: Identifiability) -> Table:
        """Tabulate the intervals of each parameter before and after the data."""
        before, after = (draws(self.parameters.posterior) for draws in (prior_draws, scalars))
        units = self.parameters.summary["unit"]
        data = {
            "informed": "inform it",
            "weak": "inform it weakly",
            "prior only": "say nothing beyond the prior",
        }
        rows = [
            (
                width.parameter,
                *(
                    _span(*interval(draws[width.parameter].to_numpy()))
                    if width.parameter in draws
                    else "–"
                    for draws in (before, after)
                ),
                units.get(width.parameter, ""),
                f"{100 * width.ratio:.3g} %",
                data[width.verdict],
            )
            for width in known.parameters
        ]
        return Table(
            "What was believed, and what is known now (94 % intervals)",
            ("Parameter", "Before the data", "After", "Unit", "Width left", "The data"),
            rows,
            words=(3, 5),
            marks=["bad" if width.verdict == "prior only" else "" for width in known.parameters],
        )


@dataclass(frozen=True, eq=False)
class Sampler(Section):
    """Convergence of the chains, with their traces and ranks."""

    parameters: Parameters
    title: str = "Sampler diagnostics"
    unfolded: bool = False

    template = "sampler"
    link = "Sampler"

    def pictures(self) -> Mapping[str, Draw]:
        posterior, shown = self.parameters.posterior, self.parameters.shown
        return {
            "trace": partial(plot_trace, posterior, shown),
            "rank": partial(plot_rank, posterior, shown),
        }


@dataclass(frozen=True, eq=False)
class Words(Section):
    """Meaning of the parameters and of the statistical terms."""

    parameters: Parameters

    template = "words"
    title = "What the words mean"
    link = "Words"

    def context(self) -> Mapping[str, object]:
        meanings = self.parameters.summary["meaning"]
        return {"meanings": meanings[meanings != ""].to_dict(), "statistics": STATISTICS}
