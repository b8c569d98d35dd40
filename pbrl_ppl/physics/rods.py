"""Start states of bodies on rods that effects add: as measured, they are off them by the noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Newton's steps: each squares what is left of a millimetre in a metre.
_STEPS = 3


def on_rod(states: Array, rod: Array, unit_moment: float) -> Array:
    """Move a body the least way onto its rod, and take from its velocity what would stretch it.

    Left to the engine, the former would be the work of one of its steps, however short: the
    shorter, the faster it throws the body about.

    Parameters
    ----------
    states : ndarray
        Of one body, shape (proposal, transition, 6).
    rod : ndarray
        Ends, on the body and in the world, and length, shape (proposal, 5), m; one without length
        moves nothing.
    unit_moment : float
        The body's moment of inertia for each unit of mass (m^2).

    Returns
    -------
    ndarray
        The same shape.

    Examples
    --------
    >>> on_rod(np.array([[[1.1, 0.0, 0.0, 0.3, 1.0, 0.0]]]), np.array([[0, 0, 0, 0, 1.0]]), 0.1)
    array([[[1., 0., 0., 0., 1., 0.]]])
    """
    there = rod[:, -1] > 0
    if not there.any():
        return states
    held, (a_x, a_y, b_x, b_y, length) = states[there], rod[there].T[..., None]

    def ahead() -> tuple[Array, Array, Array, Array, Array]:
        """Distance, direction (x, y), lever, and the inverse mass along it."""
        c, s = np.cos(held[..., 2]), np.sin(held[..., 2])
        arm_x, arm_y = c * a_x - s * a_y, s * a_x + c * a_y
        x, y = held[..., 0] + arm_x - b_x, held[..., 1] + arm_y - b_y
        distance = np.maximum(np.hypot(x, y), 1e-9)
        n_x, n_y = x / distance, y / distance
        lever = arm_x * n_y - arm_y * n_x
        return distance, n_x, n_y, lever, 1.0 + lever**2 / unit_moment

    def pushed(impulse: Array, first: int, n_x: Array, n_y: Array, lever: Array) -> None:
        held[..., first] += impulse * n_x
        held[..., first + 1] += impulse * n_y
        held[..., first + 2] += impulse * lever / unit_moment

    for _ in range(_STEPS):
        distance, n_x, n_y, lever, inverse_mass = ahead()
        pushed((length - distance) / inverse_mass, 0, n_x, n_y, lever)
    _, n_x, n_y, lever, inverse_mass = ahead()
    speed = held[..., 3] * n_x + held[..., 4] * n_y + held[..., 5] * lever
    pushed(-speed / inverse_mass, 3, n_x, n_y, lever)
    result = states.copy()
    result[there] = held
    return result
