"""Results on measured recordings for a reader: a Markdown table, and the page On hardware."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from attribution.measured import (
    JUDGEMENTS,
    MEASURED,
    QUANTITIES,
    Ahead,
    Recording,
    Result,
    false_names,
    judgement,
    missing_laws,
)
from pbrl_ppl.reporting.words import number

#: The page, and the folder of its results and pictures.
PAGE = Path(__file__).parents[1] / "docs" / "pages" / "results" / "hardware.md"
RESULTS = PAGE.with_suffix("")
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
#: Held-out errors of up to so many times the best law's are as good.
AS_GOOD = 1.25
#: The loop is quick in so many seconds.
QUICK = 60.0


def kept_results(folder: Path, recordings: Iterable[Recording] = MEASURED) -> dict[str, Result]:
    """Return the results in a folder, by name."""
    found = {each.name: Result.load(folder / f"{each.name}.json") for each in recordings}
    return {name: result for name, result in found.items() if result is not None}


def ratios(recording: Recording, result: Result) -> list[float]:
    """Return the held-out errors over those of the best law; infinite where one is missing."""
    return [
        _ratio(row, ahead.best)
        for ahead, row in _beside(recording, result)
        if ahead.best is not None
    ]


def _ratio(row: Mapping[str, Any], best: float) -> float:
    return np.inf if row["after"] is None else row["after"] / best


def bars(recording: Recording, result: Result) -> tuple[bool, bool, bool]:
    """Return whether it is right, errors as good as the best law's, and the loop quick."""
    own = ratios(recording, result)
    good = bool(own) and max(own) <= AS_GOOD
    quick = result.error is None and result.seconds <= QUICK
    return judgement(recording, result) == "right", good, quick


def summary(recordings: Iterable[Recording], found: Mapping[str, Result]) -> str:
    """Return sentences: how many recordings are right, and pass each other bar."""
    recordings = tuple(recordings)
    there = [each for each in recordings if each.name in found]
    judged = Counter(judgement(each, found[each.name]) for each in there)
    passed = [bars(each, found[each.name]) for each in there]
    _, good, quick = (sum(own) for own in zip(*passed, strict=True)) if passed else (0, 0, 0)
    return (
        f"Of {len(recordings)} recordings {len(there)} were run: {counts(judged)}."
        f" Forecast errors of at most {AS_GOOD:g} times those of the best law in the catalogue:"
        f" {good}. At most {QUICK:g} s: {quick}."
    )


def counts(judged: Mapping[str, int]) -> str:
    """Return how often each judgement was made, those that were: ``3 right, 1 wrong``."""
    return ", ".join(f"{judged[one]} {one}" for one in JUDGEMENTS if judged.get(one)) or "none"


