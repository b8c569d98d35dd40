"""The compiled rollout: numba code that calls the engine's C functions by address, without the GIL.

A vector argument of the C functions is a struct of two doubles passed by value. Under the System V
and AArch64 calling conventions that is the same as two doubles, which is what is passed here; on
other platforms :data:`AVAILABLE` is false and the plain path serves.
"""

from __future__ import annotations

import math
import platform
import sys
from collections import namedtuple
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray
from pymunk import _chipmunk_cffi

from pbrl_ppl.effects.base import Force
from pbrl_ppl.physics.properties import COLUMNS, JOINT_COLUMNS
from pbrl_ppl.physics.world import (
    DIVERGED,
    FAR,
    ITERATIONS_A_RATIO,
    MOST_ITERATIONS,
    RING,
    STICKING,
    TINY,
    World,
)

#: The engine's functions in use, each by the name of its address.
Functions = namedtuple(
    "Functions",
    [
        "cpSpaceStep",
        "cpSpaceSetIterations",
        "cpSpaceAddShape",
        "cpSpaceRemoveShape",
        "cpBodySetMass",
        "cpBodySetMoment",
        "cpBodySetPosition",
        "cpBodySetAngle",
        "cpBodySetVelocity",
        "cpBodySetAngularVelocity",
        "cpBodySetForce",
        "cpBodySetTorque",
        "cpBodyGetPosition",
        "cpBodyGetAngle",
        "cpBodyGetVelocity",
        "cpBodyGetAngularVelocity",
        "cpShapeSetElasticity",
        "cpShapeSetFriction",
        "cpConstraintSetMaxForce",
        "cpPivotJointSetAnchorA",
        "cpPivotJointSetAnchorB",
        "cpPinJointSetAnchorA",
        "cpPinJointSetAnchorB",
        "cpPinJointSetDist",
        "cpDampedRotarySpringSetDamping",
    ],
)
_MASS, _R, _MU_C, _W_X, _W_Y, _W_THETA, _MU_X, _MU_Y, _MOMENT, _TORQUE, _DAMPING = range(11)
_PATCH_MU, _PATCH_RADIUS = range(11, len(COLUMNS))
_A_X, _A_Y, _B_X, _B_Y, _LENGTH = range(len(JOINT_COLUMNS))
_FREE, _TOUCHED, _LOST = 0, 1, 2


def _addresses() -> Any:
    """Addresses of the C functions, or None where they cannot be called this way."""
    registers = platform.machine().lower() in ("x86_64", "amd64", "aarch64", "arm64")
    if sys.platform == "win32" or not registers:
        return None
    ffi, lib = _chipmunk_cffi.ffi, _chipmunk_cffi.lib
    try:
        return Functions(
            *(int(ffi.cast("intptr_t", ffi.addressof(lib, name))) for name in Functions._fields)
        )
    except (AttributeError, ffi.error):
        return None


FUNCTIONS = _addresses()
AVAILABLE = FUNCTIONS is not None


def _void_call(n_doubles: int) -> Any:
    """Make ``call(function, pointer, double...)`` for C functions that return nothing."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = [ir.IntType(64)] + [ir.DoubleType()] * n_doubles
        function = builder.inttoptr(args[0], ir.FunctionType(ir.VoidType(), kinds).as_pointer())
        builder.call(function, args[1:])
        return context.get_dummy_value()

    doubles = [types.float64] * n_doubles
    signature = types.void(types.int64, types.int64, *doubles)
    if n_doubles == 1:

        @intrinsic
        def call1(typing: Any, function: Any, pointer: Any, a: Any) -> Any:
            return signature, codegen

        return call1

    @intrinsic
    def call2(typing: Any, function: Any, pointer: Any, a: Any, b: Any) -> Any:
        return signature, codegen

    return call2


_call1 = _void_call(1)
_call2 = _void_call(2)


@intrinsic
def _call_int(typing: Any, function: Any, pointer: Any, value: Any) -> Any:
    """Call a C function of a pointer and an int that returns nothing."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64), ir.IntType(32)]).as_pointer()
        value = builder.trunc(args[2], ir.IntType(32))
        builder.call(builder.inttoptr(args[0], kind), [args[1], value])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def _call_pointer(typing: Any, function: Any, pointer: Any, other: Any) -> Any:
    """Call a C function of two pointers; what it returns, if anything, is left."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 2).as_pointer()
        builder.call(builder.inttoptr(args[0], kind), args[1:])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def _get1(typing: Any, function: Any, pointer: Any) -> Any:
    """Call a C function of a pointer that returns a double."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [ir.IntType(64)]).as_pointer()
        return builder.call(builder.inttoptr(args[0], kind), args[1:])

    return types.float64(types.int64, types.int64), codegen


