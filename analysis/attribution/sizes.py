"""Sizes of effects: from a strength relative to the body to the generator's arguments."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

from attribution.bodies import ARM, CART, CHAIN, HINGED, LEVER, PAIR, PUCK, SLED, Body, Hidden, mh

#: Effects of the catalogue that make sense on a body. `heavy_tails` is on none: the loop scores the
#: noise's shape and never adds it. An asterisk: where a motor turns it. The attractor has left the
#: catalogue: it is drawn, so that all else is drawn as it was, and its cases are left out.
_FORCES = (
    "linear_drag", "quadratic_drag", "angular_drag", "constant_force", "body_force",
    "constant_torque", "push_offset", "magnus_force", "spring", "torsion_spring",
    "point_attractor",
)  # fmt: skip
_COMMANDS = (
    "actuator_rotation", "actuator_delay", "anisotropic_gain", "torque_gain", "dead_zone",
    "force_cutoff", "saturation",
)  # fmt: skip
_PUSHED = (*_FORCES, *_COMMANDS, "inertia_scale", "mass_change", "sensor_bias", "frame_rotation")
_PIVOT = ("pivot_damping", "pivot_friction", "gravity_tilt", "constant_torque", "torsion_spring")
_MOTOR = ("torque_gain", "actuator_delay")
EFFECTS: dict[str, tuple[str, ...]] = {
    CART: (*_PUSHED, "sliding_friction", "hidden_obstacle", "sensor_scale"),
    PUCK: (*_PUSHED, "sliding_friction", "hidden_obstacle", "wheel", "distance_joint"),
    SLED: (*_PUSHED, "com_offset"),
    ARM: (*_PIVOT, *_MOTOR, "quadratic_drag", "sensor_bias", "sensor_scale"),
    LEVER: (*_PIVOT, *_MOTOR, "quadratic_drag", "com_offset", "sensor_bias"),
    PAIR: (
        "linear_drag", "angular_drag", "constant_force", "constant_torque", "actuator_rotation",
        "push_offset", "sliding_friction", "inertia_scale",
    ),
    CHAIN: ("pivot_damping", "pivot_friction", "constant_torque", "torsion_spring"),
}  # fmt: skip
_SLIDING = ("cubic_drag", "corrugation", "swirl_drag", "actuator_lag")
_DRY = ("stribeck", "stiction_patch")
#: Effects that no catalogue has.
OUTSIDE_OF: dict[str, tuple[str, ...]] = {
    CART: (*_SLIDING, *_DRY), PUCK: (*_SLIDING, *_DRY), SLED: _SLIDING, ARM: ("cubic_drag",),
    LEVER: ("cubic_drag",),
}  # fmt: skip
#: Effects of which the likelihood ratio is not in proportion to the square of the strength.
STEPS = {"dead_zone", "force_cutoff", "saturation", "hidden_obstacle", "distance_joint"}
#: The strongest: as much as all else on the body.
STRONGEST = 1.0


def makes_sense(effect: str, body: Body) -> bool:
    """Return whether an effect applies to this body and is not declared already."""
    idle = body.sort in HINGED and not body.setups[0].wrench_sd[2]
    # a patch's radius absorbs what scales the moment of inertia
    absorbed = {"inertia_scale", "torque_gain"} if dict(body.base).get("sliding_friction") else ()
    return not (idle and effect in _MOTOR) and effect not in (*dict(body.base), *absorbed)


def value(effect: str, body: Body, on: str, strength: float, turn: float) -> Hidden:
    """Return the generator's argument for an effect of this strength.

    Parameters
    ----------
    effect : str
        Its name.
    body, on : Body, str
        What it is on.
    strength : float
        Its force or torque over the body's usual ones; of angles, gains and shares itself.
    turn : float
        Direction of what has one (rad); below pi, gains are above 1 and signs are positive.
    """
    setup = body.setups[body.names.index(on)]
    return _VALUES[effect](_Scale(setup), strength, cmath.exp(1j * turn))


class _Scale:
    """Usual force (N), torque (N m), speeds (m/s, rad/s) and sizes (m, s) of a body."""

    def __init__(self, setup: mh.Setup) -> None:
        self.setup, self.length, self.mass = setup, setup.size[0], setup.mass
        self.seconds = setup.n_intervals * setup.time_step
        self.weight = setup.mass * mh.NORMAL_GRAVITY
        self.omega = setup.start_sd[2]
        if setup.hinge is None:
            self.force, self.torque = setup.wrench_sd[0], setup.wrench_sd[2]
            self.speed = setup.start_sd[0]
        else:
            lever = abs(setup.hinge)
            self.force, self.torque = self.weight, self.weight * lever
            self.speed = self.omega * lever


def _gain(strength: float, way: complex) -> float:
    return 1 + strength if way.imag > 0 else 1 / (1 + strength)


def _signed(strength: float, way: complex) -> float:
    return math.copysign(strength, way.imag)


def _pair(size: float, way: complex) -> tuple[float, float]:
    return size * way.real, size * way.imag


def _load(scale: _Scale, strength: float, way: complex) -> Hidden:
    """Draw a load from some trajectory on, or from some time on in each trajectory."""
    if way.real > 0:
        return 1 + strength, float(scale.setup.n_train // 2), 0.0
    return 1 + strength, 0.0, round(0.4 * scale.seconds, 3)


def _disc(scale: _Scale, strength: float, way: complex) -> Hidden:
    """Draw a disc away from the start positions, within a metre of the middle along each axis."""
    radius = 0.4 * strength
    return *_pair(1.5 + radius + 0.5 * math.hypot(*scale.setup.size), way), radius


def _bias(scale: _Scale, strength: float, way: complex) -> Hidden:
    if scale.setup.hinge is not None:
        return 0.0, 0.0, _signed(strength, way), 0.0, 0.0, 0.0
    speeds = _pair(strength * scale.speed, way)
    return 0.0, 0.0, 0.0, *speeds, strength * scale.omega


#: Values by name, of the body's scale, the strength and the direction.
_VALUES: dict[str, Callable[[_Scale, float, complex], Hidden]] = {
    "linear_drag": lambda b, s, way: s * b.force / b.speed,
    "quadratic_drag": lambda b, s, way: s * b.force / b.speed**2,
    "angular_drag": lambda b, s, way: s * b.torque / b.omega,
    "constant_force": lambda b, s, way: _pair(s * b.force, way),
    "body_force": lambda b, s, way: _pair(s * b.force, way),
    "constant_torque": lambda b, s, way: _signed(s * b.torque, way),
    "push_offset": lambda b, s, way: _pair(s * b.torque / b.force, way),
    "magnus_force": lambda b, s, way: _signed(s * b.force / b.speed / b.omega, way),
    "spring": lambda b, s, way: (s * b.force, *_pair(1.0, way)),
    "torsion_spring": lambda b, s, way: (s * b.torque, 0.5 * way.real),
    "point_attractor": lambda b, s, way: (s * b.force, *_pair(1.0, way), 0.3),
    "actuator_rotation": lambda b, s, way: _signed(s, way),
    "actuator_delay": lambda b, s, way: min(s, 0.95),
    "anisotropic_gain": lambda b, s, way: (_gain(s, way), 1.0),
    "torque_gain": lambda b, s, way: _gain(s, way),
    "dead_zone": lambda b, s, way: 0.8 * s * b.force,
    "force_cutoff": lambda b, s, way: 1.5 * s * b.force,
    "saturation": lambda b, s, way: (2.6 - 2.2 * s) * b.force,
    "inertia_scale": lambda b, s, way: _gain(s, way),
    "mass_change": _load,
    "sensor_bias": _bias,
    "sensor_scale": lambda b, s, way: (1.0, _gain(s, way)),
    "frame_rotation": lambda b, s, way: _signed(s, way),
    "sliding_friction": lambda b, s, way: (s * b.force / b.weight, 0.3 * b.length),
    "hidden_obstacle": _disc,
    "wheel": lambda b, s, way: (
        *_pair(0.2 * b.length, way), 0.4, 0.1 * s * b.force / b.weight, s * b.force / b.weight,
    ),
    "distance_joint": lambda b, s, way: (0.2 * b.length, 0.1 * b.length, *_pair(1.0, way), 3 * s),
    "com_offset": lambda b, s, way: _pair(0.3 * s * b.length, way),
    "pivot_damping": lambda b, s, way: s * b.torque / b.omega,
    "pivot_friction": lambda b, s, way: s * b.torque,
    "gravity_tilt": lambda b, s, way: _signed(s, way),
    "cubic_drag": lambda b, s, way: s * b.force / b.speed**3,
    "corrugation": lambda b, s, way: (s * b.force, 0.3),
    "swirl_drag": lambda b, s, way: s * b.torque / b.omega / b.speed,
    "actuator_lag": lambda b, s, way: s * b.setup.time_step,
    "stribeck": lambda b, s, way: (s * b.force, 0.5 * b.speed),
    "stiction_patch": lambda b, s, way: s * b.force / b.weight,
}  # fmt: skip
