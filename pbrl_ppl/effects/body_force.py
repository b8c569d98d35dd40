"""A constant force in the body's frame."""

import math
from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    c = math.cos(state[2])
    s = math.sin(state[2])
    wrench[0] += c * parameters[0] - s * parameters[1]
    wrench[1] += s * parameters[0] + c * parameters[1]


body_force = Effect(
    "body_force",
    (
        EffectParameter("force_x", "N", Prior("normal", sigma=20.0)),
        EffectParameter("force_y", "N", Prior("normal", sigma=20.0)),
    ),
    "a steady push in one direction of the body itself, such as a motor that never quite stops",
    "Newton's second law with a force that turns with the body",
    Force(_law),
)
