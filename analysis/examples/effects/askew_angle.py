"""An angle that a camera sees askew: too large in two opposite quarters of a turn, or too small.

measured angle = theta + cosine cos(2 theta) + sine sin(2 theta). A law of the sensor with an
inverse that is found step by step.
"""

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl import Sensor
from pbrl_ppl.effects import is_pivoted


def harmonic(theta, parameters):
    """Return what is added to an angle, and its derivative."""
    a, b = parameters["cosine"], parameters["sine"]
    c, s = np.cos(2.0 * theta), np.sin(2.0 * theta)
    return a * c + b * s, 2.0 * (b * c - a * s)


def measure(state, parameters):
    """Return what is measured of states (..., 6)."""
    x, y, theta, vx, vy, omega = np.moveaxis(state, -1, 0)
    off, slope = harmonic(theta, parameters)
    parts = (x, y, theta + off, vx, vy, omega * (1.0 + slope))
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def invert(measured, parameters):
    """Return the states of what is measured."""
    x, y, angle, vx, vy, rate = np.moveaxis(measured, -1, 0)
    theta = angle
    for _ in range(30):  # a contraction where the measured angle grows with the angle
        theta = angle - harmonic(theta, parameters)[0]
    omega = rate / (1.0 + harmonic(theta, parameters)[1])
    return np.stack(np.broadcast_arrays(x, y, theta, vx, vy, omega), axis=-1)


# of a camera that looks askew by an angle a it is (1 - cos a) / 2: 0.03 rad for 20 degrees
SIZE = pp.Prior("normal", sigma=0.03)

askew_angle = pp.Effect(
    "askew_angle",
    (pp.EffectParameter("cosine", "rad", SIZE), pp.EffectParameter("sine", "rad", SIZE)),
    "the angle is measured too large in two opposite quarters of the turn and too small in the"
    " others: the camera looks askew at the plane of motion",
    "second harmonic of a circle seen as an ellipse, a cos(2 theta) + b sin(2 theta)",
    Sensor(measure, invert),
    applies=is_pivoted,
    log_odds=-6.0,
    family="place and angle",
    unusual="it takes any misfit of an angle; few cameras look so askew",
    needs=("places", "camera"),
)
