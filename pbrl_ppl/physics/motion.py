"""Equations of motion of a tree of links, in its coordinates, and their friction.

``M a = Q + G' f``: the mass matrix M and the forces Q follow from the Jacobians of the centres of
mass (R. Featherstone, Rigid Body Dynamics Algorithms, 2008), and f are the forces of the rows of
dry friction. A row slips, with its greatest force against the motion, or it sticks: then it is a
constraint, whose force follows from the accelerations.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.calls import inner
from pbrl_ppl.physics.joints import LENGTH
from pbrl_ppl.physics.laws import ACTED, COMMAND, MORE, bound
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.tree import (
    ACROSS,
    ALONG,
    BAR,
    FREE,
    HINGE,
    LINK,
    MOST,
    PIVOT,
    RAIL,
    TURNING,
    UNDER,
    Tree,
)
from pbrl_ppl.physics.world import RING

#: Columns of a link's numbers. Mass, moment, centre of mass from the place of its joint (in its
#: frame), that place in the parent's frame or the world and in the body's own frame, gravity,
#: damping; then heading, place and velocity, and the acceleration without that of the speeds.
(
    MASS, MOMENT, COM_X, COM_Y, AT_X, AT_Y, OWN_X, OWN_Y, WEIGHT_X, WEIGHT_Y, DAMPING,
    COS, SIN, X, Y, V_X, V_Y, B_X, B_Y,
) = range(19)  # fmt: skip
#: Columns of a row's numbers: its greatest force and the one with which it sticks, its acceleration
#: without that of the speeds, a wheel's place from the joint's and direction, its greatest force
#: but for laws that change it; then G.
BOUND, FORCE, BIAS, W_X, W_Y, W_COS, W_SIN, BASE, G = range(9)
#: Rows of what each coordinate has: coordinates and speeds now and at the end of a step, natural
#: sizes, forces Q; then seven slopes (speed, acceleration), and M.
Q, U, END_Q, END_U, SIZE, LOAD, SLOPES, M = 0, 1, 2, 3, 4, 5, 6, 20
#: Rows of a ring's numbers: greatest force of a point and reaction on a ring that holds; twist
#: where a step begins (and the greatest force but for laws), at its end, and now; then its points,
#: from the joint's place.
GRIP, TWIST, TWIST_END, TWIST_NOW, POINTS = range(5)
#: Columns of a link's pose: heading and slider's direction, less the coordinate of its angle.
HEADING, AXIS = 4, 5
#: Modes of a row beside slipping in its positive (1) or negative direction: it sticks, or has no
#: friction. A ring slides or sticks.
STICK, SMOOTH, SLIDE = 0, 2, 1
#: Friction of a ring's point that is slower than this share of its body is less: it may be at rest
#: for an instant, where its direction jumps. Other points have theirs but for some 1e-6.
_SLOW = 2e-3
#: Compliance of what sticks, beside that of the bodies: redundant constraints share their force.
_SOFT = 1e-11


#: Topology of a tree and numbers of one transition: one record, for a call of many arrays would
#: cost more than what they hold.
WORK = np.dtype(
    [(name, np.int64) for name in ("n_links", "n", "n_rows", "n_kinds", "n_bodies")]
    # numbers of force laws, and the addresses of what command laws remember and of an interval's
    # inputs
    + [(name, np.int64) for name in ("n_held", "memory", "inputs")]
    # the interval (s), the error of a step as a share of natural sizes, and that of a way (m)
    + [(name, np.float64) for name in ("time_step", "tolerance", "length")]
    + [
        ("tree", np.int64, (MOST, 9)),
        ("kinds", np.int64, (MOST, 4)),  # of rows, then rings (-1): link, mode, if that is settled
        ("bodies", np.int64, (MOST,)),  # their links
        ("poses", np.float64, (MOST, 6)),
        ("links", np.float64, (MOST, B_Y + 1)),
        ("slope", np.float64, (MOST, MOST, 2)),  # derivative of a link's place by each coordinate
        ("rows", np.float64, (MOST, G + MOST)),
        ("rings", np.float64, (MOST, POINTS + len(RING), 4)),
        ("motion", np.float64, (M + MOST, MOST)),
        ("system", np.float64, (4 * MOST, 4 * MOST + 1)),
        ("states", np.float64, (MOST, 6)),
        ("acted", np.float64, (MOST + MORE, ACTED)),  # see `laws.act`
        ("held", np.float64, (2, MOST)),  # numbers of force laws, and their rates of change
    ],
    align=True,
)


def work_of(tree: Tree, length: float) -> NDArray[np.void]:
    """Return the record of a tree, shape (1,); ``length`` is a body's size (m)."""
    work = np.zeros(1, dtype=WORK)
    links, rows, rings = len(tree.links), len(tree.rows), len(tree.rings)
    work["n_links"], work["n"], work["n_rows"] = links, tree.size, rows
    work["n_kinds"], work["n_bodies"] = rows + rings, len(tree.bodies)
    work["tree"][0, :links], work["poses"][0, :links] = tree.links, tree.poses
    work["bodies"][0, : len(tree.bodies)] = tree.bodies
    work["kinds"][0, :rows, :2] = tree.rows
    work["kinds"][0, rows : rows + rings, 0] = -1
    work["kinds"][0, rows : rows + rings, 1] = tree.rings
    work["motion"][0, SIZE] = 1.0
    for kind, first in tree.links[:, [LINK.kind, LINK.first]]:
        if kind in (FREE, RAIL):
            work["motion"][0, SIZE, first : first + 1 + (kind == FREE)] = length
    return work


