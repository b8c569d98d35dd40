"""One substep of single bodies in the contact-free fast path, for many transitions at once.

This is Chipmunk's ``cpSpaceStep`` without contacts, in its order. States, wrenches and obstacles
refer to a body's origin; the substep moves its centre of mass.
"""

from __future__ import annotations

import math

from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.joints import A_X, A_Y, B_X, B_Y, LENGTH
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import STICKING

#: Number of transitions in a block, which are computed side by side.
BLOCK = 32

# Offsets of a block's rows in one array ``z``; in one array, the compiler knows that rows do not
# overlap. State; heading; wrench over mass and moment; inverse mass and moment.
X, Y, A, VX, VY, W, C, S, FX, FY, T, MI, II = (i * BLOCK for i in range(13))
# Wheel: place, axis, greatest and stored impulses; its direction, arms and masses in a substep.
WX, WY, WC, WS, JX_MAX, JY_MAX, JX, JY = (i * BLOCK for i in range(13, 21))
NX, NY, CX, CY, MX, MY = (i * BLOCK for i in range(21, 27))
# Hinge's motor and damper.
T_MAX, TJ, COEF, AIM = (i * BLOCK for i in range(27, 31))
# Weight in addition to the scene's gravity.
GX, GY = (i * BLOCK for i in range(31, 33))
# Centre of mass in the body's frame; place of the origin; wrench on it.
OX, OY, X0, Y0, UX, UY, UT = (i * BLOCK for i in range(33, 40))
ROWS = 40 * BLOCK
# Link (a joint to something fixed): anchor on the body, fixed point, length; arm, stored impulse,
# bias; a hinge's inverse tensor, whose first row is a rod's mass; a rod's direction.
AX, AY, PX, PY, L, RX, RY, LX, LY, BX, BY, K, KXY, KYY, DX, DY = (i * BLOCK for i in range(16))
LINK_ROWS = 16 * BLOCK
# Point of a patch: as a link, then stored and greatest impulses of its pivot joint and its rod.
HX, HY, H_MAX, RJ, R_MAX, CROSS, RM = (i * BLOCK for i in range(16, 23))
POINT_ROWS = 23 * BLOCK
#: Smaller rotations in a substep (rad) are computed by a series, exact to rounding.
_SMALL_TURN = 0.5
_C1, _C2, _C3, _C4, _C5, _C6, _C7 = ((-1) ** k / math.factorial(2 * k) for k in range(1, 8))
_S1, _S2, _S3, _S4, _S5, _S6, _S7 = ((-1) ** k / math.factorial(2 * k + 1) for k in range(1, 8))


@compiled
def set_body(z, i, row, wheel, normal_gravity, step):  # type: ignore[no-untyped-def]
    """Set the properties of transition ``i`` of the block for an interval; keep stored impulses.

    Returns whether the centre of mass is off the origin.
    """
    mass, com_x, com_y = row[COLUMN.mass], row[COLUMN.com_x], row[COLUMN.com_y]
    z[MI + i], z[II + i] = 1.0 / mass, 1.0 / row[COLUMN.moment]
    z[GX + i], z[GY + i] = mass * row[COLUMN.extra_gravity_x], mass * row[COLUMN.extra_gravity_y]
    z[OX + i], z[OY + i] = com_x, com_y
    if wheel:
        load, turn = mass * normal_gravity, row[COLUMN.w_theta]
        z[WX + i], z[WY + i] = row[COLUMN.w_x] - com_x, row[COLUMN.w_y] - com_y
        z[WC + i], z[WS + i] = math.cos(turn), math.sin(turn)
        z[JX_MAX + i] = row[COLUMN.mu_x] * load * step
        z[JY_MAX + i] = row[COLUMN.mu_y] * load * step
    return com_x != 0.0 or com_y != 0.0


