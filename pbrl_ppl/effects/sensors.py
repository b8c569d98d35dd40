"""Measurement: bias, scale and rotation of what is measured, and heavy-tailed noise."""

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Noise, Sensor, Values
from pbrl_ppl.parameters import Prior
from pbrl_ppl.state import STATE, STATE_UNITS, Floats

#: Natural units of a body's state; an angle has none.
_SCALES = ("range", "range", "", "speed", "speed", "turn_rate")


def _bias(parameters: Values) -> Floats:
    return np.stack(np.broadcast_arrays(*(parameters[name] for name in STATE)), axis=-1)


def _add_bias(state: Floats, parameters: Values) -> Floats:
    return state + _bias(parameters)


def _subtract_bias(measured: Floats, parameters: Values) -> Floats:
    return measured - _bias(parameters)


sensor_bias = Effect(
    "sensor_bias",
    tuple(
        EffectParameter(name, unit, Prior("normal", sigma=0.1), scale=scale)
        for name, unit, scale in zip(STATE, STATE_UNITS, _SCALES, strict=True)
    ),
    "what is measured is off by a constant: a sensor is not zeroed, or not where it is thought",
    "additive sensor bias",
    Sensor(_add_bias, _subtract_bias),
    log_odds=-2.0,
)


def _factors(parameters: Values) -> Floats:
    length, angle = np.broadcast_arrays(parameters["length"], parameters["angle"])
    return np.stack([length, length, angle, length, length, angle], axis=-1)


def _multiply(state: Floats, parameters: Values) -> Floats:
    return state * _factors(parameters)


def _divide(measured: Floats, parameters: Values) -> Floats:
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
    Sensor(_multiply, _divide),
    log_odds=-4.0,
)


def _turned(state: Floats, angle: Floats) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    x, y, theta, vx, vy, omega = np.moveaxis(state, -1, 0)
    parts = (c * x - s * y, s * x + c * y, theta + angle, c * vx - s * vy, s * vx + c * vy, omega)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _turn(state: Floats, parameters: Values) -> Floats:
    return _turned(state, parameters["angle"])


def _turn_back(measured: Floats, parameters: Values) -> Floats:
    return _turned(measured, -parameters["angle"])


frame_rotation = Effect(
    "frame_rotation",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.2)),),
    "the measuring frame is turned against that of the scene and of the commands: the camera or"
    " the mocap is not aligned",
    "rotation between two frames",
    Sensor(_turn, _turn_back),
    log_odds=-2.0,
)


def _tail(parameters: Values) -> Floats:
    return parameters["inverse_nu"]


_INVERSE_NU = Prior("truncated_normal", mu=0.0, sigma=0.3, lower=0.0, upper=1.0)

heavy_tails = Effect(
    "heavy_tails",
    (EffectParameter("inverse_nu", "1", _INVERSE_NU),),
    "a few measurements are much farther off than the others: the noise has heavy tails",
    "Student's t distribution; inverse_nu is the reciprocal of its degrees of freedom",
    Noise(_tail),
)