@intrinsic
def _get2(typing: Any, function: Any, pointer: Any) -> Any:
    """Call a C function of a pointer that returns a vector."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.LiteralStructType([ir.DoubleType(), ir.DoubleType()])
        kind = ir.FunctionType(vector, [ir.IntType(64)]).as_pointer()
        value = builder.call(builder.inttoptr(args[0], kind), args[1:])
        parts = [builder.extract_value(value, 0), builder.extract_value(value, 1)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(types.float64, 2)(types.int64, types.int64), codegen


@intrinsic
def _call_law(typing: Any, function: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Call an effect's force law: four pointers to doubles."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 4).as_pointer()
        builder.call(builder.inttoptr(args[0], kind), args[1:])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), codegen


_DOUBLES = types.CPointer(types.float64)
_LAWS: dict[Force, Any] = {}


def law_address(force: Force) -> int:
    """Compile an effect's force law to a C function, once, and give its address."""
    if force not in _LAWS:
        _LAWS[force] = numba.cfunc(types.void(_DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES))(force)
    return int(_LAWS[force].address)


class Pointers(NamedTuple):
    """The C objects of one world, for the compiled loop."""

    space: int
    iterations: int
    chained: NDArray[np.bool_]
    padding: int
    bodies: NDArray[np.int64]
    kinematic: NDArray[np.bool_]
    shapes: NDArray[np.int64]
    shape_body: NDArray[np.int64]
    wheels: NDArray[np.int64]  # (2, wheel): the rod along x, the rod along y
    wheel_body: NDArray[np.int64]
    links: NDArray[np.int64]
    link_joint: NDArray[np.int64]
    link_rod: NDArray[np.bool_]
    pivots: NDArray[np.int64]  # (2, pivot): the motor, the damper
    pivot_body: NDArray[np.int64]
    patches: NDArray[np.int64]  # (2, patch, point of the ring): what holds it, the rod
    patch_body: NDArray[np.int64]
    ring: NDArray[np.float64]
    radii: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    can_touch: NDArray[np.bool_]


def pointers(world: World) -> Pointers:
    """Where the C objects of a world are; the world must be kept alive."""
    ffi = _chipmunk_cffi.ffi

    def at(objects: list[Any]) -> NDArray[np.int64]:
        return np.array([int(ffi.cast("intptr_t", each)) for each in objects], dtype=np.int64)

    def whole(numbers: list[int]) -> NDArray[np.int64]:
        return np.array(numbers, dtype=np.int64)

    wheels, links, pivots = world.wheels, world.links, world.pivots
    return Pointers(
        space=int(ffi.cast("intptr_t", world.space._space)),
        iterations=world.iterations,
        chained=world.chained,
        padding=world.padding,
        bodies=at([body._body for body in world.bodies]),
        kinematic=world.kinematic,
        shapes=at([shape._shape for _, shape in world.shapes]),
        shape_body=whole([i for i, _ in world.shapes]),
        wheels=np.stack(
            [
                at([wheel.along_x._constraint for wheel in wheels]),
                at([wheel.along_y._constraint for wheel in wheels]),
            ]
        ),
        wheel_body=whole([wheel.body for wheel in wheels]),
        links=at([link.constraint._constraint for link in links]),
        link_joint=whole([link.joint for link in links]),
        link_rod=np.array([link.rod for link in links], dtype=bool),
        pivots=np.stack(
            [
                at([pivot.motor._constraint for pivot in pivots]),
                at([pivot.damper._constraint for pivot in pivots]),
            ]
        ),
        pivot_body=whole([pivot.body for pivot in pivots]),
        patches=at(
            [hold._constraint for patch in world.patches for hold in patch.holds]
            + [rod._constraint for patch in world.patches for rod in patch.rods]
        ).reshape(2, -1, len(RING)),
        patch_body=whole([patch.body for patch in world.patches]),
        ring=np.array(RING),
        radii=world.radii,
        obstacles=world.obstacles,
        can_touch=world.can_touch,
    )


@numba.njit(nogil=True, cache=True)
def _iterations(world, bodies):  # type: ignore[no-untyped-def]
    """Solver iterations for these masses, as in World.set_properties."""
    lightest, heaviest = np.inf, 0.0
    for i in range(len(world.chained)):
        if world.chained[i]:
            lightest = min(lightest, bodies[i, _MASS])
            heaviest = max(heaviest, bodies[i, _MASS])
    enough = min(ITERATIONS_A_RATIO * (heaviest / lightest), MOST_ITERATIONS)
    return max(world.iterations, int(enough))


