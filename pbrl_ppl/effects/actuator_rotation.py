"""The commanded force is turned by an angle."""

import math
from typing import Any

from pbrl_ppl.effects.base import Effect, EffectParameter
from pbrl_ppl.parameters import Prior


def _force(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    c = math.cos(parameters[0]) - 1.0
    s = math.sin(parameters[0])
    wrench[0] += c * command[0] - s * command[1]
    wrench[1] += s * command[0] + c * command[1]


actuator_rotation = Effect(
    "actuator_rotation",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.5)),),
    "the push points in another direction than commanded: the actuator is mounted askew",
    "rotation of a vector in the plane",
    force=_force,
)
