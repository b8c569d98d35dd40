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

from pbrl_ppl.physics.calls import from_place, inlined, inner, numbers_at, rotated, start_of
from pbrl_ppl.physics.laws import ACTED, COMMAND, MORE, WINDOW, WRENCHES, act, bound
from pbrl_ppl.physics.tree import FRICTION, KIND, LINK, MOST, POSE, Tree
from pbrl_ppl.physics.world import COLUMN, JOINT, RING, columns

#: Columns of a link's numbers. Mass, moment, centre of mass from the place of its joint (in its
#: frame), that place in the parent's frame or the world and in the body's own frame, gravity,
#: damping; then heading, place and velocity, and the acceleration without that of the speeds.
HAS = columns(
    "mass moment com_x com_y at_x at_y own_x own_y weight_x weight_y damping"
    " cos sin x y v_x v_y b_x b_y"
)
#: Columns of a row's numbers: its greatest force and the one with which it sticks, its acceleration
#: without that of the speeds, a wheel's place from the joint's and direction, its greatest force
#: but for laws that change it; then G.
ROW = columns("bound force bias w_x w_y w_cos w_sin base g")
#: Rows of a ring's numbers: greatest force of a point and reaction on a ring that holds; twist
#: where a step begins (and the greatest force but for laws), at its end, and now; then its points,
#: from the joint's place.
RIM = columns("grip twist twist_end twist_now points")
#: Rows of what each coordinate has: coordinates and speeds now and at the end of a step, natural
#: sizes, forces Q; then seven slopes (speed, acceleration), and M.
Q, U, END_Q, END_U, SIZE, LOAD, SLOPES, M = 0, 1, 2, 3, 4, 5, 6, 20
#: Modes of a row: it sticks, slips in its positive (1) or negative direction (-1), or has no
#: friction. A ring slides or sticks.
MODE = columns("stick slide smooth")
#: Steps of less than this share of an interval are taken as they are.
SHORTEST = 1e-6
#: Friction of a ring's point that is slower than this share of its body is less: it may be at rest
#: for an instant, where its direction jumps. Other points have theirs but for some 1e-6.
_SLOW = 2e-3


