"""The page of many logs: the verdict and the added laws of each, with links to their reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from pbrl_ppl.criticism import NOT_CONVERGED
from pbrl_ppl.reporting.page import Section, render_page
from pbrl_ppl.reporting.tables import tabulate
from pbrl_ppl.reporting.words import error, joined, plain

#: Stands for the verdict of a log without a report.
FAILED = "failed"


def render_logs(rows: Sequence[Mapping[str, Any]], command: str) -> str:
    """Return one page of HTML with a row a log.

    Parameters
    ----------
    rows : sequence of mapping
        Of each log its name (``log``), which is its folder's beside the page, ``verdict``, laws
        (``added``), ``error_before`` and ``error_after`` (in units of the noise) and ``warnings``;
        of one that failed ``message``.
    command : str
        Command that makes the page again.
    """

    def named(row: Mapping[str, Any]) -> str:
        link = Markup('<a href="{}/report.html">{}</a>').format(quote(row["log"]), row["log"])
        return row["log"] if row["verdict"] == FAILED else link

    table = tabulate(
        "All logs",
        rows,
        {
            "Log": named,
            "Verdict": lambda row: row["verdict"].replace("-", " "),
            "Added laws, or what went wrong": lambda row: (
                row.get("message") or joined(map(plain, row["added"]))
            ),
            "Error before": lambda row: error(row.get("error_before")),
            "Error after": lambda row: error(row.get("error_after")),
            "Warnings": lambda row: "; ".join(row["warnings"]),
        },
        {"Verdict", "Added laws, or what went wrong", "Warnings"},
        lambda row: "bad" * (row["verdict"] in (FAILED, NOT_CONVERGED)),
    )
    shown = {"count": len(rows), "verdicts": count_verdicts(rows), "logs": table}
    sections = [Section("logs", "Logs")]
    return render_page(f"{len(rows)} logs", "logs_header", sections, command=command, **shown)


def count_verdicts(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return how many logs had which verdict, as ``1 adequate, 2 failed``."""
    counts = Counter(row["verdict"] for row in rows)
    return ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
