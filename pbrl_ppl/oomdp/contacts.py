"""Sector contact predicates, by ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import FitError, HistoryError
from pbrl_ppl.oomdp.frames import turned
from pbrl_ppl.oomdp.rays import spans
from pbrl_ppl.oomdp.relations import Condition, condition
from pbrl_ppl.physics import Scenery, circles, scenery
from pbrl_ppl.scene import WORLD, Scene

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@final
@dataclass(frozen=True)
class SectorContacts:
    """Contact predicates of sectors in a body's frame, by ray casting (section 3.1.1, Fig. 1).

    A :class:`pbrl_ppl.oomdp.Relation`. Walls and static bodies count as moving bodies do.

    Rays go out from the body's origin. One is in contact with an object if, along it, the two
    solids are no farther apart than the collision radius; a sector is if any of its rays is. So
    hollows of concave bodies count too. What is narrower than the rays are apart, such as the end
    of a wall seen from its end, may slip between them. Objects that a joint joins with the body do
    not collide with it, and are left out.

    The paper gives the collision radius as 20 without a unit, for figures whose scale it does not
    give either; pixels are meant. Here it is 0.2 m: with 100 pixels a metre a cart of 0.9 m is 90
    pixels long and an apartment of 10 m fits a screen. It is also how far a body of 2 m/s comes in
    an interval of 0.1 s: with less, a body would hit what was not in its condition at the
    interval's start. It is counted from the outline, for one value serves chairs and beds.

    Attributes
    ----------
    sectors : int
        Sectors of a body, n_s. The first is centred on the body's x axis (its front), the others
        follow counter-clockwise: left, back and right.
    rays : int
        Rays in a sector, n_tps.
    radius : float
        Collision radius epsilon_c (m).
    by_object : bool
        Whether it is told apart what touches a sector: other moving bodies, static ones, walls
        (all of them are one object, ``world``). The paper's conditions say which sectors are in
        contact, and not with what: there is one object, ``anything``.

    Raises
    ------
    FitError
        If a number is below 1, or the radius negative.

    References
    ----------
    Table 2 of the paper has the defaults of ``sectors``, ``rays`` and ``radius``.

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
    radius: float = 0.2
    by_object: bool = False

    def __post_init__(self) -> None:
        for name in ("sectors", "rays"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise FitError(f"contacts: {name} is {value!r}, expected a whole number from 1 up")
        if not 0 <= self.radius < np.inf:
            raise FitError(f"contacts: radius is {self.radius!r}, expected a length of 0 m or more")

    def objects(self, scene: Scene) -> tuple[str, ...]:
        """Names of what a body may touch, in the order of the predicates."""
        if not self.by_object:
            return ("anything",)
        static = (body.name for body in scene.bodies if body.static)
        walls = (WORLD,) if scene.walls else ()
        return (*(body.name for body in scene.moving), *walls, *static)

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Names of a body's predicates: ``contact_0``, or ``contact_0(world)`` by object."""
        return tuple(
            f"contact_{sector}" + f"({name})" * self.by_object
            for name in self.objects(scene)
            for sector in range(self.sectors)
        )

    @property
    def directions(self) -> Array:
        """Directions of the rays in the body's frame, sector by sector, shape (ray, 2)."""
        middle = np.arange(self.sectors * self.rays) + 0.5 * (1 - self.rays)
        angle = 2 * np.pi * middle / (self.sectors * self.rays)
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def of(self, scene: Scene, states: Array, wrenches: Array | None = None) -> Flags:
        """Predicates contact_theta(obj) of every moving body.

        Parameters
        ----------
        scene : Scene
            Shapes, walls, static bodies and joints.
        states : ndarray
            States or poses, shape (n, body, 6 or 3), SI units, bodies as in ``scene.moving``.
        wrenches : ndarray, optional
            No matter: contacts do not depend on the action.

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
        # along a ray solids are no nearer than their bounding circles
        near = circles(world.solids, world.pairs, poses) > -self.radius
        for (i, j), rows in zip(world.pairs, near.T, strict=True):
            at = np.flatnonzero(rows)
            for body, other in ((i, j), (j, i)):
                if len(at) and body < count:
                    obj = names.index(world.solids[other].name) if self.by_object else 0
                    flags[at, body, obj] |= self._meet(world, body, other, poses[at])
        return flags

    def conditions(self, scene: Scene, states: Array) -> list[list[Condition]]:
        """Contact predicates of every moving body that hold in each state.

        Parameters and errors as of :meth:`of`. The outer list is over states, the inner one over
        bodies.
        """
        labels, flags = self.labels(scene), self.of(scene, states)
        return [[condition(body, labels) for body in state] for state in flags]

    def _meet(self, world: Scenery, body: int, other: int, poses: Array) -> Flags:
        """Which sectors of a body are in contact with another solid, shape (n, sector)."""
        rays = self.directions[None]
        own = [spans(part, np.zeros((1, 2)), rays) for part in world.solids[body].parts]
        turn = poses[:, body, 2] - poses[:, other, 2]
        origins = turned(poses[:, body, :2] - poses[:, other, :2], -poses[:, other, 2])
        directions = turned(rays, turn[:, None])
        touched = np.zeros(directions.shape[:2], dtype=bool)
        for part in world.solids[other].parts:
            its = spans(part, origins, directions)
            for mine in own:
                # a gap of spans that overlap is negative, one of a ray that misses infinite
                gap = np.maximum(its[..., 0] - mine[..., 1], mine[..., 0] - its[..., 1])
                touched |= gap <= self.radius
        return np.asarray(touched.reshape(-1, self.sectors, self.rays).any(axis=-1))
