"""A substep of bodies side by side: Chipmunk's ``cpSpaceStep`` where nothing touches, in its order.

Numba's cache looks at the file of the function called from Python alone: after an edit here, the
cached rollouts of `pbrl_ppl.physics.lockstep` and `pbrl_ppl.physics.lockstep_chain` are stale until
``__pycache__`` is removed. The same goes for `lockstep_bodies` and `lockstep_joints`.
"""

from __future__ import annotations

import math

import numba

from pbrl_ppl.physics.world import STICKING

#: Transitions side by side.
LANES = 32

# Rows of the numbers of all lanes, one array: the compiler then knows that rows do not overlap.
# State; heading; wrench over mass and moment; inverse mass and moment.
X, Y, A, VX, VY, W, C, S, FX, FY, T, MI, II = (i * LANES for i in range(13))
# Wheel: place, axis, greatest and stored impulses; its arm and masses in a substep.
WX, WY, WC, WS, JX_MAX, JY_MAX, JX, JY = (i * LANES for i in range(13, 21))
NX, NY, CX, CY, MX, MY = (i * LANES for i in range(21, 27))
# Hinge's motor and damper.
T_MAX, TJ, COEF, AIM = (i * LANES for i in range(27, 31))
# Weight that the body has beyond the scene's gravity.
GX, GY = (i * LANES for i in range(31, 33))
# Centre of mass in the body's frame; place of the origin; wrench on it.
OX, OY, X0, Y0, UX, UY, UT = (i * LANES for i in range(33, 40))
ROWS = 40 * LANES
# A link: anchor on the body, the point it is held at, length; arm, stored impulse, bias; a hinge's
# inverse tensor, of which a rod's mass is the first; a rod's direction.
AX, AY, PX, PY, L, RX, RY, LX, LY, BX, BY, K, KXY, KYY, DX, DY = (i * LANES for i in range(16))
LINK_ROWS = 16 * LANES
# A point of a patch: as a link, and the greatest impulses of what holds it and of its rod.
HX, HY, H_MAX, RJ, R_MAX, CROSS, RM = (i * LANES for i in range(16, 23))
POINT_ROWS = 23 * LANES
#: A turn of less in a substep (rad) is taken by a series, exact to rounding.
_SMALL_TURN = 0.5
_C1, _C2, _C3, _C4, _C5, _C6, _C7 = ((-1) ** k / math.factorial(2 * k) for k in range(1, 8))
_S1, _S2, _S3, _S4, _S5, _S6, _S7 = ((-1) ** k / math.factorial(2 * k + 1) for k in range(1, 8))


@numba.njit(nogil=True, cache=True)
def turn(z, step):  # type: ignore[no-untyped-def]
    """Move the bodies and turn their headings."""
    fast = False
    for i in range(LANES):
        z[X + i] += z[VX + i] * step
        z[Y + i] += z[VY + i] * step
        a = z[W + i] * step
        z[A + i] += a
        fast |= not abs(a) < _SMALL_TURN
        d = a * a
        c = 1.0 + d * (_C1 + d * (_C2 + d * (_C3 + d * (_C4 + d * (_C5 + d * (_C6 + d * _C7))))))
        s = _S1 + d * (_S2 + d * (_S3 + d * (_S4 + d * (_S5 + d * (_S6 + d * _S7)))))
        s = a * (1.0 + d * s)
        before = z[C + i]
        z[C + i] = before * c - z[S + i] * s
        z[S + i] = z[S + i] * c + before * s
    if fast:
        for i in range(LANES):
            if not abs(z[W + i] * step) < _SMALL_TURN:
                z[C + i], z[S + i] = math.cos(z[A + i]), math.sin(z[A + i])


@numba.njit(nogil=True, cache=True)
def accelerate(z, gravity, step):  # type: ignore[no-untyped-def]
    """Add what gravity and the wrench give in a substep."""
    g_x, g_y = gravity
    for i in range(LANES):
        z[VX + i] += (g_x + z[FX + i]) * step
        z[VY + i] += (g_y + z[FY + i]) * step
        z[W + i] += z[T + i] * step


@numba.njit(nogil=True, cache=True)
def limited(impulse, most):  # type: ignore[no-untyped-def]
    """An impulse no larger than ``most`` either way."""
    impulse = most if impulse > most else impulse
    return -most if impulse < -most else impulse