@inner
def set_numbers(work, gravity, normal_gravity, ring, bodies, joints):  # type: ignore[no-untyped-def]
    """Set what depends on parameters alone: of ``bodies`` (body, column), ``joints`` (joint, 9)."""
    for i in range(work.n_links):
        fields, link, joint = work.tree[i], work.links[i], work.tree[i, LINK.joint]
        parent, near, far = fields[LINK.parent], fields[LINK.near], fields[LINK.far]
        link[OWN_X], link[OWN_Y] = 0.0, 0.0
        if far >= 0:
            link[OWN_X], link[OWN_Y] = joints[joint, far], joints[joint, far + 1]
        x, y = 0.0, 0.0
        if near >= 0:
            x, y = joints[joint, near], joints[joint, near + 1]
        if parent < 0:
            at_x, at_y, c, s, _, _ = work.poses[i]
            x, y = at_x + c * x - s * y, at_y + s * x + c * y
        elif work.tree[parent, LINK.kind] == BAR:
            x = joints[joint, LENGTH]
        else:
            x, y = x - work.links[parent, OWN_X], y - work.links[parent, OWN_Y]
        link[AT_X], link[AT_Y] = x, y
        if fields[LINK.body] < 0:
            continue
        row = bodies[fields[LINK.body]]
        link[MASS], link[MOMENT] = row[COLUMN.mass], row[COLUMN.moment]
        link[COM_X], link[COM_Y] = row[COLUMN.com_x] - link[OWN_X], row[COLUMN.com_y] - link[OWN_Y]
        link[WEIGHT_X] = gravity[0] + row[COLUMN.extra_gravity_x]
        link[WEIGHT_Y] = gravity[1] + row[COLUMN.extra_gravity_y]
        if fields[LINK.owner] >= 0:
            link[DAMPING] = bodies[fields[LINK.owner], COLUMN.pivot_damping]
    for r in range(work.n_kinds):
        kind, i = work.kinds[r, 0], work.kinds[r, 1]
        link, row = work.links[i], bodies[work.tree[i, LINK.body]]
        load, radius = link[MASS] * normal_gravity, row[COLUMN.patch_radius]
        lever = 0.0
        for j in range(len(ring) if kind < 0 or kind == UNDER else 0):
            x, y = ring[j, 0] * radius - link[OWN_X], ring[j, 1] * radius - link[OWN_Y]
            lever += math.sqrt(x * x + y * y) / len(ring)
            if kind < 0:
                point = work.rings[r - work.n_rows, POINTS + j]
                point[0], point[1] = x, y
        if kind < 0:
            grip = row[COLUMN.patch_mu] * load / len(ring)
            work.rings[r - work.n_rows, GRIP, 0] = work.rings[r - work.n_rows, TWIST, 3] = grip
            continue
        numbers = work.rows[r]
        if kind == PIVOT:
            numbers[BOUND] = bodies[work.tree[i, LINK.owner], COLUMN.pivot_torque]
        elif kind == UNDER:
            lever = 1.0 if work.tree[i, LINK.kind] == RAIL else lever
            numbers[BOUND] = row[COLUMN.patch_mu] * load * lever
        elif kind == TURNING:
            numbers[BOUND] = row[COLUMN.turn_torque]
        else:
            angle = row[COLUMN.w_theta] + (0.5 * math.pi if kind == ACROSS else 0.0)
            numbers[BOUND] = load * (row[COLUMN.mu_x] if kind == ALONG else row[COLUMN.mu_y])
            numbers[W_X] = row[COLUMN.w_x] - link[OWN_X]
            numbers[W_Y] = row[COLUMN.w_y] - link[OWN_Y]
            numbers[W_COS], numbers[W_SIN] = math.cos(angle), math.sin(angle)
        numbers[BASE] = numbers[BOUND]


