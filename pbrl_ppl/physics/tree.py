"""Bodies of a world as a tree of links, whose motion is described in reduced coordinates.

A hinge leaves one coordinate, the absolute angle of the link that hangs on it; a slider one, the
position along its axis, and no angle of its own; a rod is a link without mass, with a hinge at both
ends; a free body has three. Nothing has to hold the joints together, and nothing drifts
(R. Featherstone, Rigid Body Dynamics Algorithms, 2008).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.physics.world import HINGE, JOINT, ROD, SLIDER, Link, World, columns
from pbrl_ppl.state import Floats, Ints

#: Kinds of links.
KIND = columns("free hinge bar rail")
#: Kinds of rows of dry friction: in a hinge or slider, under a body that one leaves one coordinate,
#: against turning, and along and across a wheel.
FRICTION = columns("pivot under turning along across")
#: Columns of a link: the link that it hangs on (-1: the world), its body (-1: a rod), its first
#: coordinate and that of its angle (of a body that never turns the one after the last, whose speed
#: is 0 and whose forces count for nothing), its row among all joints (-1: none), the columns of the
#: anchor on its parent (-1: a rod's end) and of its own (-1: its origin), and the body whose
#: friction acts in its hinge or slider (-1: none).
LINK = columns("kind parent body first turn joint near far owner")
#: Columns of a link's pose: those of the fixed body that it hangs on, then its heading in a slider
#: and the slider's direction, less the coordinate of its angle.
POSE = columns("x y cos sin heading axis")
#: Pose of a link that hangs on nothing fixed and in no slider.
_NOWHERE = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
#: Links, coordinates, and rows and rings that a tree may have; a larger one is left to the engine.
MOST = 24


@dataclass(frozen=True)
class Tree:
    """Links of a world, each after the one that it hangs on.

    Parameters
    ----------
    links : ndarray of int
        Shape (link, 9), columns as above.
    poses : ndarray
        x, y, cos and sin of the fixed body that a link hangs on; heading of a link in a slider, and
        direction of the slider, less the coordinate of its angle (rad). Shape (link, 6).
    rows : ndarray of int
        Kind and link of each row of dry friction, shape (row, 2).
    rings : ndarray of int
        Links of bodies on a ring of friction with more coordinates than one, shape (ring,).
    bodies : ndarray of int
        Link of each body, shape (body,); -1 for one that follows a path.
    size : int
        Number of coordinates.
    """

    links: Ints
    poses: Floats
    rows: Ints
    rings: Ints
    bodies: Ints
    size: int


def tree_of(world: World) -> Tree | None:
    """Return the tree of a world's bodies.

    A body that follows a path is none of its links. None where joints hold one, close a loop, have
    no such coordinates, or are too many.
    """
    if any(link.kind not in (HINGE, ROD, SLIDER) for link in world.links):
        return None
    left = [(_ends(world, link), link) for link in world.links]
    if any(end >= 0 and world.kinematic[end] for ends, _ in left for end in ends):
        return None
    links, moving = _Links(world), np.flatnonzero(~world.kinematic).tolist()
    while len(links.place) < len(moving):
        ready = [one for one in left if any(end < 0 or end in links.place for end in one[0])]
        if not ready:
            body = next(body for body in moving if body not in links.place)
            links.add(KIND.free, -1, body, -1, -1, -1, -1)
            continue
        chosen = min(ready, key=lambda one: min(one[0]) >= 0)  # the world's first
        left.remove(chosen)
        (a, b), link = chosen
        turned = not (a < 0 or a in links.place)
        holder, body = (b, a) if turned else (a, b)
        if body < 0 or body in links.place:
            return None  # a loop, or a body that the world holds twice
        links.hang(link, holder, body, turned)
    return None if left else links.tree(world)


class _Links:
    """Links of a world's bodies, as they are added."""

    def __init__(self, world: World) -> None:
        self.place: dict[int, int] = {}  # link of each body
        self._links: list[list[int]] = []
        self._poses: list[tuple[float, ...]] = []
        self._size = 0
        self._references = [world.scene.reference_angle(body.name) for body in world.scene.moving]
        #: Angles since the reference poses, less the coordinate of the angle.
        self._turns = [-angle for angle in self._references]

    def add(
        self, kind: int, parent: int, body: int, *joint: int, pose: tuple[float, ...] = _NOWHERE
    ) -> int:
        """Add a link, the joint's columns as above, and return its number."""
        turn = self._size + 2 * (kind == KIND.free)
        if kind == KIND.rail:
            turn = self._links[parent][LINK.turn] if parent >= 0 else -1
        if body >= 0:
            self.place[body] = len(self._links)
        self._links.append([kind, parent, body, self._size, turn, *joint])
        self._poses.append(pose)
        self._size += 3 if kind == KIND.free else 1
        return len(self._links) - 1

    def hang(self, link: Link, holder: int, body: int, turned: bool) -> None:
        """Add a body that hangs on a holder, which is the joint's second body if ``turned``."""
        parent, pose = self.place.get(holder, -1), _NOWHERE
        if holder < 0:
            fixed = link.constraint.b if turned else link.constraint.a
            pose = (*fixed.position, math.cos(fixed.angle), math.sin(fixed.angle), 0.0, 0.0)
        near, far = (JOINT.b_x, JOINT.a_x) if turned else (JOINT.a_x, JOINT.b_x)
        if link.kind is ROD:
            parent = self.add(KIND.bar, parent, -1, link.joint, near, -1, -1, pose=pose)
            pose, near = _NOWHERE, -1
        if link.kind is SLIDER:
            turn = self._turns[body] = self._turns[holder] if holder >= 0 else 0.0
            pose = (*pose[:4], self._references[body] + turn, link.axis + turn)
        kind = KIND.rail if link.kind is SLIDER else KIND.hinge
        self.add(kind, parent, body, link.joint, near, far, link.pivot, pose=pose)

    def tree(self, world: World) -> Tree | None:
        """Return the tree of these links; None if it is too large, or lets a ring not turn."""
        rows, rings = self._friction(world)
        if any(self._links[i][LINK.turn] < 0 for i in rings):
            return None
        upright = any(link[LINK.turn] < 0 for link in self._links)
        if max(len(self._links), self._size + upright, len(rows) + len(rings)) > MOST:
            return None
        links = np.array(self._links, dtype=np.int64)
        links[links[:, LINK.turn] < 0, LINK.turn] = self._size
        return Tree(
            links=links,
            poses=np.array(self._poses),
            rows=np.array(rows, dtype=np.int64).reshape(-1, 2),
            rings=np.array(rings, dtype=np.int64),
            bodies=np.array([self.place.get(i, -1) for i in range(len(world.bodies))]),
            size=self._size,
        )

    def _friction(self, world: World) -> tuple[list[tuple[int, int]], list[int]]:
        """Return kind and link of each row of dry friction, and the links of the rings."""
        links, place = self._links, self.place
        rows = [(FRICTION.pivot, i) for i, link in enumerate(links) if link[LINK.owner] >= 0]
        rows += [(FRICTION.turning, place[turner.body]) for turner in world.turners]
        for wheel in world.wheels:
            rows += [(FRICTION.along, place[wheel.body]), (FRICTION.across, place[wheel.body])]
        under = [place[patch.body] for patch in world.patches]
        alone = [i for i in under if links[i][LINK.kind] != KIND.free and links[i][LINK.parent] < 0]
        return rows + [(FRICTION.under, i) for i in alone], [i for i in under if i not in alone]


def _ends(world: World, link: Link) -> tuple[int, int]:
    """Return the bodies that a joint holds, -1 for a fixed one."""
    pair = link.constraint.a, link.constraint.b
    first, second = (world.bodies.index(one) if one in world.bodies else -1 for one in pair)
    return first, second
