"""Force across the motion of a body that turns."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] -= parameters[0] * state[5] * state[4]
    wrench[1] += parameters[0] * state[5] * state[3]


magnus_force = Effect(
    "magnus_force",
    (EffectParameter("coefficient", "kg", Prior("normal", sigma=1.0)),),
    "a force across the motion that grows with the speed and the turning: a spinning body is drawn"
    " aside",
    "Magnus force, F = c omega x v",
    Force(_law),
)
