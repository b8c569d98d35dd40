"""Compiled setters: the engine's properties, and the places of wheels, patches and discs."""

from __future__ import annotations

import math

import numpy as np

from pbrl_ppl.physics.calls import call1, call2, call_pointer
from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.laws import bound
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import STICKING


@compiled
def iterations(fewest, chained, bodies, a_ratio=2, most=2000):  # type: ignore[no-untyped-def]
    """Return the solver iterations for the masses of these bodies: in proportion to their ratio.

    With fewer, a heavy link below a light one gains energy.
    """
    lightest, heaviest = np.inf, 0.0
    for i in range(len(chained)):
        if chained[i]:
            lightest = min(lightest, bodies[i, COLUMN.mass])
            heaviest = max(heaviest, bodies[i, COLUMN.mass])
    enough = min(a_ratio * (heaviest / lightest), most)
    return max(fewest, int(enough))


@compiled
def _apply(settings, rows, normal_gravity):  # type: ignore[no-untyped-def]
    """Set properties of constraints by their rows of numbers."""
    for j in range(len(settings)):
        setting = settings[j]
        row, column = rows[setting.row], setting.column
        if setting.vector:
            x, y = row[column] * setting.scale_x, row[setting.column_y] * setting.scale_y
            call2(setting.function, setting.constraint, x, y)
        else:
            weight = row[COLUMN.mass] * normal_gravity if setting.weighted else 1.0
            call1(setting.function, setting.constraint, row[column] * weight)


@compiled
def set_properties(fn, world, bodies, joints):  # type: ignore[no-untyped-def]
    """Set masses, moments, surfaces and anchors, but no strengths of constraints."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            continue
        body, row = world.bodies[i], bodies[i]
        call1(fn.cpBodySetMass, body, row[COLUMN.mass])
        call1(fn.cpBodySetMoment, body, row[COLUMN.moment])
        call2(fn.cpBodySetCenterOfGravity, body, row[COLUMN.com_x], row[COLUMN.com_y])
    for j in range(len(world.shapes)):
        row = bodies[world.shape_body[j]]
        call1(fn.cpShapeSetElasticity, world.shapes[j], row[COLUMN.r])
        call1(fn.cpShapeSetFriction, world.shapes[j], row[COLUMN.mu_c])
    _apply(world.body_settings, bodies, world.still.normal_gravity)
    _apply(world.joint_settings, joints, world.still.normal_gravity)


@compiled
def set_strengths(fn, world, bodies, on):  # type: ignore[no-untyped-def]
    """Set the constraints' greatest forces, or set them to zero; patches get theirs as placed."""
    for constraint in world.unlimited:
        call1(fn.cpConstraintSetMaxForce, constraint, np.inf if on else 0.0)
    for constraint in world.limited:
        call1(fn.cpConstraintSetMaxForce, constraint, 0.0)
    if on:
        _apply(world.strengths, bodies, world.still.normal_gravity)


@compiled
def arm(row, theta):  # type: ignore[no-untyped-def]
    """Return the arm from a body's origin to its centre of mass, in the world's frame."""
    x, y = row[COLUMN.com_x], row[COLUMN.com_y]
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0
    c, s = math.cos(theta), math.sin(theta)
    return c * x - s * y, s * x + c * y


@compiled
def glide(row, state, step):  # type: ignore[no-untyped-def]
    """Return where a substep without forces takes a body: heading, centre of mass, its velocity."""
    x, y = arm(row, state[2])
    v_x, v_y = state[3] - state[5] * y, state[4] + state[5] * x
    theta = state[2] + state[5] * step
    x, y = state[0] + x + v_x * step, state[1] + y + v_y * step
    return math.cos(theta), math.sin(theta), x, y, v_x, v_y


