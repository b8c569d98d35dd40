"""The compiled rollout: numba code that calls the engine's C functions by address, without the GIL.

A vector argument of the C functions is a struct of two doubles passed by value. Under the System V
and AArch64 calling conventions that is the same as two doubles, which is what is passed here; on
other platforms :data:`AVAILABLE` is false and the plain path serves.
"""

from __future__ import annotations

import math
import platform
import sys
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from pymunk import _chipmunk_cffi

from pbrl_ppl.effects.base import Force
from pbrl_ppl.physics.properties import COLUMN, COLUMNS
from pbrl_ppl.physics.world import DIVERGED, FAR, TINY, World

_FUNCTIONS = (
    "cpSpaceStep",
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
    "cpGrooveJointSetAnchorB",
    "cpDampedRotarySpringSetDamping",
)
(
    _STEP,
    _SET_MASS,
    _SET_MOMENT,
    _SET_POSITION,
    _SET_ANGLE,
    _SET_VELOCITY,
    _SET_SPIN,
    _SET_FORCE,
    _SET_TORQUE,
    _GET_POSITION,
    _GET_ANGLE,
    _GET_VELOCITY,
    _GET_SPIN,
    _SET_ELASTICITY,
    _SET_FRICTION,
    _SET_MAX_FORCE,
    _SET_ANCHOR,
    _SET_DAMPING,
) = range(len(_FUNCTIONS))
_MASS, _R, _MU_C, _W_X, _W_Y, _W_THETA, _MU_X, _MU_Y, _MOMENT, _TORQUE, _DAMPING = range(
    len(COLUMNS)
)
#: The engine remembers contacts for this many steps after the shapes have parted.
_PARKED_STEPS = 5
_FREE, _TOUCHED, _LOST = 0, 1, 2


def _addresses() -> np.ndarray[Any, np.dtype[np.int64]] | None:
    """Addresses of the C functions, or None where they cannot be called this way."""
    registers = platform.machine().lower() in ("x86_64", "amd64", "aarch64", "arm64")
    if sys.platform == "win32" or not registers:
        return None
    ffi, lib = _chipmunk_cffi.ffi, _chipmunk_cffi.lib
    try:
        found = [int(ffi.cast("intptr_t", ffi.addressof(lib, name))) for name in _FUNCTIONS]
    except (AttributeError, ffi.error):
        return None
    return np.array(found, dtype=np.int64)


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


class CompiledWorld:
    """A world of one thread as arrays of pointers for the compiled loop."""

    def __init__(self, world: World) -> None:
        self.world = world  # keeps the C objects alive
        ffi = _chipmunk_cffi.ffi

        def pointers(objects: list[Any]) -> Any:
            return np.array([int(ffi.cast("intptr_t", each)) for each in objects], dtype=np.int64)

        self.space = int(ffi.cast("intptr_t", world.space._space))
        self.bodies = pointers([body._body for body in world.bodies])
        self.shapes = pointers([shape._shape for _, shape in world.shapes])
        self.shape_body = np.array([i for i, _ in world.shapes], dtype=np.int64)
        wheels, pivots = world.wheels, world.pivots
        self.wheel_body = np.array([wheel.body for wheel in wheels], dtype=np.int64)
        self.wheels = np.stack(
            [
                pointers([wheel.ground._body for wheel in wheels]),
                pointers([wheel.along_x._constraint for wheel in wheels]),
                pointers([wheel.along_y._constraint for wheel in wheels]),
            ]
        )
        self.joints = pointers([joint._constraint for joint in world.joints])
        self.pivot_body = np.array([pivot.body for pivot in pivots], dtype=np.int64)
        self.pivots = np.stack(
            [
                pointers([pivot.motor._constraint for pivot in pivots]),
                pointers([pivot.damper._constraint for pivot in pivots]),
            ]
        )

    def arrays(self) -> tuple[Any, ...]:
        """What :func:`rollout` needs, in its order."""
        return (
            self.space,
            self.bodies,
            self.shapes,
            self.shape_body,
            self.wheel_body,
            self.wheels,
            self.joints,
            self.pivot_body,
            self.pivots,
            self.world.radii,
            self.world.obstacles,
            self.world.can_touch,
        )


