"""Compiled setters: the engine's properties, the places of its wheels, patches and discs.

Numba's cache looks at the file of the function called from Python alone: after an edit here, the
cached `pbrl_ppl.physics.compiled.rollout` is stale until ``__pycache__`` is removed.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pbrl_ppl.physics.calls import call1, call2, call_pointer
from pbrl_ppl.physics.properties import COLUMNS
from pbrl_ppl.physics.scene_joints import JOINT_COLUMNS
from pbrl_ppl.physics.world import FAR, ITERATIONS_A_RATIO, MOST_ITERATIONS, NO_SIZE, STICKING

MASS, _R, _MU_C, _W_X, _W_Y, W_THETA, _MU_X, _MU_Y, _MOMENT, _TORQUE, _DAMPING = range(11)
_PATCH_MU, _PATCH_RADIUS, EXTRA_X, EXTRA_Y, _COM_X, _COM_Y = range(11, len(COLUMNS))
_A_X, _A_Y, _B_X, _B_Y, _LENGTH = range(len(JOINT_COLUMNS))


@numba.njit(nogil=True, cache=True)
def iterations(world, bodies):  # type: ignore[no-untyped-def]
    """Solver iterations for these masses, as in World.set_properties."""
    lightest, heaviest = np.inf, 0.0
    for i in range(len(world.chained)):
        if world.chained[i]:
            lightest = min(lightest, bodies[i, MASS])
            heaviest = max(heaviest, bodies[i, MASS])
    enough = min(ITERATIONS_A_RATIO * (heaviest / lightest), MOST_ITERATIONS)
    return max(world.iterations, int(enough))


@numba.njit(nogil=True, cache=True)
def set_properties(fn, world, bodies, joints):  # type: ignore[no-untyped-def]
    """Set masses, moments, surfaces and anchors, as in World.set_properties."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            continue
        call1(fn.cpBodySetMass, world.bodies[i], bodies[i, MASS])
        call1(fn.cpBodySetMoment, world.bodies[i], bodies[i, _MOMENT])
        call2(fn.cpBodySetCenterOfGravity, world.bodies[i], bodies[i, _COM_X], bodies[i, _COM_Y])
    for j in range(len(world.shapes)):
        row = bodies[world.shape_body[j]]
        call1(fn.cpShapeSetElasticity, world.shapes[j], row[_R])
        call1(fn.cpShapeSetFriction, world.shapes[j], row[_MU_C])
    for j in range(len(world.wheel_body)):
        row = bodies[world.wheel_body[j]]
        for wheel in world.wheels[:, j]:
            call2(fn.cpPinJointSetAnchorA, wheel, row[_W_X], row[_W_Y])
    for j in range(len(world.links)):
        link, row = world.links[j], joints[world.link_joint[j]]
        if world.link_rod[j]:
            call2(fn.cpPinJointSetAnchorA, link, row[_A_X], row[_A_Y])
            call2(fn.cpPinJointSetAnchorB, link, row[_B_X], row[_B_Y])
            call1(fn.cpPinJointSetDist, link, row[_LENGTH])
        else:
            call2(fn.cpPivotJointSetAnchorA, link, row[_A_X], row[_A_Y])
            call2(fn.cpPivotJointSetAnchorB, link, row[_B_X], row[_B_Y])
    for j in range(len(world.pivot_body)):
        damping = bodies[world.pivot_body[j], _DAMPING]
        call1(fn.cpDampedRotarySpringSetDamping, world.pivots[1, j], damping)
    for j in range(len(world.patch_body)):
        radius = bodies[world.patch_body[j], _PATCH_RADIUS]
        for point in range(len(world.ring)):
            x, y = world.ring[point] * radius
            call2(fn.cpPivotJointSetAnchorA, world.patches[0, j, point], x, y)
            call2(fn.cpPinJointSetAnchorA, world.patches[1, j, point], x, y)


@numba.njit(nogil=True, cache=True)
def arm(row, theta):  # type: ignore[no-untyped-def]
    """From a body's origin to its centre of mass, in the world's frame."""
    x, y = row[_COM_X], row[_COM_Y]
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0
    c, s = math.cos(theta), math.sin(theta)
    return c * x - s * y, s * x + c * y


@numba.njit(nogil=True, cache=True)
def _centre(row, state):  # type: ignore[no-untyped-def]
    """Place and velocity of the centre of mass, which goes straight within a substep."""
    x, y = arm(row, state[2])
    return state[0] + x, state[1] + y, state[3] - state[5] * y, state[4] + state[5] * x