@numba.njit(nogil=True, cache=True)
def _set_properties(fn, world, bodies, joints):  # type: ignore[no-untyped-def]
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            continue
        _call1(fn.cpBodySetMass, world.bodies[i], bodies[i, _MASS])
        _call1(fn.cpBodySetMoment, world.bodies[i], bodies[i, _MOMENT])
    for j in range(len(world.shapes)):
        row = bodies[world.shape_body[j]]
        _call1(fn.cpShapeSetElasticity, world.shapes[j], row[_R])
        _call1(fn.cpShapeSetFriction, world.shapes[j], row[_MU_C])
    for j in range(len(world.wheel_body)):
        row = bodies[world.wheel_body[j]]
        for wheel in world.wheels[:, j]:
            _call2(fn.cpPinJointSetAnchorA, wheel, row[_W_X], row[_W_Y])
    for j in range(len(world.links)):
        link, row = world.links[j], joints[world.link_joint[j]]
        if world.link_rod[j]:
            _call2(fn.cpPinJointSetAnchorA, link, row[_A_X], row[_A_Y])
            _call2(fn.cpPinJointSetAnchorB, link, row[_B_X], row[_B_Y])
            _call1(fn.cpPinJointSetDist, link, row[_LENGTH])
        else:
            _call2(fn.cpPivotJointSetAnchorA, link, row[_A_X], row[_A_Y])
            _call2(fn.cpPivotJointSetAnchorB, link, row[_B_X], row[_B_Y])
    for j in range(len(world.pivot_body)):
        damping = bodies[world.pivot_body[j], _DAMPING]
        _call1(fn.cpDampedRotarySpringSetDamping, world.pivots[1, j], damping)
    for j in range(len(world.patch_body)):
        radius = bodies[world.patch_body[j], _PATCH_RADIUS]
        for point in range(len(world.ring)):
            x, y = world.ring[point] * radius
            _call2(fn.cpPivotJointSetAnchorA, world.patches[0, j, point], x, y)
            _call2(fn.cpPinJointSetAnchorA, world.patches[1, j, point], x, y)


@numba.njit(nogil=True, cache=True)
def _set_strengths(fn, world, bodies, normal_gravity, on):  # type: ignore[no-untyped-def]
    """Give the joints their greatest forces, or none at all."""
    for j in range(len(world.wheel_body)):
        row = bodies[world.wheel_body[j]]
        load = on * row[_MASS] * normal_gravity
        _call1(fn.cpConstraintSetMaxForce, world.wheels[0, j], row[_MU_X] * load)
        _call1(fn.cpConstraintSetMaxForce, world.wheels[1, j], row[_MU_Y] * load)
    for j in range(len(world.links)):
        _call1(fn.cpConstraintSetMaxForce, world.links[j], np.inf if on else 0.0)
    for j in range(len(world.pivot_body)):
        torque = on * bodies[world.pivot_body[j], _TORQUE]
        _call1(fn.cpConstraintSetMaxForce, world.pivots[0, j], torque)
        _call1(fn.cpConstraintSetMaxForce, world.pivots[1, j], np.inf if on else 0.0)
    for joint in world.patches.ravel():  # on again in every substep
        _call1(fn.cpConstraintSetMaxForce, joint, 0.0)


@numba.njit(nogil=True, cache=True)
def _forget(fn, world, bodies, normal_gravity, touched):  # type: ignore[no-untyped-def]
    """Clear what the engine remembers of the last transition.

    Contacts go with their shapes, which are taken out and put back as in a new world: far from each
    other, and numbered alike. Where nothing has touched, and nothing will, that is left out. A
    joint's stored impulse is clipped to its greatest force, here zero.
    """
    if touched == _FREE and len(world.wheel_body) + len(world.links) + len(world.patch_body) == 0:
        return  # nothing to forget
    if touched:
        for i in range(len(world.bodies)):
            _call2(fn.cpBodySetPosition, world.bodies[i], FAR * (i + 1.0), FAR)
            _call1(fn.cpBodySetAngle, world.bodies[i], 0.0)
            _call2(fn.cpBodySetVelocity, world.bodies[i], 0.0, 0.0)
            _call1(fn.cpBodySetAngularVelocity, world.bodies[i], 0.0)
        for shape in world.shapes:
            _call_pointer(fn.cpSpaceRemoveShape, world.space, shape)
        for _ in range(world.padding):  # see World._add_shapes
            _call_pointer(fn.cpSpaceAddShape, world.space, world.shapes[0])
            _call_pointer(fn.cpSpaceRemoveShape, world.space, world.shapes[0])
        for shape in world.shapes:
            _call_pointer(fn.cpSpaceAddShape, world.space, shape)
    _set_strengths(fn, world, bodies, normal_gravity, 0.0)
    _call_int(fn.cpSpaceSetIterations, world.space, 1)
    _call1(fn.cpSpaceStep, world.space, TINY)
    _call_int(fn.cpSpaceSetIterations, world.space, _iterations(world, bodies))
    _set_strengths(fn, world, bodies, normal_gravity, 1.0)


