"""Dead zone of an actuator: a force below a threshold is lost."""

import math
from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

_LOOKS = 20


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    if math.hypot(wrench[0], wrench[1]) < parameters[0]:
        wrench[0] = 0.0
        wrench[1] = 0.0


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Thresholds between the sizes of the forces that were commanded."""
    action = history.dataset["action"].sel(body=body.name).to_numpy()[..., :2]
    size = np.unique(np.round(np.linalg.norm(action, axis=-1), 9))
    size = size[size > 0]  # not NaN either
    between = np.unique(np.quantile(size, np.linspace(0, 1, _LOOKS + 1))) if len(size) else size
    return (0.5 * (between[1:] + between[:-1]))[:, None]


dead_zone = Effect(
    "dead_zone",
    (EffectParameter("threshold", "N", Prior("half_normal", sigma=10.0)),),
    "a push weaker than a threshold does nothing: the actuator has play or sticks",
    "dead zone of an actuator",
    Command(_law),
    scan=_scan,
)