@numba.njit(nogil=True, cache=True)
def _set_properties(fn, world, properties, normal_gravity):  # type: ignore[no-untyped-def]
    _, bodies, shapes, shape_body, wheel_body, wheels, _, pivot_body, pivots, _, _, _ = world
    for i in range(len(bodies)):
        _call1(fn[_SET_MASS], bodies[i], properties[i, _MASS])
        _call1(fn[_SET_MOMENT], bodies[i], properties[i, _MOMENT])
    for j in range(len(shapes)):
        _call1(fn[_SET_ELASTICITY], shapes[j], properties[shape_body[j], _R])
        _call1(fn[_SET_FRICTION], shapes[j], properties[shape_body[j], _MU_C])
    for j in range(len(wheel_body)):
        row = properties[wheel_body[j]]
        _call2(fn[_SET_ANCHOR], wheels[1, j], row[_W_X], row[_W_Y])
        _call2(fn[_SET_ANCHOR], wheels[2, j], row[_W_X], row[_W_Y])
    for j in range(len(pivot_body)):
        _call1(fn[_SET_DAMPING], pivots[1, j], properties[pivot_body[j], _DAMPING])


@numba.njit(nogil=True, cache=True)
def _set_strengths(fn, world, properties, normal_gravity, on):  # type: ignore[no-untyped-def]
    """Give the joints their greatest forces, or none at all."""
    _, _, _, _, wheel_body, wheels, joints, pivot_body, pivots, _, _, _ = world
    for j in range(len(wheel_body)):
        row = properties[wheel_body[j]]
        load = on * row[_MASS] * normal_gravity
        _call1(fn[_SET_MAX_FORCE], wheels[1, j], row[_MU_Y] * load)
        _call1(fn[_SET_MAX_FORCE], wheels[2, j], row[_MU_X] * load)
    for j in range(len(joints)):
        _call1(fn[_SET_MAX_FORCE], joints[j], np.inf if on else 0.0)
    for j in range(len(pivot_body)):
        row = properties[pivot_body[j]]
        _call1(fn[_SET_MAX_FORCE], pivots[0, j], on * row[_TORQUE])
        _call1(fn[_SET_MAX_FORCE], pivots[1, j], np.inf if on else 0.0)


@numba.njit(nogil=True, cache=True)
def _forget(fn, world, properties, normal_gravity, touched):  # type: ignore[no-untyped-def]
    """Clear what the engine remembers of the last transition.

    Contacts are dropped once their shapes have been apart for some steps, so bodies are parked far
    from each other; a joint's stored impulse is clipped to its greatest force, here zero.
    """
    space, bodies, _, _, wheel_body, _, joints, _, _, _, _, _ = world
    if touched == _FREE and len(wheel_body) == 0 and len(joints) == 0:
        return
    for i in range(len(bodies)):
        if touched:
            _call2(fn[_SET_POSITION], bodies[i], FAR * (i + 1.0), FAR)
        _call2(fn[_SET_VELOCITY], bodies[i], 0.0, 0.0)
        _call1(fn[_SET_SPIN], bodies[i], 0.0)
        _call2(fn[_SET_FORCE], bodies[i], 0.0, 0.0)
        _call1(fn[_SET_TORQUE], bodies[i], 0.0)
    _set_strengths(fn, world, properties, normal_gravity, 0.0)
    for _ in range(_PARKED_STEPS if touched else 1):
        _call1(fn[_STEP], space, TINY)
    _set_strengths(fn, world, properties, normal_gravity, 1.0)


@numba.njit(nogil=True, cache=True)
def _near_contact(x, y, i, radii, obstacles, can_touch, places):  # type: ignore[no-untyped-def]
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
            ex, ey = x - places[j, 0], y - places[j, 1]
            if ex * ex + ey * ey <= reach * reach:
                return True
    return False


