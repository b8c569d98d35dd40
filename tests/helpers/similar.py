"""Physically similar rigs: lengths, masses and times in other units, or another frame."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pbrl_ppl.history import History
from pbrl_ppl.parameters import BODY_PARAMETERS, Layout
from pbrl_ppl.scene import MASS_PRIOR, WORLD, Body, Joint, Scene, Shape, Wall
from pbrl_ppl.state import STATE, STATE_UNITS, WRENCH, WRENCH_UNITS

#: Powers of length, mass and time in the units of the package.
_POWERS = {"m": (1, 0, 0), "kg": (0, 1, 0), "s": (0, 0, 1), "N": (1, 1, -2)}
_POWERS |= {"1": (0, 0, 0), "rad": (0, 0, 0), "W": (2, 1, -3), "Hz": (0, 0, -1)}
#: SI units of the natural units of a body.
_TYPICAL = dict(mass="kg", length="m", time="s", force="N", torque="N m", speed="m/s")
_TYPICAL |= dict(turn_rate="rad/s", range="m", interval="s", x="m", y="m")


def factor(unit: str, length: float, mass: float, time: float) -> float:
    """Return the factor of a quantity with this unit, such as ``N s/m``."""
    powers = np.zeros(3)
    for place, part in enumerate(unit.split("/")):
        for name in part.split():
            name, _, power = name.partition("^")
            powers += (-1 if place else 1) * int(power or 1) * np.array(_POWERS[name])
    return length ** powers[0] * mass ** powers[1] * time ** powers[2]


def similar(scene: Scene, length: float, mass: float, time: float) -> Scene:
    """Return the scene with its lengths, masses and times multiplied; priors of masses follow.

    Priors that the scene gives for parameters of effects are left as they are.
    """

    def of(unit: str) -> float:
        return factor(unit, length, mass, time)

    def far(points):
        return tuple(length * x for x in points)

    def scaled(body: Body) -> Body:
        prior = {name: dict(hyper) for name, hyper in body.prior}
        for name in ("w_x", "w_y"):
            if name in prior:
                prior[name] = {key: length * value for key, value in prior[name].items()}
        known = {name: of(BODY_PARAMETERS[name]) * value for name, value in body.known}
        if not (body.static or body.kinematic or "mass" in known):
            default = dict(zip(("mu", "sigma"), MASS_PRIOR, strict=True))
            prior["mass"] = default | prior.get("mass", {})
            prior["mass"]["mu"] += math.log(mass)
        shape = Shape(
            body.shape.kind,
            size=body.shape.size and far(body.shape.size),
            radius=body.shape.radius and length * body.shape.radius,
            vertices=body.shape.vertices and tuple(far(corner) for corner in body.shape.vertices),
        )
        pose = body.pose and (*far(body.pose[:2]), body.pose[2])
        typical = {name: of(_TYPICAL[name]) * value for name, value in body.typical}
        return replace(body, shape=shape, pose=pose, known=known, prior=prior, typical=typical)

    units = dict(zip(STATE, STATE_UNITS, strict=True))
    return scene.replace(
        gravity=tuple(of("m/s^2") * g for g in scene.gravity),
        normal_gravity=of("m/s^2") * scene.normal_gravity,
        time_step=time * scene.time_step,
        bodies=tuple(scaled(body) for body in scene.bodies),
        walls=tuple(Wall(far(wall.start), far(wall.end)) for wall in scene.walls),
        joints=tuple(
            replace(
                joint,
                anchor_a=joint.anchor_a and far(joint.anchor_a),
                anchor_b=joint.anchor_b and far(joint.anchor_b),
            )
            for joint in scene.joints
        ),
        noise={name: of(units[name]) * sd for name, sd in scene.noise},
    )


def similar_states(states, length: float, mass: float, time: float) -> np.ndarray:
    """Return states (..., 6) of the similar rig."""
    return np.asarray(states) * [factor(unit, length, mass, time) for unit in STATE_UNITS]


def similar_wrench(wrench, length: float, mass: float, time: float) -> np.ndarray:
    """Return wrenches (..., 3) on the similar rig."""
    return np.asarray(wrench) * [factor(unit, length, mass, time) for unit in WRENCH_UNITS]


def similar_phi(phi, layout: Layout, length: float, mass: float, time: float) -> np.ndarray:
    """Return parameters (..., p) of the similar rig, by their units in the layout."""
    factors = [
        factor(block.unit, length, mass, time) for block in layout.blocks for _ in block.owners
    ]
    return np.asarray(phi) * factors


def similar_history(
    history: History, scene: Scene, length: float, mass: float, time: float
) -> History:
    """Return the history of the similar rig, as if it had been recorded there."""
    frame = history.to_dataframe()
    units = {**dict(zip(STATE, STATE_UNITS, strict=True)), "time": "s"}
    units |= dict(zip(WRENCH, WRENCH_UNITS, strict=True))
    for name, unit in units.items():
        frame[name] *= factor(unit, length, mass, time)
    return History.from_dataframe(frame, similar(scene, length, mass, time))


def framed(scene: Scene, place: Callable, turn: float = 0.0, mirrored: bool = False) -> Scene:
    """Return the scene in another frame, in which a point of the world is at ``place(point)``.

    ``turn`` (rad) is the angle of the frame's rotation. A mirror, along x, also flips the bodies:
    boxes and circles stay what they are.
    """
    flip = -1.0 if mirrored else 1.0

    def anchor(joint: Joint, side: int):
        point = (joint.anchor_a, joint.anchor_b)[side]
        if joint.bodies is not None and joint.bodies[side] == WORLD:
            return tuple(place(point))
        return (point[0], flip * point[1])

    def body(body: Body) -> Body:
        known = {
            name: value * (flip if name in ("w_y", "w_theta") else 1.0)
            for name, value in body.known
        }
        pose = body.pose and (*place(body.pose[:2]), flip * body.pose[2] + turn)
        return replace(body, known=known, pose=pose)

    return scene.replace(
        gravity=tuple(np.subtract(place(scene.gravity), place((0.0, 0.0)))),
        bodies=tuple(map(body, scene.bodies)),
        walls=tuple(Wall(tuple(place(w.start)), tuple(place(w.end))) for w in scene.walls),
        joints=tuple(
            replace(joint, anchor_a=anchor(joint, 0), anchor_b=anchor(joint, 1))
            for joint in scene.joints
        ),
    )


def in_frame(
    history: History,
    scene: Scene,
    turn: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
    later: float = 0.0,
    turns: int = 0,
    mirrored: bool = False,
) -> tuple[Scene, History]:
    """Return the scene and the history in another frame, with later time stamps.

    The frame is mirrored along x, then turned, then moved; angles have ``turns`` whole turns more.
    """
    c, s, flip = np.cos(turn), np.sin(turn), -1.0 if mirrored else 1.0
    frame = history.to_dataframe()
    for x, y in (("x", "y"), ("vx", "vy"), ("force_x", "force_y")):
        there = flip * frame[y]
        frame[x], frame[y] = c * frame[x] - s * there, s * frame[x] + c * there
    for name in ("theta", "omega", "torque"):
        frame[name] *= flip
    frame["x"] += shift[0]
    frame["y"] += shift[1]
    frame["theta"] += turn + 2 * np.pi * turns
    frame["time"] += later

    def place(point):
        x, y = point[0], flip * point[1]
        return c * x - s * y + shift[0], s * x + c * y + shift[1]

    moved = framed(scene, place, turn, mirrored)
    return moved, History.from_dataframe(frame, moved)
