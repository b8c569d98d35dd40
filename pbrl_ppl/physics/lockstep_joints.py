"""Joints in the contact-free fast path, and a substep of all bodies.

The arithmetic is that of Chipmunk's pivot joint, pin joint, motor and rotary damper. ``a`` and
``b`` are the rows in a block of the bodies that a joint holds, ``a`` is None where that is fixed;
``joint`` is the joint's row, and ``i`` the number of a transition in the block.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.joints import A_X, A_Y, B_X, B_Y, LENGTH
from pbrl_ppl.physics.lockstep_bodies import BLOCK, BODY, accelerate, row_of, turn
from pbrl_ppl.physics.lockstep_friction import (
    POINT,
    begin_patch,
    begin_wheel,
    limited,
    place_patch,
    push,
    solve_patch,
    solve_wheel,
)
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.setters import iterations

#: Fields of a joint: anchors on the bodies, length; arms, a rod's direction, bias and stored
#: impulse; a hinge's effective mass, of which a rod has the first. Then those of a hinge's motor
#: and damper: greatest and stored impulse, effective moment; share of the speed that the damper
#: removes, as given and in use, and its target.
JOINT = row_of(
    """
    a_x a_y b_x b_y length arm_a_x arm_a_y arm_b_x arm_b_y n_x n_y bias_x bias_y impulse_x impulse_y
    mass_xx mass_xy mass_yy most_torque torque_impulse moment damped damped_now goal
    """
)


class Joints(NamedTuple):
    """Joints of a world, and their numbers in a block of transitions."""

    values: NDArray[np.float64]  # (joint, field)
    rough: NDArray[np.bool_]  # whether there is friction in it
    row: NDArray[np.int64]  # among all joints
    rod: NDArray[np.bool_]
    ends: NDArray[np.int64]  # (joint, 2): bodies; the first is -1 if it is fixed
    turned: NDArray[np.bool_]  # whether these are the joint's second and first
    pose: NDArray[np.float64]  # (joint, 4): x, y, cos and sin of the fixed body
    pivot: NDArray[np.int64]  # the body whose friction acts in it; -1 for none


class Block(NamedTuple):
    """Numbers of the bodies and patches of a block of transitions."""

    bodies: NDArray[np.float64]  # (body + 1, field): the last is fixed
    patches: NDArray[np.float64]  # (patch, point, field)
    slowing: NDArray[np.float64]  # (patch, BLOCK): deceleration by friction (m/s^2)
    patch_radius: NDArray[np.float64]  # (patch, BLOCK), m
    iterations: NDArray[np.int64]  # (BLOCK,)


@compiled
def set_constraints(block, world, batch, proposal, interval):  # type: ignore[no-untyped-def]
    """Set the numbers of patches and iterations for an interval of each transition."""
    rows = batch.given[0]
    if world.chained.any():
        for i in range(BLOCK):
            row = rows[proposal[i], interval[i]]
            block.iterations[i] = iterations(world.iterations, world.chained, row)
    for j in range(len(block.patches)):
        k = world.patch_body[j]
        for i in range(BLOCK):
            p, r = proposal[i], interval[i]
            block.slowing[j, i] = rows[p, r, k, COLUMN.patch_mu] * world.normal_gravity
            block.patch_radius[j, i] = rows[p, r, k, COLUMN.patch_radius]


@compiled
def set_joints(block, joints, batch, proposal, interval, step):  # type: ignore[no-untyped-def]
    """Set the numbers of joints for an interval of each transition."""
    rows, anchors, bodies = batch.given[0], batch.given[1], block.bodies
    for j in range(len(joints.values)):
        joint, ends = joints.values[j], joints.ends[j]
        a, b = bodies[ends[0]], bodies[ends[1]]
        number, owner, turned = joints.row[j], joints.pivot[j], joints.turned[j]
        x, y, c, s = joints.pose[j]
        for i in range(BLOCK):
            p, r = proposal[i], interval[i]
            a_x, a_y = anchors[p, number, A_X], anchors[p, number, A_Y]
            b_x, b_y = anchors[p, number, B_X], anchors[p, number, B_Y]
            if turned:
                a_x, a_y, b_x, b_y = b_x, b_y, a_x, a_y
            a_x, a_y = a_x - a[BODY.com_x + i], a_y - a[BODY.com_y + i]
            joint[JOINT.a_x + i] = x + c * a_x - s * a_y
            joint[JOINT.a_y + i] = y + s * a_x + c * a_y
            joint[JOINT.b_x + i] = b_x - b[BODY.com_x + i]
            joint[JOINT.b_y + i] = b_y - b[BODY.com_y + i]
            joint[JOINT.length + i] = anchors[p, number, LENGTH]
            if owner >= 0:
                joint[JOINT.most_torque + i] = rows[p, r, owner, COLUMN.pivot_torque] * step
                damping = rows[p, r, owner, COLUMN.pivot_damping]
                damping *= a[BODY.inverse_moment + i] + b[BODY.inverse_moment + i]
                joint[JOINT.damped + i] = 1.0 - math.exp(-damping * step) if damping else 0.0
        joints.rough[j] = False  # zero friction changes no number
        for field in (JOINT.most_torque, JOINT.torque_impulse, JOINT.damped):
            joints.rough[j] |= joint[field : field + BLOCK].any()


@compiled
def _push_both(a, b, joint, i, j_x, j_y):  # type: ignore[no-untyped-def]
    """Apply an impulse to the second body, and its opposite to the first if it moves."""
    if a is not None:
        push(a, i, joint[JOINT.arm_a_x + i], joint[JOINT.arm_a_y + i], -j_x, -j_y)
    push(b, i, joint[JOINT.arm_b_x + i], joint[JOINT.arm_b_y + i], j_x, j_y)


@compiled
def place_joint(a, b, joint, rod, step):  # type: ignore[no-untyped-def]
    """Set arms, drift and masses of a hinge or rod at the bodies' present places."""
    for i in range(BLOCK):
        x_1, y_1, to_x, to_y = joint[JOINT.a_x + i], joint[JOINT.a_y + i], 0.0, 0.0
        mass, i_1 = 0.0, 0.0
        if a is not None:
            c, s, to_x, to_y = a[BODY.cos + i], a[BODY.sin + i], a[BODY.x + i], a[BODY.y + i]
            x_1, y_1 = c * x_1 - s * y_1, s * x_1 + c * y_1
            mass, i_1 = a[BODY.inverse_mass + i], a[BODY.inverse_moment + i]
        c, s, x, y = b[BODY.cos + i], b[BODY.sin + i], joint[JOINT.b_x + i], joint[JOINT.b_y + i]
        x_2, y_2 = c * x - s * y, s * x + c * y
        joint[JOINT.arm_a_x + i], joint[JOINT.arm_a_y + i] = x_1, y_1
        joint[JOINT.arm_b_x + i], joint[JOINT.arm_b_y + i] = x_2, y_2
        d_x = (b[BODY.x + i] + x_2) - (to_x + x_1)
        d_y = (b[BODY.y + i] + y_2) - (to_y + y_1)
        mass, i_2 = mass + b[BODY.inverse_mass + i], b[BODY.inverse_moment + i]
        if rod:
            distance = math.sqrt(d_x * d_x + d_y * d_y)
            scale = 1.0 / distance if distance > 0.0 else 0.0
            n_x, n_y = d_x * scale, d_y * scale
            joint[JOINT.n_x + i], joint[JOINT.n_y + i] = n_x, n_y
            c_1, c_2 = x_1 * n_y - y_1 * n_x, x_2 * n_y - y_2 * n_x
            joint[JOINT.mass_xx + i] = 1.0 / (mass + i_1 * c_1 * c_1 + i_2 * c_2 * c_2)
            joint[JOINT.bias_x + i] = (joint[JOINT.length + i] - distance) / step
        else:
            joint[JOINT.bias_x + i], joint[JOINT.bias_y + i] = -d_x / step, -d_y / step
            xx = mass + y_1 * y_1 * i_1 + y_2 * y_2 * i_2
            xy = -x_1 * y_1 * i_1 - x_2 * y_2 * i_2
            yy = mass + x_1 * x_1 * i_1 + x_2 * x_2 * i_2
            inverse = 1.0 / (xx * yy - xy * xy)
            joint[JOINT.mass_xx + i], joint[JOINT.mass_yy + i] = yy * inverse, xx * inverse
            joint[JOINT.mass_xy + i] = -xy * inverse