@numba.njit(nogil=True, cache=True)
def _place_patches(fn, world, bodies, state, step, normal_gravity):  # type: ignore[no-untyped-def]
    """Put each point's rod along its velocity, and share its friction: as in plain.py."""
    for j in range(len(world.patch_body)):
        i = world.patch_body[j]
        radius, slowing = bodies[i, _PATCH_RADIUS], bodies[i, _PATCH_MU] * normal_gravity
        most = slowing * bodies[i, _MASS] / len(world.ring)
        theta = state[i, 2] + state[i, 5] * step
        c, s = math.cos(theta), math.sin(theta)
        for point in range(len(world.ring)):
            x, y = world.ring[point, 0] * radius, world.ring[point, 1] * radius
            x, y = c * x - s * y, s * x + c * y
            along_x, along_y = state[i, 3] - state[i, 5] * y, state[i, 4] + state[i, 5] * x
            speed = math.sqrt(along_x * along_x + along_y * along_y)
            slow = STICKING * slowing * step
            share = 1.0 if speed >= slow else speed / slow
            if speed == 0.0:
                along_x, speed = 1.0, 1.0
            x = state[i, 0] + state[i, 3] * step + x + along_x / speed
            y = state[i, 1] + state[i, 4] * step + y + along_y / speed
            _call2(fn.cpPinJointSetAnchorB, world.patches[1, j, point], x, y)
            _call1(fn.cpConstraintSetMaxForce, world.patches[0, j, point], (1.0 - share) * most)
            _call1(fn.cpConstraintSetMaxForce, world.patches[1, j, point], share * most)


@numba.njit(nogil=True, cache=True)
def _near_contact(i, state, radii, obstacles, can_touch):  # type: ignore[no-untyped-def]
    """Whether body ``i`` may touch an obstacle or a body before it: as in plain.py."""
    x, y = state[i, 0], state[i, 1]
    for j in range(len(obstacles)):
        ax, ay = obstacles[j, 0], obstacles[j, 1]
        dx, dy = obstacles[j, 2] - ax, obstacles[j, 3] - ay
        length = dx * dx + dy * dy
        t = 0.0
        if length > 0.0:
            t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length))
        reach = radii[i] + obstacles[j, 4]
        ex, ey = x - ax - t * dx, y - ay - t * dy
        if ex * ex + ey * ey <= reach * reach:
            return True
    for j in range(i):
        if can_touch[i, j]:
            reach = radii[i] + radii[j]
            ex, ey = x - state[j, 0], y - state[j, 1]
            if ex * ex + ey * ey <= reach * reach:
                return True
    return False


