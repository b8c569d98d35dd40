"""Numbers of models: rounded, in pairs, and turned."""

import math
from typing import Any

import numpy as np

from pbrl_ppl.state import Floats


def rotation(angle: float) -> Floats:
    """Return the matrix of a rotation in the plane (2, 2)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def rounded(value: float) -> float:
    """Return a number without the rounding errors of rotations."""
    return float(f"{float(value):.9g}") if abs(value) > 1e-12 else 0.0


def pair(point: Any) -> tuple[float, float]:
    """Return a point of the plane, rounded."""
    x, y = (rounded(round(float(value), 12)) for value in point)
    return x, y