@inner
def set_coordinates(work, states):  # type: ignore[no-untyped-def]
    """Set coordinates and speeds from the states (body, 6) of bodies."""
    tree, motion = work.tree, work.motion
    for i in range(work.n_links):
        parent, body, j = tree[i, LINK.parent], tree[i, LINK.body], tree[i, LINK.first]
        if tree[i, LINK.kind] == FREE:
            for d in range(3):
                motion[Q, j + d], motion[U, j + d] = states[body, d], states[body, 3 + d]
        elif tree[i, LINK.kind] == HINGE:
            motion[Q, j], motion[U, j] = states[body, 2], states[body, 5]
        else:  # from the joint's place on its parent to the one on its body, or the rod's
            x, y, v_x, v_y = work.links[i, AT_X], work.links[i, AT_Y], 0.0, 0.0
            if parent >= 0:
                x += work.links[parent, OWN_X]
                y += work.links[parent, OWN_Y]
                x, y, v_x, v_y = _seen(states[tree[parent, LINK.body]], x, y)
            last = i + 1 if tree[i, LINK.kind] == BAR else i
            end = work.links[last]
            far = _seen(states[tree[last, LINK.body]], end[OWN_X], end[OWN_Y])
            x, y, v_x, v_y = far[0] - x, far[1] - y, far[2] - v_x, far[3] - v_y
            if tree[i, LINK.kind] == BAR:
                motion[Q, j], motion[U, j] = math.atan2(y, x), (x * v_y - y * v_x) / (x * x + y * y)
                continue
            angle = motion[Q, tree[i, LINK.turn]] + work.poses[i, AXIS]
            c, s = math.cos(angle), math.sin(angle)
            motion[Q, j], motion[U, j] = c * x + s * y, c * v_x + s * v_y


@inner
def _seen(state, x, y):  # type: ignore[no-untyped-def]
    """Return place and velocity of a point of a body, given in the body's frame."""
    c, s = math.cos(state[2]), math.sin(state[2])
    x, y = c * x - s * y, s * x + c * y
    return state[0] + x, state[1] + y, state[3] - state[5] * y, state[4] + state[5] * x


# From here on elements are addressed one by one: a view of an array costs as much as ten of them.


