"""Compiled setters: the engine's properties, and the places of wheels, patches and discs."""

from __future__ import annotations

import math

import numpy as np

from pbrl_ppl.physics.calls import call1, call2, call_pointer
from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import ITERATIONS_A_RATIO, MOST_ITERATIONS, STICKING


@compiled
def iterations(world, bodies):  # type: ignore[no-untyped-def]
    """Return the solver iterations for these masses, as in World.set_properties."""
    lightest, heaviest = np.inf, 0.0
    for i in range(len(world.chained)):
        if world.chained[i]:
            lightest = min(lightest, bodies[i, COLUMN.mass])
            heaviest = max(heaviest, bodies[i, COLUMN.mass])
    enough = min(ITERATIONS_A_RATIO * (heaviest / lightest), MOST_ITERATIONS)
    return max(world.iterations, int(enough))


@compiled
def set_properties(fn, world, bodies, joints):  # type: ignore[no-untyped-def]
    """Set masses, moments, surfaces and anchors, as in World.set_properties."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            continue
        call1(fn.cpBodySetMass, world.bodies[i], bodies[i, COLUMN.mass])
        call1(fn.cpBodySetMoment, world.bodies[i], bodies[i, COLUMN.moment])
        call2(
            fn.cpBodySetCenterOfGravity,
            world.bodies[i],
            bodies[i, COLUMN.com_x],
            bodies[i, COLUMN.com_y],
        )
    for j in range(len(world.shapes)):
        row = bodies[world.shape_body[j]]
        call1(fn.cpShapeSetElasticity, world.shapes[j], row[COLUMN.r])
        call1(fn.cpShapeSetFriction, world.shapes[j], row[COLUMN.mu_c])
    for j in range(len(world.wheel_body)):
        row = bodies[world.wheel_body[j]]
        for wheel in world.wheels[:, j]:
            call2(fn.cpPinJointSetAnchorA, wheel, row[COLUMN.w_x], row[COLUMN.w_y])
    for j in range(len(world.link_settings)):
        setting = world.link_settings[j]
        row, column = joints[setting.joint], setting.column
        if setting.vector:
            call2(setting.function, setting.link, row[column], row[column + 1])
        else:
            call1(setting.function, setting.link, row[column])
    for j in range(len(world.pivot_body)):
        damping = bodies[world.pivot_body[j], COLUMN.pivot_damping]
        call1(fn.cpDampedRotarySpringSetDamping, world.pivots[1, j], damping)
    for j in range(len(world.patch_body)):
        radius = bodies[world.patch_body[j], COLUMN.patch_radius]
        for point in range(len(world.ring)):
            x, y = world.ring[point] * radius
            call2(fn.cpPivotJointSetAnchorA, world.patches[0, j, point], x, y)
            call2(fn.cpPinJointSetAnchorA, world.patches[1, j, point], x, y)


@compiled
def arm(row, theta):  # type: ignore[no-untyped-def]
    """Return the arm from a body's origin to its centre of mass, in the world's frame."""
    x, y = row[COLUMN.com_x], row[COLUMN.com_y]
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0
    c, s = math.cos(theta), math.sin(theta)
    return c * x - s * y, s * x + c * y


@compiled
def _centre(row, state):  # type: ignore[no-untyped-def]
    """Return place and velocity of the centre of mass, which moves straight in a substep."""
    x, y = arm(row, state[2])
    return state[0] + x, state[1] + y, state[3] - state[5] * y, state[4] + state[5] * x


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
    """Place the hidden discs, as in World.set_discs.

    They are removed and added again, since the order of contacts depends on their earlier places.
    """
    first = len(world.obstacles) - len(world.discs)
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
        obstacle = world.obstacles[first + j]
        obstacle[0] = obstacle[2] = x
        obstacle[1] = obstacle[3] = y
        obstacle[4] = radius


@compiled
def set_strengths(fn, world, bodies, normal_gravity, on):  # type: ignore[no-untyped-def]
    """Set the joints' greatest forces (``on`` is 1), or set them to zero (0)."""
    for j in range(len(world.wheel_body)):
        row = bodies[world.wheel_body[j]]
        load = on * row[COLUMN.mass] * normal_gravity
        call1(fn.cpConstraintSetMaxForce, world.wheels[0, j], row[COLUMN.mu_x] * load)
        call1(fn.cpConstraintSetMaxForce, world.wheels[1, j], row[COLUMN.mu_y] * load)
    for j in range(len(world.links)):
        call1(fn.cpConstraintSetMaxForce, world.links[j], np.inf if on else 0.0)
    for j in range(len(world.pivot_body)):
        torque = on * bodies[world.pivot_body[j], COLUMN.pivot_torque]
        call1(fn.cpConstraintSetMaxForce, world.pivots[0, j], torque)
        call1(fn.cpConstraintSetMaxForce, world.pivots[1, j], np.inf if on else 0.0)
    for j in range(len(world.patch_body)):
        for point in range(len(world.ring)):  # on again in every substep
            call1(fn.cpConstraintSetMaxForce, world.patches[0, j, point], 0.0)
            call1(fn.cpConstraintSetMaxForce, world.patches[1, j, point], 0.0)


