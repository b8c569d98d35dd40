"""Rotation of the commanded force by a constant angle."""

import math
from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    c = math.cos(parameters[0])
    s = math.sin(parameters[0])
    x = wrench[0]
    wrench[0] = c * x - s * wrench[1]
    wrench[1] = s * x + c * wrench[1]


actuator_rotation = Effect(
    "actuator_rotation",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.5)),),
    "the push points in another direction than commanded: the actuator is mounted askew",
    "rotation of a vector in the plane",
    Command(_law),
)
