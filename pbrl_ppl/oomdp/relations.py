"""Relations of an OO-MDP: named predicates of bodies, conditions, and contacts of sectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Protocol, final, runtime_checkable

import numpy as np

from pbrl_ppl.errors import FitError, HistoryError
from pbrl_ppl.physics import Scenery, circles, scenery
from pbrl_ppl.scene import WORLD, Scene, checks, smallest_radius
from pbrl_ppl.state import Bools, Floats, turned

#: Cond(s, a) of a body: the labels of the predicates that hold.
Condition = frozenset[str]
#: A convex part of a solid: corners (k, 2) counter-clockwise, and a radius about them; one corner
#: is a circle, two are a wall.
Part = tuple[Floats, float]


@runtime_checkable
class Relation(Protocol):
    """Predicates of every moving body in a state under an action."""

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return the names of the predicates of one body, in the order of the flags."""

    def of(self, scene: Scene, states: Floats, wrenches: Floats) -> Bools:
        """Return which predicates hold.

        Parameters
        ----------
        scene : Scene
            Shapes, walls, static bodies, joints, classes and attributes.
        states : ndarray
            Shape (n, body, 6), SI units, bodies as in ``scene.moving``.
        wrenches : ndarray
            On them, shape (n, body, 3), world frame, N and N m; of a kinematic body its velocity.

        Returns
        -------
        ndarray of bool
            Shape (n, body, ...): one flag per label for each body, in any shape.
        """


@final
@dataclass(frozen=True)
class Pushed:
    """Predicate that the body's wrench is not zero.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.2)) for name in "ab")
    >>> scene = Scene(time_step=0.1, bodies=pucks)
    >>> Pushed().of(scene, np.zeros((1, 2, 6)), np.array([[[0, 2.0, 0], [0, 0, 0]]]))[..., 0]
    array([[ True, False]])
    """

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return ``pushed``."""
        return ("pushed",)

    def of(self, scene: Scene, states: Floats, wrenches: Floats) -> Bools:
        """Return whether each body is pushed, shape (n, body, 1); see :class:`Relation`."""
        return np.asarray(wrenches.any(axis=-1, keepdims=True))


@final
@dataclass(frozen=True)
class Attributes:
    """Predicates that the body has an attribute: one per attribute in the scene.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> disc = Shape.circle(0.2)
    >>> chairs = Body("a", disc), Body("b", disc, attributes=("wheels_locked",))
    >>> scene = Scene(time_step=0.1, bodies=chairs)
    >>> Attributes().labels(scene)
    ('wheels_locked',)
    >>> Attributes().of(scene, np.zeros((1, 2, 6)), np.zeros((1, 2, 3)))[..., 0]
    array([[False,  True]])
    """

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return the attributes of the moving bodies, sorted."""
        return tuple(sorted({name for body in scene.moving for name in body.attributes}))

    def of(self, scene: Scene, states: Floats, wrenches: Floats) -> Bools:
        """Return the attributes that hold, shape (n, body, attribute); see :class:`Relation`."""
        labels = self.labels(scene)
        has = [[name in body.attributes for name in labels] for body in scene.moving]
        flags = np.array(has, dtype=bool).reshape(len(scene.moving), len(labels))
        return np.repeat(flags[None], len(states), axis=0)


def condition(flags: Sequence[bool] | Bools, labels: Sequence[str]) -> Condition:
    """Return a body's condition, from one flag per label."""
    return frozenset(compress(labels, flags))