def markdown_table(recordings: Iterable[Recording], found: Mapping[str, Result]) -> str:
    """Return a table, one row per recording; bold is what does not pass a bar."""
    lines = [
        "| recording | declared | named | judged | held-out error, declared → named | independent"
        " fits, declared → best law | verdict | seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for recording in recordings:
        cells = [recording.name, recording.declared, *_cells(recording, found.get(recording.name))]
        lines.append(f"| {' | '.join(cell or '–' for cell in cells)} |")
    return "\n".join(lines)


def _cells(recording: Recording, result: Result | None) -> list[str]:
    """Return a row of the table from the names on."""
    best = "<br>".join(
        f"{_way(each.declared, each.best)} {QUANTITIES[each.quantity][1]} at {each.seconds:g} s"
        for each in recording.ahead
    )
    if result is None:
        return ["not run", "", "", best, "", ""]
    judged, (right, _, quick) = judgement(recording, result), bars(recording, result)
    errors = []
    for ahead, row in _beside(recording, result):
        error = f"{_way(row['before'], row['after'])} {row['unit']} at {row['seconds']:g} s"
        if ahead.best is not None:
            ratio = _ratio(row, ahead.best)
            error += f": {_bold(_times(ratio), ratio <= AS_GOOD)}"
        errors.append(error)
    return [
        "<br>".join(map(_added, result.added)) if result.error is None else _reason(result.error),
        _bold(judged, right),
        "<br>".join(errors),
        best,
        _bold(result.verdict, result.error is None),
        _bold(f"{result.seconds:.0f}", quick),
    ]


def failures(recording: Recording, result: Result) -> list[str]:
    """Return sentences on what does not pass a bar, or differs from the independent fits."""
    if result.error is not None:
        return [f"The loop failed: {result.error}."]
    told = [f"False name: `{name}`." for name in false_names(recording, result)]
    judged = judgement(recording, result)
    if judged not in ("right", "wrong"):
        told.append(f"Not right: {judged}.")
    for ahead, row in _beside(recording, result):
        if ahead.best is None:
            continue
        which = f"error of the {ahead.quantity} at {ahead.seconds:g} s"
        ratio = _ratio(row, ahead.best)
        if ratio > AS_GOOD:
            told.append(f"The {which} is {_times(ratio)} that of the best law.")
    if result.seconds > QUICK:
        told.append(f"It took more than {QUICK:g} s.")
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
    table = markdown_table(recordings, found)
    made = "\n\n".join([summary(recordings, found), table, *sections])
    before, rest = text.split(BEGIN)
    page.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{rest.split(END)[1]}")


def _section(recording: Recording, result: Result | None, page: Path) -> str:
    """Return a recording's section: picture, declared model and findings."""
    lines = [f"## {recording.name}", "", recording.about, "", f"- Declared: {recording.declared}."]
    if recording.laws:
        lines.append(f"- Physically there: {_listed(recording.laws)}.")
    if others := sorted(recording.right - set(recording.laws)):
        lines.append(f"- As good a name, or may be there too: {_listed(others)}.")
    if recording.outside:
        lines.append(f"- There too, and in no catalogue: {_listed(recording.outside)}.")
    if recording.expected:
        lines.append(f"- Expected: {recording.expected}.")
    if result is None:
        return "\n".join([*lines, "- Not run yet."])
    if result.error is None:
        lines.append(f"- Found (`{result.verdict}`): {result.sentence}")
        lines += [f"- Added: {_added(each)}." for each in result.added]
        if missing := missing_laws(recording, result):
            lines.append(f"- Not named: {_listed(missing)}.")
    for ahead, row in _beside(recording, result):
        told = (
            f"- Held-out error of the {ahead.quantity} at {ahead.seconds:g} s:"
            f" {_way(row['before'], row['after'])} {row['unit']}"
        )
        if ahead.best is not None:
            told += f"; independent fits {_way(ahead.declared, ahead.best)} with {ahead.law}"
        lines.append(f"{told}.")
    bad = failures(recording, result)
    lines.append(f"- **{' '.join(bad)}**" if bad else "- Passes every bar.")
    judged = judgement(recording, result)
    made = f"`{result.method}`, seed {result.seed}, code {result.sources}"
    lines.append(f"- Judged: {judged}. {result.seconds:.0f} s, {made}.")
    if (page.with_suffix("") / f"{recording.name}.png").is_file():
        seen = f"{recording.name}: a held-out trajectory, measured and forecast from its start"
        lines += ["", f"![{seen}]({page.stem}/{recording.name}.png)"]
    return "\n".join(lines)


def _beside(recording: Recording, result: Result) -> Iterator[tuple[Ahead, dict[str, Any]]]:
    """Yield each error of a result with the independent fits of the same forecast."""
    known = {(ahead.seconds, ahead.quantity): ahead for ahead in recording.ahead}
    for row in result.errors:
        which = row["seconds"], row["quantity"]
        yield known.get(which, Ahead(*which)), row


def _reason(error: str) -> str:
    """Return an error for a cell: one line, no column marks."""
    return " ".join(error.split()).replace("|", "/")


def _bold(text: str, passed: bool) -> str:
    return text if passed else f"**{text}**"


def _times(ratio: float) -> str:
    return f"{number(ratio)} times" if np.isfinite(ratio) else "not a finite number of times"


def _way(before: float | None, after: float | None) -> str:
    return f"{number(before)} → {number(after)}"


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
