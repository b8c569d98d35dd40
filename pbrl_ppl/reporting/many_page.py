"""Tables and page of many logs: which effects were found in which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import pandas as pd
from markupsafe import Markup

from pbrl_ppl.criticism import NOT_CONVERGED
from pbrl_ppl.reporting.logs import Row
from pbrl_ppl.reporting.page import Section, Source, render_page
from pbrl_ppl.reporting.tables import Cell, Table
from pbrl_ppl.reporting.words import chance, joined, number, plain, quantity
from pbrl_ppl.sampling import Pooled

SECTIONS = (
    Section("logs", "Logs", "Logs"),
    Section("effects", "Which effects were found where", "Effects"),
    Section("kinds", "Kinds of robots", "Kinds of robots"),
    Section("warnings", "Warnings", "Warnings"),
    Section("logs_source", "Where this came from", "Source"),
)


def summary_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Return one row a log; errors are in units of the noise, paths relative to the folder."""
    columns = ["name", "kind", "status", "verdict", "effects", "error_before", "error_after",
               "seconds", "warnings", "message", "report"]  # fmt: skip
    table = []
    for row in rows:
        done = row["status"] == "done"
        named = [f"{effect['effect']}[{effect['body']}]" for effect in row.get("effects", ())]
        more = {
            "effects": "; ".join(named),
            "warnings": len(row.get("warnings", ())),
            "report": f"{row['name']}/report.html" if done else "",
        }
        table.append({name: (dict(row) | more).get(name, "") for name in columns})
    return pd.DataFrame(table, columns=columns)


def effect_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Return one row a log, effect and parameter, with its estimate and 94 % interval."""
    columns = ["name", "kind", "effect", "body", "parameter", "mean", "sd", "low", "high", "unit",
               "p_value"]  # fmt: skip
    table = [
        (row["name"], row["kind"], added["effect"], added["body"], name, parameter["mean"],
         parameter["sd"], *parameter["hdi"], parameter["unit"], added["p_value"])
        for row in rows
        for added in row.get("effects", ())
        for name, parameter in added["parameters"].items()
    ]  # fmt: skip
    return pd.DataFrame(table, columns=columns)


def in_words(rows: Iterable[Row]) -> str:
    """Return how many logs had which verdict or status."""
    ends = Counter(str(row.get("verdict", row["status"])) for row in rows)
    return ", ".join(f"{count} {end}" for end, count in sorted(ends.items()))


def page(
    rows: Sequence[Row],
    pooled: Mapping[str, Pooled],
    not_pooled: Mapping[str, str],
    source: Source,
) -> str:
    """Render one page of HTML with links to each log's report."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for effect in row.get("effects", ()):
            found.setdefault((effect["effect"], effect["body"]), []).append(row["name"])
    # more than four effects side by side would not fit beside the names of the logs
    pairs, tables = list(found), -(-len(found) // 4)
    parts = pairwise(i * len(pairs) // tables for i in range(tables + 1)) if pairs else ()
    return render_page(
        f"{len(rows)} logs",
        "logs_header",
        SECTIONS,
        rows=rows,
        headline=_verdict(in_words(rows)),
        found={_title(*pair): names for pair, names in found.items()},
        logs=_logs(rows),
        effects=[_effects(rows, pairs[i:j]) for i, j in parts],
        kinds={kind: (each.names, _pooled(each, kind)) for kind, each in pooled.items()},
        not_pooled=not_pooled,
        warnings={row["name"]: row["warnings"] for row in rows if row.get("warnings")},
        source=source,
    )


def _logs(rows: Iterable[Row]) -> Table:
    """Tabulate the logs, one row each."""
    cells, marks = [], []
    for row in rows:
        words, numbers = row.get("message", ""), ["", "", "", ""]
        if row["status"] == "done":
            words = joined(map(_named, row["effects"])) or words
            numbers = [number(row["error_before"]), number(row["error_after"]),
                       str(len(row["warnings"]) or ""), number(row["seconds"])]  # fmt: skip
        verdict = row.get("verdict", row["status"])
        cells.append([(_link(row), row["kind"]), _verdict(verdict), words, *numbers])
        marks.append("bad" * (verdict in ("failed", NOT_CONVERGED)))
    heads = ("Log", "Verdict", "Effects, or what went wrong", "Error before", "Error after",
             "Warnings", "Time (s)")  # fmt: skip
    return Table("All logs", heads, cells, (1, 2), marks)


def _effects(rows: Iterable[Row], pairs: Sequence[tuple[str, str]]) -> Table:
    """Tabulate the effects, one row a finished log, one column an effect."""
    done = [row for row in rows if row["status"] == "done"]
    cells = [[_link(row), *(_cell(row, *pair) for pair in pairs)] for row in done]
    heads = ["Log", *(_title(*pair) for pair in pairs)]
    return Table("Effects found, by log", heads, cells, range(1, len(heads)))


def _pooled(pooled: Pooled, kind: str) -> Table:
    """Tabulate the hyper-parameters of a kind, one row a parameter."""

    def interval(row: Mapping[Any, Any], middle: str, name: str) -> Cell:
        low, high = number(row[f"{name}_low"]), number(row[f"{name}_high"])
        return number(row[middle]), f"{low} to {high}"

    cells = [
        [
            (row["parameter"], row["scale"]),
            interval(row, "mean", "mean"),
            interval(row, "spread", "spread"),
            interval(row, "next_median", "next"),
            str(row["informed"]),
            chance(row["p_same"]),
        ]
        for row in pooled.table().to_dict("records")
    ]
    heads = ("Parameter", "Mean of the kind", "Spread of robots", "Next robot",
             "Robots that inform", "Same in all, p")  # fmt: skip
    return Table(f"Robots of the kind {kind}", heads, cells)


def _verdict(name: str) -> str:
    return name.replace("-", " ")


def _named(effect: Row) -> str:
    """Return an effect and its body in words, with a mark where it is a small correction."""
    small = "" if effect["main"] else " (small)"
    return f"{plain(effect['effect'])} on the {plain(effect['body'])}{small}"


def _title(effect: str, body: str) -> str:
    return f"{plain(effect).capitalize()} on the {plain(body)}"


def _link(row: Row) -> str:
    """Return a log's name, with a link to its report or its error."""
    files = {"done": "report.html", "failed": "error.json"}
    if row["status"] not in files:
        return str(row["name"])
    return Markup('<a href="{0}/{1}">{0}</a>').format(row["name"], files[row["status"]])


def _cell(row: Row, effect: str, body: str) -> str:
    """Return the size of an effect in a log, its detection limit, or a dash."""
    for added in row.get("effects", ()):
        if (added["effect"], added["body"]) == (effect, body):
            texts = [
                f"{number(parameter['mean'])} ± {quantity(parameter['sd'], parameter['unit'])}"
                for parameter in added["parameters"].values()
            ]
            return Markup("<strong>{}</strong>").format("; ".join(texts))
    sizes = row.get("detectable", {}).get(f"{effect}[{body}]") or {}
    texts = [f"below {number(size)}" for size in sizes.values() if size is not None]
    return "; ".join(texts) or "–"
