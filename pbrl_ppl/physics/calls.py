"""Machine code: compilation with a cache on disk, and calls of C functions and laws by address.

A vector argument of the C functions is a struct of two doubles passed by value. Under the System V
and AArch64 calling conventions that is the same as two doubles, which is what is passed here; on
other platforms :data:`AVAILABLE` is false, and there is no engine.
"""

from __future__ import annotations

import atexit
import hashlib
import platform
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pymunk
from llvmlite import ir
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.types import unliteral
from numba.extending import intrinsic
from numpy.typing import NDArray
from pymunk import _chipmunk_cffi

from pbrl_ppl.effects import Law
from pbrl_ppl.errors import EffectError
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.physics.world import BODY_CONSTRAINTS, JOINT_KINDS, RING, OnBody, Placed, World


def sources_digest(folder: Path) -> str:
    """Return a digest of a folder's Python files and of the columns that they index by number."""
    digest = hashlib.sha256(repr((BODY_PARAMETERS, JOINT_ANCHORS)).encode())
    for path in sorted(folder.glob("*.py")):
        digest.update(f"{path.name}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


SOURCES = sources_digest(Path(__file__).parent)


def disk_cache(function: Callable[..., object], digest: str) -> FunctionCache:
    """Return numba's cache of a function, in files that are named by a digest of the sources.

    Numba itself compares the time and size of the file that defines the function, and misses
    changes of the functions and constants that it uses from other files. Files of other digests
    are deleted: numba would fail to read one that mentions a module which is gone.

    Raises
    ------
    RuntimeError
        If neither the package's folder nor the user's cache folder can be written to.
    """
    cache = FunctionCache(function)
    base = cache._impl.filename_base
    named, folder = f"{base}.{digest[:16]}", Path(cache.cache_path)
    if not (folder / f"{named}.nbi").exists():  # the first use of these sources
        for path in folder.glob(f"{base}.*"):
            if not path.name.startswith(named):
                with suppress(OSError):
                    path.unlink()
    cache._cache_file = IndexDataCacheFile(cache.cache_path, named, digest)
    return cache


def _dispatcher(function: Callable[..., object], **options: object) -> Any:
    """Return a function as numba compiles it, without the GIL.

    A division by zero is infinite: a test for it would keep loops from being vectorised.
    """
    dispatcher = numba.njit(nogil=True, error_model="numpy", **options)(function)
    template = dispatcher.get_call_template
    # not again for each constant that is passed
    dispatcher.get_call_template = lambda args, kws: template(tuple(map(unliteral, args)), kws)
    return dispatcher


def compiled(function: Callable[..., object]) -> Any:
    """Return a function as numba compiles it, with a cache on disk.

    Where no folder can be written to, each process compiles it again.
    """
    dispatcher = _dispatcher(function)
    with suppress(RuntimeError):
        dispatcher._cache = disk_cache(function, SOURCES)
    return dispatcher


#: Processes that compile functions, by the function.
_BESIDE: dict[Any, subprocess.Popen[bytes]] = {}


def compile_beside(function: Any, code: str) -> None:
    """Compile a function into its cache in another process, which runs this code, if it is not."""
    index = getattr(getattr(function._cache, "_cache_file", None), "_index_path", None)
    if function not in _BESIDE and index is not None and not Path(index).exists():
        _BESIDE[function] = process = subprocess.Popen(
            [sys.executable, "-c", code], start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        atexit.register(setattr, process, "returncode", 0)  # it may go on without a warning


def compiled_beside(function: Any) -> Any:
    """Return a function, once no other process compiles it."""
    if function in _BESIDE:
        with suppress(subprocess.TimeoutExpired):
            _BESIDE[function].wait(120.0)
    return function


def inner(function: Callable[..., object]) -> Any:
    """Return a function that compiled ones alone can call: it compiles a fifth faster.

    What would let Python call it, which takes its arrays and tuples apart, is left out.
    """
    dispatcher = _dispatcher(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)

    def refuse(*given: object) -> None:
        raise TypeError(f"{function.__name__} can be called by compiled functions alone")

    def keep(result: Any) -> None:
        dispatcher.overloads[tuple(result.signature.args)] = result

    # numba would call a wrapper that is not there
    dispatcher._compile_for_args, dispatcher.add_overload = refuse, keep
    return dispatcher


def inlined(function: Callable[..., object]) -> Any:
    """Return a function that compiled ones take in as if its lines were theirs.

    It is for what takes many arrays, where a call would cost as much as what it does.
    """
    return numba.njit(inline="always")(function)


@inner
def copy(source, target):  # type: ignore[no-untyped-def]
    """Copy an array with two axes to another.

    An assignment of arrays would add seconds to the compilation, for the message of one that fails.
    """
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@inner
def rotated(c, s, x, y):  # type: ignore[no-untyped-def]
    """Return a vector turned by the angle with cosine ``c`` and sine ``s``."""
    return c * x - s * y, s * x + c * y


#: Addresses of the engine's C functions, by their names. Those that set properties of constraints
#: are in the settings of `Pointers`.
Functions = namedtuple(
    "Functions",
    """
    cpSpaceStep cpSpaceSetIterations cpSpaceAddShape cpSpaceRemoveShape
    cpBodySetMass cpBodySetMoment cpBodySetCenterOfGravity cpBodySetPosition cpBodySetAngle
    cpBodySetVelocity cpBodySetAngularVelocity cpBodySetForce cpBodySetTorque
    cpBodyGetPosition cpBodyGetAngle cpBodyGetVelocity cpBodyGetAngularVelocity
    cpShapeSetElasticity cpShapeSetFriction cpCircleShapeSetOffset cpCircleShapeSetRadius
    cpConstraintSetMaxForce cpPinJointSetAnchorB
    """,
)
_SETTINGS = chain(
    *(kind.settings for kind in JOINT_KINDS.values()),
    *(kind.settings + kind.joint_settings for kind in chain(*BODY_CONSTRAINTS.values())),
)
#: C functions that set properties of constraints.
SETTERS = sorted({setting.function for setting in _SETTINGS})
_DOUBLES = types.CPointer(types.float64)


def _addresses(names: Sequence[str]) -> dict[str, int]:
    """Return the addresses of C functions; none where they cannot be called this way."""
    registers = platform.machine().lower() in ("x86_64", "amd64", "aarch64", "arm64")
    if sys.platform == "win32" or not registers:
        return {}
    ffi, lib = _chipmunk_cffi.ffi, _chipmunk_cffi.lib
    try:
        return {name: int(ffi.cast("intptr_t", ffi.addressof(lib, name))) for name in names}
    except (AttributeError, ffi.error):
        return {}


_FOUND = _addresses([*Functions._fields, *SETTERS])
AVAILABLE = bool(_FOUND)
#: What to say where they are not.
MISSING = (
    f"there is no engine on {platform.system()} {platform.machine()} with pymunk {pymunk.version}:"
    " Chipmunk's C functions cannot be called from compiled code; use Linux or macOS on x86-64 or"
    " ARM64 (on Windows, in WSL), and a pymunk that pyproject.toml allows"
)
FUNCTIONS = Functions(*map(_FOUND.get, Functions._fields)) if AVAILABLE else None


def _calling(result: Any, *kinds: Any) -> tuple[Any, Callable[..., object]]:
    """Return an intrinsic's signature and code: a call by address of a C function of such kinds."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        function, *values = arguments
        nothing = result is types.void
        returns = ir.VoidType() if nothing else context.get_value_type(result)
        kind = ir.FunctionType(returns, [value.type for value in values]).as_pointer()
        returned = builder.call(builder.inttoptr(function, kind), values)
        return context.get_dummy_value() if nothing else returned

    return result(types.int64, *kinds), codegen


@intrinsic
def call1(typing, function, pointer, a):  # type: ignore[no-untyped-def]
    """Call a C function of a pointer and a double that returns nothing."""
    return _calling(types.void, types.int64, types.float64)


@intrinsic
def call2(typing, function, pointer, a, b):  # type: ignore[no-untyped-def]
    """Call a C function of a pointer and a vector that returns nothing."""
    return _calling(types.void, types.int64, types.float64, types.float64)


@intrinsic
def call_int(typing, function, pointer, value):  # type: ignore[no-untyped-def]
    """Call a C function of a pointer and an int that returns nothing."""
    return _calling(types.void, types.int64, types.int32)


@intrinsic
def call_pointer(typing, function, pointer, other):  # type: ignore[no-untyped-def]
    """Call a C function of two pointers, whatever it returns."""
    return _calling(types.void, types.int64, types.int64)


@intrinsic
def get1(typing, function, pointer):  # type: ignore[no-untyped-def]
    """Call a C function of a pointer that returns a double."""
    return _calling(types.float64, types.int64)


@intrinsic
def get2(typing, function, pointer):  # type: ignore[no-untyped-def]
    """Call a C function of a pointer that returns a vector."""
    return _calling(types.UniTuple(types.float64, 2), types.int64)


@intrinsic
def call_law(typing, function, a, b, c, d):  # type: ignore[no-untyped-def]
    """Call an effect's law: four pointers to doubles."""
    return _calling(types.void, *[_DOUBLES] * 4)


@intrinsic
def numbers_at(typing, address):  # type: ignore[no-untyped-def]
    """Return a pointer to the real numbers at an address, whose elements are read and set by index.

    To pass an array costs more than most laws: each call counts references to it.
    """

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.inttoptr(arguments[0], context.get_value_type(_DOUBLES))

    return _DOUBLES(types.int64), codegen


@intrinsic
def from_place(typing, pointer, place):  # type: ignore[no-untyped-def]
    """Return a pointer to the numbers from a place on."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.gep(arguments[0], [arguments[1]])

    return _DOUBLES(_DOUBLES, types.int64), codegen


@inner
def start_of(array):  # type: ignore[no-untyped-def]
    """Return a pointer to the first number of an array, which must be kept."""
    return numbers_at(array.ctypes.data)


def record_reader(kind: np.dtype[np.void]) -> Any:
    """Return a compiled function of an array's address and a place that returns the record there.

    A record is its address: the function that it is passed to gets no array.
    """

    @intrinsic
    def record_at(typing, address, place):  # type: ignore[no-untyped-def]
        record = numba.from_dtype(kind)

        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            start, at = arguments
            size = ir.Constant(start.type, kind.itemsize)
            place = builder.add(start, builder.mul(at, size))
            return builder.inttoptr(place, context.get_value_type(record))

        return record(types.int64, types.int64), codegen

    return record_at


#: Address of each compiled law, and the C function itself, which must be kept.
_LAWS: dict[Law, tuple[int, object]] = {}


def law_address(law: Law) -> int:
    """Return the address of an effect's law, compiled to a C function once."""
    if law not in _LAWS:
        try:
            compiled_law = numba.cfunc(types.void(_DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES))(law)
        except numba.core.errors.NumbaError as error:
            raise EffectError(
                f"the law {law.__name__} cannot be compiled: use plain arithmetic and math alone"
                f" ({' '.join(str(error).split())[:200]})"
            ) from None
        _LAWS[law] = compiled_law.address, compiled_law
    return _LAWS[law][0]


#: A property of a constraint: the C function that sets it, and where in a row its number or vector
#: is, which the body's weight or a scale multiplies.
SETTING = np.dtype(
    [(name, np.int64) for name in ("function", "constraint", "row", "column", "column_y")]
    + [(name, np.int64) for name in ("vector", "weighted")]
    + [(name, np.float64) for name in ("scale_x", "scale_y")],
    align=True,
)


class Still(NamedTuple):
    """What every compiled rollout needs of a world; discs are moved for each proposal."""

    gravity: NDArray[np.float64]  # (2,), m/s^2
    normal_gravity: float  # m/s^2
    length: float  # size of the smallest moving body (m)
    fastest: float  # speed of divergence (m/s)
    ring: NDArray[np.float64]  # (point, 2)
    radii: NDArray[np.float64]  # (body,), m
    can_touch: NDArray[np.bool_]  # (body, body)
    obstacles: NDArray[np.float64]  # (obstacle, 5), the discs last
    watched: bool  # whether there is anything to touch


def still(world: World, near: float = 1.0) -> Still:
    """Return what every compiled rollout needs of a world, with ``near`` times its radii."""
    return Still(
        np.array(world.space.gravity, dtype=float), world.scene.normal_gravity, world.size,
        world.fastest, np.array(RING), near * world.radii, world.can_touch,
        world.obstacles.copy(), len(world.obstacles) > 0 or np.tril(world.can_touch, -1).any(),
    )  # fmt: skip


#: Addresses of the C objects of a world, and what else its engine's rollout needs of it. Settings
#: are of dtype `SETTING`; wheels are (2, wheel): the rod along x, the rod along y; pivots (hinge,
#: 3): body, joint, column of its anchor on the body; patches (2, patch, point of the ring): what
#: holds it, the rod.
Pointers = namedtuple(
    "Pointers",
    """
    still space iterations chained padding far bodies kinematic shapes shape_body
    wheels wheel_body unlimited limited body_settings strengths joint_settings pivots
    discs patches patch_body
    """,
)


def pointers(world: World) -> Pointers:
    """Return the addresses of a world's C objects; the world must be kept alive."""
    ffi = _chipmunk_cffi.ffi

    def at(*objects: object) -> NDArray[np.int64]:
        places = [int(ffi.cast("intptr_t", c_object)) for c_object in objects]
        return np.array(places, dtype=np.int64)

    def whole(*numbers: int) -> NDArray[np.int64]:
        return np.array(numbers, dtype=np.int64)

    def table(placed: Iterable[Placed]) -> NDArray[np.void]:
        rows = [
            (
                _FOUND[setting.function], *at(constraint._constraint), row, setting.columns[0],
                setting.columns[-1], len(setting.columns) == 2, setting.weighted, *scale,
            )
            for constraint, setting, row, scale in placed
        ]  # fmt: skip
        return np.array(rows, dtype=SETTING)

    def constraints(*those: Iterable[pymunk.Constraint]) -> NDArray[np.int64]:
        return at(*(constraint._constraint for constraint in chain(*those)))

    def both(placed: Iterable[OnBody]) -> NDArray[np.int64]:
        return constraints(*(p.first for p in placed), *(p.second for p in placed))

    return Pointers(
        still=still(world),
        space=int(ffi.cast("intptr_t", world.space._space)),
        iterations=world.iterations,
        chained=world.chained,
        padding=world.padding,
        far=world.far,
        bodies=at(*(body._body for body in world.bodies)),
        kinematic=world.kinematic,
        shapes=at(*(shape._shape for _, shape in world.shapes)),
        shape_body=whole(*(i for i, _ in world.shapes)),
        wheels=both(world.wheels).reshape(2, -1),
        wheel_body=whole(*(wheel.body for wheel in world.wheels)),
        unlimited=constraints(world.unlimited),
        limited=constraints(world.limited),
        body_settings=table(p for p in world.body_settings if p.setting.attribute != "max_force"),
        strengths=table(p for p in world.body_settings if p.setting.attribute == "max_force"),
        joint_settings=table(world.joint_settings),
        pivots=whole(*chain(*world.pivots)).reshape(-1, 3),
        discs=at(*(disc._shape for disc in world.discs)),
        patches=both(world.patches).reshape(2, -1, len(RING)),
        patch_body=whole(*(patch.body for patch in world.patches)),
    )
