"""Files: written whole or not at all, and values as JSON has them."""

from __future__ import annotations

import contextlib
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from pbrl_ppl.errors import OutputError

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


def is_empty(folder: Path) -> bool:
    """Return whether a folder holds nothing but temporary folders of this package."""
    return all(path.name.startswith(_MAKING) for path in folder.iterdir())


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
        filled = folder.is_dir() and not is_empty(folder)
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
