"""Report: the findings as a page of HTML."""

from __future__ import annotations

import base64
from importlib import resources
from typing import Any

import jinja2
import pandas as pd

from pbrl_ppl.criticism import Findings
from pbrl_ppl.effects import catalogue
from pbrl_ppl.parameters import BODY_PARAMETERS
from pbrl_ppl.report.effect_plots import HARDLY, MOST_CANDIDATES, plot_added, plot_candidates
from pbrl_ppl.report.error_plots import plot_errors, plot_residuals, plot_rollout
from pbrl_ppl.report.posterior_plots import most_interesting, plot_rank, plot_trace, summary
from pbrl_ppl.report.residual_plots import plot_correlations, plot_growth
from pbrl_ppl.report.style import UNITS, png
from pbrl_ppl.report.words import (
    chance,
    change,
    digits_of,
    joined,
    number,
    odds,
    plain,
    quantity,
    unseen_in_words,
    verdict_in_words,
)

#: A chain mix is good enough below this R-hat and above this effective sample size.
GOOD_R_HAT, GOOD_ESS = 1.01, 400.0


def render(findings: Findings) -> str:
    """Render the report: one page of HTML that needs nothing else."""
    table = summary(findings.posterior_after)
    parameters = most_interesting(findings, table)
    pictures = {
        "rollout": plot_rollout(findings),
        "errors": plot_errors(findings),
        "residuals": plot_residuals(findings),
        "correlations": plot_correlations(findings),
        "growth": plot_growth(findings),
        "trace": plot_trace(findings, parameters),
        "rank": plot_rank(findings, parameters),
    }
    if findings.candidates:
        pictures["candidates"] = plot_candidates(findings)
    if findings.added:
        pictures["added"] = plot_added(findings)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(
        number=number,
        chance=chance,
        odds=odds,
        plain=plain,
        joined=joined,
        change=change,
        quantity=quantity,
    )
    template = resources.files("pbrl_ppl.report").joinpath("report.html.jinja").read_text("utf-8")
    return environment.from_string(template).render(
        findings=findings,
        verdict=verdict_in_words(findings),
        unseen=unseen_in_words(findings),
        posterior=_posterior_rows(findings, table),
        units=UNITS,
        shown=parameters,
        added={(added.effect, added.body) for added in findings.added},
        best=_largest_fall(findings),
        digits_of=digits_of,
        good={"r_hat": GOOD_R_HAT, "ess": GOOD_ESS},
        hardly=HARDLY,
        most=MOST_CANDIDATES,
        picture={
            name: "data:image/png;base64," + base64.b64encode(png(figure)).decode("ascii")
            for name, figure in pictures.items()
        },
    )


def _posterior_rows(findings: Findings, table: pd.DataFrame) -> list[dict[str, Any]]:
    """One row per parameter of the revised model: its summary, unit, and what is wrong with it."""
    units = dict(BODY_PARAMETERS) | {
        f"{added.effect}_{name}": e.unit
        for added in findings.added
        for name, e in added.parameters.items()
    }
    units |= {effect.variable(p): p.unit for effect in catalogue for p in effect.parameters}
    rows = []
    for label, values in table.iterrows():
        name, _, place = str(label).rstrip("]").partition("[")
        ess = min(values["ess_bulk"], values["ess_tail"])
        wrong = []
        # written so that a value that is not a number counts as bad
        if not values["r_hat"] <= GOOD_R_HAT:
            wrong.append(f"R-hat {number(values['r_hat'], 4)}")
        if not ess >= GOOD_ESS:
            wrong.append(f"effective sample size {number(ess)}")
        unit = UNITS.get(place, "") if name == "sigma" else units.get(name, "")
        rows.append({"label": label, "unit": unit.removesuffix("1"), "wrong": wrong, **values})
    return rows


def _largest_fall(findings: Findings) -> dict[str, Any] | None:
    """Find the state dimension whose error at the end of a rollout fell by the largest share."""
    before, after = findings.before.rollout_rmse, findings.after.rollout_rmse
    shares = {d: after[d] / before[d] for d in before if d in after and before[d] > 0}
    if not shares:
        return None
    best = min(shares, key=lambda dimension: shares[dimension])
    return {"name": best, "before": before[best], "after": after[best]}
