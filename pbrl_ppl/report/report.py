"""Findings in words, and as a page."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from importlib import resources
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from pbrl_ppl.criticism import ADEQUATE, UNEXPLAINED, Findings
from pbrl_ppl.effects import catalogue
from pbrl_ppl.parameters import BODY_PARAMETERS
from pbrl_ppl.report import plots
from pbrl_ppl.report.plots import UNITS, plain

#: A chain mix is good enough below this R-hat and above this effective sample size.
GOOD_R_HAT, GOOD_ESS = 1.01, 400.0

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def verdict_in_words(findings: Findings) -> str:
    """Say the verdict in a sentence or two, for a reader who knows no statistics."""
    found = _joined(
        f"{one.sentence.rstrip('.')} ({plain(one.effect)}) on the {plain(one.body)}"
        for one in findings.added
    )
    left = findings.unexplained
    rest = "a pattern remains in the errors" if left is None else left.sentence.rstrip(".")
    if findings.verdict == ADEQUATE:
        return "Nothing is missing: the declared model explains the data up to measurement noise."
    if findings.verdict == UNEXPLAINED and not found:
        return f"Something is missing that no effect in the catalogue explains: {rest}."
    if findings.verdict == UNEXPLAINED or left is not None:
        return (
            f"Part of what was missing is {found}. Something is still missing that no effect in"
            f" the catalogue explains: {rest}."
        )
    if len(findings.added) > 1:
        return f"{len(findings.added)} things were missing: {found}."
    return f"Something was missing: {found}."


def render(findings: Findings) -> str:
    """Render the report: one page of HTML that needs nothing else."""
    table = plots.summary(findings.posterior_after)
    parameters = plots.most_interesting(findings, table)
    pictures = {
        "rollout": plots.plot_rollout(findings),
        "errors": plots.plot_errors(findings),
        "residuals": plots.plot_residuals(findings),
        "trace": plots.plot_trace(findings, parameters),
        "rank": plots.plot_rank(findings, parameters),
    }
    if findings.candidates:
        pictures["candidates"] = plots.plot_candidates(findings)
    if findings.added:
        pictures["added"] = plots.plot_added(findings)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(
        number=number,
        chance=chance,
        odds=_odds,
        plain=plain,
        joined=_joined,
        change=_change,
        quantity=_quantity,
    )
    template = resources.files("pbrl_ppl.report").joinpath("report.html.jinja").read_text("utf-8")
    return environment.from_string(template).render(
        findings=findings,
        verdict=verdict_in_words(findings),
        posterior=_posterior_rows(findings, table),
        units=UNITS,
        shown=parameters,
        added={(one.effect, one.body) for one in findings.added},
        best=_largest_fall(findings),
        good={"r_hat": GOOD_R_HAT, "ess": GOOD_ESS},
        hardly=plots.HARDLY,
        most=plots.MOST_CANDIDATES,
        picture={
            name: "data:image/png;base64," + base64.b64encode(plots.png(figure)).decode("ascii")
            for name, figure in pictures.items()
        },
    )


def _posterior_rows(findings: Findings, table: pd.DataFrame) -> list[dict[str, Any]]:
    """One row per parameter of the revised model: its summary, unit, and what is wrong with it."""
    units = dict(BODY_PARAMETERS) | {
        f"{one.effect}_{name}": e.unit
        for one in findings.added
        for name, e in one.parameters.items()
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


def number(value: float | None, digits: int = 3) -> str:
    """Write a number for a reader: three significant digits, no exponent below a million.

    Examples
    --------
    >>> number(419.04), number(0.00123456), number(2.0), number(float("nan"))
    ('419', '0.00123', '2.00', '–')
    """
    if value is None or not np.isfinite(value):
        return "–"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_RAISED)}"
    places = digits - 1 - int(np.floor(np.log10(abs(value)))) if value else 0
    return f"{value:,.{max(places, 0)}f}".replace("-", "−")


def _quantity(value: float, unit: str) -> str:
    """Write a number with its unit, which is "1" where there is none."""
    return f"{number(value)} {unit.removesuffix('1')}".rstrip()


def chance(p_value: float) -> str:
    """Write a p-value: two digits, and no pretence of exactness where it underflowed.

    Examples
    --------
    >>> chance(0.0312), chance(1e-80), chance(0.0)
    ('0.031', '1.0 × 10⁻⁸⁰', '< 10⁻³⁰⁰')
    """
    return "< 10⁻³⁰⁰" if p_value < 1e-300 else number(p_value, 2)


def _odds(p_value: float) -> str:
    """How often chance alone does it."""
    if p_value < 1e-300:
        return "less than once in 10³⁰⁰ times"
    if p_value > 0.1:
        return f"in {100 * p_value:.0f} % of all cases"
    if p_value > 1e-6:
        return f"once in {1 / p_value:,.0f} times"
    power = int(np.floor(-np.log10(p_value)))
    return f"less than once in 10{str(power).translate(_RAISED)} times"


def _change(before: float, after: float) -> str:
    """Say by how much an error fell."""
    share = 1 - after / before if before > 0 else float("nan")
    if not np.isfinite(share) or abs(share) < 0.005:
        return "did not change"
    return f"{'fell' if share > 0 else 'rose'} by {abs(share) * 100:.0f} %"


def _joined(parts: Iterable[str], word: str = "and") -> str:
    *most, last = [str(part) for part in parts] or [""]
    return f"{'; '.join(most)}, {word} {last}" if most else last
