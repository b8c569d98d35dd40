"""Scene -> a pymunk world whose masses, frictions and joint strengths can be set at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymunk
from pymunk import autogeometry

from pbrl_ppl.effects.base import hanging_body
from pbrl_ppl.physics.properties import COLUMN, Array
from pbrl_ppl.scene import WORLD, Body, Joint, Scene

#: Solver iterations: one body with nothing to touch needs few (its wheel or hinge is then solved to
#: rounding), a body among others the engine's default, a chain of joints more.
ITERATIONS_ALONE, ITERATIONS, ITERATIONS_CHAINED = 5, 10, 30
#: Allowed overlap of shapes (m); the engine's default is meant for pixels.
COLLISION_SLOP = 1e-4
#: Half the length of a wheel's groove (m): the wheel never leaves it within a substep.
GROOVE = 10.0
#: Where bodies are parked (m), and for how long (s).
FAR, TINY = 1e5, 1e-9
#: No body is this fast (m/s or rad/s): the engine has diverged.
DIVERGED = 1e6


@dataclass
class Wheel:
    """J_w: two grooves of a ground body that is put at the wheel's place every substep."""

    body: int
    ground: pymunk.Body
    along_x: pymunk.GrooveJoint  # resists motion along the wheel's y axis
    along_y: pymunk.GrooveJoint


@dataclass
class Pivot:
    """Friction in a hinge, of the body that hangs in it."""

    body: int
    motor: pymunk.SimpleMotor
    damper: pymunk.DampedRotarySpring


class World:
    """One engine world with the scene's geometry in it.

    Parameters
    ----------
    scene : Scene
        Geometry, joints and gravity.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.space = pymunk.Space()
        self.space.gravity = scene.gravity
        self.space.iterations = _iterations(scene)
        self.space.collision_slop = COLLISION_SLOP
        self.bodies: list[pymunk.Body] = []
        self.shapes: list[tuple[int, pymunk.Shape]] = []
        self.wheels: list[Wheel] = []
        self.joints: list[pymunk.Constraint] = []
        self.pivots: list[Pivot] = []
        self._by_name: dict[str, pymunk.Body] = {WORLD: self.space.static_body}
        for i, body in enumerate(scene.dynamic):
            rigid = pymunk.Body(1.0, 1.0)
            self.bodies.append(rigid)
            self._by_name[body.name] = rigid
            self.space.add(rigid)
            for shape in _shapes(body, rigid):
                self.shapes.append((i, shape))
                self.space.add(shape)
            if body.wheel:
                self._add_wheel(i, rigid)
        self._add_fixed()
        self._part()
        for joint in scene.joints:
            self._add_joint(joint)
        #: What the near-contact test needs: circles about bodies, and segments with a radius.
        self.radii = np.array([bounding_radius(body) for body in scene.dynamic])
        fixed = [(*wall.start, *wall.end, 0.0) for wall in scene.walls]
        fixed += [
            (*body.pose[:2], *body.pose[:2], bounding_radius(body))
            for body in scene.bodies
            if body.static and body.pose is not None
        ]
        self.obstacles = np.array(fixed, dtype=float).reshape(-1, 5)
        self.can_touch = np.ones((len(self.bodies), len(self.bodies)), dtype=bool)
        names = [body.name for body in scene.dynamic]
        for joint in scene.joints:
            if joint.bodies[0] in names and joint.bodies[1] in names:
                i, j = (names.index(name) for name in joint.bodies)
                self.can_touch[i, j] = self.can_touch[j, i] = False

    def _part(self) -> None:
        """Step once with the bodies far apart: pairs are then found in an order without a past."""
        for i, body in enumerate(self.bodies):
            body.position = (FAR * (i + 1.0), FAR)
        self.space.step(TINY)
        for body, declared in zip(self.bodies, self.scene.dynamic, strict=True):
            # the reference pose: a rod keeps the distance that its anchors have there
            x, y, body.angle = declared.pose or (0.0, 0.0, 0.0)
            body.position, body.velocity = (x, y), (0.0, 0.0)

    def _add_fixed(self) -> None:
        """Walls and static bodies; they carry 1, for the engine multiplies both shapes' values."""
        ground = self.space.static_body
        for wall in self.scene.walls:
            self._add_static(pymunk.Segment(ground, wall.start, wall.end, 0.0))
        for body in self.scene.bodies:
            if body.static and body.pose is not None:
                rigid = pymunk.Body(body_type=pymunk.Body.STATIC)
                rigid.position, rigid.angle = body.pose[:2], body.pose[2]
                self._by_name[body.name] = rigid
                self.space.add(rigid)
                for shape in _shapes(body, rigid):
                    self._add_static(shape)

    def _add_static(self, shape: pymunk.Shape) -> None:
        shape.elasticity = shape.friction = 1.0
        self.space.add(shape)

    def _add_wheel(self, index: int, body: pymunk.Body) -> None:
        ground = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        along_x = pymunk.GrooveJoint(ground, body, (-GROOVE, 0), (GROOVE, 0), (0, 0))
        along_y = pymunk.GrooveJoint(ground, body, (0, -GROOVE), (0, GROOVE), (0, 0))
        for joint in (along_x, along_y):
            joint.max_bias = 0.0  # friction resists motion; it does not pull back
            joint.max_force = 0.0
        self.space.add(ground, along_x, along_y)
        self.wheels.append(Wheel(index, ground, along_x, along_y))

    def _add_joint(self, joint: Joint) -> None:
        a, b = (self._by_name[name] for name in joint.bodies)
        if joint.kind == "distance":
            rod = pymunk.PinJoint(a, b, joint.anchor_a, joint.anchor_b)
            rod.error_bias = 0.0
            rod.collide_bodies = False
            self.space.add(rod)
            self.joints.append(rod)
            return
        hinge = pymunk.PivotJoint(a, b, joint.anchor_a, joint.anchor_b)
        hinge.error_bias = 0.0  # correct the whole drift every substep
        hinge.collide_bodies = False
        motor = pymunk.SimpleMotor(a, b, 0.0)
        motor.max_force = 0.0
        damper = pymunk.DampedRotarySpring(a, b, 0.0, 0.0, 0.0)
        self.space.add(hinge, motor, damper)
        self.joints.append(hinge)
        hanging = self._by_name[hanging_body(self.scene, joint)]
        self.pivots.append(Pivot(self.bodies.index(hanging), motor, damper))

    def set_properties(self, properties: Array) -> None:
        """Give every body its numbers; ``properties`` has shape (body, column)."""
        for i, body in enumerate(self.bodies):
            body.mass = properties[i, COLUMN["mass"]]
            body.moment = properties[i, COLUMN["moment"]]
        for i, shape in self.shapes:
            shape.elasticity = properties[i, COLUMN["r"]]
            shape.friction = properties[i, COLUMN["mu_c"]]
        for wheel in self.wheels:
            row = properties[wheel.body]
            load = row[COLUMN["mass"]] * self.scene.normal_gravity
            anchor = (row[COLUMN["w_x"]], row[COLUMN["w_y"]])
            wheel.along_x.anchor_b = wheel.along_y.anchor_b = anchor
            wheel.along_x.max_force = row[COLUMN["mu_y"]] * load
            wheel.along_y.max_force = row[COLUMN["mu_x"]] * load
        for pivot in self.pivots:
            pivot.motor.max_force = properties[pivot.body, COLUMN["pivot_torque"]]
            pivot.damper.damping = properties[pivot.body, COLUMN["pivot_damping"]]