@compiled
def begin_joint(a, b, joint, rod, rough):  # type: ignore[no-untyped-def]
    """Apply the impulse of the substep before."""
    for i in range(BLOCK):
        j_x, j_y = joint[JOINT.impulse_x + i], joint[JOINT.impulse_y + i]
        if rod:
            j_x, j_y = joint[JOINT.n_x + i] * j_x, joint[JOINT.n_y + i] * j_x
        _push_both(a, b, joint, i, j_x, j_y)
    if rough:
        begin_pivot(a, b, joint)


@compiled
def solve_joint(a, b, joint, rod, rough):  # type: ignore[no-untyped-def]
    """Do one iteration of a hinge or rod."""
    for i in range(BLOCK):
        w = b[BODY.omega + i]
        v_x = b[BODY.vx + i] - joint[JOINT.arm_b_y + i] * w
        v_y = b[BODY.vy + i] + joint[JOINT.arm_b_x + i] * w
        if a is not None:
            w = a[BODY.omega + i]
            v_x -= a[BODY.vx + i] - joint[JOINT.arm_a_y + i] * w
            v_y -= a[BODY.vy + i] + joint[JOINT.arm_a_x + i] * w
        if rod:
            n_x, n_y = joint[JOINT.n_x + i], joint[JOINT.n_y + i]
            j = (joint[JOINT.bias_x + i] - (n_x * v_x + n_y * v_y)) * joint[JOINT.mass_xx + i]
            joint[JOINT.impulse_x + i] += j
            _push_both(a, b, joint, i, n_x * j, n_y * j)
        else:
            d_x, d_y = joint[JOINT.bias_x + i] - v_x, joint[JOINT.bias_y + i] - v_y
            j_x = joint[JOINT.mass_xx + i] * d_x + joint[JOINT.mass_xy + i] * d_y
            j_y = joint[JOINT.mass_xy + i] * d_x + joint[JOINT.mass_yy + i] * d_y
            joint[JOINT.impulse_x + i] += j_x
            joint[JOINT.impulse_y + i] += j_y
            _push_both(a, b, joint, i, j_x, j_y)
    if rough:
        solve_pivot(a, b, joint)


