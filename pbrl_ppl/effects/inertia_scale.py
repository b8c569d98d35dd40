"""The moment of inertia is not that of a uniform body."""

from typing import Any

from pbrl_ppl.effects.base import Effect, EffectParameter
from pbrl_ppl.parameters import Prior


def _modify(properties: dict[str, Any], parameters: dict[str, Any]) -> None:
    properties["moment"] *= parameters["scale"]


inertia_scale = Effect(
    "inertia_scale",
    (EffectParameter("scale", "1", Prior("log_normal", mu=0.0, sigma=0.5), null=1.0),),
    "the body is easier or harder to turn than its outline suggests: mass is not spread evenly",
    "moment of inertia about the centroid as a free parameter",
    modify=_modify,
)
