"""Centre of mass away from the body's origin."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.parameters import Prior


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    properties["com_x"] = properties["com_x"] + parameters["x"]
    properties["com_y"] = properties["com_y"] + parameters["y"]


com_offset = Effect(
    "com_offset",
    (
        EffectParameter("x", "m", Prior("normal", sigma=0.1)),
        EffectParameter("y", "m", Prior("normal", sigma=0.1)),
    ),
    "the centre of mass is not in the middle of the outline: mass is not spread evenly",
    "centre of mass of a rigid body, in the body's frame",
    Properties(_modify),
)
