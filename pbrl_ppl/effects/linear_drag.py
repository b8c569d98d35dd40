"""Viscous drag on the motion of a body."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] -= parameters[0] * state[3]
    wrench[1] -= parameters[0] * state[4]


linear_drag = Effect(
    "linear_drag",
    (EffectParameter("coefficient", "kg/s", Prior("half_normal", sigma=20.0)),),
    "a force against the motion that grows with the speed, as in oil or at low speed in air",
    "Stokes' law, F = -c v",
    Force(_law),
)
