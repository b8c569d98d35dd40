"""Additive sensor bias: a constant error of the measured state."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Sensor
from pbrl_ppl.parameters import Prior
from pbrl_ppl.state import STATE, STATE_UNITS


def _bias(parameters: Any) -> Any:
    return np.stack(np.broadcast_arrays(*(parameters[name] for name in STATE)), axis=-1)


def _measure(state: Any, parameters: Any) -> Any:
    return state + _bias(parameters)


def _invert(measured: Any, parameters: Any) -> Any:
    return measured - _bias(parameters)


sensor_bias = Effect(
    "sensor_bias",
    tuple(
        EffectParameter(name, unit, Prior("normal", sigma=0.2))
        for name, unit in zip(STATE, STATE_UNITS, strict=True)
    ),
    "what is measured is off by a constant: a sensor is not zeroed, or not where it is thought",
    "additive sensor bias",
    Sensor(_measure, _invert),
)