@compiled
def place_wheels(fn, world, bodies, state, axes, step):  # type: ignore[no-untyped-def]
    """Put the rods' ends on the wheels' axes as predicted for the end of the substep."""
    for j in range(len(world.wheel_body)):
        i = world.wheel_body[j]
        theta = state[i, 2] + state[i, 5] * step
        c, s = math.cos(theta), math.sin(theta)
        x, y, v_x, v_y = _centre(bodies[i], state[i])
        w_x, w_y = (
            bodies[i, COLUMN.w_x] - bodies[i, COLUMN.com_x],
            bodies[i, COLUMN.w_y] - bodies[i, COLUMN.com_y],
        )
        x, y = x + v_x * step + c * w_x - s * w_y, y + v_y * step + s * w_x + c * w_y
        c, s = c * axes[j, 0] - s * axes[j, 1], s * axes[j, 0] + c * axes[j, 1]
        call2(fn.cpPinJointSetAnchorB, world.wheels[0, j], x + c, y + s)
        call2(fn.cpPinJointSetAnchorB, world.wheels[1, j], x - s, y + c)


@compiled
def place_patches(fn, world, bodies, state, step, normal_gravity):  # type: ignore[no-untyped-def]
    """Put each point's rod along its velocity and split its friction, as the reference path."""
    for j in range(len(world.patch_body)):
        i = world.patch_body[j]
        radius, slowing = (
            bodies[i, COLUMN.patch_radius],
            bodies[i, COLUMN.patch_mu] * normal_gravity,
        )
        most = slowing * bodies[i, COLUMN.mass] / len(world.ring)
        theta = state[i, 2] + state[i, 5] * step
        c, s = math.cos(theta), math.sin(theta)
        at_x, at_y, v_x, v_y = _centre(bodies[i], state[i])
        for point in range(len(world.ring)):
            x = world.ring[point, 0] * radius - bodies[i, COLUMN.com_x]
            y = world.ring[point, 1] * radius - bodies[i, COLUMN.com_y]
            x, y = c * x - s * y, s * x + c * y
            along_x, along_y = v_x - state[i, 5] * y, v_y + state[i, 5] * x
            speed = math.sqrt(along_x * along_x + along_y * along_y)
            slow = STICKING * slowing * step
            share = 1.0 if speed >= slow else speed / slow
            if speed == 0.0:
                along_x, speed = 1.0, 1.0
            x = at_x + v_x * step + x + along_x / speed
            y = at_y + v_y * step + y + along_y / speed
            call2(fn.cpPinJointSetAnchorB, world.patches[1, j, point], x, y)
            call1(fn.cpConstraintSetMaxForce, world.patches[0, j, point], (1.0 - share) * most)
            call1(fn.cpConstraintSetMaxForce, world.patches[1, j, point], share * most)


@compiled
def drive(fn, world, state, action):  # type: ignore[no-untyped-def]
    """Set the velocities of kinematic bodies for the interval that begins."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            for w in range(3):
                state[i, 3 + w] = action[i, w]
            call2(fn.cpBodySetVelocity, world.bodies[i], action[i, 0], action[i, 1])
            call1(fn.cpBodySetAngularVelocity, world.bodies[i], action[i, 2])
