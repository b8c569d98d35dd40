"""Gains of the commanded force along the world's axes."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    wrench[0] *= parameters[0]
    wrench[1] *= parameters[1]


_GAIN = Prior("log_normal", mu=0.0, sigma=0.5)

anisotropic_gain = Effect(
    "anisotropic_gain",
    (EffectParameter("x", "1", _GAIN, null=1.0), EffectParameter("y", "1", _GAIN, null=1.0)),
    "pushes along one axis of the room are stronger or weaker than along the other: one of two"
    " actuators is off",
    "gains of two actuators at right angles",
    Command(_law),
)
