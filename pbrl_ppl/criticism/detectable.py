"""Smallest size of an effect that data would show, nine times of ten at a p-value of 0.01."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from pbrl_ppl.criticism.scan import Look
from pbrl_ppl.effects import Effect

Array = NDArray[np.float64]


def smallest(effect: Effect, unit: Array, tried: int) -> dict[str, float]:
    """Smallest size of each parameter, the others being nothing.

    Parameters
    ----------
    effect : Effect
        What is looked for.
    unit : ndarray
        What one unit of each parameter changes, in units of noise, shape (q,).
    tried : int
        Tests that a p-value pays for.
    """
    return dict(zip((p.name for p in effect.parameters), _sizes(unit, tried), strict=True))


def smallest_of_looks(
    effect: Effect, looks: Sequence[Look], units: Sequence[Array], candidates: int
) -> dict[str, float]:
    """Smallest size of what a scan differentiates or tries, at the look that shows it best.

    A whole change of one parameter, as by a threshold, has the value nearest to nothing that would
    be seen; one of several, such as an obstacle's place, has no size.

    Parameters
    ----------
    effect : Effect
        What is looked for.
    looks : sequence of Look
        Where it was tried.
    units : sequence of ndarray
        What one unit of each of a look's columns changes, in units of noise; of a whole change,
        all that it changes.
    candidates : int
        Tests that a p-value pays for, beside the looks.
    """
    tried = candidates * len(looks)
    names = [parameter.name for parameter in effect.parameters]
    found: dict[str, float] = {}
    whole = [
        (look.values, unit) for look, unit in zip(looks, units, strict=True) if not look.columns
    ]
    if whole and len(names) == 1:
        null = effect.null[0]
        seen = [values[0] for values, unit in whole if unit[0] >= _needed(tried)]
        found[names[0]] = float(min(seen, key=lambda value: abs(value - null), default=np.inf))
    for look, unit in zip(looks, units, strict=True):
        for column, size in zip(look.columns, _sizes(unit, tried), strict=False):
            found[names[column]] = min(found.get(names[column], np.inf), size)
    return found


def caps(effect: Effect, looks: Sequence[Look]) -> bool:
    """Whether smaller is stronger, as of a limit: whole changes by less than what does nothing."""
    return bool(looks) and all(
        not look.columns and look.values[0] < effect.null[0] for look in looks
    )


def _needed(tried: int) -> float:
    """Change in units of noise that is seen nine times of ten."""
    return float(norm.isf(0.005 / tried) + norm.isf(0.1))


def _sizes(unit: Array, tried: int) -> list[float]:
    with np.errstate(divide="ignore"):
        return [float(size) for size in _needed(tried) / unit]
