"""Constant forces and torques, tilted gravity, and a push beside the body's centre."""

import math

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Clock, Force, Properties, Values
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

_TYPICAL = Prior("normal", sigma=1.0)
_FORCES = (
    EffectParameter("force_x", "N", _TYPICAL, scale="force"),
    EffectParameter("force_y", "N", _TYPICAL, scale="force"),
)


def _tilt(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    c, s = np.cos(parameters["angle"]), np.sin(parameters["angle"])
    x, y = properties["gravity_x"], properties["gravity_y"]
    properties["gravity_x"], properties["gravity_y"] = c * x - s * y, s * x + c * y


def _has_gravity(scene: Scene, body: Body) -> bool:
    return bool(np.any(scene.gravity))


gravity_tilt = Effect(
    "gravity_tilt",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.1)),),
    "gravity does not point where the log has its vertical: the rig or the camera is not level",
    "gravity turned by an angle",
    Properties(_tilt),
    applies=_has_gravity,
)


def _world_force(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] += parameters[0]
    wrench[1] += parameters[1]


constant_force = Effect(
    "constant_force",
    _FORCES,
    "a steady push in one direction of the room: the floor slopes, or a wind blows",
    "Newton's second law with a constant force",
    Force(_world_force),
)


def _body_force(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    wrench[0] += c * parameters[0] - s * parameters[1]
    wrench[1] += s * parameters[0] + c * parameters[1]


body_force = Effect(
    "body_force",
    _FORCES,
    "a steady push in one direction of the body itself, such as a motor that never quite stops",
    "Newton's second law with a force that turns with the body",
    Force(_body_force),
    log_odds=-1.0,
)


def _torque(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] += parameters[0]


constant_torque = Effect(
    "constant_torque",
    (EffectParameter("torque", "N m", _TYPICAL, scale="torque"),),
    "a steady twist in one direction, such as a torque sensor that is off zero",
    "Euler's second law with a constant torque",
    Force(_torque),
)


def _moment_of_push(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    arm_x = c * parameters[0] - s * parameters[1]
    arm_y = s * parameters[0] + c * parameters[1]
    wrench[2] += arm_x * command[1] - arm_y * command[0]


push_offset = Effect(
    "push_offset",
    (
        EffectParameter("offset_x", "m", _TYPICAL, scale="length"),
        EffectParameter("offset_y", "m", _TYPICAL, scale="length"),
    ),
    "the push acts at a point beside the body's centre, and so turns it as well",
    "moment of a force about a point, tau = r x F",
    Force(_moment_of_push),
    log_odds=-1.0,
)
