"""A measurement that moves away steadily: a gyroscope's integral, a tag that slips.

measured = state + (x, y, theta) t, with the time t since the trajectory's start; the velocities are
off by the rates. A law of the sensor that depends on the time.
"""

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl import Sensor


def drift(parameters):
    """Return what has been added to a state; a body in a hinge has the angle's rate alone."""
    time = np.where(np.isfinite(parameters["time"]), parameters["time"], 0.0)
    rates = [parameters.get(name, np.zeros(())) for name in ("x", "y", "theta")]
    parts = [rate * time for rate in rates] + rates
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def measure(state, parameters):
    """Return what is measured of states (..., 6); the parameters have the time beside the rates."""
    return state + drift(parameters)


def invert(measured, parameters):
    """Return the states of what is measured."""
    return measured - drift(parameters)


RATE = pp.Prior("normal", sigma=0.1)

sensor_drift = pp.Effect(
    "sensor_drift",
    (
        pp.EffectParameter("x", "m/s", RATE, scale="range/time", hinged=False),
        pp.EffectParameter("y", "m/s", RATE, scale="range/time", hinged=False),
        pp.EffectParameter("theta", "rad/s", RATE, scale="/time"),
    ),
    "what is measured moves away steadily from the start of each trajectory on: a gyroscope's"
    " integral, a tag that slips",
    "sensor drift, x + a t",
    Sensor(measure, invert, timed=True),
    log_odds=-4.0,
    unusual="encoders and cameras do not drift within a recording",
)
