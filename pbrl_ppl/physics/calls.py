"""Calls of the engine's C functions, and of effects' laws, by address from compiled code.

A vector argument of the C functions is a struct of two doubles passed by value. Under the System V
and AArch64 calling conventions that is the same as two doubles, which is what is passed here; on
other platforms :data:`AVAILABLE` is false and the plain path serves.
"""

from __future__ import annotations

import platform
import sys
from collections import namedtuple
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from pymunk import _chipmunk_cffi

from pbrl_ppl.effects import Law
from pbrl_ppl.errors import EffectError

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
        "cpBodySetCenterOfGravity",
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
        "cpCircleShapeSetOffset",
        "cpCircleShapeSetRadius",
        "cpPivotJointSetAnchorA",
        "cpPivotJointSetAnchorB",
        "cpPinJointSetAnchorA",
        "cpPinJointSetAnchorB",
        "cpPinJointSetDist",
        "cpDampedRotarySpringSetDamping",
    ],
)


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
        def one_double(typing: Any, function: Any, pointer: Any, a: Any) -> Any:
            return signature, codegen

        return one_double

    @intrinsic
    def two_doubles(typing: Any, function: Any, pointer: Any, a: Any, b: Any) -> Any:
        return signature, codegen

    return two_doubles


call1 = _void_call(1)
call2 = _void_call(2)


@intrinsic
def call_int(typing: Any, function: Any, pointer: Any, value: Any) -> Any:
    """Call a C function of a pointer and an int that returns nothing."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64), ir.IntType(32)]).as_pointer()
        value = builder.trunc(args[2], ir.IntType(32))
        builder.call(builder.inttoptr(args[0], kind), [args[1], value])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def call_pointer(typing: Any, function: Any, pointer: Any, other: Any) -> Any:
    """Call a C function of two pointers; what it returns, if anything, is left."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 2).as_pointer()
        builder.call(builder.inttoptr(args[0], kind), args[1:])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def get1(typing: Any, function: Any, pointer: Any) -> Any:
    """Call a C function of a pointer that returns a double."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [ir.IntType(64)]).as_pointer()
        return builder.call(builder.inttoptr(args[0], kind), args[1:])

    return types.float64(types.int64, types.int64), codegen


@intrinsic
def get2(typing: Any, function: Any, pointer: Any) -> Any:
    """Call a C function of a pointer that returns a vector."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.LiteralStructType([ir.DoubleType(), ir.DoubleType()])
        kind = ir.FunctionType(vector, [ir.IntType(64)]).as_pointer()
        value = builder.call(builder.inttoptr(args[0], kind), args[1:])
        parts = [builder.extract_value(value, 0), builder.extract_value(value, 1)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(types.float64, 2)(types.int64, types.int64), codegen


@intrinsic
def call_law(typing: Any, function: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Call an effect's force law: four pointers to doubles."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 4).as_pointer()
        builder.call(builder.inttoptr(args[0], kind), args[1:])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), codegen


_DOUBLES = types.CPointer(types.float64)
_LAWS: dict[Law, Any] = {}


def law_address(law: Law) -> int:
    """Compile an effect's law to a C function, once, and give its address."""
    if law not in _LAWS:
        try:
            _LAWS[law] = numba.cfunc(types.void(_DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES))(law)
        except numba.core.errors.NumbaError as error:
            raise EffectError(
                f"the law {law.__name__} cannot be compiled: use plain arithmetic and math alone"
                f" ({' '.join(str(error).split())[:200]})"
            ) from None
    return int(_LAWS[law].address)