@compiled
def wheel_ends(row, after, axis_cos, axis_sin):  # type: ignore[no-untyped-def]
    """Return the far ends of a wheel's rods: x and y of the one along it, of the one across."""
    c, s, x, y, _, _ = after
    w_x, w_y = row[COLUMN.w_x] - row[COLUMN.com_x], row[COLUMN.w_y] - row[COLUMN.com_y]
    x, y = x + c * w_x - s * w_y, y + s * w_x + c * w_y
    c, s = c * axis_cos - s * axis_sin, s * axis_cos + c * axis_sin
    return x + c, y + s, x - s, y + c


@compiled
def patch_point(row, after, omega, point, step, most):  # type: ignore[no-untyped-def]
    """Return the far end of a point's rod, along its velocity, and the rod's share of the friction.

    ``point`` is in units of the ring's radius; ``most`` is the deceleration by friction (m/s^2).
    """
    c, s, at_x, at_y, v_x, v_y = after
    x = point[0] * row[COLUMN.patch_radius] - row[COLUMN.com_x]
    y = point[1] * row[COLUMN.patch_radius] - row[COLUMN.com_y]
    x, y = c * x - s * y, s * x + c * y
    along_x, along_y = v_x - omega * y, v_y + omega * x
    speed = math.sqrt(along_x * along_x + along_y * along_y)
    slow = STICKING * most * step
    share = 1.0 if speed >= slow else speed / slow
    if speed == 0.0:  # at rest any direction will do
        along_x, speed = 1.0, 1.0
    return at_x + x + along_x / speed, at_y + y + along_y / speed, share


@compiled
def hinge_signal(pivots, gravity, row, joints, state, command, i):  # type: ignore[no-untyped-def]
    """Return what laws of friction see in the hinge or slider of body ``i``, by its row and state.

    The commanded torque, that of the weight, and the speed. Of a slider the commanded force and the
    speed alone. ``pivots`` have a hinge's body, its joint and the column of its anchor on the body.
    """
    torque, rest = math.sqrt(command[0] ** 2 + command[1] ** 2), 0.0
    speed = math.sqrt(state[3] ** 2 + state[4] ** 2)
    for hinge in pivots:
        if hinge[0] == i:
            x = row[COLUMN.com_x] - joints[hinge[1], hinge[2]]
            y = row[COLUMN.com_y] - joints[hinge[1], hinge[2] + 1]
            c, s = math.cos(state[2]), math.sin(state[2])
            x, y = c * x - s * y, s * x + c * y
            weight_x = gravity[0] + row[COLUMN.extra_gravity_x]
            weight_y = gravity[1] + row[COLUMN.extra_gravity_y]
            rest = row[COLUMN.mass] * (x * weight_y - y * weight_x)
            torque, speed = command[2], abs(state[5])
    return torque, rest, speed


@compiled
def patch_signal(row, state, normal_gravity):  # type: ignore[no-untyped-def]
    """Return the greatest friction under a body but for laws, and the speed that they see."""
    turned = state[5] * row[COLUMN.patch_radius]
    speed = math.sqrt(state[3] ** 2 + state[4] ** 2 + turned**2)
    return row[COLUMN.patch_mu] * row[COLUMN.mass] * normal_gravity, speed


@compiled
def place_bodies(fn, world, bodies, state):  # type: ignore[no-untyped-def]
    """Set the bodies' states; the engine's velocity is that of the centre of mass."""
    for i in range(len(world.bodies)):
        body, (x, y) = world.bodies[i], arm(bodies[i], state[i, 2])
        call1(fn.cpBodySetAngle, body, state[i, 2])  # first: the centre's place depends on it
        call2(fn.cpBodySetPosition, body, state[i, 0], state[i, 1])
        turn = state[i, 5]
        call2(fn.cpBodySetVelocity, body, state[i, 3] - turn * y, state[i, 4] + turn * x)
        call1(fn.cpBodySetAngularVelocity, body, turn)


