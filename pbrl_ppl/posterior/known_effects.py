"""Effects that a posterior's are looked up in: a catalogue, and what was learned and is in it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pbrl_ppl.effects import LEARNED_REMAINDER, Effect, learned_remainder


def known_effects(idata: Any, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """The effects, and the learned remainder that a posterior holds, if it does."""
    table = idata.attrs.get(LEARNED_REMAINDER)
    return (*effects, *(() if table is None else (learned_remainder(str(table)),)))
