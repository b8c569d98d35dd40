"""Moment of inertia as a multiple of a uniform body's."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.parameters import Prior


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    properties["moment_per_mass"] = properties["moment_per_mass"] * parameters["scale"]


inertia_scale = Effect(
    "inertia_scale",
    (EffectParameter("scale", "1", Prior("log_normal", mu=0.0, sigma=0.5), null=1.0),),
    "the body is easier or harder to turn than its outline suggests: mass is not spread evenly",
    "moment of inertia about the centroid as a free parameter",
    Properties(_modify),
)