#: Topology of a tree and numbers of one transition: one record, for a call of many arrays would
#: cost more than what they hold.
WORK = np.dtype(
    [(name, np.int64) for name in ("n_links", "n", "n_rows", "n_kinds", "n_bodies")]
    # numbers of force laws, and the addresses of what command laws remember and of an interval's
    # inputs
    + [(name, np.int64) for name in ("n_held", "memory", "inputs")]
    # the interval (s), the error of a step as a share of natural sizes, and that of a way (m); the
    # ends of a piece of the interval in which no command jumps, as shares of it
    + [(name, np.float64) for name in ("time_step", "tolerance", "length", "low", "high")]
    + [
        ("tree", np.int64, (MOST, 9)),
        ("kinds", np.int64, (MOST, 4)),  # of rows, then rings (-1): link, mode, if that is settled
        ("bodies", np.int64, (MOST,)),  # their links
        ("poses", np.float64, (MOST, 6)),
        ("links", np.float64, (MOST, len(HAS))),
        ("slope", np.float64, (MOST, MOST, 2)),  # derivative of a link's place by each coordinate
        ("rows", np.float64, (MOST, ROW.g + MOST)),
        ("rings", np.float64, (MOST, RIM.points + len(RING), 4)),
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
        if kind in (KIND.free, KIND.rail):
            work["motion"][0, SIZE, first : first + 1 + (kind == KIND.free)] = length
    return work


@inlined
def set_numbers(work, still, bodies, joints):  # type: ignore[no-untyped-def]
    """Set what depends on parameters alone: of ``bodies`` (body, column), ``joints`` (joint, 9)."""
    for i in range(work.n_links):
        fields, link, joint = work.tree[i], work.links[i], work.tree[i, LINK.joint]
        parent, near, far = fields[LINK.parent], fields[LINK.near], fields[LINK.far]
        link[HAS.own_x], link[HAS.own_y] = 0.0, 0.0
        if far >= 0:
            link[HAS.own_x], link[HAS.own_y] = joints[joint, far], joints[joint, far + 1]
        x, y = 0.0, 0.0
        if near >= 0:
            x, y = joints[joint, near], joints[joint, near + 1]
        if parent < 0:
            at_x, at_y, c, s, _, _ = work.poses[i]
            x, y = at_x + c * x - s * y, at_y + s * x + c * y
        elif work.tree[parent, LINK.kind] == KIND.bar:
            x = joints[joint, JOINT.length]
        else:
            x, y = x - work.links[parent, HAS.own_x], y - work.links[parent, HAS.own_y]
        link[HAS.at_x], link[HAS.at_y] = x, y
        if fields[LINK.body] < 0:
            continue
        row = bodies[fields[LINK.body]]
        link[HAS.mass], link[HAS.moment] = row[COLUMN.mass], row[COLUMN.moment]
        link[HAS.com_x] = row[COLUMN.com_x] - link[HAS.own_x]
        link[HAS.com_y] = row[COLUMN.com_y] - link[HAS.own_y]
        link[HAS.weight_x] = still.gravity[0] + row[COLUMN.extra_gravity_x]
        link[HAS.weight_y] = still.gravity[1] + row[COLUMN.extra_gravity_y]
        if fields[LINK.owner] >= 0:
            link[HAS.damping] = bodies[fields[LINK.owner], COLUMN.pivot_damping]
    _set_friction(work, still.normal_gravity, still.ring, bodies)


@inner
def _set_friction(work, normal_gravity, ring, bodies):  # type: ignore[no-untyped-def]
    """Set the greatest friction of rows and rings, where links have their numbers."""
    for r in range(work.n_kinds):
        kind, i = work.kinds[r, 0], work.kinds[r, 1]
        link, row = work.links[i], bodies[work.tree[i, LINK.body]]
        load, radius = link[HAS.mass] * normal_gravity, row[COLUMN.patch_radius]
        lever = 0.0
        for j in range(len(ring) if kind < 0 or kind == FRICTION.under else 0):
            x, y = ring[j, 0] * radius - link[HAS.own_x], ring[j, 1] * radius - link[HAS.own_y]
            lever += math.sqrt(x * x + y * y) / len(ring)
            if kind < 0:
                point = work.rings[r - work.n_rows, RIM.points + j]
                point[0], point[1] = x, y
        if kind < 0:
            rim = work.rings[r - work.n_rows]
            rim[RIM.grip, 0] = rim[RIM.twist, 3] = row[COLUMN.patch_mu] * load / len(ring)
            continue
        numbers = work.rows[r]
        if kind == FRICTION.pivot:
            numbers[ROW.bound] = bodies[work.tree[i, LINK.owner], COLUMN.pivot_torque]
        elif kind == FRICTION.under:
            lever = 1.0 if work.tree[i, LINK.kind] == KIND.rail else lever
            numbers[ROW.bound] = row[COLUMN.patch_mu] * load * lever
        elif kind == FRICTION.turning:
            numbers[ROW.bound] = row[COLUMN.turn_torque]
        else:
            angle = row[COLUMN.w_theta] + (0.5 * math.pi if kind == FRICTION.across else 0.0)
            mu = row[COLUMN.mu_x] if kind == FRICTION.along else row[COLUMN.mu_y]
            numbers[ROW.bound] = load * mu
            numbers[ROW.w_x] = row[COLUMN.w_x] - link[HAS.own_x]
            numbers[ROW.w_y] = row[COLUMN.w_y] - link[HAS.own_y]
            numbers[ROW.w_cos], numbers[ROW.w_sin] = math.cos(angle), math.sin(angle)
        numbers[ROW.base] = numbers[ROW.bound]


@inner
def set_coordinates(work, states):  # type: ignore[no-untyped-def]
    """Set coordinates and speeds from the states (body, 6) of bodies."""
    tree, motion = work.tree, work.motion
    for i in range(work.n_links):
        parent, body, j = tree[i, LINK.parent], tree[i, LINK.body], tree[i, LINK.first]
        if tree[i, LINK.kind] == KIND.free:
            for d in range(3):
                motion[Q, j + d], motion[U, j + d] = states[body, d], states[body, 3 + d]
        elif tree[i, LINK.kind] == KIND.hinge:
            motion[Q, j], motion[U, j] = states[body, 2], states[body, 5]
        else:  # from the joint's place on its parent to the one on its body, or the rod's
            x, y, v_x, v_y = work.links[i, HAS.at_x], work.links[i, HAS.at_y], 0.0, 0.0
            if parent >= 0:
                x += work.links[parent, HAS.own_x]
                y += work.links[parent, HAS.own_y]
                x, y, v_x, v_y = _seen(states[tree[parent, LINK.body]], x, y)
            last = i + 1 if tree[i, LINK.kind] == KIND.bar else i
            end = work.links[last]
            far = _seen(states[tree[last, LINK.body]], end[HAS.own_x], end[HAS.own_y])
            x, y, v_x, v_y = far[0] - x, far[1] - y, far[2] - v_x, far[3] - v_y
            if tree[i, LINK.kind] == KIND.bar:
                motion[Q, j], motion[U, j] = math.atan2(y, x), (x * v_y - y * v_x) / (x * x + y * y)
                continue
            angle = motion[Q, tree[i, LINK.turn]] + work.poses[i, POSE.axis]
            c, s = math.cos(angle), math.sin(angle)
            motion[Q, j], motion[U, j] = c * x + s * y, c * v_x + s * v_y


@inner
def _seen(state, x, y):  # type: ignore[no-untyped-def]
    """Return place and velocity of a point of a body, given in the body's frame."""
    x, y = rotated(math.cos(state[2]), math.sin(state[2]), x, y)
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
        x, y, v_x, v_y, b_x, b_y = links[i, HAS.at_x], links[i, HAS.at_y], 0.0, 0.0, 0.0, 0.0
        if tree[i, LINK.kind] == KIND.free:
            j = tree[i, LINK.first]
            x, y, v_x, v_y = motion[q, j], motion[q, j + 1], motion[u, j], motion[u, j + 1]
            slope[i, j, 0] = slope[i, j + 1, 1] = 1.0
        elif parent >= 0:
            j = tree[parent, LINK.turn]
            c, s, omega = links[parent, HAS.cos], links[parent, HAS.sin], motion[u, j]
            x, y = rotated(c, s, x, y)
            v_x, v_y = links[parent, HAS.v_x] - omega * y, links[parent, HAS.v_y] + omega * x
            b_x = links[parent, HAS.b_x] - omega * omega * x
            b_y = links[parent, HAS.b_y] - omega * omega * y
            for k in range(n):
                slope[i, k, 0], slope[i, k, 1] = slope[parent, k, 0], slope[parent, k, 1]
            slope[i, j, 0] -= y
            slope[i, j, 1] += x
            x, y = links[parent, HAS.x] + x, links[parent, HAS.y] + y
        angle, omega = motion[q, turn], motion[u, turn]
        if tree[i, LINK.kind] == KIND.rail:
            j = tree[i, LINK.first]
            along, rate = motion[q, j], motion[u, j]
            direction = angle + work.poses[i, POSE.axis]
            c, s = math.cos(direction), math.sin(direction)
            x, y = x + c * along, y + s * along
            v_x, v_y = v_x + c * rate - s * along * omega, v_y + s * rate + c * along * omega
            b_x -= omega * (2.0 * s * rate + c * along * omega)
            b_y += omega * (2.0 * c * rate - s * along * omega)
            slope[i, j, 0], slope[i, j, 1] = c, s
            slope[i, turn, 0] -= s * along
            slope[i, turn, 1] += c * along
            angle += work.poses[i, POSE.heading]
        c, s = math.cos(angle), math.sin(angle)
        links[i, HAS.cos], links[i, HAS.sin], links[i, HAS.x], links[i, HAS.y] = c, s, x, y
        links[i, HAS.v_x], links[i, HAS.v_y] = v_x, v_y
        links[i, HAS.b_x], links[i, HAS.b_y] = b_x, b_y
        k = tree[i, LINK.body]
        if k >= 0:
            o_x, o_y = rotated(c, s, links[i, HAS.own_x], links[i, HAS.own_y])
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
        turn, mass = tree[i, LINK.turn], links[i, HAS.mass]
        c, s, omega = links[i, HAS.cos], links[i, HAS.sin], motion[u, turn]
        x, y = rotated(c, s, links[i, HAS.com_x], links[i, HAS.com_y])
        # the wrench acts at the body's origin
        arm_x, arm_y = rotated(c, s, links[i, HAS.own_x], links[i, HAS.own_y])
        arm_x, arm_y = arm_x + x, arm_y + y
        f_x, f_y = work.acted[body, 6], work.acted[body, 7]
        motion[LOAD, turn] += work.acted[body, 8] - (arm_x * f_y - arm_y * f_x)
        f_x += mass * (links[i, HAS.weight_x] - links[i, HAS.b_x] + omega * omega * x)
        f_y += mass * (links[i, HAS.weight_y] - links[i, HAS.b_y] + omega * omega * y)
        slope[i, turn, 0] -= y  # that of the centre of mass, for now
        slope[i, turn, 1] += x
        for j in range(n):
            s_x, s_y = slope[i, j, 0], slope[i, j, 1]
            motion[LOAD, j] += s_x * f_x + s_y * f_y
            for k in range(j + 1):
                motion[M + j, k] += mass * (s_x * slope[i, k, 0] + s_y * slope[i, k, 1])
        slope[i, turn, 0] += y
        slope[i, turn, 1] -= x
        motion[M + turn, turn] += links[i, HAS.moment]
        if links[i, HAS.damping] > 0.0:
            rate, j = motion[u, tree[i, LINK.first]], tree[i, LINK.first]
            if tree[i, LINK.kind] == KIND.hinge and tree[i, LINK.parent] >= 0:
                rate -= motion[u, tree[tree[i, LINK.parent], LINK.turn]]
                motion[LOAD, tree[tree[i, LINK.parent], LINK.turn]] += links[i, HAS.damping] * rate
            motion[LOAD, j] -= links[i, HAS.damping] * rate
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
            rows[r, ROW.g + j] = 0.0
        if kind in (FRICTION.pivot, FRICTION.under, FRICTION.turning):
            rows[r, ROW.g + tree[i, LINK.first if kind != FRICTION.turning else LINK.turn]] = 1.0
            hinged = tree[i, LINK.kind] == KIND.hinge and tree[i, LINK.parent] >= 0
            if kind == FRICTION.pivot and hinged:
                rows[r, ROW.g + tree[tree[i, LINK.parent], LINK.turn]] = -1.0
            continue
        c, s, omega = links[i, HAS.cos], links[i, HAS.sin], motion[u, turn]
        x, y = rotated(c, s, rows[r, ROW.w_x], rows[r, ROW.w_y])
        n_x, n_y = rotated(c, s, rows[r, ROW.w_cos], rows[r, ROW.w_sin])
        for j in range(n):
            rows[r, ROW.g + j] = n_x * slope[i, j, 0] + n_y * slope[i, j, 1]
        rows[r, ROW.g + turn] += n_y * x - n_x * y
        v_x, v_y = links[i, HAS.v_x] - omega * y, links[i, HAS.v_y] + omega * x
        b_x, b_y = links[i, HAS.b_x] - omega * omega * x, links[i, HAS.b_y] - omega * omega * y
        rows[r, ROW.bias] = omega * (n_x * v_y - n_y * v_x) + n_x * b_x + n_y * b_y


@inner
def set_bounds(work, laws, u):  # type: ignore[no-untyped-def]
    """Set the greatest forces of dry friction that laws change, where forces and rows are set."""
    if laws.n_frictions == 0:
        return
    tree, rows, rings, acted = work.tree, work.rows, work.rings, work.acted
    points = rings.shape[1] - RIM.points
    for r in range(work.n_kinds):
        kind, i, ring = work.kinds[r, 0], work.kinds[r, 1], r - work.n_rows
        body, under, torque, rest = tree[i, LINK.body], 1, 0.0, 0.0
        if kind < 0:
            base = points * rings[ring, RIM.twist, 3]
            speed = math.sqrt(set_twist(work, ring, i, u, RIM.twist_now))
        elif kind == FRICTION.pivot:
            base, torque, speed = rows[r, ROW.base], acted[body, COMMAND + 2], row_speed(work, r, u)
            first = tree[i, LINK.first]
            if tree[i, LINK.kind] == KIND.rail:
                torque = work.slope[i, first, 0] * acted[body, COMMAND]
                torque += work.slope[i, first, 1] * acted[body, COMMAND + 1]
            rest = work.motion[LOAD, first] + work.links[i, HAS.damping] * speed - torque
            body, under, speed = tree[i, LINK.owner], 0, abs(speed)
        elif kind == FRICTION.under:
            x, y = work.links[i, HAS.own_x], work.links[i, HAS.own_y]
            base = rows[r, ROW.base]
            speed = abs(work.motion[u, tree[i, LINK.turn]]) * math.sqrt(x * x + y * y)
        else:
            continue
        most = bound(base, laws, body, under, work.states, torque, rest, speed, acted)
        if kind < 0:
            rings[ring, RIM.grip, 0] = most / points
        else:
            rows[r, ROW.bound] = most


@inner
def load(work, laws, u, share):  # type: ignore[no-untyped-def]
    """Set what acts at places that are set and a time: wrenches, forces, and rows of friction."""
    motion, held = work.motion, work.n + 1
    for s in range(work.n_held):
        work.held[0, s] = motion[u - 1, held + s]
    if laws.n_commands + laws.n_forces > 0:
        begin = min(max(work.low + SHORTEST, share), work.high - WINDOW)  # past a jump
        held_at = start_of(work.held)
        act(
            start_of(work.states), numbers_at(work.inputs), laws, begin, begin + WINDOW,
            start_of(work.acted), numbers_at(work.memory), held_at, from_place(held_at, MOST),
        )  # fmt: skip
    for s in range(work.n_held):
        motion[u, held + s] = work.held[1, s]
    set_forces(work, u)
    set_rows(work, u)
    set_bounds(work, laws, u)


@inlined
def set_inputs(work, inputs):  # type: ignore[no-untyped-def]
    """Set the wrenches of an interval, and the velocities of bodies that follow a path."""
    work.inputs = inputs.ctypes.data
    for k in range(work.n_bodies):
        for w in range(3):
            work.acted[k, COMMAND + w] = work.acted[k, WRENCHES + w] = inputs[k, w]
            if work.bodies[k] < 0:
                work.states[k, 3 + w] = inputs[k, w]


@inner
def solve(work, u, a, impulse, soft=1e-11):  # type: ignore[no-untyped-def]
    """Compute accelerations (row a) and what holds, where forces and rows are set.

    What sticks has a compliance, ``soft`` beside that of the bodies: redundant constraints share
    their force.

    With ``impulse`` the speeds that are left when what sticks has been stopped, in place of both.
    """
    motion, system, rows, kinds = work.motion, work.system, work.rows, work.kinds
    n, count = work.n, work.n_rows
    size = n
    for r in range(work.n_kinds):
        if kinds[r, 2] == MODE.stick:
            size += 1 if r < count else 3
    if size == 1 and not impulse:  # one coordinate that moves
        force = motion[LOAD, 0]
        for r in range(count):
            if kinds[r, 2] != MODE.smooth:
                force -= kinds[r, 2] * rows[r, ROW.bound] * rows[r, ROW.g]
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
        if mode == MODE.stick:
            for d in range(1 if r < count else 3):
                for j in range(n, size):
                    system[at, j] = 0.0
                for j in range(n):
                    value = 1.0 if j == turn else 0.0
                    if r < count:
                        value = rows[r, ROW.g + j]
                    elif d < 2:
                        value = work.slope[i, j, d]
                    system[j, at], system[at, j] = -value, value
                system[at, at], system[at, size] = soft / heavy, 0.0
                if not impulse and r < count:
                    system[at, size] = -rows[r, ROW.bias]
                elif not impulse and d < 2:
                    system[at, size] = -work.links[i, HAS.b_x + d]
                at += 1
        elif not impulse and mode != MODE.smooth:
            _resist(work, r, u, size)
    _eliminate(system, size)
    for j in range(n):
        motion[a, j] = system[j, size]
    at = n
    for r in range(work.n_kinds):
        if kinds[r, 2] == MODE.stick and r < count:
            rows[r, ROW.force] = system[at, size]
            at += 1
        elif kinds[r, 2] == MODE.stick:
            for d in range(3):
                work.rings[r - count, RIM.grip, 1 + d] = system[at + d, size]
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
    c, s, o_x, o_y = links[i, HAS.cos], links[i, HAS.sin], links[i, HAS.v_x], links[i, HAS.v_y]
    x, y = rings[ring, RIM.points, 0], rings[ring, RIM.points, 1]
    slow = _SLOW * _SLOW * (o_x * o_x + o_y * o_y + omega * omega * (x * x + y * y))
    for j in range(RIM.points, rings.shape[1]):
        x, y = rotated(c, s, rings[ring, j, 0], rings[ring, j, 1])
        v_x, v_y = o_x - omega * y, o_y + omega * x
        square = v_x * v_x + v_y * v_y
        if square > 0.0:
            scale = -rings[ring, RIM.grip, 0] / math.sqrt(square + slow)
            f_x += scale * v_x
            f_y += scale * v_y
            torque += scale * (x * v_y - y * v_x)
    return f_x, f_y, torque


@inner
def _resist(work, r, u, column):  # type: ignore[no-untyped-def]
    """Add the friction of a row that slips, or of a ring that slides, to a column of the system."""
    system, slope = work.system, work.slope
    if r < work.n_rows:
        force = work.kinds[r, 2] * work.rows[r, ROW.bound]
        for j in range(work.n):
            system[j, column] -= force * work.rows[r, ROW.g + j]
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
                    speed += rows[r, ROW.g + j] * motion[a, j]
                    slow += (_SLOW * rows[r, ROW.g + j] * motion[a, j]) ** 2
                weight = rows[r, ROW.bound] / math.sqrt(speed * speed + slow)
                for j in range(n):
                    for k in range(n):
                        system[j, k] += weight * rows[r, ROW.g + j] * rows[r, ROW.g + k]
        for r in range(count, work.n_kinds):
            i, ring = work.kinds[r, 1], r - count
            c, s, turn = work.links[i, HAS.cos], work.links[i, HAS.sin], work.tree[i, LINK.turn]
            if work.kinds[r, 3] == 1 and work.kinds[r, 2] == MODE.slide:
                _resist(work, r, u, n)
                continue
            if attempt == 0:
                continue
            slow = 1e-24
            for j in range(n):
                way = abs(work.slope[i, j, 0]) + abs(work.slope[i, j, 1])
                if j == turn:
                    x, y = rings[ring, RIM.points, 0], rings[ring, RIM.points, 1]
                    way += math.sqrt(x**2 + y**2)
                slow += (_SLOW * way * motion[a, j]) ** 2
            for point in range(RIM.points, rings.shape[1]):
                x, y = rotated(c, s, rings[ring, point, 0], rings[ring, point, 1])
                work.slope[i, turn, 0] -= y
                work.slope[i, turn, 1] += x
                v_x, v_y = 0.0, 0.0
                for j in range(n):
                    v_x += work.slope[i, j, 0] * motion[a, j]
                    v_y += work.slope[i, j, 1] * motion[a, j]
                weight = rings[ring, RIM.grip, 0] / math.sqrt(v_x * v_x + v_y * v_y + slow)
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
        speed += work.rows[r, ROW.g + j] * work.motion[u, j]
    return speed


@inner
def set_twist(work, ring, i, u, field):  # type: ignore[no-untyped-def]
    """Set a ring's twist, its third part times the ring's radius; return its square."""
    rings = work.rings
    x, y = rings[ring, RIM.points, 0], rings[ring, RIM.points, 1]
    turned = work.motion[u, work.tree[i, LINK.turn]] * math.sqrt(x * x + y * y)
    v_x, v_y = work.links[i, HAS.v_x], work.links[i, HAS.v_y]
    rings[ring, field, 0], rings[ring, field, 1], rings[ring, field, 2] = v_x, v_y, turned
    return v_x * v_x + v_y * v_y + turned * turned


@inner
def strain(work, ring, i, tries=40):  # type: ignore[no-untyped-def]
    """Return by how much the reaction on a ring that holds exceeds what it can hold, as a share.

    With a wheel under the same body, or friction against turning, which hold with it.

    The greatest power of the reaction over that of friction, less one (S. Goyal, A. Ruina and
    J. Papadopoulos, Wear 143, 1991), by reweighted least squares.
    """
    rings, system, c, s = work.rings, work.system, work.links[i, HAS.cos], work.links[i, HAS.sin]
    grip, f_x, f_y = rings[ring, RIM.grip, 0], -rings[ring, RIM.grip, 1], -rings[ring, RIM.grip, 2]
    torque, square = -rings[ring, RIM.grip, 3], 0.0
    for j in range(RIM.points, rings.shape[1]):
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
        for j in range(RIM.points, rings.shape[1]):
            x, y = rotated(c, s, rings[ring, j, 0], rings[ring, j, 1])
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
            if work.kinds[r, 1] == i and work.kinds[r, 0] >= FRICTION.turning:
                row = work.rows[r]
                n_x, n_y, lever = 0.0, 0.0, 1.0
                if work.kinds[r, 0] >= FRICTION.along:
                    n_x, n_y = rotated(c, s, row[ROW.w_cos], row[ROW.w_sin])
                    x, y = rotated(c, s, row[ROW.w_x], row[ROW.w_y])
                    lever = n_y * x - n_x * y
                along = n_x * t_x + n_y * t_y + lever * rate
                speed = math.sqrt(along * along + _SLOW * _SLOW)
                lost += row[ROW.bound] * speed
                weight = row[ROW.bound] / speed
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