@inner
def set_places(work, q, u):  # type: ignore[no-untyped-def]
    """Set places, velocities and their derivatives, and states, from rows q and u of the motion."""
    tree, links, slope, motion, states = work.tree, work.links, work.slope, work.motion, work.states
    n = work.n
    for i in range(work.n_links):
        parent, turn = tree[i, LINK.parent], tree[i, LINK.turn]
        for k in range(n):
            slope[i, k, 0] = slope[i, k, 1] = 0.0
        x, y, v_x, v_y, b_x, b_y = links[i, AT_X], links[i, AT_Y], 0.0, 0.0, 0.0, 0.0
        if tree[i, LINK.kind] == FREE:
            j = tree[i, LINK.first]
            x, y, v_x, v_y = motion[q, j], motion[q, j + 1], motion[u, j], motion[u, j + 1]
            slope[i, j, 0] = slope[i, j + 1, 1] = 1.0
        elif parent >= 0:
            j = tree[parent, LINK.turn]
            c, s, omega = links[parent, COS], links[parent, SIN], motion[u, j]
            x, y = c * x - s * y, s * x + c * y
            v_x, v_y = links[parent, V_X] - omega * y, links[parent, V_Y] + omega * x
            b_x = links[parent, B_X] - omega * omega * x
            b_y = links[parent, B_Y] - omega * omega * y
            for k in range(n):
                slope[i, k, 0], slope[i, k, 1] = slope[parent, k, 0], slope[parent, k, 1]
            slope[i, j, 0] -= y
            slope[i, j, 1] += x
            x, y = links[parent, X] + x, links[parent, Y] + y
        angle, omega = motion[q, turn], motion[u, turn]
        if tree[i, LINK.kind] == RAIL:
            j = tree[i, LINK.first]
            along, rate = motion[q, j], motion[u, j]
            c, s = math.cos(angle + work.poses[i, AXIS]), math.sin(angle + work.poses[i, AXIS])
            x, y = x + c * along, y + s * along
            v_x, v_y = v_x + c * rate - s * along * omega, v_y + s * rate + c * along * omega
            b_x -= omega * (2.0 * s * rate + c * along * omega)
            b_y += omega * (2.0 * c * rate - s * along * omega)
            slope[i, j, 0], slope[i, j, 1] = c, s
            slope[i, turn, 0] -= s * along
            slope[i, turn, 1] += c * along
            angle += work.poses[i, HEADING]
        c, s = math.cos(angle), math.sin(angle)
        links[i, COS], links[i, SIN], links[i, X], links[i, Y] = c, s, x, y
        links[i, V_X], links[i, V_Y], links[i, B_X], links[i, B_Y] = v_x, v_y, b_x, b_y
        k = tree[i, LINK.body]
        if k >= 0:
            o_x, o_y = links[i, OWN_X], links[i, OWN_Y]
            o_x, o_y = c * o_x - s * o_y, s * o_x + c * o_y
            states[k, 0], states[k, 1], states[k, 2] = x - o_x, y - o_y, angle
            states[k, 3], states[k, 4], states[k, 5] = v_x + omega * o_y, v_y - omega * o_x, omega


@inner
def set_forces(work, u):  # type: ignore[no-untyped-def]
    """Set M and Q, and the rows of dry friction, where places and wrenches are set."""
    tree, links, slope, motion = work.tree, work.links, work.slope, work.motion
    n = work.n
    for j in range(n):
        motion[LOAD, j] = 0.0
        for k in range(n):
            motion[M + j, k] = 0.0
    for body in range(work.n_bodies):
        i = work.bodies[body]
        if i < 0:
            continue
        turn, mass = tree[i, LINK.turn], links[i, MASS]
        c, s, omega = links[i, COS], links[i, SIN], motion[u, turn]
        x = c * links[i, COM_X] - s * links[i, COM_Y]
        y = s * links[i, COM_X] + c * links[i, COM_Y]
        # the wrench acts at the body's origin
        arm_x = x + c * links[i, OWN_X] - s * links[i, OWN_Y]
        arm_y = y + s * links[i, OWN_X] + c * links[i, OWN_Y]
        f_x, f_y = work.acted[body, 6], work.acted[body, 7]
        motion[LOAD, turn] += work.acted[body, 8] - (arm_x * f_y - arm_y * f_x)
        f_x += mass * (links[i, WEIGHT_X] - links[i, B_X] + omega * omega * x)
        f_y += mass * (links[i, WEIGHT_Y] - links[i, B_Y] + omega * omega * y)
        slope[i, turn, 0] -= y  # that of the centre of mass, for now
        slope[i, turn, 1] += x
        for j in range(n):
            s_x, s_y = slope[i, j, 0], slope[i, j, 1]
            motion[LOAD, j] += s_x * f_x + s_y * f_y
            for k in range(j + 1):
                motion[M + j, k] += mass * (s_x * slope[i, k, 0] + s_y * slope[i, k, 1])
        slope[i, turn, 0] += y
        slope[i, turn, 1] -= x
        motion[M + turn, turn] += links[i, MOMENT]
        if links[i, DAMPING] > 0.0:
            rate, j = motion[u, tree[i, LINK.first]], tree[i, LINK.first]
            if tree[i, LINK.kind] == HINGE and tree[i, LINK.parent] >= 0:
                rate -= motion[u, tree[tree[i, LINK.parent], LINK.turn]]
                motion[LOAD, tree[tree[i, LINK.parent], LINK.turn]] += links[i, DAMPING] * rate
            motion[LOAD, j] -= links[i, DAMPING] * rate
    for j in range(n):
        for k in range(j):
            motion[M + k, j] = motion[M + j, k]


