"""Gain of the commanded force."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] *= parameters[0]
    wrench[1] *= parameters[0]


force_gain = Effect(
    "force_gain",
    (EffectParameter("factor", "1", Prior("log_normal", mu=0.0, sigma=0.5), null=1.0),),
    "every push is stronger or weaker than commanded by the same factor: the actuator's scale is"
    " off",
    "gain of an actuator",
    Command(_law),
)
