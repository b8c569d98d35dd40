"""Viscous drag on the rotation of a body."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[2] -= parameters[0] * state[5]


angular_drag = Effect(
    "angular_drag",
    (EffectParameter("coefficient", "N m s", Prior("half_normal", sigma=10.0)),),
    "a torque against the rotation that grows with the angular speed",
    "viscous torque, tau = -c omega",
    Force(_law),
)