@inner
def set_rows(work, u):  # type: ignore[no-untyped-def]
    """Set the rows of dry friction, where places are set."""
    tree, links, slope, motion, rows = work.tree, work.links, work.slope, work.motion, work.rows
    n = work.n
    for r in range(work.n_rows):
        kind, i = work.kinds[r, 0], work.kinds[r, 1]
        turn = tree[i, LINK.turn]
        for j in range(n):
            rows[r, G + j] = 0.0
        if kind in (PIVOT, UNDER, TURNING):
            rows[r, G + tree[i, LINK.first if kind != TURNING else LINK.turn]] = 1.0
            if kind == PIVOT and tree[i, LINK.kind] == HINGE and tree[i, LINK.parent] >= 0:
                rows[r, G + tree[tree[i, LINK.parent], LINK.turn]] = -1.0
            continue
        c, s, omega = links[i, COS], links[i, SIN], motion[u, turn]
        x = c * rows[r, W_X] - s * rows[r, W_Y]
        y = s * rows[r, W_X] + c * rows[r, W_Y]
        n_x = c * rows[r, W_COS] - s * rows[r, W_SIN]
        n_y = s * rows[r, W_COS] + c * rows[r, W_SIN]
        for j in range(n):
            rows[r, G + j] = n_x * slope[i, j, 0] + n_y * slope[i, j, 1]
        rows[r, G + turn] += n_y * x - n_x * y
        v_x, v_y = links[i, V_X] - omega * y, links[i, V_Y] + omega * x
        b_x, b_y = links[i, B_X] - omega * omega * x, links[i, B_Y] - omega * omega * y
        rows[r, BIAS] = omega * (n_x * v_y - n_y * v_x) + n_x * b_x + n_y * b_y


@inner
def set_bounds(work, laws, u):  # type: ignore[no-untyped-def]
    """Set the greatest forces of dry friction that laws change, where forces and rows are set."""
    if laws.n_frictions == 0:
        return
    tree, motion, acted, states = work.tree, work.motion, work.acted, work.states
    for r in range(work.n_kinds):
        kind, i = work.kinds[r, 0], work.kinds[r, 1]
        turn, body = tree[i, LINK.turn], tree[i, LINK.body]
        if kind == PIVOT:
            owner, torque = tree[i, LINK.owner], acted[body, COMMAND + 2]
            first, speed = tree[i, LINK.first], row_speed(work, r, u)
            if tree[i, LINK.kind] == RAIL:
                torque = work.slope[i, first, 0] * acted[body, COMMAND]
                torque += work.slope[i, first, 1] * acted[body, COMMAND + 1]
            rest = motion[LOAD, first] + work.links[i, DAMPING] * speed - torque
            work.rows[r, BOUND] = bound(
                work.rows[r, BASE], laws, owner, 0, states, torque, rest, abs(speed), acted
            )
        elif kind == UNDER:
            x, y = work.links[i, OWN_X], work.links[i, OWN_Y]
            speed = abs(motion[u, turn]) * math.sqrt(x * x + y * y)
            work.rows[r, BOUND] = bound(
                work.rows[r, BASE], laws, body, 1, states, 0.0, 0.0, speed, acted
            )
        elif kind < 0:
            ring = r - work.n_rows
            points, base = work.rings.shape[1] - POINTS, work.rings[ring, TWIST, 3]
            speed = math.sqrt(set_twist(work, ring, i, u, TWIST_NOW))
            most = bound(points * base, laws, body, 1, states, 0.0, 0.0, speed, acted)
            work.rings[ring, GRIP, 0] = most / points


