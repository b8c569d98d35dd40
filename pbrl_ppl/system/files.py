"""Files: written whole or not at all, and values as JSON has them."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO

from pbrl_ppl.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def check_regular(path: Path) -> None:
    """Raise an OSError where there is a folder, or a pipe or device, which may have no end."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device; expected a file")


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Return the text of a regular file; raises an OSError or a UnicodeDecodeError."""
    check_regular(path)
    return path.read_text(encoding=encoding)


def reason(error: Exception) -> str:
    """Return why a file could not be read, without the number of the system's error."""
    return getattr(error, "strerror", None) or str(error)


def parse_toml(text: str) -> dict[str, Any]:
    """Return a TOML document; raises a ValueError that says why it is none."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None
    except ValueError:  # of Python's integers
        raise ValueError("a number has thousands of digits") from None


#: What a sealed file ends with, before a hash of all bytes before it: HDF5 ignores it.
_SEAL = b"\npbrl_ppl sha256 "


def seal(path: Path) -> None:
    """Append the hash of a file's contents to it."""
    digest = _digest(path, path.stat().st_size)
    with path.open("ab") as file:
        file.write(_SEAL + digest)


def is_as_sealed(path: Path) -> bool | None:
    """Return whether a file is as it was sealed; None if it has no seal."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END) - len(_SEAL) - 64
        file.seek(max(size, 0))
        end = file.read()
    if not end.startswith(_SEAL):
        return None
    return end == _SEAL + _digest(path, size)


def _digest(path: Path, size: int) -> bytes:
    """Return the SHA-256 of a file's first bytes, in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while size > 0 and (part := file.read(min(size, 2**20))):
            digest.update(part)
            size -= len(part)
    return digest.hexdigest().encode()


def check_survives(path: Path, code: str, *, start: float = 60.0, rate: float = 1e6) -> None:
    """Read a file in a process of its own first: some damaged ones end it, or never end.

    Parameters
    ----------
    path : Path
        The file, which the code gets as its argument.
    code : str
        Python that reads it. Errors are not told: who reads it after this gets them.
    start, rate : float
        Seconds that it may take, and bytes a second beside them.

    Raises
    ------
    ValueError
        If the process did not survive, or took longer.
    """
    limit = start + path.stat().st_size / rate
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-c", code, str(path)], capture_output=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"reading it took over {limit:.0f} s: it is damaged") from None
    if ended.returncode not in (0, 1):
        raise ValueError("it is damaged")


#: Reads what is in an HDF5 file.
_READ_HDF5 = """
import h5py, sys

def read(name, item):
    if isinstance(item, h5py.Dataset) and item.nbytes < 2**30:
        item[()]

h5py.File(sys.argv[1]).visititems(read)
"""
#: Bytes of arrays that a file may hold whatever its size, and for each of its bytes.
_MOST, _PACKED = 2**30, 200


def check_hdf5(path: Path) -> None:
    """Raise an error where a file is not HDF5, or declares arrays far larger than itself.

    xarray would take the memory of such arrays, and leaves what is no HDF5 to be closed later. Of a
    damaged file that has no seal HDF5 may read for ever.
    """
    import h5py

    if is_as_sealed(path) is None and h5py.is_hdf5(path):
        check_survives(path, _READ_HDF5)

    sizes: list[int] = []

    def note(_: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            sizes.append(math.prod(item.shape or (0,)) * item.dtype.itemsize)

    with h5py.File(path, "r") as file:
        file.visititems(note)
    if sum(sizes) > max(_MOST, _PACKED * path.stat().st_size):
        raise ValueError(f"it declares arrays of {sum(sizes) / 2**30:.3g} GB")


#: How names of temporary folders begin; a process that is killed leaves them behind.
_MAKING = ".pbrl-ppl-"
#: Age (s) of a temporary folder whose process no longer writes to it.
_ABANDONED = 3600.0


@contextlib.contextmanager
def temporary_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder in a folder, and remove those that killed processes left there."""
    for left in folder.glob(f"{_MAKING}*"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > _ABANDONED:
                shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=_MAKING, dir=folder) as made:
        yield Path(made)


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call ``write`` with a path of this name in a temporary folder, then rename it to ``path``.

    Raises
    ------
    OutputError
        If the file cannot be written; nothing is left behind then.
    """
    try:
        with temporary_folder(path.parent) as aside:
            write(aside / path.name)
            (aside / path.name).replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written: {error.strerror or error}; choose an existing, writable"
            " folder"
        ) from error