@compiled
def set_discs(fn, world, discs):  # type: ignore[no-untyped-def]
    """Place the hidden discs, as in `plain.set_discs`.

    They are removed and added again, since the order of contacts depends on their earlier places.
    """
    obstacles = world.still.obstacles
    first = len(obstacles) - len(world.discs)
    for j in range(len(world.discs)):
        call_pointer(fn.cpSpaceRemoveShape, world.space, world.discs[j])
    if len(world.discs):
        for _ in range(-len(world.discs) % (world.padding + len(world.shapes))):
            # the numbers of the moving shapes go on from a multiple: see World._add_shapes
            call_pointer(fn.cpSpaceAddShape, world.space, world.discs[0])
            call_pointer(fn.cpSpaceRemoveShape, world.space, world.discs[0])
    for j in range(len(world.discs)):
        x, y, radius = discs[j, 0], discs[j, 1], discs[j, 2]
        if not radius > 0.0:
            x, y, radius = -world.far, -world.far * (j + 1.0), 0.0
        call2(fn.cpCircleShapeSetOffset, world.discs[j], x, y)
        call1(fn.cpCircleShapeSetRadius, world.discs[j], radius)
        call_pointer(fn.cpSpaceAddShape, world.space, world.discs[j])
        obstacle = obstacles[first + j]
        obstacle[0] = obstacle[2] = x
        obstacle[1] = obstacle[3] = y
        obstacle[4] = radius


@compiled
def place_wheels(fn, world, bodies, state, axes, step):  # type: ignore[no-untyped-def]
    """Put the rods' ends on the wheels' axes as predicted for the end of the substep."""
    for j in range(len(world.wheel_body)):
        row, body = bodies[world.wheel_body[j]], state[world.wheel_body[j]]
        x_1, y_1, x_2, y_2 = wheel_ends(row, glide(row, body, step), axes[j, 0], axes[j, 1])
        call2(fn.cpPinJointSetAnchorB, world.wheels[0, j], x_1, y_1)
        call2(fn.cpPinJointSetAnchorB, world.wheels[1, j], x_2, y_2)


@compiled
def place_patches(fn, world, laws, bodies, state, step, acted):  # type: ignore[no-untyped-def]
    """Put each point's rod along its velocity; split its friction with the pivot joint."""
    for j in range(len(world.patch_body)):
        k = world.patch_body[j]
        row, body = bodies[k], state[k]
        after = glide(row, body, step)
        most, speed = patch_signal(row, body, world.still.normal_gravity)
        most = bound(most, laws, k, 1, state, 0.0, 0.0, speed, acted)
        slowing, most = most / row[COLUMN.mass], most / len(world.still.ring)
        for i in range(len(world.still.ring)):
            x, y, share = patch_point(row, after, body[5], world.still.ring[i], step, slowing)
            call2(fn.cpPinJointSetAnchorB, world.patches[1, j, i], x, y)
            call1(fn.cpConstraintSetMaxForce, world.patches[0, j, i], (1.0 - share) * most)
            call1(fn.cpConstraintSetMaxForce, world.patches[1, j, i], share * most)


@compiled
def set_brakes(world, laws, bodies, joints, state, acted):  # type: ignore[no-untyped-def]
    """Set the greatest torque of friction in hinges where laws change it."""
    for j in range(len(world.strengths)):
        setting = world.strengths[j]
        i = setting.row
        if setting.column == COLUMN.pivot_torque:
            torque, rest, speed = hinge_signal(
                world.pivots, world.still.gravity, bodies[i], joints, state[i], acted[i], i
            )
            base = bodies[i, COLUMN.pivot_torque]
            most = bound(base, laws, i, 0, state, torque, rest, speed, acted)
            call1(setting.function, setting.constraint, most)


@compiled
def drive(fn, world, state, action):  # type: ignore[no-untyped-def]
    """Set the velocities of kinematic bodies for the interval that begins."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            for w in range(3):
                state[i, 3 + w] = action[i, w]
            call2(fn.cpBodySetVelocity, world.bodies[i], action[i, 0], action[i, 1])
            call1(fn.cpBodySetAngularVelocity, world.bodies[i], action[i, 2])
