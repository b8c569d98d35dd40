"""The stored mode of an updated posterior."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pbrl_ppl.effects import Effect
from pbrl_ppl.posterior import MODE, climbed_text, parameter_draws, problem_of, stored_mode


def climb_from(earlier: Any, updated: Any, effects: Iterable[Effect]) -> None:
    """Store the mode of all data, climbed to from that of the earlier data, in place.

    Over a library or joints of unknown bodies there is no climb: none is stored. Nor is one where
    the earlier posterior holds none.

    Parameters
    ----------
    earlier, updated : InferenceData or DataTree
        Before and after.
    effects : iterable of Effect
        Where the names of its effects are looked up.
    """
    updated.attrs.pop(MODE, None)
    problem = problem_of(updated, effects)
    begin = stored_mode(problem, earlier)
    if begin is None or problem.library is not None or problem.layout.discrete.any():
        return
    phi, _ = parameter_draws(problem, updated)
    updated.attrs[MODE] = climbed_text(problem, begin, phi)
