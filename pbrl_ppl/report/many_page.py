"""Many logs in tables and on a page: which effects were found where."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib import resources
from typing import Any

import jinja2
import pandas as pd

from pbrl_ppl.report.words import number, plain, quantity
from pbrl_ppl.sampling import Pooled

Row = Mapping[str, Any]

_COLUMNS = ("name", "kind", "status", "verdict", "effects", "error_before", "error_after",
            "seconds", "warnings", "message", "report")  # fmt: skip
_ESTIMATE = ("name", "kind", "effect", "body", "parameter", "mean", "sd", "low", "high", "unit",
             "p_value")  # fmt: skip


def summary_table(rows: Iterable[Row]) -> pd.DataFrame:
    """One row a log; errors are in units of the noise, paths relative to the folder."""
    table = []
    for row in rows:
        done = row["status"] == "done"
        named = [f"{each['effect']}[{each['body']}]" for each in row.get("effects", ())]
        own = {
            "effects": "; ".join(named),
            "warnings": len(row.get("warnings", ())),
            "report": f"{row['name']}/report.html" if done else "",
        }
        table.append({name: (dict(row) | own).get(name, "") for name in _COLUMNS})
    return pd.DataFrame(table, columns=list(_COLUMNS))


def effect_table(rows: Iterable[Row]) -> pd.DataFrame:
    """One row a log, effect and parameter, with its estimate and 94 % interval."""
    table = [
        {"name": row["name"], "kind": row["kind"], "effect": added["effect"],
         "body": added["body"], "parameter": name, "mean": each["mean"], "sd": each["sd"],
         "low": each["hdi"][0], "high": each["hdi"][1], "unit": each["unit"],
         "p_value": added["p_value"]}
        for row in rows
        for added in row.get("effects", ())
        for name, each in added["parameters"].items()
    ]  # fmt: skip
    return pd.DataFrame(table, columns=list(_ESTIMATE))


def page(
    rows: tuple[Row, ...],
    pooled: Mapping[str, Pooled],
    not_pooled: Mapping[str, str],
    sentence: str,
) -> str:
    """One page of HTML with links to each log's report."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(number=number, plain=plain)
    template = resources.files("pbrl_ppl.report").joinpath("many.html.jinja").read_text("utf-8")
    found = dict.fromkeys(
        (each["effect"], each["body"]) for row in rows for each in row.get("effects", ())
    )
    return environment.from_string(template).render(
        rows=rows,
        sentence=sentence,
        found=list(found),
        cell=_cell,
        pooled={kind: each.table().to_dict("records") for kind, each in pooled.items()},
        robots={kind: each.names for kind, each in pooled.items()},
        not_pooled=not_pooled,
    )


def _cell(row: Row, effect: str, body: str) -> tuple[str, str]:
    """What a log says of an effect, and in which way: found, unseen, or nothing."""
    for added in row.get("effects", ()):
        if (added["effect"], added["body"]) == (effect, body):
            said = [
                f"{number(each['mean'])} ± {quantity(each['sd'], each['unit'])}"
                for each in added["parameters"].values()
            ]
            return "; ".join(said), "found"
    sizes = row.get("detectable", {}).get(f"{effect}[{body}]") or {}
    said = [f"below {number(size)}" for size in sizes.values() if size is not None]
    return "; ".join(said), "unseen" if said else "none"
