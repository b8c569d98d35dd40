"""Scores of rows: how often the right name was said, none where none was to be had, a wrong one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from attribution.baselines import WAYS
from attribution.bodies import BODIES
from attribution.cases import CATALOGUED, CLEAN, LEFT_OUT, NONSENSE, OUTSIDE
from attribution.one_case import Row

#: What may come of a case in which something is hidden; each has one.
NAMED, ABSTAINED, MISNAMED, MISSED = "named", "abstained", "misnamed", "missed"
#: What may come of the others.
RIGHT, FALSE_ALARM, REFUSED, ACCEPTED = "right", "false alarm", "refused", "accepted"
_NO_VERDICT = ("not-converged", "failed")


def outcome(row: Row) -> str:
    """What came of a case in a word."""
    verdict = row.verdict
    if row.kind == CLEAN:
        return RIGHT if verdict == "adequate" else FALSE_ALARM
    if row.kind == NONSENSE:
        return ACCEPTED if verdict == "adequate" else REFUSED
    if verdict in _NO_VERDICT:
        return verdict
    if verdict == "adequate":
        return MISSED
    if row.kind == CATALOGUED and _named_first(row):
        return NAMED
    return ABSTAINED if row.open or verdict == "unexplained" else MISNAMED


def _named_first(row: Row) -> bool:
    """Whether the first name is the right one, or of a group that holds it."""
    first = row.added[:1]
    return any(row.effect in (one["effect"], *one["not_separable_from"]) for one in first)


def score(rows: Sequence[Row]) -> dict[str, float | int | None]:
    """Scores; a share of no cases is None. Failures and missing verdicts count against the loop.

    Returns
    -------
    dict
        Over the cases that the oracle detects: ``naming``, share of catalogued ones in which the
        right effect comes first; ``abstention``, share of left-out and outside ones in which the
        loop says that something remains; ``misnamed`` and ``missed``, shares of all of them with a
        wrong name and nothing said to remain, and called adequate. ``false_alarms``: share of
        clean cases that are not adequate. ``coverage``: share of true values of correctly named
        effects inside the interval. ``excess``: median, over catalogued cases, of by how much the
        revised model's errors of forecasts exceed the oracle's, a share. ``baseline_naming``: the
        best of the usual ways' shares of names among the same, each beside it; a twin is right.
        ``nonsense_adequate``: number of nonsense cases called
        adequate. ``detected``, ``cases``, ``failed``, ``not_converged``: numbers. ``seconds``: sum.
    """
    hidden = [row for row in rows if row.kind in (CATALOGUED, LEFT_OUT, OUTSIDE) and row.detected]
    catalogued = [row for row in hidden if row.kind == CATALOGUED]
    nameless = [row for row in hidden if row.kind != CATALOGUED]
    return {
        "naming": _share(outcome(row) == NAMED for row in catalogued),
        "abstention": _share(outcome(row) == ABSTAINED for row in nameless),
        "misnamed": _share(outcome(row) == MISNAMED for row in hidden),
        "missed": _share(outcome(row) == MISSED for row in hidden),
        "false_alarms": _share(outcome(row) == FALSE_ALARM for row in rows if row.kind == CLEAN),
        "coverage": _share(
            inside for row in catalogued if outcome(row) == NAMED for inside in row.within()
        ),
        "excess": _median(row.excess for row in catalogued),
        **_baselines(catalogued),
        "nonsense_adequate": sum(outcome(row) == ACCEPTED for row in rows),
        "cases": len(rows),
        "detected": len(hidden),
        "failed": sum(row.verdict == "failed" for row in rows),
        "not_converged": sum(row.verdict == "not-converged" for row in rows),
        "seconds": round(sum(row.seconds for row in rows), 1),
    }


def _baselines(rows: Sequence[Row]) -> dict[str, float | None]:
    """Shares of right names of each of the usual ways that was there, and the best."""
    shares = {}
    for way in WAYS:
        names = [(row.baselines.get(way), row) for row in rows]
        if any(name is not None for name, _ in names):
            shares[way] = _share(name in _same(row) for name, row in names)
    best = max((share for share in shares.values() if share is not None), default=None)
    return {"baseline_naming": best} | {f"naming_{way}": share for way, share in shares.items()}


def _same(row: Row) -> tuple[str | None, ...]:
    """Effects that are the same physics on the body as what is hidden."""
    groups = BODIES[row.body].twins
    return next((group for group in groups if row.effect in group), (row.effect,))


def _median(found: Iterable[float | None]) -> float | None:
    known = [value for value in found if value is not None]
    return float(np.median(known)) if known else None


def _share(found: Iterable[bool]) -> float | None:
    found = list(found)
    return sum(found) / len(found) if found else None
