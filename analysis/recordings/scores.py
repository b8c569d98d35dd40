"""Scores of rows, their table in Markdown, and a case in full."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from pbrl_ppl.criticism import UNEXPLAINED
from recordings.cases import NOISES, RATES, SHAPES, WORLDS
from recordings.one_case import Row

_CANDIDATES = 8


def table(rows: Sequence[Row]) -> str:
    """Return the table: named/detectable, false names/clean of each world, rate, shape and noise.

    A clean case whose verdict is not adequate counts as one with a false name.
    """
    columns = [(shape, noise) for shape in SHAPES for noise in NOISES]
    heads = ["world", "rate", *(f"{shape}, {noise}" for shape, noise in columns), "all"]
    lines = [_line(heads), _line(["---"] * len(heads))]
    for world in WORLDS:
        for rate in RATES:
            own = [row for row in rows if (row.world, row.rate) == (world, rate)]
            cells = [[row for row in own if (row.shape, row.noise) == c] for c in columns]
            lines.append(_line([world, f"{rate} Hz", *map(_cell, cells), _cell(own)]))
    cells = [[row for row in rows if (row.shape, row.noise) == c] for c in columns]
    return "\n".join([*lines, _line(["all", "", *map(_cell, cells), _cell(rows)])])


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    detectable = [row for row in rows if row.detectable]
    clean = [row for row in rows if row.clean]
    named = sum(row.named for row in detectable)
    false = sum(not row.names_nothing for row in clean)
    return f"{named}/{len(detectable)}, {false}/{len(clean)}"


def score(rows: Sequence[Row]) -> dict[str, float | int | None]:
    """Return the scores; a share of no cases is None. Failures count against the loop.

    Returns
    -------
    dict
        ``naming``: share of detectable cases with the right name and no other; ``extra_names``:
        number of detectable cases with a wrong name beside the right one; ``overcautious``: number
        of named ones whose verdict is that something remains unexplained; ``in_group``: number of
        named ones in which the right name is only among those that the data cannot separate from
        the one added; ``wrong_names``: number
        with wrong names alone; ``missed``: number without a name. ``clean``: share of clean cases
        called adequate, without a name. ``undetectable_named``: number of cases with an effect that
        the oracle does not detect in which something was named. ``coverage``: share of true
        coefficients inside the interval. ``oracle_false_alarms``: number of clean cases in which
        the oracle detects an effect. ``detectable``, ``cases``, ``failed``: numbers.
        ``seconds_median``, ``seconds_max``: durations of the loop.
    """
    detectable = [row for row in rows if row.detectable]
    clean = [row for row in rows if row.clean]
    hidden = [row for row in rows if not row.clean and not row.detectable]
    inside = [each for row in rows for each in row.inside]
    seconds = [row.seconds for row in rows]
    return {
        "naming": _share([row.named for row in detectable]),
        "extra_names": sum(row.extra for row in detectable),
        "overcautious": sum(row.named and row.verdict == UNEXPLAINED for row in detectable),
        "in_group": sum(
            row.named and any(one["effect"] not in row.answers for one in row.added)
            for row in detectable
        ),
        "wrong_names": sum(
            bool(row.added) and not row.named and not row.extra for row in detectable
        ),
        "missed": sum(not row.added for row in detectable),
        "clean": _share([row.names_nothing for row in clean]),
        "undetectable_named": sum(bool(row.added) for row in hidden),
        "coverage": _share(inside),
        "oracle_false_alarms": sum(row.oracle is not None and row.oracle.detects for row in clean),
        "detectable": len(detectable),
        "cases": len(rows),
        "failed": sum(row.findings is None for row in rows),
        "seconds_median": round(float(np.median(seconds)), 1) if seconds else None,
        "seconds_max": round(max(seconds), 1) if seconds else None,
    }


def _share(found: Sequence[bool]) -> float | None:
    return sum(found) / len(found) if found else None


def brief(row: Row) -> str:
    """Return a case in a line: the oracle's p-value, the verdict, names and intervals."""
    if row.oracle is None:
        return f"{row.name}: {row.error}"
    wrong = (row.detectable and not row.named) or (row.clean and not row.names_nothing)
    names = "; ".join(_name(one) for one in row.added) or "nothing"
    hit = "" if not row.inside else f", {sum(row.inside)}/{len(row.inside)} inside"
    return (
        f"{row.name}{' (!)' if wrong else ''}: oracle p = {row.oracle.p_value:.0e};"
        f" {row.error or row.verdict}, added {names}{hit}; {row.seconds:.0f} s"
    )


def _name(one: dict[str, object]) -> str:
    others = " or ".join(one["not_separable_from"])  # type: ignore[arg-type]
    return f"{one['effect']} (or {others})" if others else str(one["effect"])


def told(row: Row) -> str:
    """Return a case in full: candidates and why they were rejected, tests, the remainder."""
    lines = [brief(row)]
    lines += [f"    true {name}: {value}" for name, value in row.answers.items() if value]
    if row.oracle is not None:
        lines.append(f"    oracle: {row.effect} {row.oracle.estimate:.4g} +- {row.oracle.sd:.2g}")
    if row.findings is None:
        return "\n".join(lines)
    for one in row.added:
        for name, each in one["parameters"].items():
            low, high = each["hdi"]
            lines.append(
                f"    added {one['effect']}: {name} {each['mean']:.4g} [{low:.4g}, {high:.4g}]"
            )
    for rank, one in enumerate(row.findings["candidates"]):
        if rank >= _CANDIDATES and one["effect"] not in row.answers:
            continue
        lines.append(
            f"    candidate {rank + 1} {one['effect']}: S = {one['statistic']:.1f},"
            f" p = {one['p_value']:.0e}, {one['estimate']}: {one['why']}"
        )
    for test in row.findings["tests"]:
        if not test["passed"]:
            lines.append(f"    failed test {test['name']}: {test['sentence']}")
    if row.findings["unexplained"] is not None:
        lines.append(f"    remains: {row.findings['unexplained']['sentence']}")
    before, after = (row.findings["error"][key]["rollout_rmse"] for key in ("before", "after"))
    lines.append(f"    held-out rollout error: {before} before, {after} after")
    return "\n".join(lines)
