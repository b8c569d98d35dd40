"""A constant torque."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[2] += parameters[0]


constant_torque = Effect(
    "constant_torque",
    (EffectParameter("torque", "N m", Prior("normal", sigma=10.0)),),
    "a steady twist in one direction, such as a torque sensor that is off zero",
    "Euler's second law with a constant torque",
    Force(_law),
)
