"""Scores of rows: how often the right effect, a wrong one or none was named."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from attribution.baselines import WAYS
from attribution.bodies import CHAIN, PAIR, indistinguishable
from attribution.cases import CATALOGUED, CLEAN, LEFT_OUT, METHODS, NONSENSE, OUTSIDE
from attribution.one_case import Row
from attribution.oracle import MATTERS

#: What may come of a case in which something is hidden; each has one.
NAMED, EXTRA, ABSTAINED, MISNAMED = "named", "extra name", "abstained", "misnamed"
MISSED, NEGLIGIBLE, EQUIVALENT, SMALL = "missed", "negligible", "equivalent", "small"
#: What may come of the others.
RIGHT, FALSE_ALARM, REFUSED, ACCEPTED = "right", "false alarm", "refused", "accepted"
_NO_VERDICT = ("not-converged", "failed")


def outcome(row: Row) -> str:
    """Return the outcome of a case in a word."""
    verdict = row.verdict
    if row.kind == CLEAN:
        return RIGHT if verdict == "adequate" else FALSE_ALARM
    if row.kind == NONSENSE:
        return ACCEPTED if verdict == "adequate" else REFUSED
    if verdict in _NO_VERDICT:
        return verdict
    if verdict == "adequate":
        return MISSED if row.matters else NEGLIGIBLE
    right = [_is_right(row, one) for one in row.added]
    if row.kind == CATALOGUED and any(right):
        return NAMED if all(right) else EXTRA
    if row.open or verdict == "unexplained":
        return SMALL if row.kind == CATALOGUED and not (row.added or row.is_main) else ABSTAINED
    return EQUIVALENT if row.kind != CATALOGUED and _is_as_good(row) else MISNAMED


def _is_as_good(row: Row) -> bool:
    """Return whether the revised model forecasts the test recording as well as the oracle's."""
    return row.excess is not None and row.excess < MATTERS


def _is_right(row: Row, one: Mapping[str, Any]) -> bool:
    """Return whether a name, or a group that contains it, is equivalent to the right effect."""
    same = indistinguishable(row.body, row.effect)
    names = (one["effect"], *one["not_separable_from"])
    return row.kind == CATALOGUED and one["body"] == row.on and any(n in same for n in names)


def score(rows: Sequence[Row]) -> dict[str, float | int | None]:
    """Return the scores; a share of no cases is None. Failures count against the loop.

    Returns
    -------
    dict
        Over the cases that the oracle detects, but for those that do not matter and are called
        adequate (``negligible``, their number), those of no main law of which the loop says that
        something remains (``small``), and those of an effect that is not to be had in which what
        was added forecasts as the oracle's model does (``equivalent``): ``naming``,
        share of catalogued ones with the right effect's name and no other; ``overcautious``, share
        of these ones with the right name alone and the verdict ``unexplained``; ``extra_names``,
        number with a wrong name beside the right one; ``abstention``, share of left-out and outside
        ones in which the loop says that something remains; ``misnamed`` and ``missed``, shares of
        all of them with wrong names alone and nothing said to remain, and called adequate;
        ``wrong_names_open``, number with a wrong name of which something is said to remain.
        ``false_alarms``: share of clean cases that are not adequate. ``worse_after``: number of all
        cases with an effect added whose held-out error grew. ``coverage``: share of true values of
        correctly named effects inside the interval. ``excess``: median, over catalogued cases, of
        by how much the revised model's errors of forecasts exceed the oracle's, a share.
        ``baseline_naming``: the best of the usual ways' shares of names among those of one body,
        each beside it; an indistinguishable effect is right. ``nonsense_adequate``: number of
        nonsense cases called adequate. ``detected``, ``cases``, ``failed``, ``not_converged``,
        ``method_laplace``, ``method_importance``: numbers. ``seconds``: sum.
    """
    detected = [row for row in rows if row.kind in (CATALOGUED, LEFT_OUT, OUTSIDE) and row.detected]
    hidden = [row for row in detected if outcome(row) not in (NEGLIGIBLE, EQUIVALENT, SMALL)]
    catalogued = [row for row in hidden if row.kind == CATALOGUED]
    nameless = [row for row in hidden if row.kind != CATALOGUED]
    named = [row for row in catalogued if outcome(row) == NAMED]
    return {
        "naming": _share(outcome(row) == NAMED for row in catalogued),
        "overcautious": _share(
            outcome(row) == NAMED and row.verdict == "unexplained" for row in catalogued
        ),
        "extra_names": sum(outcome(row) == EXTRA for row in catalogued),
        "abstention": _share(outcome(row) == ABSTAINED for row in nameless),
        "misnamed": _share(outcome(row) == MISNAMED for row in hidden),
        "missed": _share(outcome(row) == MISSED for row in hidden),
        "wrong_names_open": sum(outcome(row) == ABSTAINED and bool(row.added) for row in hidden),
        "false_alarms": _share(outcome(row) == FALSE_ALARM for row in rows if row.kind == CLEAN),
        "worse_after": sum(row.worse for row in rows),
        "coverage": _share(inside for row in named for inside in row.within()),
        "excess": _median(row.excess for row in catalogued),
        **_baselines([row for row in catalogued if row.body not in (PAIR, CHAIN)]),
        "nonsense_adequate": sum(outcome(row) == ACCEPTED for row in rows),
        "cases": len(rows),
        "detected": len(detected),
        "negligible": sum(outcome(row) == NEGLIGIBLE for row in detected),
        "equivalent": sum(outcome(row) == EQUIVALENT for row in detected),
        "small": sum(outcome(row) == SMALL for row in detected),
        "failed": sum(row.verdict == "failed" for row in rows),
        "not_converged": sum(row.verdict == "not-converged" for row in rows),
        **{f"method_{method}": sum(row.method == method for row in rows) for method in METHODS},
        "seconds": round(sum(row.seconds for row in rows), 1),
    }


def _baselines(rows: Sequence[Row]) -> dict[str, float | None]:
    """Return the share of right names of each installed baseline, and the best."""
    shares = {}
    for way in WAYS:
        names = [(row.baselines.get(way), row) for row in rows]
        if any(name is not None for name, _ in names):
            shares[way] = _share(
                name in indistinguishable(row.body, row.effect) for name, row in names
            )
    best = max((share for share in shares.values() if share is not None), default=None)
    return {"baseline_naming": best} | {f"naming_{way}": share for way, share in shares.items()}


def _median(found: Iterable[float | None]) -> float | None:
    known = [value for value in found if value is not None]
    return float(np.median(known)) if known else None


def _share(found: Iterable[bool]) -> float | None:
    found = list(found)
    return sum(found) / len(found) if found else None