@numba.njit(nogil=True, cache=True)
def _drive(fn, world, state, action):  # type: ignore[no-untyped-def]
    """Give the kinematic bodies the velocities of the interval that begins."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            for w in range(3):
                state[i, 3 + w] = action[i, w]
            _call2(fn.cpBodySetVelocity, world.bodies[i], action[i, 0], action[i, 1])
            _call1(fn.cpBodySetAngularVelocity, world.bodies[i], action[i, 2])


@numba.njit(nogil=True, cache=True)
def _transition(  # type: ignore[no-untyped-def]
    fn,
    world,
    bodies,
    forces,
    force_body,
    force_offset,
    laws,
    start,
    actions,
    step,
    substeps,
    normal_gravity,
    out,
):
    """One transition of horizon H into ``out`` (H, body, 6); says what became of it."""
    k = len(world.bodies)
    state = start.copy()
    command = np.zeros(3)
    wrench = np.zeros((k, 3))
    axes = np.empty((len(world.wheel_body), 2))
    for j in range(len(axes)):
        turn = bodies[world.wheel_body[j], _W_THETA]
        axes[j, 0], axes[j, 1] = math.cos(turn), math.sin(turn)
    touched = _FREE
    watch = len(world.obstacles) > 0 or k > 1
    for i in range(k):
        body = world.bodies[i]
        _call2(fn.cpBodySetPosition, body, state[i, 0], state[i, 1])
        _call1(fn.cpBodySetAngle, body, state[i, 2])
        _call2(fn.cpBodySetVelocity, body, state[i, 3], state[i, 4])
        _call1(fn.cpBodySetAngularVelocity, body, state[i, 5])
    state_at, command_at = state.ctypes.data, command.ctypes.data
    wrench_at, laws_at = wrench.ctypes.data, laws.ctypes.data
    for h in range(len(actions)):
        _drive(fn, world, state, actions[h])
        for _ in range(substeps):
            for i in range(k):
                for w in range(3):
                    wrench[i, w] = actions[h, i, w]
            for e in range(len(forces)):
                i = force_body[e]
                for w in range(3):
                    command[w] = actions[h, i, w]
                _call_law(
                    forces[e],
                    state_at + 48 * i,
                    command_at,
                    laws_at + 8 * force_offset[e],
                    wrench_at + 24 * i,
                )
            for i in range(k):
                if world.kinematic[i]:
                    continue
                _call2(fn.cpBodySetForce, world.bodies[i], wrench[i, 0], wrench[i, 1])
                _call1(fn.cpBodySetTorque, world.bodies[i], wrench[i, 2])
            for j in range(len(world.wheel_body)):
                i = world.wheel_body[j]
                theta = state[i, 2] + state[i, 5] * step
                c, s = math.cos(theta), math.sin(theta)
                w_x, w_y = bodies[i, _W_X], bodies[i, _W_Y]
                x = state[i, 0] + state[i, 3] * step + c * w_x - s * w_y
                y = state[i, 1] + state[i, 4] * step + s * w_x + c * w_y
                c, s = c * axes[j, 0] - s * axes[j, 1], s * axes[j, 0] + c * axes[j, 1]
                _call2(fn.cpPinJointSetAnchorB, world.wheels[0, j], x + c, y + s)
                _call2(fn.cpPinJointSetAnchorB, world.wheels[1, j], x - s, y + c)
            _place_patches(fn, world, bodies, state, step, normal_gravity)
            _call1(fn.cpSpaceStep, world.space, step)
            for i in range(k):
                body = world.bodies[i]
                state[i, 0], state[i, 1] = _get2(fn.cpBodyGetPosition, body)
                state[i, 2] = _get1(fn.cpBodyGetAngle, body)
                state[i, 3], state[i, 4] = _get2(fn.cpBodyGetVelocity, body)
                state[i, 5] = _get1(fn.cpBodyGetAngularVelocity, body)
                speed = abs(state[i, 3]) + abs(state[i, 4]) + abs(state[i, 5])
                if not speed < DIVERGED:  # also true of NaN
                    return _LOST
                if watch and touched == _FREE:
                    near = _near_contact(i, state, world.radii, world.obstacles, world.can_touch)
                    touched = _TOUCHED if near else _FREE
        out[h] = state
    return touched


@numba.njit(nogil=True, cache=True)
def rollout(  # type: ignore[no-untyped-def]
    fn,
    world,
    bodies,
    joints,
    laws,
    forces,
    force_body,
    force_offset,
    start,
    actions,
    time_step,
    normal_gravity,
    counts,
    weights,
    first,
    last,
    out,
):
    """Predict items ``first`` to ``last`` of proposals x transitions into ``out``.

    ``out`` has shape (proposal * transition, H, body, 6). The transition is run with each number of
    substeps in ``counts``, the finest first, and the weighted sum taken, which cancels the leading
    errors; where shapes came close the finest run stands alone: a collision's time is no smooth
    function of the substep.

    Returns the item at which the engine diverged (its world is then of no more use), or ``last``.
    """
    n = len(start)
    scratch = np.empty((actions.shape[1], actions.shape[2], 6))
    total = np.empty_like(scratch)
    proposal = -1
    state = _TOUCHED  # what an earlier call left behind is unknown
    for item in range(first, last):
        p, t = item // n, item % n
        if p != proposal:
            proposal = p
            _set_properties(fn, world, bodies[p], joints[p])
        total[:] = 0.0
        for level in range(len(counts)):
            before = state
            for _ in range(2):
                _forget(fn, world, bodies[p], normal_gravity, before)
                state = _transition(
                    fn, world, bodies[p], forces, force_body, force_offset, laws[p],
                    start[t], actions[t], time_step / counts[level], counts[level],
                    normal_gravity, scratch,
                )  # fmt: skip
                if state != _TOUCHED or before == _TOUCHED:
                    break
                before = _TOUCHED  # contacts in the order of a new world: once more from there
            if state == _LOST:
                return item
            if level == 0:
                out[item] = scratch
            if state == _TOUCHED:
                break
            total += weights[level] * scratch
        if state == _FREE and len(counts) > 1:
            out[item] = total
    return last
