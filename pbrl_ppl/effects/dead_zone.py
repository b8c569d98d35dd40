"""Dead zone of an actuator: what exceeds a threshold acts."""

import math
from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.scans import force_levels
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

_LOOKS = 20


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    size = math.hypot(wrench[0], wrench[1])
    share = 1.0 - parameters[0] / size if size > parameters[0] else 0.0
    wrench[0] *= share
    wrench[1] *= share


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """A small threshold, then some among the sizes of the forces that were commanded."""
    return np.vstack([[[np.nan]], force_levels(history, body, _LOOKS)])


dead_zone = Effect(
    "dead_zone",
    (EffectParameter("threshold", "N", Prior("half_normal", sigma=10.0)),),
    "only what exceeds a threshold of the push acts: the actuator has play or friction",
    "dead zone of an actuator (G. Tao and P. V. Kokotovic, 1994)",
    Command(_law),
    scan=_scan,
)
