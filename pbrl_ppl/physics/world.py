"""The pymunk world of a scene, the kinds of joints and constraints in it, and what can be set."""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
import pymunk
from pymunk import autogeometry

from pbrl_ppl.effects import hanging_body
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, smallest_radius
from pbrl_ppl.state import Bools, Floats


def columns(names: str | Iterable[str], width: int = 1) -> Any:
    """Return where columns of a width begin, by their names; a string has spaces between them."""
    found = namedtuple("Columns", names)  # type: ignore[misc]
    return found(*range(0, width * len(found._fields), width))


#: Columns of a body's properties. ``moment`` is about the centre of mass (kg m^2), which is at
#: ``com_x`` and ``com_y`` of the body's frame (m); ``pivot_torque`` (N m) and ``pivot_damping``
#: (N m s) act in the body's hinge (along its slider: N and N s/m), ``turn_torque`` (N m) against
#: any turning of a free one; ``patch_mu`` (1) and ``patch_radius`` (m) describe the friction under
#: it, ``extra_gravity_x`` and ``extra_gravity_y`` (m/s^2) are added to the scene's gravity.
COLUMNS = (
    *BODY_PARAMETERS,
    *("moment", "pivot_torque", "pivot_damping", "turn_torque", "patch_mu", "patch_radius"),
    *("extra_gravity_x", "extra_gravity_y", "com_x", "com_y"),
)
#: Index of each column, by name.
COLUMN = columns(COLUMNS)
#: Columns of a joint's numbers: its anchors and its length; of a slider, the ends of its line in
#: the first body's frame (m).
JOINT_COLUMNS = (*JOINT_ANCHORS, "length", "low_x", "low_y", "high_x", "high_y")
JOINT = columns(JOINT_COLUMNS)
#: Points of a ring that carry a body's weight, in units of the ring's radius.
RING = tuple((math.cos(0.25 * i * math.pi), math.sin(0.25 * i * math.pi)) for i in range(8))
#: Bounding radius (m) and engine time (s) of the shopping cart, for which the engine's treatment of
#: overlaps was chosen.
_CART = math.hypot(0.45, 0.275)
_CART_TIME = math.sqrt(_CART / 9.81)
#: Duration of the step that forgets contacts, in sampling intervals.
TINY = 1e-9
#: Refinement of the substeps near contacts in a scene with hidden discs: a disc's inferred place
#: must not depend on the substep in which a body stops.
FINER = 8


class Setting(NamedTuple):
    """A property of a pymunk constraint, the C function that sets it, and the columns it takes.

    The columns are those of a joint's numbers, or of a body's for a constraint of a body. With
    ``weighted`` the number is multiplied by the body's weight.
    """

    attribute: str
    function: str
    columns: tuple[int, ...]
    weighted: bool = False


@dataclass(frozen=True)
class EngineJoint:
    """What a kind of joint is in the engine.

    A new kind is one more entry of :data:`JOINT_KINDS`, and a kind of link in `tree_of`.

    Attributes
    ----------
    constraint : callable
        Makes the pymunk constraint of two bodies, with both anchors at their origins.
    settings : tuple of Setting
        Properties of the constraint, in the order in which they are set.
    friction : str
        The body's constraints by which friction and damping act in it: see `world`. None without.
    gap : callable
        Distance of the anchors from that in the reference poses (m); they meet by default.
    """

    constraint: Callable[[pymunk.Body, pymunk.Body], pymunk.Constraint]
    settings: tuple[Setting, ...]
    friction: str = ""
    gap: Callable[[float], float] = lambda distance: 0.0


def _anchors(name: str, x: int, y: int) -> tuple[Setting, ...]:
    """Return the settings of both anchors; ``x`` and ``y`` are columns of the first body's."""
    return (
        Setting("anchor_a", f"{name}SetAnchorA", (x, y)),
        Setting("anchor_b", f"{name}SetAnchorB", (JOINT.b_x, JOINT.b_y)),
    )