@inner
def solve(work, u, a, impulse):  # type: ignore[no-untyped-def]
    """Compute accelerations (row a) and what holds, where forces and rows are set.

    With ``impulse`` the speeds that are left when what sticks has been stopped, in place of both.
    """
    motion, system, rows, kinds = work.motion, work.system, work.rows, work.kinds
    n, count = work.n, work.n_rows
    size = n
    for r in range(work.n_kinds):
        if kinds[r, 2] == STICK:
            size += 1 if r < count else 3
    if size == 1 and not impulse:  # one coordinate that moves
        force = motion[LOAD, 0]
        for r in range(count):
            if kinds[r, 2] != SMOOTH:
                force -= kinds[r, 2] * rows[r, BOUND] * rows[r, G]
        motion[a, 0] = force / motion[M, 0]
        return
    heavy, at = 0.0, n
    for j in range(n):
        heavy = max(heavy, motion[M + j, j])
        system[j, size] = 0.0 if impulse else motion[LOAD, j]
        for k in range(n):
            system[j, k] = motion[M + j, k]
            if impulse:
                system[j, size] += motion[M + j, k] * motion[u, k]
    for r in range(work.n_kinds):
        i, mode = kinds[r, 1], kinds[r, 2]
        turn = work.tree[i, LINK.turn]
        if mode == STICK:
            for d in range(1 if r < count else 3):
                for j in range(n, size):
                    system[at, j] = 0.0
                for j in range(n):
                    value = 1.0 if j == turn else 0.0
                    if r < count:
                        value = rows[r, G + j]
                    elif d < 2:
                        value = work.slope[i, j, d]
                    system[j, at], system[at, j] = -value, value
                system[at, at], system[at, size] = _SOFT / heavy, 0.0
                if not impulse and r < count:
                    system[at, size] = -rows[r, BIAS]
                elif not impulse and d < 2:
                    system[at, size] = -work.links[i, B_X + d]
                at += 1
        elif not impulse and mode != SMOOTH:
            _resist(work, r, u, size)
    _eliminate(system, size)
    for j in range(n):
        motion[a, j] = system[j, size]
    at = n
    for r in range(work.n_kinds):
        if kinds[r, 2] == STICK and r < count:
            rows[r, FORCE] = system[at, size]
            at += 1
        elif kinds[r, 2] == STICK:
            for d in range(3):
                work.rings[r - count, GRIP, 1 + d] = system[at + d, size]
            at += 3


@inner
def _eliminate(system, size):  # type: ignore[no-untyped-def]
    """Solve a linear system in place; its last column becomes the solution."""
    for k in range(size):
        best = k
        for i in range(k + 1, size):
            if abs(system[i, k]) > abs(system[best, k]):
                best = i
        if best != k:
            for j in range(k, size + 1):
                system[k, j], system[best, j] = system[best, j], system[k, j]
        scale = 1.0 / system[k, k]
        for i in range(k + 1, size):
            factor = system[i, k] * scale
            if factor != 0.0:
                for j in range(k + 1, size + 1):
                    system[i, j] -= factor * system[k, j]
    for k in range(size - 1, -1, -1):
        total = system[k, size]
        for j in range(k + 1, size):
            total -= system[k, j] * system[j, size]
        system[k, size] = total / system[k, k]


@inner
def _sliding(work, ring, i, omega):  # type: ignore[no-untyped-def]
    """Return force and torque, at the place of its joint, on a body whose ring slides."""
    links, rings, f_x, f_y, torque = work.links, work.rings, 0.0, 0.0, 0.0
    c, s, o_x, o_y = links[i, COS], links[i, SIN], links[i, V_X], links[i, V_Y]
    x, y = rings[ring, POINTS, 0], rings[ring, POINTS, 1]
    slow = _SLOW * _SLOW * (o_x * o_x + o_y * o_y + omega * omega * (x * x + y * y))
    for j in range(POINTS, rings.shape[1]):
        x = c * rings[ring, j, 0] - s * rings[ring, j, 1]
        y = s * rings[ring, j, 0] + c * rings[ring, j, 1]
        v_x, v_y = o_x - omega * y, o_y + omega * x
        square = v_x * v_x + v_y * v_y
        if square > 0.0:
            scale = -rings[ring, GRIP, 0] / math.sqrt(square + slow)
            f_x += scale * v_x
            f_y += scale * v_y
            torque += scale * (x * v_y - y * v_x)
    return f_x, f_y, torque


