"""Laws of motion of a fall, a pendulum and a slider: closed forms, or SciPy's integrator.

No engine of the package is used. Each law takes the body, the effect's coefficient, initial states
of shape (trajectory, state), times of shape (row,) in s and forces of shape (trajectory, row - 1)
in N, and returns positions of shape (trajectory, row, coordinate).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]

#: Gravity (m/s^2).
G = 9.81
#: Relative and absolute tolerance of the integrator.
RTOL, ATOL = 1e-10, 1e-12


@dataclass(frozen=True)
class Body:
    """A ball, a rod or a block.

    Parameters
    ----------
    mass : float
        Its mass (kg).
    size : tuple of float
        Radius of a ball; width and length of a rod; length and width of a block (m).
    hinge : float
        Distance of a rod's hinge from its centre (m).
    """

    mass: float
    size: tuple[float, ...]
    hinge: float = 0.0

    @property
    def inertia(self) -> float:
        """Moment of inertia of a rod about its hinge (kg m^2)."""
        return self.mass * ((self.size[0] ** 2 + self.size[1] ** 2) / 12 + self.hinge**2)


Law = Callable[[Body, float, Array, Array, Array], Array]


def integrated(rate: Callable[[Array], Array], start: Array, time: Array) -> Array:
    """Return the solution of an autonomous equation, shape (trajectory, row, state)."""

    def flat(at: float, state: Array) -> Array:
        return rate(state.reshape(start.shape)).ravel()

    found = solve_ivp(
        flat, (time[0], time[-1]), start.ravel(), "DOP853", time, rtol=RTOL, atol=ATOL
    )
    if not found.success:
        raise RuntimeError(f"the integrator stopped at {found.t[-1]:.3g} s: {found.message}")
    return found.y.T.reshape(len(time), *start.shape).swapaxes(0, 1)


def linear_fall(body: Body, coefficient: float, start: Array, time: Array, force: Array) -> Array:
    """Return x and y of a fall with the drag F = -c v; the start is x, y, vx, vy."""
    z = coefficient / body.mass * time
    small = np.abs(z) < 1e-3  # series: differences of nearly equal numbers otherwise
    safe = np.where(small, 1.0, z)
    first = np.where(small, 1 - z / 2 + z**2 / 6 - z**3 / 24, -np.expm1(-safe) / safe)
    second = np.where(
        small, 1 / 2 - z / 6 + z**2 / 24 - z**3 / 120, (1 + np.expm1(-safe) / safe) / safe
    )
    places = start[:, None, :2] + start[:, None, 2:] * (time * first)[:, None]
    places[..., 1] -= G * time**2 * second
    return places


def quadratic_fall(
    body: Body, coefficient: float, start: Array, time: Array, force: Array
) -> Array:
    """Return x and y of a fall with the drag F = -c abs(v) v; the start is x, y, vx, vy."""
    if coefficient == 0.0:
        return linear_fall(body, 0.0, start, time, force)

    def rate(state: Array) -> Array:
        velocity = state[:, 2:]
        speed = np.hypot(velocity[:, :1], velocity[:, 1:])
        return np.hstack([velocity, -coefficient / body.mass * speed * velocity - [0.0, G]])

    return integrated(rate, start, time)[..., :2]


def pendulum(body: Body, coefficient: float, start: Array, time: Array, force: Array) -> Array:
    """Return the angle of a rod with the torque -c omega in its hinge; the start: angle, rate."""
    pull, damping = body.mass * G * body.hinge / body.inertia, coefficient / body.inertia

    def rate(state: Array) -> Array:
        angle, turning = state.T
        return np.stack([turning, -pull * np.sin(angle) - damping * turning], axis=1)

    return integrated(rate, start, time)[..., :1]


def slider(body: Body, coefficient: float, start: Array, time: Array, force: Array) -> Array:
    """Return x of a block with dry friction, mu = c, on a line; the start is x, vx.

    In an interval the force is constant, and the block stops once at most: it then stays or turns.
    """
    x, v = start.T.copy()
    most = coefficient * G
    places = [x.copy()]
    for dt, push in zip(np.diff(time), force.T / body.mass, strict=True):
        remaining = np.full(len(x), dt)
        for _ in range(2):
            way = np.where(v != 0.0, np.sign(v), np.sign(push))
            rests = (v == 0.0) & (np.abs(push) <= most)
            a = np.where(rests, 0.0, push - most * way)
            brakes = v * a < 0.0
            span = np.minimum(remaining, np.where(brakes, -v / np.where(brakes, a, 1.0), np.inf))
            x = x + v * span + a * span**2 / 2
            v = np.where(brakes & (span < remaining), 0.0, v + a * span)
            remaining = remaining - span
        places.append(x.copy())
    return np.stack(places, axis=1)[..., None]


#: The laws, by the effect that their coefficient is the size of.
LAWS: dict[str, Law] = {
    "linear_drag": linear_fall,
    "quadratic_drag": quadratic_fall,
    "pivot_damping": pendulum,
    "sliding_friction": slider,
}
