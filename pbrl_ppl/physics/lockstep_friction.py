"""Wheels and floor friction in the contact-free fast path.

The arithmetic is that of Chipmunk's pin joint and pivot joint. ``body`` is the row of a body in a
block, ``point`` that of a point of a ring of friction, and ``i`` the number of a transition in the
block.
"""

from __future__ import annotations

import math

from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.lockstep_bodies import BLOCK, BODY, row_of
from pbrl_ppl.physics.world import STICKING

#: Fields of a point of a ring of friction: its arm, the direction in which it slides, its lever and
#: effective mass; stored and greatest impulses of the pivot joint that holds it and of its rod.
POINT = row_of(
    """
    arm_x arm_y n_x n_y lever mass_xx mass_xy mass_yy hold_x hold_y most_hold
    rod_mass rod_impulse most_rod
    """
)


@compiled
def limited(impulse, most):  # type: ignore[no-untyped-def]
    """Return an impulse clipped to ``most`` in both directions."""
    impulse = most if impulse > most else impulse
    return -most if impulse < -most else impulse


@compiled
def begin_wheel(body):  # type: ignore[no-untyped-def]
    """Place a wheel's two rods and apply their impulses of the substep before."""
    for i in range(BLOCK):
        c, s = body[BODY.cos + i], body[BODY.sin + i]
        x, y = body[BODY.wheel_x + i], body[BODY.wheel_y + i]
        r_x, r_y = c * x - s * y, s * x + c * y
        x, y = body[BODY.wheel_cos + i], body[BODY.wheel_sin + i]
        n_x, n_y = c * x - s * y, s * x + c * y
        along, across = r_x * n_y - r_y * n_x, r_x * n_x + r_y * n_y
        mass, moment = body[BODY.inverse_mass + i], body[BODY.inverse_moment + i]
        body[BODY.axis_x + i], body[BODY.axis_y + i] = n_x, n_y
        body[BODY.lever_along + i], body[BODY.lever_across + i] = along, across
        body[BODY.mass_along + i] = 1.0 / (mass + moment * along * along)
        body[BODY.mass_across + i] = 1.0 / (mass + moment * across * across)
        j_x, j_y = body[BODY.impulse_along + i], body[BODY.impulse_across + i]
        body[BODY.vx + i] -= (n_x * j_x - n_y * j_y) * mass
        body[BODY.vy + i] -= (n_y * j_x + n_x * j_y) * mass
        body[BODY.omega + i] -= moment * (along * j_x + across * j_y)


@compiled
def solve_wheel(body):  # type: ignore[no-untyped-def]
    """Do one iteration of a wheel's rods, whose impulses friction limits."""
    for i in range(BLOCK):
        n_x, n_y = body[BODY.axis_x + i], body[BODY.axis_y + i]
        along, across = body[BODY.lever_along + i], body[BODY.lever_across + i]
        mass, moment = body[BODY.inverse_mass + i], body[BODY.inverse_moment + i]
        v_x, v_y, w = body[BODY.vx + i], body[BODY.vy + i], body[BODY.omega + i]
        old = body[BODY.impulse_along + i]
        new = old + (n_x * v_x + n_y * v_y + along * w) * body[BODY.mass_along + i]
        new = limited(new, body[BODY.most_along + i])
        body[BODY.impulse_along + i] = new
        j = new - old
        v_x -= n_x * j * mass
        v_y -= n_y * j * mass
        w -= moment * along * j
        old = body[BODY.impulse_across + i]
        new = old + (n_x * v_y - n_y * v_x + across * w) * body[BODY.mass_across + i]
        new = limited(new, body[BODY.most_across + i])
        body[BODY.impulse_across + i] = new
        j = new - old
        body[BODY.vx + i] = v_x + n_y * j * mass
        body[BODY.vy + i] = v_y - n_x * j * mass
        body[BODY.omega + i] = w - moment * across * j


@compiled
def push(body, i, r_x, r_y, j_x, j_y):  # type: ignore[no-untyped-def]
    """Apply an impulse to a body at an arm."""
    body[BODY.vx + i] += j_x * body[BODY.inverse_mass + i]
    body[BODY.vy + i] += j_y * body[BODY.inverse_mass + i]
    body[BODY.omega + i] += body[BODY.inverse_moment + i] * (r_x * j_y - r_y * j_x)


