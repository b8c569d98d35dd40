"""Tables and page of many logs: which effects were found in which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd
from markupsafe import Markup

from pbrl_ppl.criticism import NOT_CONVERGED
from pbrl_ppl.reporting.logs import Row
from pbrl_ppl.reporting.page import Section, Source, render_page
from pbrl_ppl.reporting.tables import Cell, Table, tabulate
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
    table = [
        {
            **row,
            "effects": "; ".join(map(effect_label, row.get("effects", ()))),
            "warnings": len(row.get("warnings", ())),
            "report": f"{row['name']}/report.html" if row["status"] == "done" else "",
        }
        for row in rows
    ]
    return pd.DataFrame([{name: row.get(name, "") for name in columns} for row in table])


def effect_label(effect: Row) -> str:
    """Return an effect and its body as ``angular_drag[cart]``."""
    return f"{effect['effect']}[{effect['body']}]"


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
    return ", ".join(f"{count} {end}" for end, count in sorted(Counter(map(_end, rows)).items()))


def _end(row: Row) -> str:
    """Return the verdict of a log, or its status without one."""
    return str(row.get("verdict", row["status"]))


def page(
    rows: Sequence[Row],
    pooled: Mapping[str, Pooled],
    not_pooled: Mapping[str, str],
    source: Source,
) -> str:
    """Render one page of HTML with links to each log's report."""
    found = _found(rows)
    return render_page(
        f"{len(rows)} logs",
        "logs_header",
        SECTIONS,
        rows=rows,
        headline=in_words(rows).replace("-", " "),
        found={_title(*pair): names for pair, names in found.items()},
        logs=_logs(rows),
        effects=_effects(rows, list(found)),
        kinds={kind: (each.names, _pooled(each, kind)) for kind, each in pooled.items()},
        not_pooled=not_pooled,
        warnings={row["name"]: row["warnings"] for row in rows if row.get("warnings")},
        source=source,
    )


def _logs(rows: Iterable[Row]) -> Table:
    """Tabulate the logs, one row each."""

    def numbers(key: str) -> Callable[[Row], str]:
        return lambda row: number(row[key]) if key in row else ""

    return tabulate(
        "All logs",
        rows,
        {
            "Log": lambda row: (_link(row), row["kind"]),
            "Verdict": lambda row: _end(row).replace("-", " "),
            "Effects, or what went wrong": lambda row: (
                joined(map(_named, row.get("effects", ()))) or row.get("message", "")
            ),
            "Error before": numbers("error_before"),
            "Error after": numbers("error_after"),
            "Warnings": lambda row: str(len(row.get("warnings", ())) or ""),
            "Time (s)": numbers("seconds"),
        },
        {"Verdict", "Effects, or what went wrong"},
        lambda row: "bad" * (_end(row) in ("failed", NOT_CONVERGED)),
    )


def _found(rows: Iterable[Row]) -> dict[tuple[str, str], list[str]]:
    """Return the names of the logs in which each effect of a body was found."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for effect in row.get("effects", ()):
            found.setdefault((effect["effect"], effect["body"]), []).append(row["name"])
    return found


def _effects(rows: Iterable[Row], pairs: Sequence[tuple[str, str]], most: int = 4) -> list[Table]:
    """Tabulate the effects, one row a finished log, one column an effect.

    More than ``most`` effects side by side would not fit beside the names of the logs.
    """
    done = [row for row in rows if row["status"] == "done"]
    columns = {_title(*pair): partial(_cell, effect=pair[0], body=pair[1]) for pair in pairs}
    heads, count = list(columns), -(-len(columns) // most)
    parts = [heads[i * len(heads) // count : (i + 1) * len(heads) // count] for i in range(count)]
    return [
        tabulate(
            "Effects found, by log", done, {"Log": _link, **{h: columns[h] for h in part}}, part
        )
        for part in parts
    ]


def _pooled(pooled: Pooled, kind: str) -> Table:
    """Tabulate the hyper-parameters of a kind, one row a parameter."""

    def interval(middle: str, name: str) -> Callable[[Mapping[Hashable, Any]], Cell]:
        return lambda row: (
            number(row[middle]),
            f"{number(row[f'{name}_low'])} to {number(row[f'{name}_high'])}",
        )

    return tabulate(
        f"Robots of the kind {kind}",
        pooled.table().to_dict("records"),
        {
            "Parameter": lambda row: (row["parameter"], row["scale"]),
            "Mean of the kind": interval("mean", "mean"),
            "Spread of robots": interval("spread", "spread"),
            "Next robot": interval("next_median", "next"),
            "Robots that inform": lambda row: str(row["informed"]),
            "Same in all, p": lambda row: chance(row["p_same"]),
        },
    )


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
