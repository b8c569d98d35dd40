"""The page of decisions has a table of all thresholds, equal to the fields of Criteria."""

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from pbrl_ppl.criticism import DEFAULT

PAGE = Path(__file__).parents[2] / "analysis/docs/pages/explanation/decisions.md"


def reasons(criteria: Any) -> dict[str, str]:
    """Return the reason of each field, from the docstring's section of parameters."""
    text = inspect.getdoc(type(criteria)).partition("Parameters\n----------\n")[2]
    text = text.partition("\n\n")[0]
    found = {}
    for names, reason in re.findall(r"^(\w[\w, ]*)(?: : \w+)?\n((?:    .*\n?)+)", text, flags=re.M):
        for name in names.split(", "):
            found[name] = " ".join(reason.split())
    return found


def rows(criteria: Any, group: str = "") -> Iterator[str]:
    """Yield a row of the table for each threshold."""
    why = reasons(criteria)
    for field in fields(criteria):
        value = getattr(criteria, field.name)
        if is_dataclass(value):
            yield from rows(value, f"{field.name}.")
        else:
            yield f"| `{group}{field.name}` | {value:g} | {why[field.name]} |"


def test_the_page_has_all_thresholds() -> None:
    table = "\n".join(["| field | default | reason |", "|---|---|---|", *rows(DEFAULT)])
    assert table in PAGE.read_text(encoding="utf-8"), f"put this table on the page:\n{table}"