HINGE = EngineJoint(
    constraint=lambda a, b: pymunk.PivotJoint(a, b, (0, 0), (0, 0)),
    settings=_anchors("cpPivotJoint", JOINT.a_x, JOINT.a_y),
    friction="pivot",
)
ROD = EngineJoint(
    constraint=lambda a, b: pymunk.PinJoint(a, b, (0, 0), (0, 0)),
    settings=(
        *_anchors("cpPinJoint", JOINT.a_x, JOINT.a_y),
        Setting("distance", "cpPinJointSetDist", (JOINT.length,)),
    ),
    gap=lambda distance: distance,
)
#: Right for bodies that never turn alone: see `never_turning`.
SLIDER = EngineJoint(
    constraint=lambda a, b: pymunk.GrooveJoint(a, b, (-1, 0), (1, 0), (0, 0)),
    settings=(
        Setting("groove_a", "cpGrooveJointSetGrooveA", (JOINT.low_x, JOINT.low_y)),
        Setting("groove_b", "cpGrooveJointSetGrooveB", (JOINT.high_x, JOINT.high_y)),
        Setting("anchor_b", "cpGrooveJointSetAnchorB", (JOINT.b_x, JOINT.b_y)),
    ),
    friction="rail",
)
#: Every kind that a scene can declare.
JOINT_KINDS = {"hinge": HINGE, "slider": SLIDER, "distance": ROD}


def never_turning(scene: Scene) -> Bools:
    """Return the moving bodies that sliders alone tie to what is fixed, shape (body,).

    They keep their reference angles: their moments of inertia do not matter.
    """
    reached = {WORLD, *(body.name for body in scene.bodies if body.static)}
    pairs = [set(joint.bodies or ()) for joint in scene.joints if joint.traits.slides]
    for _ in pairs:
        for pair in pairs:
            reached |= pair if pair & reached else set()
    return np.array([body.name in reached and not body.kinematic for body in scene.moving])


class ConstraintKind(NamedTuple):
    """What a constraint on a body is in the engine: a maker, properties, a limit of its force.

    ``joint_settings`` are those properties that are numbers of the joint in which it acts.
    """

    constraint: Callable[[pymunk.Body, pymunk.Body], pymunk.Constraint]
    settings: tuple[Setting, ...]
    limited: bool = True
    joint_settings: tuple[Setting, ...] = ()


def _strength(column: int, *, weighted: bool = False) -> tuple[Setting, ...]:
    """Return the setting of a constraint's greatest force by a column of the body."""
    return (Setting("max_force", "cpConstraintSetMaxForce", (column,), weighted),)


def _motor(column: int) -> ConstraintKind:
    """Return the kind of friction against turning, by the column of its greatest torque."""
    return ConstraintKind(lambda a, b: pymunk.SimpleMotor(a, b, 0.0), _strength(column))


#: The place of a wheel on its body.
_HUB = Setting("anchor_a", "cpPinJointSetAnchorA", (COLUMN.w_x, COLUMN.w_y))
#: Beside joints, two kinds of constraints on a body for each use, with their settings.
#:
#: ``wheel`` is the constraint J_w: two rods to the ground, each with limited force. Every substep,
#: their far ends are put on the wheel's axes, 1 m away. A rod is the engine's only joint that
#: resists motion along a line and leaves motion across it alone. (Off-centre, its groove joint
#: turns motion along the groove into a force across it.)
#:
#: ``pivot`` is friction and damping in a hinge, with the parameters of the hanging body, and
#: ``turning`` friction against the turning of a free one.
#:
#: ``rail`` is the same in a slider: a rod with limited force, and a damper, along its line to an
#: end that is far away.
#:
#: ``patch`` is Coulomb friction under a body, at points of a ring that share its weight. A pivot
#: joint to the ground, whose force is limited as a vector, holds a point if it rests; a rod along
#: its velocity brakes it if it slides. (The pivot joint alone would not do: its force on a sliding
#: point is not opposite to the motion, because the engine solves it in the metric of the point's
#: inertia.) Both get their strength every substep.
BODY_CONSTRAINTS = {
    "wheel": tuple(
        ConstraintKind(ROD.constraint, (_HUB, *_strength(friction, weighted=True)))
        for friction in (COLUMN.mu_x, COLUMN.mu_y)
    ),
    "pivot": (
        _motor(COLUMN.pivot_torque),
        ConstraintKind(
            lambda a, b: pymunk.DampedRotarySpring(a, b, 0.0, 0.0, 0.0),
            (Setting("damping", "cpDampedRotarySpringSetDamping", (COLUMN.pivot_damping,)),),
            limited=False,
        ),
    ),
    "turning": (_motor(COLUMN.turn_torque),),
    "rail": (
        ConstraintKind(
            ROD.constraint,
            _strength(COLUMN.pivot_torque),
            joint_settings=_anchors("cpPinJoint", JOINT.high_x, JOINT.high_y),
        ),
        ConstraintKind(
            lambda a, b: pymunk.DampedSpring(a, b, (0, 0), (0, 0), 0.0, 0.0, 0.0),
            (Setting("damping", "cpDampedSpringSetDamping", (COLUMN.pivot_damping,)),),
            limited=False,
            joint_settings=_anchors("cpDampedSpring", JOINT.high_x, JOINT.high_y),
        ),
    ),
    "patch": tuple(
        ConstraintKind(
            kind.constraint, (Setting("anchor_a", function, 2 * (COLUMN.patch_radius,)),)
        )
        for kind, function in ((HINGE, "cpPivotJointSetAnchorA"), (ROD, "cpPinJointSetAnchorA"))
    ),
}


