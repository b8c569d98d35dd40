"""Joints of two bodies side by side: Chipmunk's pivot joint, pin joint, motor and rotary damper.

``a`` and ``b`` are the rows of the bodies' numbers, ``own`` those of the joint; a joint to what
does not move is a link of `lockstep_solver`, of the same rows.
"""

from __future__ import annotations

import math

import numba

from pbrl_ppl.physics import lockstep_solver as single
from pbrl_ppl.physics.lockstep_solver import (
    AX,
    AY,
    BX,
    BY,
    DX,
    DY,
    H_MAX,
    II,
    KXY,
    KYY,
    LANES,
    LINK_ROWS,
    LX,
    LY,
    MI,
    MX,
    MY,
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

_FIRST = LINK_ROWS // LANES
# The other body's anchor and arm; a link's are the second body's.
A1X, A1Y, R1X, R1Y = (i * LANES for i in range(_FIRST, _FIRST + 4))
# Motor and damper in a hinge: greatest and stored impulse, moment; share of the speed that the
# damper takes, as given and in use, and its aim.
M_MAX, MJ, MM, SHARE, TAKEN, GOAL = (i * LANES for i in range(_FIRST + 4, _FIRST + 10))
JOINT_ROWS = LINK_ROWS + 10 * LANES


@numba.njit(nogil=True, cache=True)
def place(a, b, own, rod, step):  # type: ignore[no-untyped-def]
    """Arms, drift to correct and masses of a hinge or rod, where the bodies now are."""
    for i in range(LANES):
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


@numba.njit(nogil=True, cache=True)
def begin(a, b, own, rod):  # type: ignore[no-untyped-def]
    """Apply the impulse of the substep before."""
    for i in range(LANES):
        j_x, j_y = own[LX + i], own[LY + i]
        if rod:
            j_x, j_y = own[DX + i] * own[LX + i], own[DY + i] * own[LX + i]
        _push(a, b, own, i, j_x, j_y)


@numba.njit(nogil=True, cache=True)
def _push(a, b, own, i, j_x, j_y):  # type: ignore[no-untyped-def]
    """Apply an impulse to the second body, and its opposite to the first."""
    a[VX + i] -= j_x * a[MI + i]
    a[VY + i] -= j_y * a[MI + i]
    a[W + i] -= a[II + i] * (own[R1X + i] * j_y - own[R1Y + i] * j_x)
    b[VX + i] += j_x * b[MI + i]
    b[VY + i] += j_y * b[MI + i]
    b[W + i] += b[II + i] * (own[RX + i] * j_y - own[RY + i] * j_x)


@numba.njit(nogil=True, cache=True)
def solve(a, b, own, rod):  # type: ignore[no-untyped-def]
    """One iteration of a hinge or rod."""
    for i in range(LANES):
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


@numba.njit(nogil=True, cache=True)
def begin_pivot(a, b, own):  # type: ignore[no-untyped-def]
    """Apply the motor's impulse of the substep before."""
    for i in range(LANES):
        own[MM + i], own[TAKEN + i] = 1.0 / (a[II + i] + b[II + i]), own[SHARE + i]
        own[GOAL + i] = 0.0
        a[W + i] -= own[MJ + i] * a[II + i]
        b[W + i] += own[MJ + i] * b[II + i]


@numba.njit(nogil=True, cache=True)
def solve_pivot(a, b, own):  # type: ignore[no-untyped-def]
    """One iteration of friction in a hinge: the motor, then the damper."""
    for i in range(LANES):
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


@numba.njit(nogil=True, cache=True)
def rest(bodies, joints, patches, i):  # type: ignore[no-untyped-def]
    """Let further iterations change nothing in lane ``i``."""
    for z in bodies:
        z[MX + i] = z[MY + i] = 0.0
    for own in joints:
        own[K + i] = own[KXY + i] = own[KYY + i] = own[MM + i] = own[TAKEN + i] = 0.0
    for points in patches:
        for own in points:
            own[K + i] = own[KXY + i] = own[KYY + i] = own[RM + i] = 0.0
            own[H_MAX + i] = math.inf  # else rounding clips once more what is on the limit


@numba.njit(nogil=True, cache=True)
def _iterate(  # type: ignore[no-untyped-def]
    bodies, joints, patches, wheel, ends, rods, rough, patch_body, times
):
    """Iterate all constraints, in the order in which the engine has them."""
    for _ in range(times):
        for k in range(len(wheel)):
            if wheel[k]:
                single.solve_wheel(bodies[k])
        for j in range(len(joints)):
            a, b = bodies[ends[j, 0]], bodies[ends[j, 1]]
            if ends[j, 0] < 0:
                single.solve_link(b, joints[j], rods[j])
            else:
                solve(a, b, joints[j], rods[j])
            if rough[j]:
                solve_pivot(a, b, joints[j])
        for j in range(len(patches)):
            single.solve_patch(bodies[patch_body[j]], patches[j])


@numba.njit(nogil=True, cache=True)
def substep(  # type: ignore[no-untyped-def]
    bodies, joints, patches, chain, rough, slowing, patch_radius, step, most
):
    """One step of the engine, of ``most`` iterations a lane, shape (LANES,)."""
    moving, ends = len(chain.radii), chain.link_ends
    for k in range(moving):
        single.turn(bodies[k], step)
    for j in range(len(patches)):
        z = bodies[chain.patch_body[j]]
        single.place_patch(z, patches[j], chain.ring, slowing[j], patch_radius[j], step)
    for j in range(len(joints)):
        a, b = bodies[ends[j, 0]], bodies[ends[j, 1]]
        if ends[j, 0] < 0:
            single.place_link(b, joints[j], chain.link_rod[j], step)
        else:
            place(a, b, joints[j], chain.link_rod[j], step)
    for k in range(moving):
        single.accelerate(bodies[k], chain.gravity, step)
    for k in range(moving):
        if chain.wheel[k]:
            single.begin_wheel(bodies[k])
    for j in range(len(joints)):
        a, b = bodies[ends[j, 0]], bodies[ends[j, 1]]
        if ends[j, 0] < 0:
            single.begin_link(b, joints[j], chain.link_rod[j])
        else:
            begin(a, b, joints[j], chain.link_rod[j])
        if rough[j]:
            begin_pivot(a, b, joints[j])
    for j in range(len(patches)):
        single.begin_patch(bodies[chain.patch_body[j]], patches[j])
    done, longest = 0, most.max()
    while done < longest:
        until = longest
        for i in range(LANES):
            if most[i] > done:
                until = min(until, most[i])
        _iterate(
            bodies, joints, patches, chain.wheel, ends, chain.link_rod, rough,
            chain.patch_body, until - done,
        )  # fmt: skip
        if until < longest:
            for i in range(LANES):
                if most[i] == until:
                    rest(bodies, joints, patches, i)
        done = until