@compiled
def place_patch(body, points, ring, slowing, radius, step):  # type: ignore[no-untyped-def]
    """Split each point's friction between its pivot joint and the rod along its velocity."""
    for p in range(len(ring)):
        point = points[p]
        for i in range(BLOCK):
            c, s = body[BODY.cos + i], body[BODY.sin + i]
            x = ring[p, 0] * radius[i] - body[BODY.com_x + i]
            y = ring[p, 1] * radius[i] - body[BODY.com_y + i]
            r_x, r_y = c * x - s * y, s * x + c * y
            point[POINT.arm_x + i], point[POINT.arm_y + i] = r_x, r_y
            n_x = body[BODY.vx + i] - body[BODY.omega + i] * r_y
            n_y = body[BODY.vy + i] + body[BODY.omega + i] * r_x
            speed = math.sqrt(n_x * n_x + n_y * n_y)
            slow = STICKING * slowing[i] * step
            share = 1.0 if speed >= slow else speed / slow
            mass, moment = body[BODY.inverse_mass + i], body[BODY.inverse_moment + i]
            most = slowing[i] / mass / len(ring) * step
            point[POINT.most_hold + i] = (1.0 - share) * most
            point[POINT.most_rod + i] = share * most
            rest = speed == 0.0
            scale = 1.0 if rest else 1.0 / speed
            n_x = 1.0 if rest else n_x * scale
            n_y = 0.0 if rest else n_y * scale
            lever = r_x * n_y - r_y * n_x
            point[POINT.n_x + i], point[POINT.n_y + i], point[POINT.lever + i] = n_x, n_y, lever
            point[POINT.rod_mass + i] = 1.0 / (mass + moment * lever * lever)
            xx, xy = mass + r_y * r_y * moment, -r_x * r_y * moment
            yy = mass + r_x * r_x * moment
            inverse = 1.0 / (xx * yy - xy * xy)
            point[POINT.mass_xx + i], point[POINT.mass_yy + i] = yy * inverse, xx * inverse
            point[POINT.mass_xy + i] = -xy * inverse


@compiled
def begin_patch(body, points):  # type: ignore[no-untyped-def]
    """Apply the impulses of the substep before."""
    for point in points:
        for i in range(BLOCK):
            j = point[POINT.rod_impulse + i]
            j_x = point[POINT.hold_x + i] + point[POINT.n_x + i] * j
            j_y = point[POINT.hold_y + i] + point[POINT.n_y + i] * j
            push(body, i, point[POINT.arm_x + i], point[POINT.arm_y + i], j_x, j_y)


@compiled
def solve_patch(body, points):  # type: ignore[no-untyped-def]
    """Do one iteration of the points' pivot joints, then of their rods.

    Returns the number of impulses that changed. If it is 0, further iterations change nothing.
    """
    changed = 0
    for point in points:
        for i in range(BLOCK):
            r_x, r_y, w = point[POINT.arm_x + i], point[POINT.arm_y + i], body[BODY.omega + i]
            v_x, v_y = body[BODY.vx + i] - r_y * w, body[BODY.vy + i] + r_x * w
            old_x, old_y = point[POINT.hold_x + i], point[POINT.hold_y + i]
            most, xy = point[POINT.most_hold + i], point[POINT.mass_xy + i]
            new_x = old_x - (point[POINT.mass_xx + i] * v_x + xy * v_y)
            new_y = old_y - (xy * v_x + point[POINT.mass_yy + i] * v_y)
            size = new_x * new_x + new_y * new_y
            scale = most / math.sqrt(size) if size > most * most else 1.0
            new_x, new_y = new_x * scale, new_y * scale
            point[POINT.hold_x + i], point[POINT.hold_y + i] = new_x, new_y
            changed += new_x != old_x or new_y != old_y
            push(body, i, r_x, r_y, new_x - old_x, new_y - old_y)
    for point in points:
        for i in range(BLOCK):
            n_x, n_y, old = point[POINT.n_x + i], point[POINT.n_y + i], point[POINT.rod_impulse + i]
            v = n_x * body[BODY.vx + i] + n_y * body[BODY.vy + i]
            v += point[POINT.lever + i] * body[BODY.omega + i]
            new = limited(old - v * point[POINT.rod_mass + i], point[POINT.most_rod + i])
            point[POINT.rod_impulse + i] = new
            changed += new != old
            r_x, r_y, j = point[POINT.arm_x + i], point[POINT.arm_y + i], new - old
            push(body, i, r_x, r_y, n_x * j, n_y * j)
    return changed
