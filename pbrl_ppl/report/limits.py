"""Detection limits: sizes from which these recordings would show an effect."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism import Candidate, Loop
from pbrl_ppl.effects import Effect, Sensor
from pbrl_ppl.parameters import Prior
from pbrl_ppl.report.words import number, plain, quantity
from pbrl_ppl.state import STATE

#: A size is plausible if the effect's prior has more than this probability beyond it.
_IMPLAUSIBLE = 1e-3
_DRAWS = 20_000


def measured_parameters(
    candidate: Candidate, findings: Loop, effects: Iterable[Effect]
) -> tuple[str, ...]:
    """Return a candidate's parameters without those of state dimensions that were not measured.

    Parameters
    ----------
    candidate : Candidate
        Of the findings.
    findings : Loop
        Their residuals name the state dimensions that were measured.
    effects : iterable of Effect
        Where the candidate's name is looked up.
    """
    effect = next((each for each in effects if each.name == candidate.effect), None)
    names = tuple(candidate.units)
    if effect is None or not isinstance(effect.stage, Sensor):
        return names
    return tuple(name for name in names if name not in STATE or name in findings.residuals_after)


def limits_in_words(candidate: Candidate, findings: Loop, effects: Iterable[Effect]) -> str:
    """Write the detection limit of each parameter; empty where there is none.

    Limits beyond what the effect's prior allows are no limits: no plausible size would be seen.

    Parameters
    ----------
    candidate, findings, effects
        As of :func:`measured_parameters`.
    """
    effects = tuple(effects)
    effect = next((each for each in effects if each.name == candidate.effect), None)
    told = {} if effect is None else {each.name: each for each in effect.parameters}
    limits = {}
    for name in measured_parameters(candidate, findings, effects):
        if name not in candidate.detectable:
            continue
        size, unit = candidate.detectable[name], candidate.units[name]
        null = told[name].null if name in told else 0.0
        if not np.isfinite(size) or (
            name in told and not _plausible(told[name].prior, null, size, candidate.caps)
        ):
            limits[name] = ""
        elif candidate.caps:
            limits[name] = f"{plain(name)} up to {quantity(size, unit)}"
        elif null:
            limits[name] = f"{plain(name)} {number(null)} ± {quantity(size, unit)}"
        else:
            limits[name] = f"{plain(name)} {quantity(size, unit)}"
    if not any(limits.values()):
        return "no plausible size" if limits else ""
    return ", ".join(text or f"{plain(name)} no plausible size" for name, text in limits.items())


def _plausible(prior: Prior, null: float, size: float, caps: bool) -> bool:
    """Return whether the prior reaches a size: a distance from the null value, or a cap."""
    draws = _draws(prior)
    reached = draws <= size if caps else np.abs(draws - null) >= size
    return bool(reached.mean() > _IMPLAUSIBLE)


@cache
def _draws(prior: Prior) -> NDArray[np.float64]:
    return prior.sample(np.random.default_rng(0), _DRAWS)