@compiled
def set_state(z, i, state):  # type: ignore[no-untyped-def]
    """Set the state of the centre of mass of transition ``i`` from that of the origin."""
    z[A + i], z[W + i] = state[2], state[5]
    align(z, i)
    x, y = _arm(z, i)
    z[X + i], z[Y + i] = state[0] + x, state[1] + y
    z[VX + i], z[VY + i] = state[3] - state[5] * y, state[4] + state[5] * x


@compiled
def align(z, i):  # type: ignore[no-untyped-def]
    """Set the heading of transition ``i`` from its angle, which removes accumulated rounding."""
    z[C + i], z[S + i] = math.cos(z[A + i]), math.sin(z[A + i])


@compiled
def _arm(z, i):  # type: ignore[no-untyped-def]
    """Return the arm from the origin to the centre of mass, in the world's frame."""
    if z[OX + i] == 0.0 and z[OY + i] == 0.0:
        return 0.0, 0.0
    c, s, x, y = z[C + i], z[S + i], z[OX + i], z[OY + i]
    return c * x - s * y, s * x + c * y


@compiled
def get_state(z, i, state):  # type: ignore[no-untyped-def]
    """Write the state of the origin of transition ``i`` into ``state``."""
    x, y = _arm(z, i)
    state[0], state[1], state[2] = z[X + i] - x, z[Y + i] - y, z[A + i]
    state[3], state[4] = z[VX + i] + z[W + i] * y, z[VY + i] - z[W + i] * x
    state[5] = z[W + i]


@compiled
def add(total, state, weight, level, levels):  # type: ignore[no-untyped-def]
    """Add the state of one number of substeps to the weighted sum."""
    for d in range(6):
        if levels == 1:
            total[d] = state[d]
        else:
            total[d] = weight * state[d] + (total[d] if level else 0.0)


@compiled
def set_wrench(z, i, wrench):  # type: ignore[no-untyped-def]
    """Set the accelerations of transition ``i`` by a wrench and the additional weight."""
    z[UX + i], z[UY + i], z[UT + i] = wrench[0], wrench[1], wrench[2]
    z[FX + i] = (wrench[0] + z[GX + i]) * z[MI + i]
    z[FY + i] = (wrench[1] + z[GY + i]) * z[MI + i]
    z[T + i] = wrench[2] * z[II + i]


@compiled
def lever(z):  # type: ignore[no-untyped-def]
    """Set the angular accelerations by forces on origins that are off the centres of mass."""
    for i in range(BLOCK):
        x = z[C + i] * z[OX + i] - z[S + i] * z[OY + i]
        y = z[S + i] * z[OX + i] + z[C + i] * z[OY + i]
        z[T + i] = (z[UT + i] - (x * z[UY + i] - y * z[UX + i])) * z[II + i]


@compiled
def locate(z):  # type: ignore[no-untyped-def]
    """Compute the places of the origins."""
    for i in range(BLOCK):
        z[X0 + i] = z[X + i] - (z[C + i] * z[OX + i] - z[S + i] * z[OY + i])
        z[Y0 + i] = z[Y + i] - (z[S + i] * z[OX + i] + z[C + i] * z[OY + i])


@compiled
def lose(z, free, touched):  # type: ignore[no-untyped-def]
    """Mark the transitions that have diverged."""
    for i in range(BLOCK):
        speed = abs(z[VX + i]) + abs(z[VY + i]) + free.size * abs(z[W + i])
        touched[i] |= not speed < free.fastest  # also true of NaN


@compiled
def watch(z, radius, obstacles, discs, touched):  # type: ignore[no-untyped-def]
    """Mark the transitions whose body is near an obstacle; `locate` must come first."""
    for j in range(len(obstacles)):
        a_x, a_y, size = obstacles[j, 0], obstacles[j, 1], obstacles[j, 4]
        d_x, d_y = obstacles[j, 2] - a_x, obstacles[j, 3] - a_y
        length = d_x * d_x + d_y * d_y
        scale, reach = 1.0 / length if length > 0.0 else 0.0, radius + size
        for i in range(BLOCK):
            x, y = z[X0 + i] - a_x, z[Y0 + i] - a_y
            t = (x * d_x + y * d_y) * scale
            t = 0.0 if t < 0.0 else t
            t = 1.0 if t > 1.0 else t
            x, y = x - t * d_x, y - t * d_y
            touched[i] |= x * x + y * y <= reach * reach
    for j in range(discs.shape[1]):
        for i in range(BLOCK):
            x, y, reach = z[X0 + i] - discs[i, j, 0], z[Y0 + i] - discs[i, j, 1], discs[i, j, 2]
            reach = radius + reach if reach > 0.0 else -1.0
            touched[i] |= (x * x + y * y <= reach * reach) & (reach > 0.0)


