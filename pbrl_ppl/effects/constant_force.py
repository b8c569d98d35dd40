"""A constant force in the world's frame."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] += parameters[0]
    wrench[1] += parameters[1]


constant_force = Effect(
    "constant_force",
    (
        EffectParameter("force_x", "N", Prior("normal", sigma=20.0)),
        EffectParameter("force_y", "N", Prior("normal", sigma=20.0)),
    ),
    "a steady push in one direction of the room: the floor slopes, or a wind blows",
    "Newton's second law with a constant force",
    Force(_law),
)
