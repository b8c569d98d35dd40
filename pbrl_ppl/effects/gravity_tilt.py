"""Gravity at an angle to the vertical of the log."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    c, s = np.cos(parameters["angle"]), np.sin(parameters["angle"])
    x, y = properties["gravity_x"], properties["gravity_y"]
    properties["gravity_x"], properties["gravity_y"] = c * x - s * y, s * x + c * y


def _falls(scene: Scene, body: Body) -> bool:
    return bool(np.any(scene.gravity))


gravity_tilt = Effect(
    "gravity_tilt",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.1)),),
    "gravity does not point where the log has its vertical: the rig or the camera is not level",
    "gravity turned by an angle",
    Properties(_modify),
    applies=_falls,
)