@compiled
def turn(z, step):  # type: ignore[no-untyped-def]
    """Move the bodies and rotate their headings."""
    fast = False
    for i in range(BLOCK):
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
        for i in range(BLOCK):
            if not abs(z[W + i] * step) < _SMALL_TURN:
                z[C + i], z[S + i] = math.cos(z[A + i]), math.sin(z[A + i])


@compiled
def accelerate(z, gravity, step):  # type: ignore[no-untyped-def]
    """Add the velocity changes by gravity and the wrench."""
    g_x, g_y = gravity
    for i in range(BLOCK):
        z[VX + i] += (g_x + z[FX + i]) * step
        z[VY + i] += (g_y + z[FY + i]) * step
        z[W + i] += z[T + i] * step


@compiled
def limited(impulse, most):  # type: ignore[no-untyped-def]
    """Return an impulse clipped to ``most`` in both directions."""
    impulse = most if impulse > most else impulse
    return -most if impulse < -most else impulse


@compiled
def begin_wheel(z):  # type: ignore[no-untyped-def]
    """Place the wheel's two rods and apply their impulses of the substep before."""
    for i in range(BLOCK):
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


@compiled
def solve_wheel(z):  # type: ignore[no-untyped-def]
    """Do one iteration of the wheel's rods, whose impulses friction limits."""
    for i in range(BLOCK):
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


@compiled
def _inverse_tensor(z, own, i):  # type: ignore[no-untyped-def]
    """Set the inverse of the tensor from an impulse at an arm to the velocity of that point."""
    r_x, r_y, mass, moment = own[RX + i], own[RY + i], z[MI + i], z[II + i]
    xx, xy, yy = mass + r_y * r_y * moment, -r_x * r_y * moment, mass + r_x * r_x * moment
    inverse = 1.0 / (xx * yy - xy * xy)
    own[K + i], own[KXY + i], own[KYY + i] = yy * inverse, -xy * inverse, xx * inverse


@compiled
def _push(z, own, i, j_x, j_y):  # type: ignore[no-untyped-def]
    """Apply an impulse at an arm."""
    z[VX + i] += j_x * z[MI + i]
    z[VY + i] += j_y * z[MI + i]
    z[W + i] += z[II + i] * (own[RX + i] * j_y - own[RY + i] * j_x)


@compiled
def place_link(z, own, rod, step):  # type: ignore[no-untyped-def]
    """Set arm, drift and masses of a link at the body's present place."""
    for i in range(BLOCK):
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


@compiled
def begin_link(z, own, rod):  # type: ignore[no-untyped-def]
    """Apply the impulse of the substep before."""
    for i in range(BLOCK):
        if rod:
            _push(z, own, i, own[DX + i] * own[LX + i], own[DY + i] * own[LX + i])
        else:
            _push(z, own, i, own[LX + i], own[LY + i])


@compiled
def solve_link(z, own, rod):  # type: ignore[no-untyped-def]
    """Do one iteration of a hinge or rod."""
    for i in range(BLOCK):
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


@compiled
def begin_pivot(z):  # type: ignore[no-untyped-def]
    """Apply the motor's impulse of the substep before."""
    for i in range(BLOCK):
        z[W + i] -= z[TJ + i] * z[II + i]
        z[AIM + i] = 0.0