@numba.njit(nogil=True, cache=True)
def begin_wheel(z):  # type: ignore[no-untyped-def]
    """Two rods from the wheel along its axes, with the impulses of the substep before."""
    for i in range(LANES):
        c, s = z[C + i], z[S + i]
        r_x, r_y = c * z[WX + i] - s * z[WY + i], s * z[WX + i] + c * z[WY + i]
        n_x, n_y = c * z[WC + i] - s * z[WS + i], s * z[WC + i] + c * z[WS + i]
        along, across = r_x * n_y - r_y * n_x, r_x * n_x + r_y * n_y
        mass, moment = z[MI + i], z[II + i]
        z[NX + i], z[NY + i], z[CX + i], z[CY + i] = n_x, n_y, along, across
        z[MX + i] = 1.0 / (mass + moment * along * along)
        z[MY + i] = 1.0 / (mass + moment * across * across)
        j_x, j_y = z[JX + i], z[JY + i]
        z[VX + i] -= (n_x * j_x - n_y * j_y) * mass
        z[VY + i] -= (n_y * j_x + n_x * j_y) * mass
        z[W + i] -= moment * (along * j_x + across * j_y)


@numba.njit(nogil=True, cache=True)
def solve_wheel(z):  # type: ignore[no-untyped-def]
    """One iteration of the wheel's rods, which friction limits."""
    for i in range(LANES):
        n_x, n_y, along, across = z[NX + i], z[NY + i], z[CX + i], z[CY + i]
        mass, moment, v_x, v_y, w = z[MI + i], z[II + i], z[VX + i], z[VY + i], z[W + i]
        most, old = z[JX_MAX + i], z[JX + i]
        new = limited(old + (n_x * v_x + n_y * v_y + along * w) * z[MX + i], most)
        z[JX + i] = new
        j = new - old
        v_x -= n_x * j * mass
        v_y -= n_y * j * mass
        w -= moment * along * j
        most, old = z[JY_MAX + i], z[JY + i]
        new = limited(old + (n_x * v_y - n_y * v_x + across * w) * z[MY + i], most)
        z[JY + i] = new
        j = new - old
        z[VX + i] = v_x + n_y * j * mass
        z[VY + i] = v_y - n_x * j * mass
        z[W + i] = w - moment * across * j


@numba.njit(nogil=True, cache=True)
def _inverse_tensor(z, own, i):  # type: ignore[no-untyped-def]
    """What a point of the body at its arm gains from an impulse, inverted."""
    r_x, r_y, mass, moment = own[RX + i], own[RY + i], z[MI + i], z[II + i]
    xx, xy, yy = mass + r_y * r_y * moment, -r_x * r_y * moment, mass + r_x * r_x * moment
    inverse = 1.0 / (xx * yy - xy * xy)
    own[K + i], own[KXY + i], own[KYY + i] = yy * inverse, -xy * inverse, xx * inverse


@numba.njit(nogil=True, cache=True)
def _push(z, own, i, j_x, j_y):  # type: ignore[no-untyped-def]
    """Apply an impulse at an arm."""
    z[VX + i] += j_x * z[MI + i]
    z[VY + i] += j_y * z[MI + i]
    z[W + i] += z[II + i] * (own[RX + i] * j_y - own[RY + i] * j_x)


@numba.njit(nogil=True, cache=True)
def place_link(z, own, rod, step):  # type: ignore[no-untyped-def]
    """Arm, drift to correct and masses of a link, where the body now is."""
    for i in range(LANES):
        c, s = z[C + i], z[S + i]
        own[RX + i] = c * own[AX + i] - s * own[AY + i]
        own[RY + i] = s * own[AX + i] + c * own[AY + i]
        d_x = own[PX + i] - (z[X + i] + own[RX + i])
        d_y = own[PY + i] - (z[Y + i] + own[RY + i])
        if rod:
            distance = math.sqrt(d_x * d_x + d_y * d_y)
            scale = 1.0 / distance if distance > 0.0 else 0.0
            own[DX + i], own[DY + i] = d_x * scale, d_y * scale
            across = own[RX + i] * own[DY + i] - own[RY + i] * own[DX + i]
            own[K + i] = 1.0 / (z[MI + i] + z[II + i] * across * across)
            own[BX + i] = (distance - own[L + i]) / step
        else:
            own[BX + i], own[BY + i] = d_x / step, d_y / step
            _inverse_tensor(z, own, i)


@numba.njit(nogil=True, cache=True)
def begin_link(z, own, rod):  # type: ignore[no-untyped-def]
    """Apply the impulse of the substep before."""
    for i in range(LANES):
        if rod:
            _push(z, own, i, own[DX + i] * own[LX + i], own[DY + i] * own[LX + i])
        else:
            _push(z, own, i, own[LX + i], own[LY + i])


