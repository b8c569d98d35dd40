"""Heavy-tailed measurement noise: Student's t distribution."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Noise
from pbrl_ppl.parameters import Prior


def _tail(parameters: Any) -> Any:
    return parameters["inverse_nu"]


heavy_tails = Effect(
    "heavy_tails",
    (
        EffectParameter(
            "inverse_nu", "1", Prior("truncated_normal", mu=0.0, sigma=0.3, lower=0.0, upper=1.0)
        ),
    ),
    "a few measurements are much farther off than the others: the noise has heavy tails",
    "Student's t distribution; inverse_nu is the reciprocal of its degrees of freedom",
    Noise(_tail),
)
