"""Cut-off of an actuator: a force below a threshold is lost, a larger one acts in full."""

import math
from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.scans import force_levels
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

#: The likelihood has a step at each size that was commanded: no climb finds the right one.
_LOOKS = 200


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    if math.hypot(wrench[0], wrench[1]) < parameters[0]:
        wrench[0] = 0.0
        wrench[1] = 0.0


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Thresholds between the sizes of the forces that were commanded."""
    return force_levels(history, body, _LOOKS)


force_cutoff = Effect(
    "force_cutoff",
    (EffectParameter("threshold", "N", Prior("half_normal", sigma=10.0)),),
    "a push weaker than a threshold does nothing, a stronger one acts in full",
    "threshold of an actuator",
    Command(_law),
    scan=_scan,
)