@inner
def _resist(work, r, u, column):  # type: ignore[no-untyped-def]
    """Add the friction of a row that slips, or of a ring that slides, to a column of the system."""
    system, slope = work.system, work.slope
    if r < work.n_rows:
        for j in range(work.n):
            system[j, column] -= work.kinds[r, 2] * work.rows[r, BOUND] * work.rows[r, G + j]
        return
    i = work.kinds[r, 1]
    turn = work.tree[i, LINK.turn]
    f_x, f_y, torque = _sliding(work, r - work.n_rows, i, work.motion[u, turn])
    for j in range(work.n):
        system[j, column] += slope[i, j, 0] * f_x + slope[i, j, 1] * f_y
    system[turn, column] += torque


@inner
def set_first_slide(work, u, a, tries=30):  # type: ignore[no-untyped-def]
    """Set the accelerations (row a) with which rings that hold begin to slide.

    They are the least of ``a M a / 2 - Q a`` and the power of friction where there is no speed yet,
    by reweighted least squares; rows that slip, and rings that slide, have their friction.
    """
    motion, system, rings, rows, n = work.motion, work.system, work.rings, work.rows, work.n
    count = work.n_rows
    for attempt in range(tries):
        for j in range(n):
            system[j, n] = motion[LOAD, j]
            for k in range(n):
                system[j, k] = motion[M + j, k]
        for r in range(count):
            if work.kinds[r, 2] in (-1, 1):
                _resist(work, r, u, n)
            elif attempt > 0:
                speed, slow = 0.0, 1e-24
                for j in range(n):
                    speed += rows[r, G + j] * motion[a, j]
                    slow += (_SLOW * rows[r, G + j] * motion[a, j]) ** 2
                weight = rows[r, BOUND] / math.sqrt(speed * speed + slow)
                for j in range(n):
                    for k in range(n):
                        system[j, k] += weight * rows[r, G + j] * rows[r, G + k]
        for r in range(count, work.n_kinds):
            i, ring = work.kinds[r, 1], r - count
            c, s, turn = work.links[i, COS], work.links[i, SIN], work.tree[i, LINK.turn]
            if work.kinds[r, 3] == 1 and work.kinds[r, 2] == SLIDE:
                _resist(work, r, u, n)
                continue
            if attempt == 0:
                continue
            slow = 1e-24
            for j in range(n):
                way = abs(work.slope[i, j, 0]) + abs(work.slope[i, j, 1])
                if j == turn:
                    way += math.sqrt(rings[ring, POINTS, 0] ** 2 + rings[ring, POINTS, 1] ** 2)
                slow += (_SLOW * way * motion[a, j]) ** 2
            for point in range(POINTS, rings.shape[1]):
                x = c * rings[ring, point, 0] - s * rings[ring, point, 1]
                y = s * rings[ring, point, 0] + c * rings[ring, point, 1]
                work.slope[i, turn, 0] -= y
                work.slope[i, turn, 1] += x
                v_x, v_y = 0.0, 0.0
                for j in range(n):
                    v_x += work.slope[i, j, 0] * motion[a, j]
                    v_y += work.slope[i, j, 1] * motion[a, j]
                weight = rings[ring, GRIP, 0] / math.sqrt(v_x * v_x + v_y * v_y + slow)
                for j in range(n):
                    for k in range(n):
                        both = work.slope[i, j, 0] * work.slope[i, k, 0]
                        both += work.slope[i, j, 1] * work.slope[i, k, 1]
                        system[j, k] += weight * both
                work.slope[i, turn, 0] += y
                work.slope[i, turn, 1] -= x
        _eliminate(system, n)
        off, size = 0.0, 1e-300
        for j in range(n):
            off = max(off, abs(motion[a, j] - system[j, n]) / motion[SIZE, j])
            size = max(size, abs(system[j, n]) / motion[SIZE, j])
            motion[a, j] = system[j, n]
        if off < 1e-4 * size:
            break


@inner
def row_speed(work, r, u):  # type: ignore[no-untyped-def]
    """Return the speed of a row, or its acceleration without the bias, by a row of the motion."""
    speed = 0.0
    for j in range(work.n):
        speed += work.rows[r, G + j] * work.motion[u, j]
    return speed


