"""Drag: forces and torques that depend on the velocity."""

import math

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.parameters import Prior
from pbrl_ppl.state import Floats

#: At the typical motion such a law is of the order of the typical force or torque.
_TYPICAL = Prior("half_normal", sigma=1.0)


def _linear(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] -= parameters[0] * state[3]
    wrench[1] -= parameters[0] * state[4]


linear_drag = Effect(
    "linear_drag",
    (EffectParameter("coefficient", "kg/s", _TYPICAL, scale="force/speed"),),
    "a force against the motion that grows with the speed, as in oil or at low speed in air",
    "Stokes' law, F = -c v",
    Force(_linear),
)


def _quadratic(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    speed = math.sqrt(state[3] * state[3] + state[4] * state[4])
    wrench[0] -= parameters[0] * speed * state[3]
    wrench[1] -= parameters[0] * speed * state[4]


quadratic_drag = Effect(
    "quadratic_drag",
    (EffectParameter("coefficient", "kg/m", _TYPICAL, scale="force/speed^2"),),
    "a force against the motion that grows with the square of the speed, as in air or water",
    "Rayleigh's drag equation, F = -c |v| v",
    Force(_quadratic),
)


def _angular(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] -= parameters[0] * state[5]


angular_drag = Effect(
    "angular_drag",
    (EffectParameter("coefficient", "N m s", _TYPICAL, scale="torque/turn_rate"),),
    "a torque against the rotation that grows with the angular speed",
    "viscous torque, tau = -c omega",
    Force(_angular),
)


def _magnus(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] -= parameters[0] * state[5] * state[4]
    wrench[1] += parameters[0] * state[5] * state[3]


magnus_force = Effect(
    "magnus_force",
    (
        EffectParameter(
            "coefficient", "kg", Prior("normal", sigma=1.0), scale="force/speed turn_rate"
        ),
    ),
    "a force across the motion that grows with the speed and the turning: a spinning body is drawn"
    " aside",
    "Magnus force, F = c omega x v",
    Force(_magnus),
    log_odds=-4.0,
)