@final
@dataclass(frozen=True)
class SectorContacts:
    """Contact predicates of sectors in a body's frame, by ray casting (section 3.1.1, Fig. 1).

    A :class:`pbrl_ppl.oomdp.Relation`. Walls and static bodies count as moving bodies do.

    Rays start at the body's origin. A ray is in contact with an object if the gap between the two
    solids along it is at most the collision radius; a sector is in contact if any of its rays is.
    Hollows of concave bodies count too. Objects narrower than the distance between rays, such as a
    wall seen from its end, may be missed. Objects joined to the body by a joint do not collide with
    it, and are left out.

    The paper gives the collision radius as 20, without a unit or the scale of its figures; pixels
    are meant. Here it is 0.4 times the bounding radius of the smallest moving body: 0.21 m for a
    cart of 0.9 m, which has 90 pixels at 100 pixels per metre. It should be the way of a body in an
    interval: with less, a body would hit objects that are not in its condition at the interval's
    start. It counts from the outline, so that one value serves chairs and beds.

    Attributes
    ----------
    sectors : int
        Sectors of a body, n_s. The first is centred on the body's x axis (front), the others
        follow counter-clockwise (left, back, right).
    rays : int
        Rays in a sector, n_tps.
    radius : float, optional
        Collision radius epsilon_c (m); 0.4 times the bounding radius of the smallest moving body by
        default.
    by_object : bool
        Whether predicates distinguish what touches a sector: each moving body, each static body,
        and the walls (all walls are one object, ``world``). In the paper's conditions there is one
        object, ``anything``.

    Raises
    ------
    FitError
        If a number is below 1, or the radius negative.

    References
    ----------
    Table 2 of the paper has the defaults of ``sectors`` and ``rays``.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape, Wall
    >>> wall = Wall((0.6, -2.0), (0.6, 2.0))
    >>> scene = Scene(time_step=0.1, bodies=(Body("cart", Shape.box(1.0, 0.6)),), walls=(wall,))
    >>> contacts = SectorContacts()
    >>> contacts.conditions(scene, np.zeros((1, 1, 6)))  # 0.1 m in front of it
    [[frozenset({'contact_0'})]]
    >>> SectorContacts(by_object=True).conditions(scene, np.zeros((1, 1, 6)))
    [[frozenset({'contact_0(world)'})]]
    """

    sectors: int = 4
    rays: int = 10
    radius: float | None = None
    by_object: bool = False

    def __post_init__(self) -> None:
        with checks.located(kind=FitError):
            checks.settle(self, "contacts", sectors=checks.whole, rays=checks.whole)
            checks.settle(self, "contacts", radius=checks.not_negative)

    def objects(self, scene: Scene) -> tuple[str, ...]:
        """Return the names of the objects that a body may touch, in the order of the predicates."""
        if not self.by_object:
            return ("anything",)
        static = (body.name for body in scene.bodies if body.static)
        walls = (WORLD,) if scene.walls else ()
        return (*(body.name for body in scene.moving), *walls, *static)

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return a body's predicates: ``contact_0``, or by object ``contact_0(world)``."""
        return tuple(
            f"contact_{sector}" + f"({name})" * self.by_object
            for name in self.objects(scene)
            for sector in range(self.sectors)
        )

    @property
    def directions(self) -> Floats:
        """Return the rays' directions in the body's frame, sector by sector, shape (ray, 2)."""
        middle = np.arange(self.sectors * self.rays) + 0.5 * (1 - self.rays)
        angle = 2 * np.pi * middle / (self.sectors * self.rays)
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def of(self, scene: Scene, states: Floats, wrenches: Floats | None = None) -> Bools:
        """Return the predicates contact_theta(obj) of every moving body.

        Parameters
        ----------
        scene : Scene
            Shapes, walls, static bodies and joints.
        states : ndarray
            States or poses, shape (n, body, 6 or 3), SI units, bodies as in ``scene.moving``.
        wrenches : ndarray, optional
            Ignored: contacts do not depend on the action.

        Returns
        -------
        ndarray of bool
            Shape (n, body, object, sector); objects as :meth:`objects` names them.

        Raises
        ------
        HistoryError
            If the states have another shape, or a pose is not finite.
        """
        states = np.asarray(states, dtype=float)
        count = len(scene.moving)
        if states.ndim != 3 or states.shape[1] != count or states.shape[2] not in (3, 6):
            raise HistoryError(
                f"contacts: states have shape {states.shape}, expected (n, {count}, 6), or 3 for"
                " poses alone; give them one state a row"
            )
        if not np.isfinite(states[..., :3]).all():
            raise HistoryError(
                "contacts: a pose is not finite, and rays need one; leave out what is not measured"
            )
        world = scenery(scene)
        poses = world.with_fixed(states[..., :3])
        names = self.objects(scene)
        flags = np.zeros((len(states), count, len(names), self.sectors), dtype=bool)
        if not world.pairs:
            return flags
        radius = 0.4 * smallest_radius(scene) if self.radius is None else self.radius
        # along a ray solids are no nearer than their bounding circles
        near = circles(world.solids, world.pairs, poses) > -radius
        for (i, j), rows in zip(world.pairs, near.T, strict=True):
            at = np.flatnonzero(rows)
            for body, other in ((i, j), (j, i)):
                if len(at) and body < count:
                    obj = names.index(world.solids[other].name) if self.by_object else 0
                    flags[at, body, obj] |= self._sectors(world, body, other, poses[at], radius)
        return flags

    def conditions(self, scene: Scene, states: Floats) -> list[list[Condition]]:
        """Return the contact predicates that hold, for each state a list over moving bodies.

        Parameters and errors are those of :meth:`of`.
        """
        labels, flags = self.labels(scene), self.of(scene, states)
        return [[condition(body.ravel(), labels) for body in state] for state in flags]

    def _sectors(
        self, world: Scenery, body: int, other: int, poses: Floats, radius: float
    ) -> Bools:
        """Return which sectors of a body are in contact with another solid, shape (n, sector)."""
        rays = self.directions[None]
        insides = [spans(part, np.zeros((1, 2)), rays) for part in world.solids[body].parts]
        turn = poses[:, body, 2] - poses[:, other, 2]
        origins = turned(poses[:, body, :2] - poses[:, other, :2], -poses[:, other, 2])
        directions = turned(rays, turn[:, None])
        touched = np.zeros(directions.shape[:2], dtype=bool)
        for part in world.solids[other].parts:
            outside = spans(part, origins, directions)
            for inside in insides:
                # the gap is negative where spans overlap, and infinite where a ray misses
                gap = np.maximum(outside[..., 0] - inside[..., 1], inside[..., 0] - outside[..., 1])
                touched |= gap <= radius
        return np.asarray(touched.reshape(-1, self.sectors, self.rays).any(axis=-1))


