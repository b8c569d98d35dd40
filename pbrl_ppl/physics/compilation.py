"""Compilation of this room's loops to machine code, and the cache of it on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.types import unliteral

from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS


def sources_digest(folder: Path) -> str:
    """Return a digest of a folder's Python files and of the columns that they index by number."""
    digest = hashlib.sha256(repr((BODY_PARAMETERS, JOINT_ANCHORS)).encode())
    for path in sorted(folder.glob("*.py")):
        digest.update(f"{path.name}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


SOURCES = sources_digest(Path(__file__).parent)


def disk_cache(function: Callable[..., Any], digest: str) -> FunctionCache:
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


def compiled(function: Callable[..., Any]) -> Any:
    """Return a function as numba compiles it, without the GIL and with a cache on disk.

    A division by zero is infinite: a test for it would keep loops from being vectorised.
    Where no folder can be written to, each process compiles it again.
    """
    dispatcher = numba.njit(nogil=True, error_model="numpy")(function)
    template = dispatcher.get_call_template
    # not again for each constant that is passed
    dispatcher.get_call_template = lambda args, kws: template(tuple(map(unliteral, args)), kws)
    with suppress(RuntimeError):
        dispatcher._cache = disk_cache(function, SOURCES)
    return dispatcher


@compiled
def copy(source, target):  # type: ignore[no-untyped-def]
    """Copy an array with two axes to another.

    An assignment of arrays would add seconds to the compilation, for the message of one that fails.
    """
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]
