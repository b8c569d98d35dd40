"""Rotation of the measuring frame."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Sensor
from pbrl_ppl.parameters import Prior


def _turned(state: Any, angle: Any) -> Any:
    c, s = np.cos(angle), np.sin(angle)
    x, y, theta, vx, vy, omega = np.moveaxis(state, -1, 0)
    parts = (c * x - s * y, s * x + c * y, theta + angle, c * vx - s * vy, s * vx + c * vy, omega)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _measure(state: Any, parameters: Any) -> Any:
    return _turned(state, parameters["angle"])


def _invert(measured: Any, parameters: Any) -> Any:
    return _turned(measured, -parameters["angle"])


frame_rotation = Effect(
    "frame_rotation",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.2)),),
    "the measuring frame is turned against that of the scene and of the commands: the camera or"
    " the mocap is not aligned",
    "rotation between two frames",
    Sensor(_measure, _invert),
)
