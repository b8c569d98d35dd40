"""Dry friction in a hinge."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.hinge import is_pivoted
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.parameters import Prior


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    # the engine solves it together with the hinge, so sticking is exact
    properties["pivot_torque"] = properties["pivot_torque"] + parameters["torque"]


pivot_friction = Effect(
    "pivot_friction",
    (EffectParameter("torque", "N m", Prior("half_normal", sigma=1.0)),),
    "dry friction in the hinge: a steady torque against the rotation that can also hold it still",
    "Coulomb's law of friction",
    Properties(_modify),
    applies=is_pivoted,
)
