"""Effects that the loop's catalogue lacks, for the oracle: it knows what is hidden."""

from __future__ import annotations

import math
from typing import Any

import pbrl_ppl as pp

_REFERENCE = "attribution benchmark"


def _saturation(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    # its parameter is the reciprocal of the cap: nothing is capped at 0
    size = math.hypot(wrench[0], wrench[1]) * parameters[0]
    if size > 1.0:
        wrench[0] /= size
        wrench[1] /= size


def _gain(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] *= parameters[0]
    wrench[1] *= parameters[1]


def _spring(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] -= parameters[0] * (state[0] - parameters[1])
    wrench[1] -= parameters[0] * (state[1] - parameters[2])


def _magnus(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] -= parameters[0] * state[5] * state[4]
    wrench[1] += parameters[0] * state[5] * state[3]


_WIDE = pp.Prior("normal", sigma=20.0)
_FACTOR = pp.Prior("log_normal", mu=0.0, sigma=0.5)

_EFFECTS = (
    pp.Effect(
        "saturation",
        (pp.EffectParameter("reciprocal", "1/N", pp.Prior("half_normal", sigma=1.0)),),
        "the push is never stronger than a cap",
        _REFERENCE,
        pp.Command(_saturation),
    ),
    pp.Effect(
        "anisotropic_gain",
        (
            pp.EffectParameter("x", "1", _FACTOR, null=1.0),
            pp.EffectParameter("y", "1", _FACTOR, null=1.0),
        ),
        "the push is weaker along one axis",
        _REFERENCE,
        pp.Command(_gain),
    ),
    pp.Effect(
        "spring",
        (
            pp.EffectParameter("stiffness", "N/m", pp.Prior("half_normal", sigma=20.0)),
            pp.EffectParameter("anchor_x", "m", _WIDE),
            pp.EffectParameter("anchor_y", "m", _WIDE),
        ),
        "a pull towards a place that grows with the distance",
        _REFERENCE,
        pp.Force(_spring),
    ),
    pp.Effect(
        "magnus_force",
        (pp.EffectParameter("coefficient", "kg", _WIDE),),
        "a force across the motion of a body that turns",
        _REFERENCE,
        pp.Force(_magnus),
    ),
)
OUTSIDE_EFFECTS = {effect.name: effect for effect in _EFFECTS}


def parameters_of(effect: pp.Effect, value: float | tuple[float, ...]) -> dict[str, float]:
    """Parameters of an effect from what the generator was told."""
    values = value if isinstance(value, tuple) else (value,)
    if effect.name == "saturation":
        values = (1.0 / values[0],)
    return {p.name: float(v) for p, v in zip(effect.parameters, values, strict=True)}