@compiled
def begin_pivot(a, b, joint):  # type: ignore[no-untyped-def]
    """Apply the motor's impulse of the substep before."""
    for i in range(BLOCK):
        i_1, i_2 = 0.0, b[BODY.inverse_moment + i]
        impulse = joint[JOINT.torque_impulse + i]
        if a is not None:
            i_1 = a[BODY.inverse_moment + i]
            a[BODY.omega + i] -= impulse * i_1
        b[BODY.omega + i] += impulse * i_2
        joint[JOINT.moment + i] = 1.0 / (i_1 + i_2)
        joint[JOINT.damped_now + i], joint[JOINT.goal + i] = joint[JOINT.damped + i], 0.0


@compiled
def solve_pivot(a, b, joint):  # type: ignore[no-untyped-def]
    """Do one iteration of friction in a hinge: the motor, then the damper."""
    for i in range(BLOCK):
        i_1, w_1, i_2, w_2 = 0.0, 0.0, b[BODY.inverse_moment + i], b[BODY.omega + i]
        if a is not None:
            i_1, w_1 = a[BODY.inverse_moment + i], a[BODY.omega + i]
        moment, old = joint[JOINT.moment + i], joint[JOINT.torque_impulse + i]
        new = limited(old - (w_2 - w_1) * moment, joint[JOINT.most_torque + i])
        joint[JOINT.torque_impulse + i] = new
        w_1 -= (new - old) * i_1
        w_2 += (new - old) * i_2
        w = w_1 - w_2
        change = (joint[JOINT.goal + i] - w) * joint[JOINT.damped_now + i]
        joint[JOINT.goal + i] = w + change
        if a is not None:
            a[BODY.omega + i] = w_1 + change * moment * i_1
        b[BODY.omega + i] = w_2 - change * moment * i_2


