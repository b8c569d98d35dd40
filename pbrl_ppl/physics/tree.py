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

from pbrl_ppl.physics.joints import A_X, B_X, ROD, SLIDER
from pbrl_ppl.physics.world import Link, World
from pbrl_ppl.state import Floats, Ints

#: Kinds of links.
FREE, HINGE, BAR, RAIL = range(4)
#: Kinds of rows of dry friction: in a hinge or slider, under a body that one leaves one coordinate,
#: against turning, and along and across a wheel.
PIVOT, UNDER, TURNING, ALONG, ACROSS = range(5)
#: Columns of a link: the link that it hangs on (-1: the world), its body (-1: a rod), its first
#: coordinate and that of its angle (of a body that never turns the one after the last, whose speed
#: is 0 and whose forces count for nothing), its row among all joints (-1: none), the columns of the
#: anchor on its parent (-1: a rod's end) and of its own (-1: its origin), and the body whose
#: friction acts in its hinge or slider (-1: none).
KIND, PARENT, BODY, FIRST, TURN, JOINT, NEAR, FAR, OWNER = range(9)


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
    if not all(link.kind.contact_free for link in world.links):
        return None
    links: list[list[int]] = []
    poses: list[tuple[float, ...]] = []
    headings: list[tuple[float, float]] = []
    place: dict[int, int] = {}
    references = [world.scene.reference_angle(body.name) for body in world.scene.moving]
    turns = [-angle for angle in references]  # since the poses, less the coordinate of an angle
    left = [(_ends(world, link), link) for link in world.links]
    size, nowhere = 0, (0.0, 0.0, 1.0, 0.0)
    if any(end >= 0 and world.kinematic[end] for ends, _ in left for end in ends):
        return None

    def add(kind: int, parent: int, body: int, pose: tuple[float, ...], *joint: int) -> int:
        nonlocal size
        turn = size + 2 * (kind == FREE)
        if kind == RAIL:
            turn = links[parent][TURN] if parent >= 0 else -1
        links.append([kind, parent, body, size, turn, *joint])
        poses.append(pose)
        headings.append((0.0, 0.0))
        size += 3 if kind == FREE else 1
        return len(links) - 1

    moves = (~world.kinematic).tolist()
    while len(place) < sum(moves):
        ready = [one for one in left if any(end < 0 or end in place for end in one[0])]
        if not ready:
            body = next(i for i in range(len(world.bodies)) if i not in place and moves[i])
            place[body] = add(FREE, -1, body, nowhere, -1, -1, -1, -1)
            continue
        chosen = min(ready, key=lambda one: min(one[0]) >= 0)  # the world's first
        left.remove(chosen)
        (a, b), link = chosen
        turned = not (a < 0 or a in place)
        holder, body = (b, a) if turned else (a, b)
        if body < 0 or body in place:
            return None  # a loop, or a body that the world holds twice
        parent, pose = place.get(holder, -1), nowhere
        if holder < 0:
            fixed = link.constraint.b if turned else link.constraint.a
            pose = (*fixed.position, math.cos(fixed.angle), math.sin(fixed.angle))
        near, far = (B_X, A_X) if turned else (A_X, B_X)
        if link.kind is ROD:
            parent = add(BAR, parent, -1, pose, link.joint, near, -1, -1)
            pose, near = nowhere, -1
        kind = RAIL if link.kind is SLIDER else HINGE
        place[body] = add(kind, parent, body, pose, link.joint, near, far, link.pivot)
        if kind == RAIL:
            turns[body] = turns[holder] if holder >= 0 else 0.0
            headings[-1] = references[body] + turns[body], link.axis + turns[body]
    if left:
        return None
    rows, rings = _friction(world, links, place)
    if any(links[i][TURN] < 0 for i in rings):
        return None
    upright = any(link[TURN] < 0 for link in links)
    if max(len(links), size + upright, len(rows) + len(rings)) > MOST:
        return None
    for each in links:
        each[TURN] = size if each[TURN] < 0 else each[TURN]
    return Tree(
        links=np.array(links, dtype=np.int64),
        poses=np.hstack([poses, headings]),
        rows=np.array(rows, dtype=np.int64).reshape(-1, 2),
        rings=np.array(rings, dtype=np.int64),
        bodies=np.array([place.get(i, -1) for i in range(len(world.bodies))], dtype=np.int64),
        size=size,
    )


def _friction(
    world: World, links: list[list[int]], place: dict[int, int]
) -> tuple[list[tuple[int, int]], list[int]]:
    """Return kind and link of each row of dry friction, and the links of the rings."""
    rows = [(PIVOT, i) for i, link in enumerate(links) if link[OWNER] >= 0]
    rows += [(TURNING, place[turner.body]) for turner in world.turners]
    for wheel in world.wheels:
        rows += [(ALONG, place[wheel.body]), (ACROSS, place[wheel.body])]
    under = [place[patch.body] for patch in world.patches]
    alone = [i for i in under if links[i][KIND] != FREE and links[i][PARENT] < 0]
    return rows + [(UNDER, i) for i in alone], [i for i in under if i not in alone]


def _ends(world: World, link: Link) -> tuple[int, int]:
    """Return the bodies that a joint holds, -1 for a fixed one."""
    pair = link.constraint.a, link.constraint.b
    first, second = (world.bodies.index(one) if one in world.bodies else -1 for one in pair)
    return first, second
