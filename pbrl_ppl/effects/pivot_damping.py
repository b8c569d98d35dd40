"""Viscous friction in a hinge."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.hinge import is_pivoted
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.parameters import Prior


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    properties["pivot_damping"] = properties["pivot_damping"] + parameters["coefficient"]


pivot_damping = Effect(
    "pivot_damping",
    (EffectParameter("coefficient", "N m s", Prior("half_normal", sigma=1.0)),),
    "viscous friction in the hinge: a torque against the rotation that grows with its speed",
    "viscous torque on the relative angular velocity, tau = -c omega",
    Properties(_modify),
    applies=is_pivoted,
)
