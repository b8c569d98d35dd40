"""Drag: forces and torques that depend on the velocity."""

import math

import numpy as np

from pbrl_ppl.effects.effect import (
    SIGNED,
    SIZE,
    Effect,
    EffectParameter,
    Force,
    is_unpivoted,
    measured,
)
from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats


def _linear(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] -= parameters[0] * state[3]
    wrench[1] -= parameters[0] * state[4]


linear_drag = Effect(
    "linear_drag",
    (EffectParameter("coefficient", "kg/s", SIZE, scale="force/speed"),),
    "a force against the motion that grows with the speed, as in oil or at low speed in air",
    "Stokes' law, F = -c v",
    Force(_linear),
    family="drag",
)


def _quadratic(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    speed = math.sqrt(state[3] * state[3] + state[4] * state[4])
    wrench[0] -= parameters[0] * speed * state[3]
    wrench[1] -= parameters[0] * speed * state[4]


quadratic_drag = Effect(
    "quadratic_drag",
    (EffectParameter("coefficient", "kg/m", SIZE, scale="force/speed^2"),),
    "a force against the motion that grows with the square of the speed, as in air or water",
    "Rayleigh's drag equation, F = -c |v| v",
    Force(_quadratic),
    family="drag",
)


def _angular(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] -= parameters[0] * state[5]


angular_drag = Effect(
    "angular_drag",
    (EffectParameter("coefficient", "N m s", SIZE, scale="torque/turn_rate"),),
    "a torque against the rotation that grows with the angular speed",
    "viscous torque, tau = -c omega",
    Force(_angular),
    family="angular drag",
)


def _quadratic_angular(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] -= parameters[0] * abs(state[5]) * state[5]


quadratic_angular_drag = Effect(
    "quadratic_angular_drag",
    (EffectParameter("coefficient", "N m s^2", SIZE, scale="torque/turn_rate^2"),),
    "a torque against the rotation that grows with the square of the angular speed: a fan,"
    " a stirrer",
    "drag of a rotor, tau = -c |omega| omega",
    Force(_quadratic_angular),
    family="angular drag",
)


def _linear_by_axis(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    x = -parameters[0] * (c * state[3] + s * state[4])
    y = -parameters[1] * (c * state[4] - s * state[3])
    wrench[0] += c * x - s * y
    wrench[1] += s * x + c * y


drag_by_axis = Effect(
    "drag_by_axis",
    EffectParameter.each("along", "across", unit="kg/s", prior=SIZE, scale="force/speed"),
    "a force against the motion that grows with the speed and is another along the body than across"
    " it: a hull, a skid",
    "linear drag with two coefficients in the body's frame (T. I. Fossen, 2011)",
    Force(_linear_by_axis),
    log_odds=-1.0,
    family="drag",
    needs=("theta",),
)


def _quadratic_by_axis(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    x, y = c * state[3] + s * state[4], c * state[4] - s * state[3]
    x, y = -parameters[0] * abs(x) * x, -parameters[1] * abs(y) * y
    wrench[0] += c * x - s * y
    wrench[1] += s * x + c * y


quadratic_drag_by_axis = Effect(
    "quadratic_drag_by_axis",
    EffectParameter.each("along", "across", unit="kg/m", prior=SIZE, scale="force/speed^2"),
    "a force against the motion that grows with the square of the speed and is another along the"
    " body than across it",
    "cross-flow drag in the body's frame (T. I. Fossen, 2011)",
    Force(_quadratic_by_axis),
    applies=is_unpivoted,
    log_odds=-1.0,
    family="drag",
    needs=("theta",),
)


def _wind(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    x, y = state[3] - parameters[1], state[4] - parameters[2]
    speed = math.sqrt(x * x + y * y)
    wrench[0] -= parameters[0] * speed * x
    wrench[1] -= parameters[0] * speed * y


def _scan_winds(scene: Scene, history: History, body: Body) -> Floats:
    """Return winds in eight directions about the body's usual speed; the derivative is by drag."""
    velocity = measured(history, body, "vx", "vy")
    speed = np.sqrt((velocity**2).sum(axis=-1).mean()) if len(velocity) else 0.0
    turns = np.arange(8) * (np.pi / 4.0)
    winds = speed * np.outer((0.5, 1.5), np.exp(1j * turns)).ravel()
    return np.array([(np.nan, w.real, w.imag) for w in winds if speed > 0.0]).reshape(-1, 3)


wind = Effect(
    "wind",
    (
        EffectParameter("coefficient", "kg/m", SIZE, scale="force/speed^2"),
        *EffectParameter.each("wind_x", "wind_y", unit="m/s", prior=SIGNED, scale="speed"),
    ),
    "drag against air or water that moves itself: it grows with the square of the speed through it",
    "Rayleigh's drag equation, F = -c |v - w| (v - w)",
    Force(_wind),
    applies=is_unpivoted,
    scan=_scan_winds,
    log_odds=-3.0,
    unusual="indoors there is none, and a constant force with drag is the same",
)


def _magnus(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] -= parameters[0] * state[5] * state[4]
    wrench[1] += parameters[0] * state[5] * state[3]


magnus_force = Effect(
    "magnus_force",
    (EffectParameter("coefficient", "kg", SIGNED, scale="force/speed turn_rate"),),
    "a force across the motion that grows with the speed and the turning: a spinning body is drawn"
    " aside",
    "Magnus force, F = c omega x v",
    Force(_magnus),
    log_odds=-4.0,
    unusual="it needs a fast spin, and a camera that sees it",
    needs=("theta",),
)