@compiled
def _finish(block, joints, i):  # type: ignore[no-untyped-def]
    """Make further iterations change nothing in transition ``i``."""
    for body in block.bodies:
        body[BODY.mass_along + i] = body[BODY.mass_across + i] = 0.0
    if joints is not None:
        for joint in joints.values:
            joint[JOINT.mass_xx + i] = joint[JOINT.mass_xy + i] = joint[JOINT.mass_yy + i] = 0.0
            joint[JOINT.moment + i] = joint[JOINT.damped_now + i] = 0.0
    for points in block.patches:
        for point in points:
            point[POINT.mass_xx + i] = point[POINT.mass_xy + i] = point[POINT.mass_yy + i] = 0.0
            point[POINT.rod_mass + i] = 0.0
            point[POINT.most_hold + i] = math.inf  # else rounding clips an impulse once more


@compiled
def substep(block, joints, world, step):  # type: ignore[no-untyped-def]
    """Do one step of the engine, with the iterations of each transition of the block."""
    bodies, patches = block.bodies, block.patches
    if joints is not None:
        values, rod, rough, ends = joints.values, joints.rod, joints.rough, joints.ends
    for k in range(len(world.wheel)):
        turn(bodies[k], step)
    for j in range(len(patches)):  # by the velocities before, at the heading after
        body, slowing, radius = bodies[world.patch_body[j]], block.slowing[j], block.patch_radius[j]
        place_patch(body, patches[j], world.ring, slowing, radius, step)
    if joints is not None:
        for j in range(len(values)):
            if ends[j, 0] < 0:
                place_joint(None, bodies[ends[j, 1]], values[j], rod[j], step)
            else:
                place_joint(bodies[ends[j, 0]], bodies[ends[j, 1]], values[j], rod[j], step)
    for k in range(len(world.wheel)):
        accelerate(bodies[k], world.gravity, step)
    for k in range(len(world.wheel)):
        if world.wheel[k]:
            begin_wheel(bodies[k])
    if joints is not None:
        for j in range(len(values)):
            b = bodies[ends[j, 1]]
            if ends[j, 0] < 0:
                begin_joint(None, b, values[j], rod[j], rough[j])
            else:
                begin_joint(bodies[ends[j, 0]], b, values[j], rod[j], rough[j])
    for j in range(len(patches)):
        begin_patch(bodies[world.patch_body[j]], patches[j])
    patches_alone = len(patches) > 0 and joints is None and not world.wheel.any()
    done, longest = 0, block.iterations.max()
    while done < longest:
        until = longest
        for i in range(BLOCK):
            if block.iterations[i] > done:
                until = min(until, block.iterations[i])
        for _ in range(until - done):
            for k in range(len(world.wheel)):
                if world.wheel[k]:
                    solve_wheel(bodies[k])
            if joints is not None:
                for j in range(len(values)):
                    b = bodies[ends[j, 1]]
                    if ends[j, 0] < 0:
                        solve_joint(None, b, values[j], rod[j], rough[j])
                    else:
                        solve_joint(bodies[ends[j, 0]], b, values[j], rod[j], rough[j])
            changed = 0
            for j in range(len(patches)):
                changed += solve_patch(bodies[world.patch_body[j]], patches[j])
            if patches_alone and changed == 0:
                break
        if until < longest:
            for i in range(BLOCK):
                if block.iterations[i] == until:
                    _finish(block, joints, i)
        done = until