class Placed(NamedTuple):
    """A setting of a constraint in a world."""

    constraint: pymunk.Constraint
    setting: Setting
    row: int  # of the bodies' or of the joints' numbers
    scale: tuple[float, float] = (1.0, 1.0)  # of a vector


class OnBody(NamedTuple):
    """The kinds of constraints on a body: one each of a wheel, one a point of a patch."""

    body: int
    first: tuple[pymunk.Constraint, ...]
    second: tuple[pymunk.Constraint, ...] = ()


class Link(NamedTuple):
    """Joint constraint J_d, its kind and its row among all joints.

    ``pivot`` is the body whose friction acts in it, -1 for none; ``axis`` the direction of a slider
    in the bodies' reference poses (rad).
    """

    joint: int
    kind: EngineJoint
    constraint: pymunk.Constraint
    pivot: int
    axis: float = 0.0


class World:
    """One engine world with the scene's geometry.

    Parameters
    ----------
    scene : Scene
        Geometry, joints and gravity.
    kinds : tuple of EngineJoint
        Kind of each of the scene's joints in the engine.
    joined : tuple of (int, int)
        Indices into ``scene.joinable`` of the bodies of each joint of unknown bodies, in the
        scene's order; two equal indices mean no joint.
    discs : int
        Number of hidden static discs; their places and sizes are properties.
    patches : tuple of int
        Bodies with friction under them.
    wheels, turners : tuple of int
        Bodies with a wheel that an effect adds, and with friction against turning.
    rods : tuple of (int, int)
        Body and row among all joints of each rod that an effect adds.
    """

    def __init__(
        self,
        scene: Scene,
        kinds: tuple[EngineJoint, ...] = (),
        joined: tuple[tuple[int, int], ...] = (),
        discs: int = 0,
        patches: tuple[int, ...] = (),
        wheels: tuple[int, ...] = (),
        turners: tuple[int, ...] = (),
        rods: tuple[tuple[int, int], ...] = (),
    ) -> None:
        self.scene = scene
        self.space = pymunk.Space()
        self.space.gravity = scene.gravity
        #: Bounding radius of the smallest moving body (m).
        self.size = smallest_radius(scene)
        #: Speed from which the engine counts as diverged (m/s).
        self.fastest = 1e5 * self.size / scene.time_step
        #: Distance of the places where bodies are parked (m).
        self.far = 1e9 * _extent(scene)
        self._scale_overlaps()
        self.bodies: list[pymunk.Body] = []
        self.shapes: list[tuple[int, pymunk.Shape]] = []
        self.wheels: list[OnBody] = []
        self.links: list[Link] = []
        #: Body whose friction acts in a hinge, the joint, and the column of its anchor on the body.
        self.pivots: list[tuple[int, int, int]] = []
        #: Constraints whose force is limited and others, and the settings of all of them by the
        #: bodies' and the joints' numbers.
        self.limited: list[pymunk.Constraint] = []
        self.unlimited: list[pymunk.Constraint] = []
        self.body_settings: list[Placed] = []
        self.joint_settings: list[Placed] = []
        self.discs: list[pymunk.Circle] = []
        self._by_name: dict[str, pymunk.Body] = {WORLD: self.space.static_body}
        self._add_fixed()
        self._add_discs(discs)
        #: Which bodies follow a path, at the velocities in their actions.
        self.kinematic = np.array([body.kinematic for body in scene.moving])
        self._add_moving(wheels)
        self._add_shapes()
        #: Which bodies can touch each other, and what does not move (the diagonal).
        self.can_touch = ~np.logical_and.outer(self.kinematic, self.kinematic)
        self._add_joints(kinds, joined)
        ground = self.space.static_body
        for i, position in rods:
            self._add_link(position, self.bodies[i], ground, ROD)
        self.patches = [self._constrain("patch", i, self.bodies[i], ground, RING) for i in patches]
        self.turners = [self._constrain("turning", i, self.bodies[i], ground) for i in turners]
        #: Which dynamic bodies are joined to other moving ones.
        self.chained = np.logical_not(self.can_touch.all(axis=1)) & ~self.kinematic
        alone = len(scene.bodies) == 1 and not scene.walls and not (discs or patches)
        #: Solver iterations. The wheel or hinge of a single body without obstacles soon converges
        #: to rounding; several bodies need the engine's default, and a chain of joints more (see
        #: `compiled.iterations`).
        self.iterations = 30 if self.chained.any() else 5 if alone else 10
        #: For the near-contact test: radii of bounding circles, and segments with a radius.
        self.radii = np.array([body.shape.bounding_radius for body in scene.moving])
        self.obstacles = self._obstacles(discs)

    def check_steps(self) -> None:
        """Refuse sliders on what turns, for which the engine has no right joint.

        Raises
        ------
        SimulationError
            If there is one.
        """
        moving = [body.name for body in self.scene.moving]
        upright = set(compress(moving, never_turning(self.scene)))
        for joint in self.scene.joints:
            if joint.traits.slides and not upright.intersection(joint.bodies or ()):
                a, b = joint.bodies or ("", "")
                raise SimulationError(
                    f"the slider of {a} and {b} turns, and Chipmunk, which steps contacts and"
                    " closed chains, has no such joint; expected a slider to the world, or to one"
                    " that slides on it. Use engine 'auto', and keep other bodies and walls away"
                )

    def _scale_overlaps(self) -> None:
        """Let overlaps scale with the scene; the engine's defaults are meant for pixels."""
        self.space.collision_slop = 1e-4 / _CART * self.size
        left = self.space.collision_bias**_CART_TIME
        # the power underflows where the engine time is below a hundredth of the cart's
        self.space.collision_bias = max(left ** (1.0 / engine_time(self.scene)), 1e-300)

    def _add_moving(self, wheels: tuple[int, ...]) -> None:
        """Add the moving bodies, far from each other, with their wheels but without shapes."""
        for i, body in enumerate(self.scene.moving):
            kind = pymunk.Body.KINEMATIC if body.kinematic else pymunk.Body.DYNAMIC
            rigid = pymunk.Body(1.0, 1.0, kind)
            rigid.position = self.far * (i + 1.0), self.far
            self.bodies.append(rigid)
            self._by_name[body.name] = rigid
            self.space.add(rigid)
            self.shapes += [(i, shape) for shape in engine_shapes(body, rigid)]
            if body.wheel or i in wheels:
                self.wheels.append(self._constrain("wheel", i, rigid, self.space.static_body))

    def _add_shapes(self) -> None:
        """Add the moving shapes so that contacts have one order, whatever was simulated before.

        The engine numbers shapes as they are added and visits them by that number modulo the size
        of a hash table: the first in a list that is larger than the number of entries. The first
        shape must get a multiple of it, here and whenever they are added again.
        """
        tables = (5, 13, 23, 47, 97, 193, 389, 769, 1543, 3079, 6151, 12289)
        table = next(size for size in tables if size > len(self.shapes))
        self.padding = -len(self.shapes) % table
        first = self.shapes[0][1]
        for _ in range(-len(self.space.shapes) % table):
            self.space.add(first)
            self.space.remove(first)
        for _, shape in self.shapes:
            self.space.add(shape)
        self.space.step(TINY * self.scene.time_step)
        for body in self.bodies:
            body.velocity = (0.0, 0.0)

    def _add_fixed(self) -> None:
        """Add walls and static bodies."""
        ground = self.space.static_body
        for wall in self.scene.walls:
            self._add_static(pymunk.Segment(ground, wall.start, wall.end, 0.0))
        for body in self.scene.bodies:
            if body.static and body.pose is not None:
                rigid = pymunk.Body(body_type=pymunk.Body.STATIC)
                rigid.position, rigid.angle = body.pose[:2], body.pose[2]
                self._by_name[body.name] = rigid
                self.space.add(rigid)
                for shape in engine_shapes(body, rigid):
                    self._add_static(shape)

    def _add_discs(self, discs: int) -> None:
        """Add hidden discs, far from everything."""
        for j in range(discs):
            away = -self.far, -self.far * (j + 1)
            self.discs.append(pymunk.Circle(self.space.static_body, 0.0, away))
            self._add_static(self.discs[j])

    def _obstacles(self, discs: int) -> Floats:
        """Return what does not move as segments with a radius, shape (obstacle, 5), discs last."""
        fixed = [(*wall.start, *wall.end, 0.0) for wall in self.scene.walls]
        fixed += [
            (*body.pose[:2], *body.pose[:2], body.shape.bounding_radius)
            for body in self.scene.bodies
            if body.static and body.pose is not None
        ]
        fixed += [(-self.far, -self.far, -self.far, -self.far, 0.0)] * discs
        return np.array(fixed, dtype=float).reshape(-1, 5)

    def _add_static(self, shape: pymunk.Shape) -> None:
        shape.elasticity = shape.friction = 1.0  # the engine multiplies both shapes' values
        self.space.add(shape)

    def _constrain(
        self,
        use: str,
        row: int,
        a: pymunk.Body,
        b: pymunk.Body,
        points: tuple[tuple[float, float], ...] = ((1.0, 1.0),),
        joint: int = -1,
    ) -> OnBody:
        """Add the constraints of a use, which resist motion but do not correct drift."""
        made = []
        for kind in BODY_CONSTRAINTS[use]:
            made.append(tuple(kind.constraint(a, b) for _ in points))
            for constraint, point in zip(made[-1], points, strict=True):
                if kind.limited:
                    constraint.max_bias = constraint.max_force = 0.0
                self._add_constraint(constraint, kind.limited)
                self.body_settings += [Placed(constraint, s, row, point) for s in kind.settings]
                self.joint_settings += [Placed(constraint, s, joint) for s in kind.joint_settings]
        return OnBody(row, *made)

    def _add_constraint(self, constraint: pymunk.Constraint, limited: bool) -> None:
        (self.limited if limited else self.unlimited).append(constraint)
        self.space.add(constraint)

    def _add_joints(
        self, kinds: tuple[EngineJoint, ...], joined: tuple[tuple[int, int], ...]
    ) -> None:
        """Add the scene's joints; their anchors and lengths are properties."""
        pairs, names = iter(joined), self.scene.joinable
        for position, (joint, kind) in enumerate(zip(self.scene.joints, kinds, strict=True)):
            bodies = joint.bodies
            if bodies is None:
                first, second = next(pairs)
                if first == second:  # i_a = i_b nullifies the joint
                    continue
                bodies = names[first], names[second]
            a, b = (self._by_name[name] for name in bodies)
            self._add_link(position, a, b, kind, joint)
            if a in self.bodies and b in self.bodies:
                i, j = self.bodies.index(a), self.bodies.index(b)
                self.can_touch[i, j] = self.can_touch[j, i] = False

    def _add_link(
        self,
        position: int,
        a: pymunk.Body,
        b: pymunk.Body,
        kind: EngineJoint,
        joint: Joint | None = None,
    ) -> None:
        link = kind.constraint(a, b)
        link.error_bias = 0.0  # correct the whole drift every substep
        link.collide_bodies = False
        self._add_constraint(link, limited=False)
        pivot = -1
        if joint is not None and joint.bodies is not None and JOINT_KINDS[joint.kind].friction:
            pivot = self.bodies.index(self._by_name[hanging_body(self.scene, joint)])
            self._constrain(kind.friction, pivot, a, b, joint=position)
            if kind is HINGE:
                column = JOINT.a_x if a is self.bodies[pivot] else JOINT.b_x
                self.pivots.append((pivot, position, column))
        axis = self.scene.direction(joint) if joint is not None and joint.axis else 0.0
        self.links.append(Link(position, kind, link, pivot, axis))
        self.joint_settings += [Placed(link, setting, position) for setting in kind.settings]