@numba.njit(nogil=True, cache=True)
def _transition(  # type: ignore[no-untyped-def]
    fn, world, properties, laws, law_body, law_offset, values, start, actions, step, substeps, out
):
    """One transition of horizon H into ``out`` (H, body, 6); says what became of it."""
    space, bodies, _, _, wheel_body, wheels, _, _, _, radii, obstacles, can_touch = world
    k = len(bodies)
    state = start.copy()
    command = np.zeros(3)
    wrench = np.zeros((k, 3))
    touched = _FREE
    watch = len(obstacles) > 0 or k > 1
    for i in range(k):
        _call2(fn[_SET_POSITION], bodies[i], state[i, 0], state[i, 1])
        _call1(fn[_SET_ANGLE], bodies[i], state[i, 2])
        _call2(fn[_SET_VELOCITY], bodies[i], state[i, 3], state[i, 4])
        _call1(fn[_SET_SPIN], bodies[i], state[i, 5])
    state_at, command_at = state.ctypes.data, command.ctypes.data
    wrench_at, values_at = wrench.ctypes.data, values.ctypes.data
    for h in range(len(actions)):
        for _ in range(substeps):
            for i in range(k):
                for w in range(3):
                    wrench[i, w] = actions[h, i, w]
            for e in range(len(laws)):
                i = law_body[e]
                for w in range(3):
                    command[w] = actions[h, i, w]
                _call_law(
                    laws[e],
                    state_at + 48 * i,
                    command_at,
                    values_at + 8 * law_offset[e],
                    wrench_at + 24 * i,
                )
            for i in range(k):
                _call2(fn[_SET_FORCE], bodies[i], wrench[i, 0], wrench[i, 1])
                _call1(fn[_SET_TORQUE], bodies[i], wrench[i, 2])
            for j in range(len(wheel_body)):
                i = wheel_body[j]
                theta = state[i, 2] + state[i, 5] * step
                c, s = math.cos(theta), math.sin(theta)
                w_x, w_y = properties[i, _W_X], properties[i, _W_Y]
                x = state[i, 0] + state[i, 3] * step + c * w_x - s * w_y
                y = state[i, 1] + state[i, 4] * step + s * w_x + c * w_y
                _call1(fn[_SET_ANGLE], wheels[0, j], theta + properties[i, _W_THETA])
                _call2(fn[_SET_POSITION], wheels[0, j], x, y)
            _call1(fn[_STEP], space, step)
            for i in range(k):
                state[i, 0], state[i, 1] = _get2(fn[_GET_POSITION], bodies[i])
                state[i, 2] = _get1(fn[_GET_ANGLE], bodies[i])
                state[i, 3], state[i, 4] = _get2(fn[_GET_VELOCITY], bodies[i])
                state[i, 5] = _get1(fn[_GET_SPIN], bodies[i])
                speed = abs(state[i, 3]) + abs(state[i, 4]) + abs(state[i, 5])
                if not speed < DIVERGED:  # also true of NaN
                    return _LOST
                if watch and touched == _FREE:
                    near = _near_contact(
                        state[i, 0], state[i, 1], i, radii, obstacles, can_touch, state
                    )
                    touched = _TOUCHED if near else _FREE
        for i in range(k):
            for d in range(6):
                out[h, i, d] = state[i, d]
    return touched


@numba.njit(nogil=True, cache=True)
def rollout(  # type: ignore[no-untyped-def]
    fn,
    world,
    properties,
    laws,
    law_body,
    law_offset,
    values,
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
            _set_properties(fn, world, properties[p], normal_gravity)
        total[:] = 0.0
        for level in range(len(counts)):
            _forget(fn, world, properties[p], normal_gravity, state)
            state = _transition(
                fn, world, properties[p], laws, law_body, law_offset, values[p],
                start[t], actions[t], time_step / counts[level], counts[level], scratch,
            )  # fmt: skip
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


if len(COLUMN) != 11:  # the column numbers above are spelled out for the compiler
    raise ImportError("physics/compiled.py: the columns of properties.py have changed")
