"""Joints between two moving bodies in the contact-free fast path, and a substep of all bodies.

The arithmetic is that of Chipmunk's pivot joint, pin joint, motor and rotary damper. ``a`` and
``b`` are the rows of the bodies' numbers, ``own`` those of the joint. A joint to something fixed is
a link of `lockstep_solver`, with the same rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import lockstep_solver as solver
from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.joints import A_X, A_Y, B_X, B_Y, LENGTH
from pbrl_ppl.physics.lockstep_solver import (
    AX,
    AY,
    BLOCK,
    BX,
    BY,
    DX,
    DY,
    H_MAX,
    II,
    KXY,
    KYY,
    LINK_ROWS,
    LX,
    LY,
    MI,
    MX,
    MY,
    OX,
    OY,
    PX,
    PY,
    RM,
    RX,
    RY,
    VX,
    VY,
    C,
    K,
    L,
    S,
    W,
    X,
    Y,
    limited,
)
from pbrl_ppl.physics.properties import COLUMN

_FIRST = LINK_ROWS // BLOCK
# Anchor and arm of the first body; those of a link are the second body's.
A1X, A1Y, R1X, R1Y = (i * BLOCK for i in range(_FIRST, _FIRST + 4))
# Motor and damper in a hinge: greatest and stored impulse, moment; share of the speed that the
# damper removes, as given and in use, and its target.
M_MAX, MJ, MM, SHARE, TAKEN, GOAL = (i * BLOCK for i in range(_FIRST + 4, _FIRST + 10))
JOINT_ROWS = LINK_ROWS + 10 * BLOCK


class Block(NamedTuple):
    """Numbers of the bodies, joints and patches of a block of transitions."""

    bodies: NDArray[np.float64]  # (body + 1, ROWS): the last is fixed
    joints: NDArray[np.float64]  # (joint, JOINT_ROWS)
    patches: NDArray[np.float64]  # (patch, point, POINT_ROWS)
    slowing: NDArray[np.float64]  # (patch, BLOCK): deceleration by friction (m/s^2)
    patch_radius: NDArray[np.float64]  # (patch, BLOCK), m
    rough: NDArray[np.bool_]  # (joint,): whether there is friction in it
    iterations: NDArray[np.int64]  # (BLOCK,)


@compiled
def set_joint(own, i, bodies, chain, j, joint, row, step):  # type: ignore[no-untyped-def]
    """Set the numbers of link ``j`` in transition ``i`` for an interval."""
    a, b, pose = bodies[chain.link_ends[j, 0]], bodies[chain.link_ends[j, 1]], chain.link_pose[j]
    first, second = (joint[A_X], joint[A_Y]), (joint[B_X], joint[B_Y])
    if chain.link_turned[j]:
        first, second = second, first
    own[A1X + i], own[A1Y + i] = first[0] - a[OX + i], first[1] - a[OY + i]
    own[AX + i], own[AY + i] = second[0] - b[OX + i], second[1] - b[OY + i]
    own[PX + i] = pose[0] + pose[2] * first[0] - pose[3] * first[1]
    own[PY + i] = pose[1] + pose[3] * first[0] + pose[2] * first[1]
    own[L + i] = joint[LENGTH]
    if chain.link_pivot[j] >= 0:
        own[M_MAX + i] = row[COLUMN.pivot_torque] * step
        damping = row[COLUMN.pivot_damping] * (a[II + i] + b[II + i])
        own[SHARE + i] = 1.0 - math.exp(-damping * step) if damping else 0.0


@compiled
def place(a, b, own, rod, step):  # type: ignore[no-untyped-def]
    """Set arms, drift and masses of a hinge or rod at the bodies' present places."""
    for i in range(BLOCK):
        x_1 = a[C + i] * own[A1X + i] - a[S + i] * own[A1Y + i]
        y_1 = a[S + i] * own[A1X + i] + a[C + i] * own[A1Y + i]
        x_2 = b[C + i] * own[AX + i] - b[S + i] * own[AY + i]
        y_2 = b[S + i] * own[AX + i] + b[C + i] * own[AY + i]
        own[R1X + i], own[R1Y + i], own[RX + i], own[RY + i] = x_1, y_1, x_2, y_2
        d_x = (b[X + i] + x_2) - (a[X + i] + x_1)
        d_y = (b[Y + i] + y_2) - (a[Y + i] + y_1)
        mass, i_1, i_2 = a[MI + i] + b[MI + i], a[II + i], b[II + i]
        if rod:
            distance = math.sqrt(d_x * d_x + d_y * d_y)
            scale = 1.0 / distance if distance > 0.0 else 0.0
            n_x, n_y = d_x * scale, d_y * scale
            own[DX + i], own[DY + i] = n_x, n_y
            c_1, c_2 = x_1 * n_y - y_1 * n_x, x_2 * n_y - y_2 * n_x
            own[K + i] = 1.0 / (mass + i_1 * c_1 * c_1 + i_2 * c_2 * c_2)
            own[BX + i] = (own[L + i] - distance) / step
        else:
            own[BX + i], own[BY + i] = -d_x / step, -d_y / step
            xx = mass + y_1 * y_1 * i_1 + y_2 * y_2 * i_2
            xy = -x_1 * y_1 * i_1 - x_2 * y_2 * i_2
            yy = mass + x_1 * x_1 * i_1 + x_2 * x_2 * i_2
            inverse = 1.0 / (xx * yy - xy * xy)
            own[K + i], own[KXY + i], own[KYY + i] = yy * inverse, -xy * inverse, xx * inverse


