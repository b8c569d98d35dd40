"""Names, units and order of a body's state and of the wrench on it; angles; array types."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

Angle = TypeVar("Angle", float, Floats)

#: A body's state: pose and velocity of its origin in the world frame.
STATE = ("x", "y", "theta", "vx", "vy", "omega")
STATE_UNITS = ("m", "m", "rad", "m/s", "m/s", "rad/s")
#: The part of the state that is a pose.
POSE = STATE[:3]
#: Where the state holds the angle, whose differences are wrapped.
THETA = STATE.index("theta")

#: Offset from a position to its velocity in the state.
VELOCITY = 3

#: A wrench at the body's origin, in the world frame.
WRENCH = ("force_x", "force_y", "torque")
WRENCH_UNITS = ("N", "N", "N m")

#: What acts in an interval: the wrench, the one before (zero before the first), the trajectory's
#: number, and the time in it at which the interval begins and ends (s).
INPUT = (*WRENCH, *(f"previous_{name}" for name in WRENCH), "trajectory", "begin", "end")


def acceleration_unit(velocity: str) -> str:
    """Return the unit of the acceleration of a velocity such as ``vx`` or ``omega``."""
    return "rad/s²" if velocity == "omega" else "m/s²"


def wrapped(angle: Angle) -> Angle:
    """Return an angle, or an array of any shape, in (-pi, pi] (rad).

    Examples
    --------
    >>> wrapped(np.array([0.5, 2 * np.pi - 0.5, -np.pi])).round(3)
    array([ 0.5  , -0.5  ,  3.142])
    """
    result: Angle = np.pi - np.mod(np.pi - angle, 2 * np.pi)
    return result


def turned(vectors: Floats, angle: Floats | float) -> Floats:
    """Return vectors (..., 2) turned by angles that broadcast with their leading axes."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)
