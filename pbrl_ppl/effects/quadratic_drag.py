"""Quadratic drag: a force that grows with the square of the speed."""

import math
from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    speed = math.sqrt(state[3] * state[3] + state[4] * state[4])
    wrench[0] -= parameters[0] * speed * state[3]
    wrench[1] -= parameters[0] * speed * state[4]


quadratic_drag = Effect(
    "quadratic_drag",
    (EffectParameter("coefficient", "kg/m", Prior("half_normal", sigma=20.0)),),
    "a force against the motion that grows with the square of the speed, as in air or water",
    "Rayleigh's drag equation, F = -c |v| v",
    Force(_law),
)
