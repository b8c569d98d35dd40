"""Effects outside the loop's catalogue, for the oracle."""

from __future__ import annotations

import math
from typing import Any

import pbrl_ppl as pp
from pbrl_ppl import Command

_REFERENCE = "attribution benchmark"


def _cubic_drag(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    drag = parameters[0] * (state[3] * state[3] + state[4] * state[4])
    wrench[0] -= drag * state[3]
    wrench[1] -= drag * state[4]


def _corrugation(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] -= parameters[0] * math.sin(state[0] / parameters[1])


def _swirl_drag(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[2] -= parameters[0] * math.hypot(state[3], state[4]) * state[5]


def _actuator_lag(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    # as if the command before had been reached; the middle of the substep stands for it
    left = math.exp(-0.5 * (command[6] + command[7]) / max(parameters[0], 1e-6))
    for i in range(3):
        wrench[i] += left * (command[3 + i] - wrench[i])


def _stribeck(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    speed = math.hypot(state[3], state[4])
    share = parameters[0] * math.exp(-((speed / parameters[1]) ** 2)) / max(speed, 1e-3)
    wrench[0] -= share * state[3]
    wrench[1] -= share * state[4]


def _stiction_patch(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    if state[0] > 0.0:
        share = parameters[0] / max(math.hypot(state[3], state[4]), 1e-3)
        wrench[0] -= share * state[3]
        wrench[1] -= share * state[4]


_SIZE = pp.Prior("half_normal", sigma=10.0)

_EFFECTS = (
    pp.Effect(
        "cubic_drag",
        (pp.EffectParameter("coefficient", "kg s/m^2", _SIZE),),
        "a force against the motion that grows with the cube of the speed",
        _REFERENCE,
        pp.Force(_cubic_drag),
    ),
    pp.Effect(
        "corrugation",
        (
            pp.EffectParameter("force", "N", pp.Prior("normal", sigma=10.0)),
            pp.EffectParameter("length", "m", pp.Prior("log_normal", sigma=1.0), null=1.0),
        ),
        "a force along x that changes with the place like a sine",
        _REFERENCE,
        pp.Force(_corrugation),
    ),
    pp.Effect(
        "swirl_drag",
        (pp.EffectParameter("coefficient", "N s", _SIZE),),
        "a torque against turning that grows with the speed",
        _REFERENCE,
        pp.Force(_swirl_drag),
    ),
    pp.Effect(
        "actuator_lag",
        (pp.EffectParameter("share", "1", pp.Prior("half_normal", sigma=1.0)),),
        "the motor follows its command with a lag of first order, a share of the interval",
        _REFERENCE,
        Command(_actuator_lag, memory=True),
    ),
    pp.Effect(
        "stribeck",
        (
            pp.EffectParameter("force", "N", _SIZE),
            pp.EffectParameter("speed", "m/s", pp.Prior("log_normal", sigma=1.0), null=0.5),
        ),
        "dry friction that fades with the speed",
        _REFERENCE,
        pp.Force(_stribeck),
    ),
    pp.Effect(
        "stiction_patch",
        (pp.EffectParameter("force", "N", _SIZE),),
        "dry friction of the floor where x is positive",
        _REFERENCE,
        pp.Force(_stiction_patch),
    ),
)
#: Laws of the catalogue that contain one of these, and are left out of the loop's beside it.
CONTAINING = {
    "actuator_lag": "first_order_lag",
    "stribeck": "sliding_stribeck",
}
OUTSIDE_EFFECTS = {effect.name: effect for effect in _EFFECTS}


def parameters_of(effect: pp.Effect, value: float | tuple[float, ...]) -> dict[str, float]:
    """Return an effect's parameters from the generator's arguments."""
    values = value if isinstance(value, tuple) else (value,)
    return {p.name: float(v) for p, v in zip(effect.parameters, values, strict=True)}
