"""Moment of a commanded force that acts beside the body's origin."""

import math
from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    c = math.cos(state[2])
    s = math.sin(state[2])
    arm_x = c * parameters[0] - s * parameters[1]
    arm_y = s * parameters[0] + c * parameters[1]
    wrench[2] += arm_x * command[1] - arm_y * command[0]


push_offset = Effect(
    "push_offset",
    (
        EffectParameter("offset_x", "m", Prior("normal", sigma=0.5)),
        EffectParameter("offset_y", "m", Prior("normal", sigma=0.5)),
    ),
    "the push acts at a point beside the body's centre, and so turns it as well",
    "moment of a force about a point, tau = r x F",
    Force(_law),
)