@numba.njit(nogil=True, cache=True)
def solve_link(z, own, rod):  # type: ignore[no-untyped-def]
    """One iteration of a hinge or rod."""
    for i in range(LANES):
        v_x = z[VX + i] - own[RY + i] * z[W + i]
        v_y = z[VY + i] + own[RX + i] * z[W + i]
        if rod:
            n_x, n_y = own[DX + i], own[DY + i]
            j = (own[BX + i] - (n_x * v_x + n_y * v_y)) * own[K + i]
            own[LX + i] += j
            _push(z, own, i, n_x * j, n_y * j)
        else:
            d_x, d_y = own[BX + i] - v_x, own[BY + i] - v_y
            j_x = own[K + i] * d_x + own[KXY + i] * d_y
            j_y = own[KXY + i] * d_x + own[KYY + i] * d_y
            own[LX + i] += j_x
            own[LY + i] += j_y
            _push(z, own, i, j_x, j_y)


@numba.njit(nogil=True, cache=True)
def begin_pivot(z):  # type: ignore[no-untyped-def]
    """Apply the motor's impulse of the substep before."""
    for i in range(LANES):
        z[W + i] -= z[TJ + i] * z[II + i]
        z[AIM + i] = 0.0


@numba.njit(nogil=True, cache=True)
def solve_pivot(z):  # type: ignore[no-untyped-def]
    """Friction in a hinge: the motor, then the damper."""
    for i in range(LANES):
        most, old, w = z[T_MAX + i], z[TJ + i], z[W + i]
        new = limited(old + w / z[II + i], most)
        z[TJ + i] = new
        w -= (new - old) * z[II + i]
        change = (z[AIM + i] - w) * z[COEF + i]
        z[AIM + i] = w + change
        z[W + i] = w + change


@numba.njit(nogil=True, cache=True)
def place_patch(z, points, ring, slowing, radius, step):  # type: ignore[no-untyped-def]
    """Share each point's friction between what holds it and its rod, along its velocity."""
    for p in range(len(ring)):
        own = points[p]
        for i in range(LANES):
            c, s = z[C + i], z[S + i]
            at_x, at_y = ring[p, 0] * radius[i] - z[OX + i], ring[p, 1] * radius[i] - z[OY + i]
            r_x, r_y = c * at_x - s * at_y, s * at_x + c * at_y
            own[RX + i], own[RY + i] = r_x, r_y
            d_x, d_y = z[VX + i] - z[W + i] * r_y, z[VY + i] + z[W + i] * r_x
            speed = math.sqrt(d_x * d_x + d_y * d_y)
            slow = STICKING * slowing[i] * step
            share = 1.0 if speed >= slow else speed / slow
            most = slowing[i] / z[MI + i] / len(ring) * step
            own[H_MAX + i], own[R_MAX + i] = (1.0 - share) * most, share * most
            rest = speed == 0.0
            scale = 1.0 if rest else 1.0 / speed
            d_x = 1.0 if rest else d_x * scale
            d_y = 0.0 if rest else d_y * scale
            own[DX + i], own[DY + i] = d_x, d_y
            across = r_x * d_y - r_y * d_x
            own[CROSS + i] = across
            own[RM + i] = 1.0 / (z[MI + i] + z[II + i] * across * across)
            _inverse_tensor(z, own, i)


@numba.njit(nogil=True, cache=True)
def begin_patch(z, points):  # type: ignore[no-untyped-def]
    """Apply the impulses of the substep before."""
    for own in points:
        for i in range(LANES):
            j = own[RJ + i]
            _push(z, own, i, own[HX + i] + own[DX + i] * j, own[HY + i] + own[DY + i] * j)


@numba.njit(nogil=True, cache=True)
def solve_patch(z, points):  # type: ignore[no-untyped-def]
    """What holds the points, then their rods; how many impulses changed.

    With none, a further iteration repeats this one.
    """
    changed = 0
    for own in points:
        for i in range(LANES):
            v_x = z[VX + i] - own[RY + i] * z[W + i]
            v_y = z[VY + i] + own[RX + i] * z[W + i]
            old_x, old_y, most = own[HX + i], own[HY + i], own[H_MAX + i]
            new_x = old_x - (own[K + i] * v_x + own[KXY + i] * v_y)
            new_y = old_y - (own[KXY + i] * v_x + own[KYY + i] * v_y)
            size = new_x * new_x + new_y * new_y
            scale = most / math.sqrt(size) if size > most * most else 1.0
            own[HX + i], own[HY + i] = new_x * scale, new_y * scale
            changed += own[HX + i] != old_x or own[HY + i] != old_y
            _push(z, own, i, own[HX + i] - old_x, own[HY + i] - old_y)
    for own in points:
        for i in range(LANES):
            n_x, n_y, most, old = own[DX + i], own[DY + i], own[R_MAX + i], own[RJ + i]
            v = n_x * z[VX + i] + n_y * z[VY + i] + own[CROSS + i] * z[W + i]
            new = limited(old - v * own[RM + i], most)
            own[RJ + i] = new
            changed += new != old
            _push(z, own, i, n_x * (new - old), n_y * (new - old))
    return changed
