"""Saturation of an actuator: a force is capped."""

import math
from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.scans import force_levels
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

_LOOKS = 20
#: No actuator reaches this (N).
_NEVER = 1e9


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    size = math.hypot(wrench[0], wrench[1])
    if size > parameters[0]:
        wrench[0] *= parameters[0] / size
        wrench[1] *= parameters[0] / size


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Limits between the sizes of the forces that were commanded."""
    return force_levels(history, body, _LOOKS)


saturation = Effect(
    "saturation",
    (EffectParameter("limit", "N", Prior("log_normal", mu=2.5, sigma=1.5), null=_NEVER),),
    "a push is never stronger than a limit, whatever is commanded: the actuator saturates",
    "saturation of an actuator",
    Command(_law),
    scan=_scan,
)
