"""Counted work that a run reports, against what must hold of it."""

from collections.abc import Iterable

from pbrl_ppl.system.threads import Work


def of_work(said: Iterable[str]) -> dict[str, int]:
    """Return the greatest total of each sentence; all works rise and end with all units done."""
    totals: dict[str, int] = {}
    before = Work("", 0, 0)
    for work in (one for one in said if isinstance(one, Work)):
        assert work.done >= 0, work
        if (work, work.total) != (before, before.total) or before.done >= before.total:
            assert before.done >= before.total, (before, before.done, before.total)
        else:
            assert work.done >= before.done, (work, before.done, work.done)
        totals[str(work)] = max(work.total, totals.get(str(work), 0))
        before = work
    assert before.done >= before.total, before
    return totals
