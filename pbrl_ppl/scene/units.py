"""Natural units of a body: typical sizes in which default priors and thresholds are numbers."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import Scene
from pbrl_ppl.scene.checks import PLACES, UNITS, nearest

#: Location and scale of the logarithm of a mass (kg) under Table 1, uninformative by default.
MASS_PRIOR = 1.0, 1.5


@dataclass(frozen=True)
class Units:
    """Natural units of a body, in SI units.

    Attributes
    ----------
    mass : float
        Its known mass, or its prior's median (kg).
    length : float
        Radius of its bounding circle or, if it is larger, its lever about a hinge (m).
    time : float
        Duration of the longest trajectory (s).
    force : float
        The largest of weight, commanded forces, and mass times acceleration (N).
    torque : float
        The larger of force times length and the commanded torques (N m).
    speed : float
        Root mean square speed (m/s).
    turn_rate : float
        Root mean square angular speed (rad/s).
    range : float
        Largest distance of a position from their mean (m).
    interval : float
        Sampling interval (s).
    x, y : float
        Mean position (m).

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> puck = Body("puck", Shape.circle(0.5), known={"mass": 2.0})
    >>> units = units_of(Scene(time_step=0.1, bodies=(puck,), gravity=(0, -10)), "puck")
    >>> units.force, units.of("force length^2"), units.of("mass/length")
    (20.0, 5.0, 4.0)
    """

    mass: float
    length: float
    time: float
    force: float
    torque: float
    speed: float
    turn_rate: float
    range: float
    interval: float
    x: float = 0.0
    y: float = 0.0

    def of(self, product: str) -> float:
        """Return a product of natural units, such as ``force/speed^2``, in SI units.

        Raises
        ------
        SceneError
            If a name is not one of the units.
        """
        value = 1.0
        for place, part in enumerate(product.split("/")):
            for factor in part.split():
                name, power = _factor(factor)
                value *= getattr(self, name) ** (-power if place else power)
        return value


def _factor(factor: str) -> tuple[str, int]:
    """Return the name and the power of a factor such as ``speed^2``."""
    match = re.fullmatch(r"([a-z_]+)(?:\^(\d+))?", factor)
    names = [name for name in UNITS if name not in PLACES]
    if match is None or match[1] not in names:
        raise SceneError(
            f"natural unit {factor!r} is unknown{nearest(factor, names)} (known:"
            f" {', '.join(names)}, with a power as in speed^2)"
        )
    return match[1], int(match[2] or 1)


def check_product(product: str) -> None:
    """Raise `SceneError` where a product of natural units cannot be read."""
    for factor in product.replace("/", " ").split():
        _factor(factor)


def units_of(scene: Scene, name: str) -> Units:
    """Return the natural units of a body: its ``typical``, and from the scene what that lacks.

    Raises
    ------
    SceneError
        If there is no such body.
    """
    body = scene.body(name)
    mass = dict(body.known).get("mass")
    if mass is None:  # the median of Table 1's log-normal
        mu = dict(dict(body.prior).get("mass", ())).get("mu", MASS_PRIOR[0])
        # more leaves the floating-point numbers, and such a prior is refused later
        mass = math.exp(min(mu, 30.0))
    length = max([body.shape.bounding_radius, *_levers(scene, name)])
    gravity = max(math.hypot(*scene.gravity), scene.normal_gravity)
    # range and duration of the motion where neither the scene nor a recording shows them
    extent, time, x, y = 10.0 * length, 100 * scene.time_step, 0.0, 0.0
    speed = math.sqrt(gravity * length) or length / time
    if scene.extent is not None:
        x_min, x_max, y_min, y_max = scene.extent
        x, y = (x_min + x_max) / 2, (y_min + y_max) / 2
        extent = max(length, math.hypot(x_max - x_min, y_max - y_min) / 2)
    force = mass * (gravity or speed**2 / length)
    torque, turn_rate, interval = force * length, speed / length, scene.time_step
    units = Units(mass, length, time, force, torque, speed, turn_rate, extent, interval, x, y)
    return replace(units, **dict(body.typical))


def motion_time(scene: Scene) -> float:
    """Return the shortest time in which a typical force changes a body's motion (s).

    It makes the typical speed, or moves the body by its length, whichever takes longer.
    """
    bodies = [units_of(scene, body.name) for body in scene.dynamic]
    return min(
        max(units.of("mass speed/force"), math.sqrt(units.of("mass length/force")))
        for units in bodies
    )


def state_sizes(scene: Scene) -> NDArray[np.float64]:
    """Return typical sizes of a state, shape (6,): those of the body that moves most.

    In the order of :data:`pbrl_ppl.state.STATE`: m, m, rad, m/s, m/s, rad/s.
    """
    bodies = [units_of(scene, body.name) for body in scene.dynamic]
    place, speed, rate = (
        max(getattr(units, name) for units in bodies) for name in ("range", "speed", "turn_rate")
    )
    return np.array([place, place, 1.0, speed, speed, rate])


def smallest_radius(scene: Scene) -> float:
    """Return the bounding radius of the smallest moving body (m)."""
    return min(body.shape.bounding_radius for body in scene.moving)


def body_sizes(scene: Scene) -> NDArray[np.float64]:
    """Return natural sizes of the state of each moving body, shape (body, 6), SI units.

    The radius of its bounding circle, 1 rad, and these in one sampling interval.
    """
    reach = np.array([body.shape.bounding_radius for body in scene.moving])
    pose = np.stack([reach, reach, np.ones_like(reach)], axis=1)
    return np.hstack([pose, pose / scene.time_step])


def _levers(scene: Scene, name: str) -> list[float]:
    """Return the distances (m) of a body's origin from the hinges that hold it."""
    anchors = [
        anchor
        for joint in scene.joints
        if joint.traits.pins_anchors and joint.bodies
        for owner, anchor in zip(joint.bodies, (joint.anchor_a, joint.anchor_b), strict=True)
        if owner == name and anchor is not None
    ]
    return [math.hypot(*anchor) for anchor in anchors]
