"""Scene -> a pymunk world whose masses, frictions and joint strengths can be set at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymunk
from pymunk import autogeometry

from pbrl_ppl.effects import hanging_body
from pbrl_ppl.physics.properties import COLUMN, Array
from pbrl_ppl.scene import WORLD, Body, Joint, Scene

#: Solver iterations: one body with nothing to touch needs few (its wheel or hinge is then solved to
#: rounding), a body among others the engine's default, a chain of joints more: about as many as a
#: body is heavier than another (with fewer, a heavy link below a light one gains energy).
ITERATIONS_ALONE, ITERATIONS, ITERATIONS_CHAINED = 5, 10, 30
ITERATIONS_A_RATIO, MOST_ITERATIONS = 2, 2000
#: Points of a ring that carry a body's weight, in units of its radius.
RING = tuple((math.cos(0.25 * i * math.pi), math.sin(0.25 * i * math.pi)) for i in range(8))
#: A point slower than so many times what friction takes from a speed in an engine step may stick.
#: (With a tenth, points that creep are held back across their way now and then: predictions jump.)
STICKING = 1.0
#: Allowed overlap of shapes (m); the engine's default is meant for pixels.
COLLISION_SLOP = 1e-4
#: Where bodies are parked (m), and for how long (s).
FAR, TINY = 1e5, 1e-9
#: How many times finer to step what comes near something, where there are hidden discs: their place
#: is sought, and must not hang on the substep in which a body stops.
FINER = 8
#: Radius of a disc that is not there (m).
NO_SIZE = 1e-9
#: Sizes of the engine's hash tables: the least that is more than what it holds.
_TABLES = (5, 13, 23, 47, 97, 193, 389, 769, 1543, 3079, 6151, 12289)
#: No body is this fast (m/s or rad/s): the engine has diverged.
DIVERGED = 1e6


@dataclass
class Wheel:
    """J_w: two rods from the wheel to the ground, each of which resists motion along itself.

    Their far ends are put on the wheel's axes, 1 m away, every substep; a rod is the engine's one
    joint that acts along a line and leaves motion across it alone. (Its groove joint does not:
    off-centre, it turns motion along the groove into a force across.)
    """

    body: int
    along_x: pymunk.PinJoint
    along_y: pymunk.PinJoint


@dataclass
class Link:
    """J_d: a rod, or a hinge where its length is zero."""

    joint: int
    constraint: pymunk.PinJoint | pymunk.PivotJoint

    @property
    def rod(self) -> bool:
        """Whether it has a length."""
        return isinstance(self.constraint, pymunk.PinJoint)


@dataclass
class Pivot:
    """Friction in a hinge, of the body that hangs in it."""

    body: int
    motor: pymunk.SimpleMotor
    damper: pymunk.DampedRotarySpring


@dataclass
class Patch:
    """Coulomb friction under a body, at points of a ring that share its weight.

    A point that slides is held back by a rod along its velocity, as strongly as friction can; one
    that rests, by a joint to the ground whose force is clipped as a vector. (That joint alone would
    not do: what it does to a sliding point is not against its motion, for it is solved in the
    metric of the point's inertia.) Both are placed every substep.
    """

    body: int
    holds: tuple[pymunk.PivotJoint, ...]
    rods: tuple[pymunk.PinJoint, ...]


class World:
    """One engine world with the scene's geometry in it.

    Parameters
    ----------
    scene : Scene
        Geometry, joints and gravity.
    hinges : tuple of bool
        Which joints have no length, one a joint.
    joined : tuple of (int, int)
        Which of ``scene.joinable`` each joint of unknown bodies holds, in the scene's order; a pair
        of equals is no joint.
    discs : int
        Static discs beside those of the scene; their places and sizes are properties.
    patches : tuple of int
        Bodies with friction under them.
    wheels : tuple of int
        Bodies with a wheel beside those of which the scene says so.
    rods : tuple of (int, int)
        Bodies that a rod ties to a place beside the scene's joints, and each rod's place among all
        joints.
    """

    def __init__(
        self,
        scene: Scene,
        hinges: tuple[bool, ...] = (),
        joined: tuple[tuple[int, int], ...] = (),
        discs: int = 0,
        patches: tuple[int, ...] = (),
        wheels: tuple[int, ...] = (),
        rods: tuple[tuple[int, int], ...] = (),
    ) -> None:
        self.scene = scene
        self.space = pymunk.Space()
        self.space.gravity = scene.gravity
        self.space.collision_slop = COLLISION_SLOP
        self.bodies: list[pymunk.Body] = []
        self.shapes: list[tuple[int, pymunk.Shape]] = []
        self.wheels: list[Wheel] = []
        self.links: list[Link] = []
        self.pivots: list[Pivot] = []
        self.discs: list[pymunk.Circle] = []
        self._by_name: dict[str, pymunk.Body] = {WORLD: self.space.static_body}
        self._add_fixed()
        for j in range(discs):
            away = -FAR, -FAR * (j + 1)
            self.discs.append(pymunk.Circle(self.space.static_body, NO_SIZE, away))
            self._add_static(self.discs[j])
        #: Which bodies go where they are told, at the velocities that their actions hold.
        self.kinematic = np.array([body.kinematic for body in scene.moving])
        for i, body in enumerate(scene.moving):
            kind = pymunk.Body.KINEMATIC if body.kinematic else pymunk.Body.DYNAMIC
            rigid = pymunk.Body(1.0, 1.0, kind)
            rigid.position = FAR * (i + 1.0), FAR
            self.bodies.append(rigid)
            self._by_name[body.name] = rigid
            self.space.add(rigid)
            self.shapes += [(i, shape) for shape in _shapes(body, rigid)]
            if body.wheel or i in wheels:
                self._add_wheel(i, rigid)
        self._add_shapes()
        self.can_touch = np.ones((len(self.bodies), len(self.bodies)), dtype=bool)
        self._add_joints(hinges, joined)
        for i, position in rods:
            self._add_link(position, self.bodies[i], self.space.static_body, False)
        self.patches = [self._new_patch(i) for i in patches]
        #: Which bodies that forces move are joined to other moving ones.
        self.chained = np.logical_not(self.can_touch.all(axis=1)) & ~self.kinematic
        alone = len(scene.bodies) == 1 and not scene.walls and not (discs or patches)
        self.iterations = (
            ITERATIONS_CHAINED if self.chained.any() else ITERATIONS_ALONE if alone else ITERATIONS
        )
        #: What the near-contact test needs: circles about bodies, and segments with a radius.
        self.radii = np.array([body.shape.bounding_radius for body in scene.moving])
        fixed = [(*wall.start, *wall.end, 0.0) for wall in scene.walls]
        fixed += [
            (*body.pose[:2], *body.pose[:2], body.shape.bounding_radius)
            for body in scene.bodies
            if body.static and body.pose is not None
        ]
        fixed += [(-FAR, -FAR, -FAR, -FAR, NO_SIZE)] * discs  # the last ones
        self.obstacles = np.array(fixed, dtype=float).reshape(-1, 5)

    def _add_shapes(self) -> None:
        """Add the moving shapes so that the contacts' order does not depend on earlier transitions.

        The engine numbers shapes as they are added and visits them by that number modulo the size
        of a hash table: the first must get a multiple of it, here and whenever they are added anew.
        """
        table = next(size for size in _TABLES if size > len(self.shapes))
        self.padding = -len(self.shapes) % table
        first = self.shapes[0][1]
        for _ in range(-len(self.space.shapes) % table):
            self.space.add(first)
            self.space.remove(first)
        for _, shape in self.shapes:
            self.space.add(shape)
        self.space.step(TINY)
        for body in self.bodies:
            body.velocity = (0.0, 0.0)

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
        ground = self.space.static_body
        along_x, along_y = (pymunk.PinJoint(body, ground, (0, 0), (0, 0)) for _ in range(2))
        for joint in (along_x, along_y):
            joint.max_bias = 0.0  # friction resists motion; it does not pull back
            joint.max_force = 0.0
        self.space.add(along_x, along_y)
        self.wheels.append(Wheel(index, along_x, along_y))

    def _new_patch(self, index: int) -> Patch:
        body, ground = self.bodies[index], self.space.static_body
        holds = tuple(pymunk.PivotJoint(body, ground, (0, 0), (0, 0)) for _ in RING)
        rods = tuple(pymunk.PinJoint(body, ground, (0, 0), (0, 0)) for _ in RING)
        for joint in (*holds, *rods):
            joint.max_bias = 0.0  # friction resists motion; it does not pull back
            joint.max_force = 0.0
        self.space.add(*holds, *rods)
        return Patch(index, holds, rods)

    def _add_joints(self, hinges: tuple[bool, ...], joined: tuple[tuple[int, int], ...]) -> None:
        """Hinges and rods; their anchors and lengths are properties."""
        pairs, names = iter(joined), self.scene.joinable
        for position, (joint, hinge) in enumerate(zip(self.scene.joints, hinges, strict=True)):
            bodies = joint.bodies
            if bodies is None:
                first, second = next(pairs)
                if first == second:  # i_a = i_b nullifies the joint
                    continue
                bodies = names[first], names[second]
            a, b = (self._by_name[name] for name in bodies)
            self._add_link(position, a, b, hinge)
            if joint.kind == "hinge" and joint.bodies is not None:
                self._add_pivot(joint, a, b)
            if a in self.bodies and b in self.bodies:
                i, j = self.bodies.index(a), self.bodies.index(b)
                self.can_touch[i, j] = self.can_touch[j, i] = False

    def _add_link(self, position: int, a: pymunk.Body, b: pymunk.Body, hinge: bool) -> None:
        kind = pymunk.PivotJoint if hinge else pymunk.PinJoint
        link = kind(a, b, (0, 0), (0, 0))
        link.error_bias = 0.0  # correct the whole drift every substep
        link.collide_bodies = False
        self.space.add(link)
        self.links.append(Link(position, link))

    def _add_pivot(self, joint: Joint, a: pymunk.Body, b: pymunk.Body) -> None:
        motor = pymunk.SimpleMotor(a, b, 0.0)
        motor.max_force = 0.0
        damper = pymunk.DampedRotarySpring(a, b, 0.0, 0.0, 0.0)
        self.space.add(motor, damper)
        hanging = self._by_name[hanging_body(self.scene, joint)]
        self.pivots.append(Pivot(self.bodies.index(hanging), motor, damper))

    def set_discs(self, discs: Array) -> None:
        """Place the hidden discs; x, y and radius, shape (disc, 3). One without radius is away.

        They are taken out and put back, for the order of contacts depends on the ways of static
        shapes to where they are.
        """
        first = len(self.obstacles) - len(self.discs)
        self.space.remove(*self.discs)
        for j, (shape, (x, y, radius)) in enumerate(zip(self.discs, discs, strict=True)):
            there = (x, y, radius) if radius > 0 else (-FAR, -FAR * (j + 1), NO_SIZE)
            shape.unsafe_set_offset(there[:2])
            shape.unsafe_set_radius(there[2])
            self.space.add(shape)
            self.obstacles[first + j] = (*there[:2], *there)

    def set_properties(self, bodies: Array, joints: Array) -> None:
        """Give the engine its numbers; shapes (body, column) and (joint, column)."""
        mass = bodies[self.chained, COLUMN["mass"]]
        ratio = mass.max() / mass.min() if len(mass) else 0.0
        enough = min(ITERATIONS_A_RATIO * ratio, MOST_ITERATIONS)
        self.space.iterations = max(self.iterations, int(enough))
        for i, body in enumerate(self.bodies):
            if self.kinematic[i]:
                continue
            body.mass = bodies[i, COLUMN["mass"]]
            body.moment = bodies[i, COLUMN["moment"]]
            body.center_of_gravity = bodies[i, COLUMN["com_x"]], bodies[i, COLUMN["com_y"]]
        for i, shape in self.shapes:
            shape.elasticity = bodies[i, COLUMN["r"]]
            shape.friction = bodies[i, COLUMN["mu_c"]]
        for wheel in self.wheels:
            row = bodies[wheel.body]
            load = row[COLUMN["mass"]] * self.scene.normal_gravity
            place = row[COLUMN["w_x"]], row[COLUMN["w_y"]]
            wheel.along_x.anchor_a = wheel.along_y.anchor_a = place
            wheel.along_x.max_force = row[COLUMN["mu_x"]] * load
            wheel.along_y.max_force = row[COLUMN["mu_y"]] * load
        for patch in self.patches:
            radius = bodies[patch.body, COLUMN["patch_radius"]]
            for (x, y), hold, rod in zip(RING, patch.holds, patch.rods, strict=True):
                hold.anchor_a = rod.anchor_a = x * radius, y * radius
        for link in self.links:
            a_x, a_y, b_x, b_y, length = joints[link.joint]
            link.constraint.anchor_a, link.constraint.anchor_b = (a_x, a_y), (b_x, b_y)
            if isinstance(link.constraint, pymunk.PinJoint):
                link.constraint.distance = length
        for pivot in self.pivots:
            pivot.motor.max_force = bodies[pivot.body, COLUMN["pivot_torque"]]
            pivot.damper.damping = bodies[pivot.body, COLUMN["pivot_damping"]]


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