@contextlib.contextmanager
def only_writer(path: Path) -> Iterator[None]:
    """Keep other processes of this user and machine from this context with the same path.

    A lock of the operating system, which ends with the process; without such locks, nothing.

    Raises
    ------
    OutputError
        If another process is in it.
    """
    lock = _locked(path)
    try:
        yield
    finally:
        if lock is not None:
            Path(lock.name).unlink(missing_ok=True)
            lock.close()


def _locked(path: Path) -> BinaryIO | None:
    """Return a locked file that stands for a path, or None where that is impossible."""
    if fcntl is None:
        return None
    digest = hashlib.sha256(os.fsencode(path.absolute().resolve())).hexdigest()[:32]
    try:
        file = (Path(tempfile.gettempdir()) / f"pbrl-ppl-{os.getuid()}-{digest}.lock").open("ab")
    except OSError:  # no folder for temporary files
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise OutputError(
            f"{path}: another command is writing to it; wait for its end, or choose another output"
        ) from None
    if os.fstat(file.fileno()).st_nlink:
        return file
    file.close()  # of a command that has just ended
    return _locked(path)


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) whole or not at all; raises as :func:`write_atomically`."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def check_folder(folder: Path, overwrite: bool, files: Iterable[str] = ()) -> Path:
    """Check that ``files`` can be written to a folder, and return its nearest existing parent.

    The folder is made and removed again, so that no trace is left.

    Raises
    ------
    OutputError
        If they cannot, or if the folder is not empty and ``overwrite`` is false.
    """
    where, missing = f"output folder {folder}:", list[Path]()
    places = (folder, *folder.parents)
    try:
        # a dangling link counts as there: it cannot be made a folder
        missing += takewhile(lambda place: not (place.exists() or place.is_symlink()), places)
        nearest = places[len(missing)]
        if nearest.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        there = folder.iterdir() if folder.is_dir() else ()
        filled = not all(path.name.startswith(_MAKING) for path in there)
    except OSError as error:
        raise OutputError(
            f"{where} it cannot be made or written ({error.strerror}); choose another path"
        ) from None
    finally:
        for made in missing:
            with contextlib.suppress(OSError):
                made.rmdir()
    if not nearest.is_dir():
        raise OutputError(f"{where} {nearest} is a file, expected a folder; choose another path")
    if filled and not overwrite:
        raise OutputError(
            f"{where} it is not empty; choose another, or allow overwriting (overwrite,"
            " --overwrite)"
        )
    for name in files:
        if (folder / name).is_dir():
            raise OutputError(f"{where} {name} in it is a folder; remove it")
    return nearest


def json_fields(value: Any) -> dict[str, Any]:
    """Return a dataclass's fields by their keys in JSON: ``key`` of their metadata, or names."""
    keys = {one.name: one.metadata.get("key", one.name) for one in fields(value)}
    return {keys.get(name, name): item for name, item in vars(value).items()}


def json_values(value: object) -> Any:
    """Return plain values for JSON: arrays as lists, paths as text, non-finite numbers as null.

    A dataclass becomes an object of its fields.
    """
    if is_dataclass(value):
        value = json_fields(value)
    if isinstance(value, Mapping):
        return {str(key): json_values(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # NumPy's arrays and scalars
        value = value.tolist()
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [json_values(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
