"""Rows of a posterior's parameters, and whether its chains can be relied on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from pbrl_ppl.effects import Effect
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.posterior import Identifiability, from_groups, group, groups, interval, scalars
from pbrl_ppl.report.glossary import meaning
from pbrl_ppl.report.page import Table
from pbrl_ppl.report.style import UNITS
from pbrl_ppl.report.words import digits_of, number

#: A chain mix is good below this R-hat and above this effective sample size ...
GOOD_R_HAT, GOOD_ESS = 1.01, 400.0
#: ... and up to these good enough for a verdict, and for the first digits of an interval.
ROUGH_R_HAT, ROUGH_ESS = 1.05, 100.0

_TOLD = {
    "informed": "inform it",
    "weak": "inform it weakly",
    "prior only": "say nothing beyond the prior",
}


def posterior_rows(
    table: pd.DataFrame,
    effects: Iterable[Effect],
    units: Mapping[str, str] | None = None,
    *,
    method: str = "",
) -> list[dict[str, Any]]:
    """One row per parameter: its summary, unit, meaning, and what is wrong with its chains.

    Draws of Laplace's approximation are independent, and there are no chains to compare.
    """
    chains = method != "laplace"
    effects = tuple(effects)
    known = {**BODY_PARAMETERS, **JOINT_ANCHORS, **(units or {})}
    known |= {effect.variable(p): p.unit for effect in effects for p in effect.parameters}
    rows = []
    for label, values in table.iterrows():
        name, _, place = str(label).rstrip("]").partition("[")
        ess = min(values["ess_bulk"], values["ess_tail"])
        wrong = []
        # written so that a value that is not a number counts as bad
        if chains and not values["r_hat"] <= GOOD_R_HAT:
            wrong.append(f"R-hat {number(values['r_hat'], 4)}")
        if chains and not ess >= GOOD_ESS:
            wrong.append(f"effective sample size {number(ess)}")
        unit = known.get(name, "")
        if name == "sigma":
            unit = UNITS.get(place, "")
        elif name in ("unexplained_acceleration", "contact_acceleration"):
            unit = "rad/s²" if place == "omega" else "m/s²"
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


def parameter_table(rows: list[dict[str, Any]], caption: str) -> Table:
    """Posterior of all parameters, in their units."""
    return Table(
        caption,
        ("Parameter", "Mean", "sd", "94 % interval", "Unit", "R-hat", "ESS bulk", "ESS tail"),
        [
            (
                (row["label"], row["meaning"]),
                number(row["mean"]),
                number(row["sd"]),
                f"{number(row['lower'], _digits(row))} to {number(row['upper'], _digits(row))}",
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


def _digits(row: Mapping[str, Any]) -> int:
    return min(digits_of(row["lower"], row["upper"]), 6)


def sampler_in_words(rows: list[dict[str, Any]]) -> tuple[str, str]:
    """Say whether the sampler worked, by the worst of its diagnostics: in a word, and in full."""
    if not all(row["chains"] for row in rows):
        return "No chains.", "Independent draws of Laplace's approximation: as good as that is."
    hats = [row["r_hat"] if np.isfinite(row["r_hat"]) else np.inf for row in rows]
    sizes = [min(row["ess_bulk"], row["ess_tail"]) for row in rows]
    failed, rough = (sum(bool(row[name]) for row in rows) for name in ("failed", "wrong"))
    found = (
        f"The largest R-hat of {len(rows)} parameters is {number(max(hats), 4)} (at most"
        f" {GOOD_R_HAT} is wanted), the smallest effective sample size"
        f" {number(float(np.nanmin(sizes)))} (at least {GOOD_ESS:.0f})."
    )
    if failed:
        return "Not converged.", f"{failed} of {len(rows)} parameters did not converge. {found}"
    if rough:
        return (
            "Well enough.",
            f"The chains agree, but {rough} of {len(rows)} parameters have fewer effective draws"
            f" or a larger R-hat than is wanted: the last digits of their intervals are rough."
            f" {found} With R-hat up to {ROUGH_R_HAT} and from {ROUGH_ESS:.0f} effective draws on"
            " conclusions stand; for more digits take more draws.",
        )
    return "Yes.", f"The chains agree and are long enough. {found}"


def width_table(posterior: Any, said: Identifiability, units: Mapping[str, str]) -> Table:
    """Intervals of each parameter before and after the data, both in its unit."""
    after = scalars(posterior)
    before: Any = {}
    if "prior" in groups(posterior):
        before = scalars(from_groups({"posterior": group(posterior, "prior")}, {}))

    def spans(draws: Any, name: str) -> str:
        if name not in draws:
            return "–"
        low, high = interval(draws[name].to_numpy())
        digits = min(digits_of(low, high), 6)
        return f"{number(low, digits)} to {number(high, digits)}"

    rows, marks = [], []
    for width in said.parameters:
        name = width.parameter
        rows.append(
            (
                name,
                spans(before, name),
                spans(after, name),
                units.get(name, ""),
                f"{100 * width.ratio:.3g} %",
                _TOLD[width.verdict],
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