def _iterations(scene: Scene) -> int:
    moving = {body.name for body in scene.dynamic}
    if any(moving.issuperset(joint.bodies) for joint in scene.joints):
        return ITERATIONS_CHAINED
    alone = len(scene.bodies) == 1 and not scene.walls
    return ITERATIONS_ALONE if alone else ITERATIONS


def _shapes(body: Body, rigid: pymunk.Body) -> list[pymunk.Shape]:
    """The engine's shapes of a body; a concave outline is cut into convex parts."""
    outline = body.shape.outline
    if outline is None:
        return [pymunk.Circle(rigid, float(body.shape.radius or 0.0))]
    if body.shape.kind == "box" or _is_convex(outline):
        return [pymunk.Poly(rigid, outline)]
    closed = [*outline, outline[0]]
    return [pymunk.Poly(rigid, part) for part in autogeometry.convex_decomposition(closed, 0.0)]


def _is_convex(outline: tuple[tuple[float, float], ...]) -> bool:
    n = len(outline)
    for i in range(n):
        (ax, ay), (bx, by), (cx, cy) = outline[i], outline[(i + 1) % n], outline[(i + 2) % n]
        if (bx - ax) * (cy - by) - (by - ay) * (cx - bx) < -1e-12:
            return False
    return True


def bounding_radius(body: Body) -> float:
    """Radius of the circle about the origin that holds the whole body (m)."""
    outline = body.shape.outline
    if outline is None:
        return float(body.shape.radius or 0.0)
    return max(math.hypot(x, y) for x, y in outline)