@compiled
def begin(a, b, own, rod):  # type: ignore[no-untyped-def]
    """Apply the impulse of the substep before."""
    for i in range(BLOCK):
        j_x, j_y = own[LX + i], own[LY + i]
        if rod:
            j_x, j_y = own[DX + i] * own[LX + i], own[DY + i] * own[LX + i]
        _push(a, b, own, i, j_x, j_y)


@compiled
def _push(a, b, own, i, j_x, j_y):  # type: ignore[no-untyped-def]
    """Apply an impulse to the second body, and its opposite to the first."""
    a[VX + i] -= j_x * a[MI + i]
    a[VY + i] -= j_y * a[MI + i]
    a[W + i] -= a[II + i] * (own[R1X + i] * j_y - own[R1Y + i] * j_x)
    b[VX + i] += j_x * b[MI + i]
    b[VY + i] += j_y * b[MI + i]
    b[W + i] += b[II + i] * (own[RX + i] * j_y - own[RY + i] * j_x)


@compiled
def solve(a, b, own, rod):  # type: ignore[no-untyped-def]
    """Do one iteration of a hinge or rod."""
    for i in range(BLOCK):
        w_1, w_2 = a[W + i], b[W + i]
        v_x = (b[VX + i] - own[RY + i] * w_2) - (a[VX + i] - own[R1Y + i] * w_1)
        v_y = (b[VY + i] + own[RX + i] * w_2) - (a[VY + i] + own[R1X + i] * w_1)
        if rod:
            n_x, n_y = own[DX + i], own[DY + i]
            j = (own[BX + i] - (n_x * v_x + n_y * v_y)) * own[K + i]
            own[LX + i] += j
            _push(a, b, own, i, n_x * j, n_y * j)
        else:
            d_x, d_y = own[BX + i] - v_x, own[BY + i] - v_y
            j_x = own[K + i] * d_x + own[KXY + i] * d_y
            j_y = own[KXY + i] * d_x + own[KYY + i] * d_y
            own[LX + i] += j_x
            own[LY + i] += j_y
            _push(a, b, own, i, j_x, j_y)


@compiled
def begin_pivot(a, b, own):  # type: ignore[no-untyped-def]
    """Apply the motor's impulse of the substep before."""
    for i in range(BLOCK):
        own[MM + i], own[TAKEN + i] = 1.0 / (a[II + i] + b[II + i]), own[SHARE + i]
        own[GOAL + i] = 0.0
        a[W + i] -= own[MJ + i] * a[II + i]
        b[W + i] += own[MJ + i] * b[II + i]


