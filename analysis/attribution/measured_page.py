"""Results on measured recordings for a reader: a Markdown table, and the page On hardware."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from attribution.measured import MEASURED, QUANTITIES, Recording, Result
from pbrl_ppl.report.words import number

#: The page, and the folder of its results and pictures.
PAGE = Path(__file__).parents[1] / "docs" / "pages" / "results" / "hardware.md"
RESULTS = PAGE.with_suffix("")
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
#: Held-out errors of up to so many times an independent fit's are as good.
AS_GOOD = 1.3


def kept_results(folder: Path, recordings: Iterable[Recording] = MEASURED) -> dict[str, Result]:
    """Return the results in a folder, by name."""
    found = {each.name: Result.load(folder / f"{each.name}.json") for each in recordings}
    return {name: result for name, result in found.items() if result is not None}


def markdown_table(recordings: Iterable[Recording], found: Mapping[str, Result]) -> str:
    """Return a table, one row per recording: declared, found, and held-out errors."""
    lines = [
        "| recording | declared | found | error before | error after | independent fit |",
        "|---|---|---|---|---|---|",
    ]
    for recording in recordings:
        result = found.get(recording.name)
        errors = () if result is None else result.errors
        cells = (
            recording.name,
            recording.declared,
            "not run" if result is None else _found(result),
            *("<br>".join(_error(row, row[key]) for row in errors) for key in ("before", "after")),
            "<br>".join(
                _error({"seconds": each.seconds, "unit": QUANTITIES[each.quantity][1]}, each.best)
                for each in recording.ahead
            ),
        )
        lines.append(f"| {' | '.join(cell or '–' for cell in cells)} |")
    return "\n".join(lines)


def failures(recording: Recording, result: Result) -> list[str]:
    """Return sentences on results that are worse than the independent fit."""
    if result.error is not None:
        return [f"The loop failed: {result.error}."]
    right = set(recording.right)
    told = []
    if right and not any(right & set(group) for group in result.names):
        told.append(f"Not named: {_listed(recording.right)}.")
    true = right | set(recording.possible)
    false = [group[0] for group in result.names if right and not true & set(group)]
    told += [f"False name: `{name}`." for name in false]
    for ahead, row in _beside(recording, result):
        if ahead.best is not None and row["after"] is not None:
            ratio = row["after"] / ahead.best
            if ratio > AS_GOOD:
                told.append(
                    f"The error of the {ahead.quantity} at {ahead.seconds:g} s is"
                    f" {number(ratio, 2)} times that of the independent fit."
                )
    for (effect, parameter), size in recording.sizes.items():
        for each in result.added:
            if each["effect"] == effect:
                estimate = each["parameters"][parameter]
                low, high = estimate["hdi"]
                if not low <= size <= high:
                    told.append(
                        f"The 94 % interval of `{effect}`, {_interval(estimate)}, does"
                        f" not hold the {number(size)} of the independent fit."
                    )
    return told


def write_page(page: Path = PAGE, recordings: Iterable[Recording] = MEASURED) -> None:
    """Write the table, and a section for each recording, between the page's markers.

    Parameters
    ----------
    page : Path
        Has both markers; results and pictures are in the folder beside it of the same name.
    recordings : iterable of Recording
        In the order of the page.

    Raises
    ------
    ValueError
        If the page lacks a marker.
    """
    recordings, text = tuple(recordings), page.read_text()
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(END) < text.index(BEGIN):
        raise ValueError(f"{page}: expected one line {BEGIN} and after it one {END}; add them")
    found = kept_results(page.with_suffix(""), recordings)
    sections = [_section(each, found.get(each.name), page) for each in recordings]
    made = "\n\n".join([markdown_table(recordings, found), *sections])
    before, rest = text.split(BEGIN)
    page.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{rest.split(END)[1]}")


def _section(recording: Recording, result: Result | None, page: Path) -> str:
    """Return a recording's section: picture, declared model and findings."""
    lines = [f"## {recording.name}", "", recording.about, "", f"- Declared: {recording.declared}."]
    if recording.right:
        lines.append(f"- Physically there, by independent fits: {_listed(recording.right)}.")
    if recording.possible:
        lines.append(f"- May be there too: {_listed(recording.possible)}.")
    if result is None:
        return "\n".join([*lines, "- Not run yet."])
    if result.error is None:
        lines.append(f"- Found (`{result.verdict}`): {result.sentence}")
        lines += [f"- Added: {_added(each)}." for each in result.added]
    for ahead, row in _beside(recording, result):
        unit = row["unit"]
        told = (
            f"- Held-out error of the {ahead.quantity} at {ahead.seconds:g} s:"
            f" {number(row['before'])} {unit} before, {number(row['after'])} {unit} after"
        )
        if ahead.best is not None:
            told += (
                f"; independent fits {number(ahead.declared)} {unit} as declared,"
                f" {number(ahead.best)} {unit} with {ahead.law}"
            )
        lines.append(f"{told}.")
    bad = failures(recording, result)
    lines.append(f"- **{' '.join(bad)}**" if bad else "- As good as the independent fit.")
    lines.append(
        f"- {result.seconds:.0f} s, `{result.method}`, seed {result.seed}, code {result.sources}."
    )
    if (page.with_suffix("") / f"{recording.name}.png").is_file():
        seen = f"{recording.name}: a held-out trajectory, measured and forecast from its start"
        lines += ["", f"![{seen}]({page.stem}/{recording.name}.png)"]
    return "\n".join(lines)


def _beside(recording: Recording, result: Result) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Return the forecasts of a recording with their errors."""
    for ahead in recording.ahead:
        for row in result.errors:
            if (row["seconds"], row["quantity"]) == (ahead.seconds, ahead.quantity):
                yield ahead, row


def _found(result: Result) -> str:
    """Return the verdict and the names, for a cell."""
    if result.error is not None:
        return "failed"
    return "<br>".join([result.verdict, *map(_added, result.added)])


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _either(names: Iterable[str]) -> str:
    return " or ".join(f"`{name}`" for name in names)


def _added(added: Mapping[str, Any]) -> str:
    """Return an effect with means and intervals of its parameters."""
    sizes = [
        f"{name} {number(each['mean'])} ({_interval(each)}) {each['unit']}".rstrip()
        for name, each in added["parameters"].items()
    ]
    names = _either([added["effect"], *added["not_separable_from"]])
    return f"{names} of {added['body']}: {', '.join(sizes)}"


def _interval(estimate: Mapping[str, Any]) -> str:
    """Return a 94 % interval as text."""
    low, high = estimate["hdi"]
    return f"{number(low)} to {number(high)}"


def _error(row: Mapping[str, Any], value: float | None) -> str:
    return f"{number(value)} {row['unit']} at {row['seconds']:g} s"
