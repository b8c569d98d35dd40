"""Steady forces, cogging, and the mass that all forces move."""

import math

import numpy as np

from pbrl_ppl.effects.effect import (
    SIGNED,
    SIZE,
    Clock,
    Effect,
    EffectParameter,
    Force,
    Properties,
    Values,
    adding,
    measured,
)
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

_FORCES = EffectParameter.each("force_x", "force_y", unit="N", prior=SIGNED, scale="force")


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
    family="place and angle",
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
    family="place and angle",
    needs=("free",),  # in a hinge it is a tilt, or a weight
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
    needs=("theta",),
)


def _torque(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] += parameters[0]


constant_torque = Effect(
    "constant_torque",
    (EffectParameter("torque", "N m", SIGNED, scale="torque"),),
    "a steady twist in one direction, such as a torque sensor that is off zero",
    "Euler's second law with a constant torque",
    Force(_torque),
    family="place and angle",
)


def _moment_of_push(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    arm_x = c * parameters[0] - s * parameters[1]
    arm_y = s * parameters[0] + c * parameters[1]
    wrench[2] += arm_x * command[1] - arm_y * command[0]


push_offset = Effect(
    "push_offset",
    EffectParameter.each("offset_x", "offset_y", unit="m", prior=SIGNED, scale="length"),
    "the push acts at a point beside the body's centre, and so turns it as well",
    "moment of a force about a point, tau = r x F",
    Force(_moment_of_push),
    log_odds=-1.0,
    needs=("commands",),
)


def _cogging(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    phase = math.floor(parameters[2] + 0.5) * state[2]  # a whole number: an angle has no turns
    wrench[2] += parameters[0] * math.cos(phase) + parameters[1] * math.sin(phase)


def _scan_counts(scene: Scene, history: History, body: Body) -> Floats:
    """Return tooth counts to scan; the derivative is by the torques."""
    theta = measured(history, body, "theta")
    reach = min(np.ptp(theta), 2.0 * np.pi) if len(theta) else 0.0
    counts = [n for n in (2, 3, 4, 6, 8, 12) if 2.0 * np.pi < n * reach < 2.0 * np.pi * 12.0]
    return np.array([(np.nan, np.nan, n) for n in counts]).reshape(-1, 3)


cogging = Effect(
    "cogging",
    (
        *EffectParameter.each("cosine", "sine", unit="N m", prior=SIGNED, scale="torque"),
        EffectParameter("count", "1", Prior("log_normal", mu=1.5, sigma=1.0), null=2.0),
    ),
    "a torque that repeats several times in a turn: a motor's magnets, a bearing with flat spots",
    "cogging torque, a cos(n theta) + b sin(n theta)",
    Force(_cogging),
    scan=_scan_counts,
    log_odds=-3.0,
    family="place and angle",
    unusual="few drives have magnets or teeth that are felt beside their friction",
    needs=("places",),
)


_OFFSET = Prior("normal", sigma=0.2)
_SCALE = Prior("log_normal", mu=0.0, sigma=0.5)


def _scale_moment(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["moment_per_mass"] = properties["moment_per_mass"] * parameters["scale"]


inertia_scale = Effect(
    "inertia_scale",
    (EffectParameter("scale", "1", _SCALE, null=1.0),),
    "the body is easier or harder to turn than its outline suggests: mass is not spread evenly",
    "moment of inertia about the centroid as a free parameter",
    Properties(_scale_moment),
    log_odds=-2.0,
    unusual="the moment of inertia is mostly declared as free where it is not known",
)


com_offset = Effect(
    "com_offset",
    EffectParameter.each("x", "y", unit="m", prior=_OFFSET, scale="length"),
    "the centre of mass is not in the middle of the outline: mass is not spread evenly",
    "centre of mass of a rigid body, in the body's frame",
    adding(com_x="x", com_y="y"),
    log_odds=-1.0,
)


def _scale_mass(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    # the interval in which the mass changes is blended
    loaded = clock.after(parameters["time"]) * (clock.trajectory > parameters["trajectory"] - 0.5)
    properties["mass"] = properties["mass"] * (1.0 + (parameters["factor"] - 1.0) * loaded)


def _scan_begins(scene: Scene, history: History, body: Body, *, most: int = 20) -> Floats:
    """Return changes from some trajectory on, then in every trajectory from some time on.

    ``most``: trajectories, and times, of a change of mass, at most.
    """
    numbers = history.dataset["number"].to_numpy()
    last = float(np.nanmax(history.elapsed))
    grid = np.linspace(0, 1, most)
    between = numbers[1:] - 0.5
    begins = np.unique(np.quantile(between, grid, method="nearest")) if len(between) else between
    times = np.linspace(0, last, most + 2)[1:-1]
    changes = [(np.nan, begin, 0.0) for begin in begins] + [(np.nan, 0.0, time) for time in times]
    return np.array(changes).reshape(-1, 3)


mass_change = Effect(
    "mass_change",
    (
        EffectParameter("factor", "1", _SCALE, null=1.0),
        EffectParameter("trajectory", "1", Prior("half_normal", sigma=100.0)),
        EffectParameter("time", "s", SIZE, scale="time"),
    ),
    "the body is heavier or lighter from some trajectory, or some time, on: it carries a load",
    "a change point in the mass",
    Properties(_scale_mass, timed=True),
    scan=_scan_begins,
    log_odds=-8.0,
    unusual="few rigs lose or take up a load within a recording",
)
