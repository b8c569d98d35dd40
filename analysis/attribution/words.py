"""Rows and scores as text: the table, a case in full, and JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.table import Table

from attribution.cases import KINDS
from attribution.one_case import Row
from attribution.scores import outcome

_CANDIDATES = 6


def table(rows: list[Row]) -> Table:
    """Return a table, one row per case: the oracle's result and the loop's."""
    shown = Table("case", "method", "oracle's p", "verdict", "added", "outcome", "in interval", "s")
    kind = None
    for row in sorted(rows, key=lambda row: (KINDS.index(row.kind), row.name)):
        if kind not in (None, row.kind):
            shown.add_section()
        kind = row.kind
        within = row.within()
        shown.add_row(
            row.name,
            row.method,
            _oracle(row),
            row.error or row.verdict + ", something remains" * (row.open and bool(row.added)),
            ", ".join(map(_name, row.added)),
            outcome(row),
            f"{sum(within)}/{len(within)}" if within else "",
            f"{row.seconds:.0f}",
        )
    return shown


def _oracle(row: Row) -> str:
    if row.oracle is None:
        return ""
    if not row.oracle.detects:
        return f"{row.oracle.p_value:.0e} not detected"
    return f"{row.oracle.p_value:.0e}, {100 * row.oracle.main:.0f} %"


def _name(added: dict[str, Any]) -> str:
    others = " or ".join(added["not_separable_from"])
    name = f"{added['effect']}[{added['body']}]"
    return f"{name} (or {others})" if others else name


def score_table(scores: dict[str, float | int | None]) -> Table:
    """Return the scores in one column."""
    shown = Table("score", "value")
    for name, value in scores.items():
        text = "no cases" if value is None else f"{value:.3g}" if name != "seconds" else f"{value}"
        shown.add_row(name, text)
    return shown


def plain(row: Row) -> dict[str, Any]:
    """Return a row for JSON, with its findings in short."""
    short = {
        "verdict": row.verdict,
        "outcome": outcome(row),
        "added": row.added,
        "unexplained": row.findings and row.findings["unexplained"],
        "small": row.findings and row.findings["small"],
    }
    rest = {key: value for key, value in asdict(row).items() if key != "findings"}
    return rest | {"detected": row.detected} | short


def told(row: Row) -> str:
    """Return a case in full: stages, candidates, tests, added effects and the remainder."""
    lines = [f"== {row.name}: {row.verdict} ({outcome(row)}), {row.method}, {row.seconds:.0f} s"]
    if row.effect is not None:
        lines.append(f"hidden: {row.effect} on {row.on} {row.truth}")
    if row.oracle is not None:
        lines.append(f"oracle: statistic {row.oracle.statistic:.1f}, p = {row.oracle.p_value:.1e}")
        lines[-1] += f", forecasts better by {100 * row.oracle.gain:.1f} %"
    found = row.findings
    if found is None:
        return "\n".join([*lines, f"failed: {row.error}"])
    lines += [f"{second:6.1f} s  {stage}" for second, stage in found["stages"]]
    lines.append(f"{found['loop_seconds']:6.1f} s  done")
    lines.append(f"engine: {found['numerical']}")
    for one in found["candidates"][:_CANDIDATES]:
        lines.append(
            f"candidate {one['effect']}: S = {one['statistic']:.1f}, {one['dof']} df,"
            f" p = {one['p_value']:.1e}, identifiable {one['identifiable']:.2g}, {one['estimate']}"
        )
    for one in row.added:
        estimates = {name: (e["mean"], e["hdi"]) for name, e in one["parameters"].items()}
        lines.append(f"added {_name(one)}: {estimates}")
    if found["small"]:
        lines.append(f"too small to matter: {found['small']}")
    for test in found["tests"]:
        chance = "" if test["p_value"] is None else f", p = {test['p_value']:.1e}"
        lines.append(
            f"test {'passed' if test['passed'] else 'FAILED'}: {test['name']}{chance}:"
            f" {test['sentence']}"
        )
    lines.append(f"unexplained acceleration: {found['unexplained_acceleration']}")
    if found["unexplained"] is not None:
        lines.append(f"remains: {found['unexplained']['sentence']}")
    return "\n".join(lines)
