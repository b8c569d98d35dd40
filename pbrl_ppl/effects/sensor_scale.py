"""Scale error of the measured state."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Sensor
from pbrl_ppl.parameters import Prior


def _factors(parameters: Any) -> Any:
    length, angle = np.broadcast_arrays(parameters["length"], parameters["angle"])
    return np.stack([length, length, angle, length, length, angle], axis=-1)


def _measure(state: Any, parameters: Any) -> Any:
    return state * _factors(parameters)


def _invert(measured: Any, parameters: Any) -> Any:
    return measured / _factors(parameters)


_SCALE = Prior("log_normal", mu=0.0, sigma=0.1)

sensor_scale = Effect(
    "sensor_scale",
    (
        EffectParameter("length", "1", _SCALE, null=1.0),
        EffectParameter("angle", "1", _SCALE, null=1.0),
    ),
    "lengths or angles are measured too large or too small by a factor: a camera's or an encoder's"
    " scale is off",
    "scale factor error of a sensor",
    Sensor(_measure, _invert),
)