@compiled
def solve_pivot(z):  # type: ignore[no-untyped-def]
    """Do one iteration of friction in a hinge: the motor, then the damper."""
    for i in range(BLOCK):
        most, old, w = z[T_MAX + i], z[TJ + i], z[W + i]
        new = limited(old + w / z[II + i], most)
        z[TJ + i] = new
        w -= (new - old) * z[II + i]
        change = (z[AIM + i] - w) * z[COEF + i]
        z[AIM + i] = w + change
        z[W + i] = w + change


@compiled
def place_patch(z, points, ring, slowing, radius, step):  # type: ignore[no-untyped-def]
    """Split each point's friction between its pivot joint and the rod along its velocity."""
    for p in range(len(ring)):
        own = points[p]
        for i in range(BLOCK):
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


@compiled
def begin_patch(z, points):  # type: ignore[no-untyped-def]
    """Apply the impulses of the substep before."""
    for own in points:
        for i in range(BLOCK):
            j = own[RJ + i]
            _push(z, own, i, own[HX + i] + own[DX + i] * j, own[HY + i] + own[DY + i] * j)


@compiled
def solve_patch(z, points):  # type: ignore[no-untyped-def]
    """Do one iteration of the points' pivot joints, then of their rods.

    Returns the number of impulses that changed. If it is 0, further iterations change nothing.
    """
    changed = 0
    for own in points:
        for i in range(BLOCK):
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
        for i in range(BLOCK):
            n_x, n_y, most, old = own[DX + i], own[DY + i], own[R_MAX + i], own[RJ + i]
            v = n_x * z[VX + i] + n_y * z[VY + i] + own[CROSS + i] * z[W + i]
            new = limited(old - v * own[RM + i], most)
            own[RJ + i] = new
            changed += new != old
            _push(z, own, i, n_x * (new - old), n_y * (new - old))
    return changed


@compiled
def set_properties(z, links, free, i, row, joints, normal_gravity, step):  # type: ignore[no-untyped-def]
    """Set the properties of transition ``i``; return whether its centre is off its origin."""
    shifted = set_body(z, i, row, free.wheel, normal_gravity, step)
    if free.pivot:
        z[T_MAX + i] = row[COLUMN.pivot_torque] * step
        z[COEF + i] = 1.0 - math.exp(-row[COLUMN.pivot_damping] * step * z[II + i])
    for j in range(len(free.link_joint)):
        own, joint, pose = links[j], joints[free.link_joint[j]], free.link_pose[j]
        near, far = (joint[A_X], joint[A_Y]), (joint[B_X], joint[B_Y])
        if not free.link_first[j]:
            near, far = far, near
        own[AX + i], own[AY + i] = near[0] - z[OX + i], near[1] - z[OY + i]
        own[PX + i] = pose[0] + pose[2] * far[0] - pose[3] * far[1]
        own[PY + i] = pose[1] + pose[3] * far[0] + pose[2] * far[1]
        own[L + i] = joint[LENGTH]
    return shifted


@compiled
def substep(z, links, points, free, slowing, patch_radius, step):  # type: ignore[no-untyped-def]
    """Do one step of the engine."""
    sliding = len(free.ring) > 0
    patch_alone = not (free.wheel or free.pivot or len(links))
    turn(z, step)
    if sliding:  # by the velocities before, at the heading after
        place_patch(z, points, free.ring, slowing, patch_radius, step)
    for j in range(len(links)):
        place_link(z, links[j], free.link_rod[j], step)
    accelerate(z, free.gravity, step)
    if free.wheel:
        begin_wheel(z)
    for j in range(len(links)):
        begin_link(z, links[j], free.link_rod[j])
    if free.pivot:
        begin_pivot(z)
    if sliding:
        begin_patch(z, points)
    for _ in range(free.iterations):
        if free.wheel:
            solve_wheel(z)
        for j in range(len(links)):
            solve_link(z, links[j], free.link_rod[j])
        if free.pivot:
            solve_pivot(z)
        if sliding and not solve_patch(z, points) and patch_alone:
            break
