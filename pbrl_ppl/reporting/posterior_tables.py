"""Tables of a posterior's parameters, sampler diagnostics, and a glossary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pbrl_ppl.effects import Effect
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.posterior import PARETO_K, SIZE, Identifiability, interval, scalars
from pbrl_ppl.reporting.page import Table
from pbrl_ppl.reporting.posterior_plots import most_interesting, prior_draws, summary
from pbrl_ppl.reporting.style import UNITS, acceleration_unit
from pbrl_ppl.reporting.words import digits_of, number, plain

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


#: Chains are good up to this R-hat and from this effective sample size on ...
GOOD_R_HAT, GOOD_ESS = 1.01, 400.0
#: ... and up to these good enough for a verdict, and for the first digits of an interval.
ROUGH_R_HAT, ROUGH_ESS = 1.05, 100.0

_DATA = {
    "informed": "inform it",
    "weak": "inform it weakly",
    "prior only": "say nothing beyond the prior",
}


def parameter_section(
    posterior: Any,
    effects: Iterable[Effect],
    known: Identifiability | None,
    added: Iterable[str] = (),
) -> dict[str, Any]:
    """Return what a page shows of a posterior's parameters and of its sampler.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.
    effects : iterable of Effect
        Where the names of its effects are looked up.
    known : Identifiability or None
        What the data inform, if that could be computed.
    added : iterable of str
        Labels of parameters to show first.
    """
    table = summary(posterior)
    # draws of Laplace's approximation are independent: there are no chains to compare
    chains = posterior.attrs.get("method") != "laplace"
    # draws by importance sampling are independent: R-hat of few of them is often above its limit
    most = ROUGH_R_HAT if SIZE in posterior.attrs else GOOD_R_HAT
    rows = _posterior_rows(table, tuple(effects), chains, most)
    return {
        "posterior": _parameter_table(rows),
        "count": len(rows),
        "bad": [row for row in rows if row["failed"]],
        "sampled": _sampler_in_words(rows, posterior.attrs),
        "widths": known
        and _width_table(posterior, known, {row["label"]: row["unit"] for row in rows}),
        "shown": most_interesting(table, added),
        "meanings": {row["label"]: row["meaning"] for row in rows if row["meaning"]},
        "statistics": STATISTICS,
    }


def _posterior_rows(
    table: pd.DataFrame, effects: Sequence[Effect], chains: bool, most: float
) -> list[dict[str, Any]]:
    """Return a row per parameter: its summary, unit, meaning, and what is wrong with its chains.

    ``most`` is the largest R-hat that is not worth a mention.
    """
    known = {**BODY_PARAMETERS, **JOINT_ANCHORS}
    known |= {effect.variable(p): p.unit for effect in effects for p in effect.parameters}
    rows = []
    for label, values in table.iterrows():
        name, _, place = str(label).rstrip("]").partition("[")
        ess = min(values["ess_bulk"], values["ess_tail"])
        wrong = []
        # written so that a value that is not a number counts as bad
        if chains and not values["r_hat"] <= most:
            wrong.append(f"R-hat {number(values['r_hat'], 4)}")
        if chains and not ess >= GOOD_ESS:
            wrong.append(f"effective sample size {number(ess)}")
        unit = known.get(name, "")
        if name == "sigma":
            unit = UNITS.get(place, "")
        elif name in ("unexplained_acceleration", "contact_acceleration"):
            unit = acceleration_unit(place)
        rows.append(
            {
                "label": str(label),
                "meaning": meaning(str(label), effects),
                "unit": unit.removesuffix("1"),
                "wrong": wrong,
                "failed": chains and not (values["r_hat"] <= ROUGH_R_HAT and ess >= ROUGH_ESS),
                "chains": chains,
                **values,
            }
        )
    return rows


def _parameter_table(rows: list[dict[str, Any]]) -> Table:
    """Tabulate the posterior of all parameters, in their units."""
    return Table(
        "Posterior of all parameters",
        ("Parameter", "Mean", "sd", "94 % interval", "Unit", "R-hat", "ESS bulk", "ESS tail"),
        [
            (
                (row["label"], row["meaning"]),
                number(row["mean"]),
                number(row["sd"]),
                _span(row["lower"], row["upper"]),
                row["unit"],
                number(row["r_hat"], 4),
                number(row["ess_bulk"]),
                number(row["ess_tail"]),
            )
            for row in rows
        ],
        words=(4,),
        marks=["bad" if row["wrong"] else "" for row in rows],
    )


def _span(low: float, high: float) -> str:
    """Return an interval as text, with the digits that tell its ends apart."""
    digits = min(digits_of(low, high), 6)
    return f"{number(low, digits)} to {number(high, digits)}"


class SamplerResult(NamedTuple):
    """Verdict on the sampler: in a word, and in a sentence."""

    word: str
    sentence: str


def _origin_in_words(attributes: Mapping[str, Any]) -> str:
    """Return what the weights of importance sampling are worth; nothing of chains."""
    if PARETO_K not in attributes:
        return ""
    return (
        f" The draws are resampled proposals of {attributes.get('proposals', 'another density')}:"
        f" Pareto k of their weights is"
        f" {number(attributes[PARETO_K])} (above 0.7 the proposals would miss a part of the"
        f" posterior), and by their weights the draws are worth {number(attributes[SIZE])}"
        " independent ones."
    )


def _sampler_in_words(rows: list[dict[str, Any]], attributes: Mapping[str, Any]) -> SamplerResult:
    """Return the verdict on the sampler, by the worst of its diagnostics."""
    if not all(row["chains"] for row in rows):
        return SamplerResult(
            "No chains.", "Independent draws of Laplace's approximation: as good as that is."
        )
    hats = [row["r_hat"] if np.isfinite(row["r_hat"]) else np.inf for row in rows]
    sizes = [min(row["ess_bulk"], row["ess_tail"]) for row in rows]
    failed, rough = (sum(bool(row[name]) for row in rows) for name in ("failed", "wrong"))
    found = (
        f"The largest R-hat of {len(rows)} parameters is {number(max(hats), 4)} (at most"
        f" {GOOD_R_HAT} is wanted), the smallest effective sample size"
        f" {number(float(np.nanmin(sizes)))} (at least {GOOD_ESS:.0f})."
        f"{_origin_in_words(attributes)}"
    )
    agree = "The draws suffice" if SIZE in attributes else "The chains agree"
    if failed:
        return SamplerResult(
            "Not converged.", f"{failed} of {len(rows)} parameters did not converge. {found}"
        )
    if rough:
        return SamplerResult(
            "Well enough.",
            f"{agree}, but {rough} of {len(rows)} parameters have fewer effective draws"
            f" or a larger R-hat than is wanted: the last digits of their intervals are rough."
            f" {found} With R-hat up to {ROUGH_R_HAT} and from {ROUGH_ESS:.0f} effective draws on"
            " conclusions stand; for more digits take more draws.",
        )
    long = "" if SIZE in attributes else " and are long enough"
    return SamplerResult("Yes.", f"{agree}{long}. {found}")


def _width_table(posterior: Any, known: Identifiability, units: Mapping[str, str]) -> Table:
    """Tabulate the intervals of each parameter before and after the data."""
    before, after = prior_draws(posterior), scalars(posterior)

    def spans(draws: Any, name: str) -> str:
        if name not in draws:
            return "–"
        return _span(*interval(draws[name].to_numpy()))

    rows, marks = [], []
    for width in known.parameters:
        name = width.parameter
        rows.append(
            (
                name,
                spans(before, name),
                spans(after, name),
                units.get(name, ""),
                f"{100 * width.ratio:.3g} %",
                _DATA[width.verdict],
            )
        )
        marks.append("bad" if width.verdict == "prior only" else "")
    return Table(
        "What was believed, and what is known now (94 % intervals)",
        ("Parameter", "Before the data", "After", "Unit", "Width left", "The data"),
        rows,
        words=(3, 5),
        marks=marks,
    )