def spans(part: Part, origins: Floats, directions: Floats) -> Floats:
    """Return the distances at which rays enter and leave a convex part.

    Parameters
    ----------
    part : tuple of ndarray and float
        Part of a solid from :func:`pbrl_ppl.physics.scenery`, in the solid's frame (m).
    origins : ndarray
        Origins of the rays, shape (n, 2), m.
    directions : ndarray
        Unit vectors, shape (n, ray, 2).

    Returns
    -------
    ndarray
        Distances along the rays, shape (n, ray, 2), m. The first is 0 where the origin is inside;
        a ray that misses has (inf, -inf). A wall has no width: a ray leaves it where it enters, and
        a ray along it misses.

    Examples
    --------
    >>> box = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    >>> spans((box, 0.0), np.array([[-3.0, 0.0]]), np.array([[[1.0, 0.0]]]))
    array([[[2., 4.]]])
    """
    corners, radius = part
    with np.errstate(over="ignore"):  # a ray almost parallel to an edge
        if len(corners) == 1:
            enter, leave = _circle(origins - corners[0], directions, radius)
        elif len(corners) == 2:
            enter, leave = _segment(corners, origins, directions)
        else:
            enter, leave = _polygon(corners, origins, directions)
    enter = np.maximum(enter, 0.0)
    hit = enter <= leave
    return np.stack([np.where(hit, enter, np.inf), np.where(hit, leave, -np.inf)], axis=-1)


def _circle(arm: Floats, directions: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return distances to a circle from origins at these positions from its centre."""
    ahead = np.einsum("nrc,nc->nr", directions, arm)
    square = ahead**2 - ((arm**2).sum(axis=-1) - radius**2)[:, None]
    half = np.sqrt(np.where(square < 0, np.nan, square))
    return -ahead - half, -ahead + half


def _segment(ends: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Return the distance to a wall, twice."""
    edge, arm = ends[1] - ends[0], ends[0] - origins
    across = directions[..., 0] * edge[1] - directions[..., 1] * edge[0]
    across = np.where(across == 0, np.nan, across)
    at = (arm[:, 0] * edge[1] - arm[:, 1] * edge[0])[:, None] / across
    share = arm[:, None, 0] * directions[..., 1] - arm[:, None, 1] * directions[..., 0]
    at = np.where((share / across >= 0) & (share / across <= 1), at, np.nan)
    return at, at


def _polygon(corners: Floats, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Return the last entry and the first exit among the edges (Cyrus and Beck's clipping)."""
    enter = np.full(directions.shape[:2], -np.inf)
    leave = -enter
    for corner, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        outward = np.array([after[1] - corner[1], corner[0] - after[0]])
        depth = ((corner - origins) @ outward)[:, None]
        rate = directions @ outward
        at = depth / np.where(rate == 0, np.nan, rate)
        enter = np.where(rate < 0, np.maximum(enter, at), enter)
        leave = np.where(rate > 0, np.minimum(leave, at), leave)
        # along the edge, and outside of it
        leave = np.where((rate == 0) & (depth < 0), -np.inf, leave)
    return enter, leave
