"""Measurement: bias, scale and rotation of what is measured, and heavy-tailed noise."""

from collections.abc import Callable

import numpy as np

from pbrl_ppl.effects.effect import (
    Effect,
    EffectParameter,
    Noise,
    Sensor,
    Values,
    With,
    is_pivoted,
    is_unpivoted,
)
from pbrl_ppl.parameters import Prior
from pbrl_ppl.state import STATE, STATE_UNITS, Floats

#: Natural units of a body's state; an angle has none.
_SCALES = ("range", "range", "", "speed", "speed", "turn_rate")
#: A measurement; see :class:`Sensor`.
Measure = Callable[[Floats, Values], Floats]


def _with_opposites(measured: Floats, parameters: Values, measure: Measure) -> Floats:
    return measure(measured, {name: -value for name, value in parameters.items()})


def _undone_by_opposites(measure: Measure) -> Sensor:
    """Return the stage of a measurement that the opposite parameters undo."""
    return Sensor(measure, With(_with_opposites, measure))


def _add_bias(state: Floats, parameters: Values) -> Floats:
    nothing = np.zeros(())  # of what the effect does not have on a hinged body
    given = (parameters.get(name, nothing) for name in STATE)
    return np.asarray(state + np.stack(np.broadcast_arrays(*given), axis=-1))


sensor_bias = Effect(
    "sensor_bias",
    tuple(
        EffectParameter(name, unit, Prior("normal", sigma=0.1), scale=scale, hinged=name == "theta")
        for name, unit, scale in zip(STATE, STATE_UNITS, _SCALES, strict=True)
    ),
    "what is measured is off by a constant: a sensor is not zeroed, or not where it is thought",
    "additive sensor bias",
    _undone_by_opposites(_add_bias),
    log_odds=-1.0,
)


def _factors(parameters: Values) -> Floats:
    nothing = np.ones(())  # a length, of a hinged body
    length, angle = np.broadcast_arrays(parameters.get("length", nothing), parameters["angle"])
    return np.stack([length, length, angle, length, length, angle], axis=-1)


def _multiply(state: Floats, parameters: Values) -> Floats:
    return state * _factors(parameters)


def _divide(measured: Floats, parameters: Values) -> Floats:
    return measured / _factors(parameters)


_SCALE = Prior("log_normal", mu=0.0, sigma=0.1)

sensor_scale = Effect(
    "sensor_scale",
    (
        EffectParameter("length", "1", _SCALE, null=1.0, hinged=False),
        EffectParameter("angle", "1", _SCALE, null=1.0),
    ),
    "lengths or angles are measured too large or too small by a factor: a camera's or an encoder's"
    " scale is off",
    "scale factor error of a sensor",
    Sensor(_multiply, _divide),
    log_odds=-4.0,
    unusual="scales are calibrated, and a mass or a gain that is off looks the same",
)


def _turned(state: Floats, parameters: Values) -> Floats:
    angle = parameters["angle"]
    c, s = np.cos(angle), np.sin(angle)
    x, y, theta, vx, vy, omega = np.moveaxis(state, -1, 0)
    parts = (c * x - s * y, s * x + c * y, theta + angle, c * vx - s * vy, s * vx + c * vy, omega)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


frame_rotation = Effect(
    "frame_rotation",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.2)),),
    "the measuring frame is turned against that of the scene and of the commands: the camera or"
    " the mocap is not aligned",
    "rotation between two frames",
    _undone_by_opposites(_turned),
    log_odds=-2.0,
    unusual="most logs have one frame; it is a force across the commands, too",
    needs=("x", "y"),
)


def _seen_askew(state: Floats, parameters: Values) -> Floats:
    x, y, theta, vx, vy, omega = np.moveaxis(state, -1, 0)
    a, b = parameters["along_x"], parameters["along_y"]
    depth, rate = 1.0 + a * x + b * y, a * vx + b * vy
    parts = (
        x / depth, y / depth, theta,
        (vx - x * rate / depth) / depth, (vy - y * rate / depth) / depth, omega,
    )  # fmt: skip
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


_TILT = Prior("normal", sigma=0.1)

askew_camera = Effect(
    "askew_camera",
    EffectParameter.each("along_x", "along_y", unit="1/m", prior=_TILT, scale="/range"),
    "places are measured too small at one end of the room and too large at the other: the camera"
    " looks askew",
    "perspective of a tilted plane, x / (1 + a x + b y)",
    _undone_by_opposites(_seen_askew),
    applies=is_unpivoted,
    log_odds=-6.0,
    family="place and angle",
    unusual="it takes any misfit of a place where nothing else stands",
    needs=("places", "camera"),
)


def _off_centre(state: Floats, parameters: Values) -> Floats:
    theta, c, s = state[..., 2], parameters["cosine"], parameters["sine"]
    measured = np.array(np.broadcast_to(state, (*np.broadcast_shapes(theta.shape, c.shape), 6)))
    measured[..., 2] += c * np.cos(theta) + s * np.sin(theta)
    measured[..., 5] *= 1.0 + s * np.cos(theta) - c * np.sin(theta)
    return measured


def _without_off_centre(measured: Floats, parameters: Values, tries: int = 30) -> Floats:
    state = np.array(measured)
    for _ in range(tries):  # a contraction where the measured angle grows with the angle
        off = _off_centre(state, parameters) - state
        state = np.where(np.arange(6) == 2, measured - off, np.broadcast_to(measured, off.shape))
    slope = _off_centre(np.where(np.arange(6) == 5, 1.0, state), parameters)[..., 5]
    state[..., 5] = measured[..., 5] / slope
    return np.asarray(state)


_HARMONIC = Prior("normal", sigma=0.03)

encoder_eccentricity = Effect(
    "encoder_eccentricity",
    (EffectParameter("cosine", "rad", _HARMONIC), EffectParameter("sine", "rad", _HARMONIC)),
    "the angle is measured too large on one side of the turn and too small on the other: the"
    " encoder's disc is off its centre",
    "first harmonic of an encoder's error, a cos(theta) + b sin(theta)",
    Sensor(_off_centre, _without_off_centre),
    applies=is_pivoted,
    log_odds=-6.0,
    family="place and angle",
    unusual="it takes any misfit of an angle; encoders are seldom off by as much",
    needs=("places", "theta"),
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