@compiled
def solve_pivot(a, b, own):  # type: ignore[no-untyped-def]
    """Do one iteration of friction in a hinge: the motor, then the damper."""
    for i in range(BLOCK):
        i_1, i_2, mass = a[II + i], b[II + i], own[MM + i]
        w_1, w_2, most, old = a[W + i], b[W + i], own[M_MAX + i], own[MJ + i]
        new = limited(old - (w_2 - w_1) * mass, most)
        own[MJ + i] = new
        w_1 -= (new - old) * i_1
        w_2 += (new - old) * i_2
        w = w_1 - w_2
        change = (own[GOAL + i] - w) * own[TAKEN + i]
        own[GOAL + i] = w + change
        a[W + i] = w_1 + change * mass * i_1
        b[W + i] = w_2 - change * mass * i_2


@compiled
def _finish(block, i):  # type: ignore[no-untyped-def]
    """Make further iterations change nothing in transition ``i``."""
    for z in block.bodies:
        z[MX + i] = z[MY + i] = 0.0
    for own in block.joints:
        own[K + i] = own[KXY + i] = own[KYY + i] = own[MM + i] = own[TAKEN + i] = 0.0
    for points in block.patches:
        for own in points:
            own[K + i] = own[KXY + i] = own[KYY + i] = own[RM + i] = 0.0
            own[H_MAX + i] = math.inf  # else rounding clips an impulse on the limit once more


@compiled
def _iterate(block, chain, times):  # type: ignore[no-untyped-def]
    """Iterate all constraints, in the engine's order."""
    bodies, joints, patches = block.bodies, block.joints, block.patches
    for _ in range(times):
        for k in range(len(chain.wheel)):
            if chain.wheel[k]:
                solver.solve_wheel(bodies[k])
        for j in range(len(joints)):
            a, b = bodies[chain.link_ends[j, 0]], bodies[chain.link_ends[j, 1]]
            if chain.link_ends[j, 0] < 0:
                solver.solve_link(b, joints[j], chain.link_rod[j])
            else:
                solve(a, b, joints[j], chain.link_rod[j])
            if block.rough[j]:
                solve_pivot(a, b, joints[j])
        for j in range(len(patches)):
            solver.solve_patch(bodies[chain.patch_body[j]], patches[j])


@compiled
def substep(block, chain, step):  # type: ignore[no-untyped-def]
    """Do one step of the engine, with the iterations of each transition of the block."""
    bodies, joints, patches = block.bodies, block.joints, block.patches
    moving, ends, most = len(chain.radii), chain.link_ends, block.iterations
    for k in range(moving):
        solver.turn(bodies[k], step)
    for j in range(len(patches)):
        z = bodies[chain.patch_body[j]]
        solver.place_patch(z, patches[j], chain.ring, block.slowing[j], block.patch_radius[j], step)
    for j in range(len(joints)):
        a, b = bodies[ends[j, 0]], bodies[ends[j, 1]]
        if ends[j, 0] < 0:
            solver.place_link(b, joints[j], chain.link_rod[j], step)
        else:
            place(a, b, joints[j], chain.link_rod[j], step)
    for k in range(moving):
        solver.accelerate(bodies[k], chain.gravity, step)
    for k in range(moving):
        if chain.wheel[k]:
            solver.begin_wheel(bodies[k])
    for j in range(len(joints)):
        a, b = bodies[ends[j, 0]], bodies[ends[j, 1]]
        if ends[j, 0] < 0:
            solver.begin_link(b, joints[j], chain.link_rod[j])
        else:
            begin(a, b, joints[j], chain.link_rod[j])
        if block.rough[j]:
            begin_pivot(a, b, joints[j])
    for j in range(len(patches)):
        solver.begin_patch(bodies[chain.patch_body[j]], patches[j])
    done, longest = 0, most.max()
    while done < longest:
        until = longest
        for i in range(BLOCK):
            if most[i] > done:
                until = min(until, most[i])
        _iterate(block, chain, until - done)
        if until < longest:
            for i in range(BLOCK):
                if most[i] == until:
                    _finish(block, i)
        done = until