@numba.njit(nogil=True, cache=True)
def place_bodies(fn, world, bodies, state):  # type: ignore[no-untyped-def]
    """Put the bodies in a state: the engine's velocity is that of the centre of mass."""
    for i in range(len(world.bodies)):
        body, (x, y) = world.bodies[i], arm(bodies[i], state[i, 2])
        call1(fn.cpBodySetAngle, body, state[i, 2])  # first: the place of the centre hangs on it
        call2(fn.cpBodySetPosition, body, state[i, 0], state[i, 1])
        turn = state[i, 5]
        call2(fn.cpBodySetVelocity, body, state[i, 3] - turn * y, state[i, 4] + turn * x)
        call1(fn.cpBodySetAngularVelocity, body, turn)


@numba.njit(nogil=True, cache=True)
def set_discs(fn, world, discs):  # type: ignore[no-untyped-def]
    """Place the hidden discs, as in World.set_discs.

    They are taken out and put back: the contacts' order depends on where a static shape was before.
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
            x, y, radius = -FAR, -FAR * (j + 1.0), NO_SIZE
        call2(fn.cpCircleShapeSetOffset, world.discs[j], x, y)
        call1(fn.cpCircleShapeSetRadius, world.discs[j], radius)
        call_pointer(fn.cpSpaceAddShape, world.space, world.discs[j])
        obstacle = world.obstacles[first + j]
        obstacle[0] = obstacle[2] = x
        obstacle[1] = obstacle[3] = y
        obstacle[4] = radius


@numba.njit(nogil=True, cache=True)
def set_strengths(fn, world, bodies, normal_gravity, on):  # type: ignore[no-untyped-def]
    """Give the joints their greatest forces, or none at all."""
    for j in range(len(world.wheel_body)):
        row = bodies[world.wheel_body[j]]
        load = on * row[MASS] * normal_gravity
        call1(fn.cpConstraintSetMaxForce, world.wheels[0, j], row[_MU_X] * load)
        call1(fn.cpConstraintSetMaxForce, world.wheels[1, j], row[_MU_Y] * load)
    for j in range(len(world.links)):
        call1(fn.cpConstraintSetMaxForce, world.links[j], np.inf if on else 0.0)
    for j in range(len(world.pivot_body)):
        torque = on * bodies[world.pivot_body[j], _TORQUE]
        call1(fn.cpConstraintSetMaxForce, world.pivots[0, j], torque)
        call1(fn.cpConstraintSetMaxForce, world.pivots[1, j], np.inf if on else 0.0)
    for j in range(len(world.patch_body)):
        for point in range(len(world.ring)):  # on again in every substep
            call1(fn.cpConstraintSetMaxForce, world.patches[0, j, point], 0.0)
            call1(fn.cpConstraintSetMaxForce, world.patches[1, j, point], 0.0)


@numba.njit(nogil=True, cache=True)
def place_wheels(fn, world, bodies, state, axes, step):  # type: ignore[no-untyped-def]
    """Put the rods' ends on the wheels' axes, as they will be when the engine solves for forces."""
    for j in range(len(world.wheel_body)):
        i = world.wheel_body[j]
        theta = state[i, 2] + state[i, 5] * step
        c, s = math.cos(theta), math.sin(theta)
        x, y, v_x, v_y = _centre(bodies[i], state[i])
        w_x, w_y = bodies[i, _W_X] - bodies[i, _COM_X], bodies[i, _W_Y] - bodies[i, _COM_Y]
        x, y = x + v_x * step + c * w_x - s * w_y, y + v_y * step + s * w_x + c * w_y
        c, s = c * axes[j, 0] - s * axes[j, 1], s * axes[j, 0] + c * axes[j, 1]
        call2(fn.cpPinJointSetAnchorB, world.wheels[0, j], x + c, y + s)
        call2(fn.cpPinJointSetAnchorB, world.wheels[1, j], x - s, y + c)


@numba.njit(nogil=True, cache=True)
def place_patches(fn, world, bodies, state, step, normal_gravity):  # type: ignore[no-untyped-def]
    """Put each point's rod along its velocity, and share its friction: as in plain.py."""
    for j in range(len(world.patch_body)):
        i = world.patch_body[j]
        radius, slowing = bodies[i, _PATCH_RADIUS], bodies[i, _PATCH_MU] * normal_gravity
        most = slowing * bodies[i, MASS] / len(world.ring)
        theta = state[i, 2] + state[i, 5] * step
        c, s = math.cos(theta), math.sin(theta)
        at_x, at_y, v_x, v_y = _centre(bodies[i], state[i])
        for point in range(len(world.ring)):
            x = world.ring[point, 0] * radius - bodies[i, _COM_X]
            y = world.ring[point, 1] * radius - bodies[i, _COM_Y]
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


@numba.njit(nogil=True, cache=True)
def drive(fn, world, state, action):  # type: ignore[no-untyped-def]
    """Give the kinematic bodies the velocities of the interval that begins."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            for w in range(3):
                state[i, 3 + w] = action[i, w]
            call2(fn.cpBodySetVelocity, world.bodies[i], action[i, 0], action[i, 1])
            call1(fn.cpBodySetAngularVelocity, world.bodies[i], action[i, 2])