@inner
def set_twist(work, ring, i, u, field):  # type: ignore[no-untyped-def]
    """Set a ring's twist, its third part times the ring's radius; return its square."""
    rings = work.rings
    x, y = rings[ring, POINTS, 0], rings[ring, POINTS, 1]
    turned = work.motion[u, work.tree[i, LINK.turn]] * math.sqrt(x * x + y * y)
    v_x, v_y = work.links[i, V_X], work.links[i, V_Y]
    rings[ring, field, 0], rings[ring, field, 1], rings[ring, field, 2] = v_x, v_y, turned
    return v_x * v_x + v_y * v_y + turned * turned


@inner
def strain(work, ring, i, tries=40):  # type: ignore[no-untyped-def]
    """Return by how much the reaction on a ring that holds exceeds what it can hold, as a share.

    With a wheel under the same body, or friction against turning, which hold with it.

    The greatest power of the reaction over that of friction, less one (S. Goyal, A. Ruina and
    J. Papadopoulos, Wear 143, 1991), by reweighted least squares.
    """
    rings, system, c, s = work.rings, work.system, work.links[i, COS], work.links[i, SIN]
    grip, f_x, f_y = rings[ring, GRIP, 0], -rings[ring, GRIP, 1], -rings[ring, GRIP, 2]
    torque, square = -rings[ring, GRIP, 3], 0.0
    for j in range(POINTS, rings.shape[1]):
        square = max(square, rings[ring, j, 0] ** 2 + rings[ring, j, 1] ** 2)
    t_x, t_y, rate = f_x, f_y, torque / max(square, 1e-300)
    share, before = -1.0, -1.0
    for _ in range(tries):
        size = math.sqrt(t_x * t_x + t_y * t_y + rate * rate * square)
        if not size > 0.0:
            return -1.0  # nothing pulls
        t_x, t_y, rate = t_x / size, t_y / size, rate / size
        for j in range(3):
            for k in range(3):
                system[j, k] = 0.0
        lost = 0.0
        for j in range(POINTS, rings.shape[1]):
            x = c * rings[ring, j, 0] - s * rings[ring, j, 1]
            y = s * rings[ring, j, 0] + c * rings[ring, j, 1]
            v_x, v_y = t_x - rate * y, t_y + rate * x
            speed = math.sqrt(v_x * v_x + v_y * v_y + _SLOW * _SLOW)
            lost += grip * speed
            weight = grip / speed
            system[0, 0] += weight
            system[1, 1] += weight
            system[0, 2] -= weight * y
            system[1, 2] += weight * x
            system[2, 2] += weight * (x * x + y * y)
        for r in range(work.n_rows):  # of a wheel, or against turning, on the same body
            if work.kinds[r, 1] == i and work.kinds[r, 0] >= TURNING:
                row = work.rows[r]
                n_x, n_y, lever = 0.0, 0.0, 1.0
                if work.kinds[r, 0] >= ALONG:
                    n_x = c * row[W_COS] - s * row[W_SIN]
                    n_y = s * row[W_COS] + c * row[W_SIN]
                    x, y = c * row[W_X] - s * row[W_Y], s * row[W_X] + c * row[W_Y]
                    lever = n_y * x - n_x * y
                along = n_x * t_x + n_y * t_y + lever * rate
                speed = math.sqrt(along * along + _SLOW * _SLOW)
                lost += row[BOUND] * speed
                weight = row[BOUND] / speed
                system[0, 0] += weight * n_x * n_x
                system[0, 1] += weight * n_x * n_y
                system[1, 1] += weight * n_y * n_y
                system[0, 2] += weight * n_x * lever
                system[1, 2] += weight * n_y * lever
                system[2, 2] += weight * lever * lever
        share, before = (f_x * t_x + f_y * t_y + torque * rate) / lost - 1.0, share
        if abs(share - before) < 1e-12:
            break
        system[1, 0], system[2, 0], system[2, 1] = system[0, 1], system[0, 2], system[1, 2]
        system[0, 3], system[1, 3], system[2, 3] = f_x, f_y, torque
        if not square > 0.0:  # a point, which holds no torque
            system[2, 0], system[2, 1], system[2, 2], system[2, 3] = 0.0, 0.0, 1.0, 0.0
        _eliminate(system, 3)
        t_x, t_y, rate = system[0, 3], system[1, 3], system[2, 3]
    return share