def engine_time(scene: Scene) -> float:
    """Return the time in which gravity moves the smallest body by about its size (s).

    Without gravity it is that of the cart, in sampling intervals.
    """
    gravity = max(math.hypot(*scene.gravity), scene.normal_gravity)
    if gravity > 0.0:
        return math.sqrt(smallest_radius(scene) / gravity)
    return _CART_TIME / 0.1 * scene.time_step


def _extent(scene: Scene) -> float:
    """Return the largest coordinate of walls and poses, or the largest body's radius (m)."""
    radii = (body.shape.bounding_radius for body in scene.bodies)
    return max([*map(abs, scene.extent or ()), *radii])


def engine_shapes(body: Body, rigid: pymunk.Body) -> list[pymunk.Shape]:
    """Return the engine's shapes of a body; a concave outline is cut into convex parts."""
    outline = body.shape.outline
    if outline is None:
        return [pymunk.Circle(rigid, float(body.shape.radius or 0.0))]
    if _is_convex(outline):
        return [pymunk.Poly(rigid, outline)]
    closed = [*outline, outline[0]]
    return [pymunk.Poly(rigid, part) for part in autogeometry.convex_decomposition(closed, 0.0)]


def _is_convex(outline: tuple[tuple[float, float], ...], rounding: float = 1e-12) -> bool:
    """Whether no corner turns inwards, to rounding: a share of the outline's extent squared."""
    corners = np.array(outline)
    edge = np.roll(corners, -1, axis=0) - corners
    after = np.roll(edge, -1, axis=0)
    cross = edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0]
    return bool((cross >= -rounding * np.ptp(corners, axis=0).max() ** 2).all())
