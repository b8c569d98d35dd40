"""The cache of machine code on disk, and the private pymunk symbols that compiled code calls."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numba
import pymunk
import pytest
from pymunk import _chipmunk_cffi

from pbrl_ppl.physics import calls, compile_for_search, compiled, flow, lockstep, physics
from pbrl_ppl.physics.calls import SOURCES, disk_cache, sources_digest
from pbrl_ppl.physics.calls import compiled as decorator
from pbrl_ppl.scene import Body, Joint, Scene, Shape

#: Functions by the kinds of their arguments after the object, and of what they return.
SIGNATURES = {
    ("double",): (
        "cpSpaceStep cpBodySetMass cpBodySetMoment cpBodySetAngle cpBodySetAngularVelocity"
        " cpBodySetTorque cpShapeSetElasticity cpShapeSetFriction cpConstraintSetMaxForce"
        " cpCircleShapeSetRadius cpPinJointSetDist cpDampedRotarySpringSetDamping"
        " cpDampedSpringSetDamping"
    ),
    ("struct cpVect",): (
        "cpBodySetCenterOfGravity cpBodySetPosition cpBodySetVelocity cpBodySetForce"
        " cpCircleShapeSetOffset cpPivotJointSetAnchorA cpPivotJointSetAnchorB"
        " cpPinJointSetAnchorA cpPinJointSetAnchorB cpGrooveJointSetAnchorB"
        " cpGrooveJointSetGrooveA cpGrooveJointSetGrooveB cpDampedSpringSetAnchorA"
        " cpDampedSpringSetAnchorB"
    ),
    ("int",): "cpSpaceSetIterations",
    ("struct cpShape *",): "cpSpaceAddShape cpSpaceRemoveShape",
    (): "cpBodyGetPosition cpBodyGetAngle cpBodyGetVelocity cpBodyGetAngularVelocity",
}
RETURNED = {
    "cpBodyGetPosition": "struct cpVect",
    "cpBodyGetVelocity": "struct cpVect",
    "cpBodyGetAngle": "double",
    "cpBodyGetAngularVelocity": "double",
    "cpSpaceAddShape": "struct cpShape *",
}


def test_pymunk_has_the_functions_that_compiled_code_calls() -> None:
    """A vector must be two doubles: it is passed as such."""
    ffi, lib = _chipmunk_cffi.ffi, _chipmunk_cffi.lib
    assert [(name, field.type.cname) for name, field in ffi.typeof("cpVect").fields] == [
        ("x", "double"),
        ("y", "double"),
    ]
    known = {name: kinds for kinds, names in SIGNATURES.items() for name in names.split()}
    assert set(known) == {*calls.Functions._fields, *calls.SETTERS}
    for name, kinds in known.items():
        kind = ffi.typeof(getattr(lib, name))
        first, *others = (argument.cname for argument in kind.args)
        assert first.startswith("struct cp") and first.endswith("*"), name
        assert tuple(others) == kinds, name
        assert kind.result.cname == RETURNED.get(name, "void"), name


def test_pymunk_objects_hold_pointers_to_their_structs() -> None:
    space, body = pymunk.Space(), pymunk.Body(1.0, 1.0)
    joint = pymunk.PinJoint(body, space.static_body)
    for pointer, struct in (
        (space._space, "cpSpace"),
        (body._body, "cpBody"),
        (pymunk.Circle(body, 1.0)._shape, "cpShape"),
        (joint._constraint, "cpConstraint"),
    ):
        kind = _chipmunk_cffi.ffi.typeof(pointer)
        assert kind.cname in (f"struct {struct} *", f"{struct} *")


def test_the_digest_follows_contents_and_names(tmp_path) -> None:
    source = tmp_path / "doubling.py"
    source.write_text("STEP = 1\n")
    first = sources_digest(tmp_path)
    source.touch()
    assert sources_digest(tmp_path) == first
    source.write_text("STEP = 2\n")
    assert sources_digest(tmp_path) != first
    source.write_text("STEP = 1\n")
    assert sources_digest(tmp_path) == first
    source.rename(tmp_path / "other.py")
    assert sources_digest(tmp_path) != first


@pytest.fixture
def module(tmp_path) -> ModuleType:
    """A module in a file, with a function to compile."""
    path = tmp_path / "doubling.py"
    path.write_text("def double(x):\n    return 2.0 * x\n")
    spec = importlib.util.spec_from_file_location("doubling", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_another_digest_recompiles(module) -> None:
    def hits(digest: str) -> int:
        dispatcher = numba.njit(module.double)
        dispatcher._cache = disk_cache(module.double, digest)
        assert dispatcher(1.5) == 3.0
        return sum(dispatcher.stats.cache_hits.values())

    assert [hits(digest) for digest in ("a", "a", "b", "b", "a")] == [0, 1, 0, 1, 0]


def test_an_older_cache_that_cannot_be_read_is_deleted(module) -> None:
    """It may mention modules that are gone."""
    older = disk_cache(module.double, "a")
    index = Path(older._cache_file._index_path)
    index.parent.mkdir(exist_ok=True)
    index.write_bytes(b"not an index")
    dispatcher = numba.njit(module.double)
    dispatcher._cache = disk_cache(module.double, "b")
    assert dispatcher(1.5) == 3.0
    assert not index.exists()


@pytest.mark.parametrize("rollout", [compiled.rollout_engine, lockstep.rollout_free])
def test_rollouts_are_cached_by_the_digest(rollout) -> None:
    assert rollout._cache._cache_file._source_stamp == SOURCES


def test_without_a_folder_to_write_to_there_is_no_cache() -> None:
    """Numba finds no place for the cache of a function that is in no file."""
    names: dict = {}
    exec("def double(x):\n    return 2.0 * x\n", names)
    function = decorator(names["double"])
    assert function._cache.cache_path is None
    assert function(1.5) == 3.0


def test_python_cannot_call_a_function_of_compiled_ones() -> None:
    """It has no wrapper; without the refusal the interpreter would crash."""
    quarter = calls.inner(lambda x: 0.25 * x)
    half = numba.njit(lambda x: 2.0 * quarter(x))
    assert half(3.0) == 1.5
    with pytest.raises(TypeError, match="compiled functions alone"):
        quarter(3.0)


def test_another_process_compiles_what_is_asked_for_later(module, tmp_path, monkeypatch) -> None:
    """It is waited for, and its code is taken from the cache; what is there is not compiled."""
    monkeypatch.syspath_prepend(tmp_path)  # the cache names the module
    digest = "beside"
    code = (
        f"import sys, numba; sys.path.insert(0, {str(tmp_path)!r}); import doubling\n"
        "from pbrl_ppl.physics.calls import disk_cache\n"
        "one = numba.njit(doubling.double)\n"
        f"one._cache = disk_cache(doubling.double, {digest!r}); one(1.5)"
    )
    dispatcher = numba.njit(module.double)
    dispatcher._cache = disk_cache(module.double, digest)
    calls.compile_beside(dispatcher, code)
    assert calls.compiled_beside(dispatcher)(1.5) == 3.0
    assert sum(dispatcher.stats.cache_hits.values()) == 1
    again = numba.njit(module.double)
    again._cache = disk_cache(module.double, digest)
    calls.compile_beside(again, "raise SystemExit(1)")
    assert again not in calls._BESIDE


def test_a_search_compiles_the_loop_of_joined_bodies_beside(monkeypatch) -> None:
    """A scene with a joint needs it at once: another process would only load the package."""
    asked: list = []
    monkeypatch.setattr(physics, "compile_beside", lambda loop, code: asked.append(loop))
    body = Body("puck", Shape.circle(0.1))
    hinge = Joint("hinge", ("world", "puck"), (0.0, 0.0), (0.0, 0.0))
    compile_for_search(Scene(time_step=0.1, bodies=(body,), joints=(hinge,)))
    assert not asked
    compile_for_search(Scene(time_step=0.1, bodies=(body,)))
    assert asked == [flow.rollout_tree]
