"""Outputs looked at before the long work whose result would be lost."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

from pbrl_ppl.errors import OutputError


def check_file(path: Path, endings: tuple[str, ...], overwrite: bool) -> None:
    """Refuse a file that has the wrong ending, exists already, or cannot be written.

    Raises
    ------
    OutputError
        Says which.
    """
    if path.suffix not in endings:
        raise OutputError(f"{path}: expected a name that ends in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path}: it is a folder; choose another name")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: it exists; choose another file, or pass --overwrite")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it, or choose another")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.stem}."):
            pass
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); choose another file"
        ) from None


def check_can_make(folder: Path) -> None:
    """Refuse a folder that cannot be made or written: it is tried, and nothing stays.

    Raises
    ------
    OutputError
        If it cannot.
    """
    made: list[Path] = []
    try:
        for each in reversed((folder, *folder.parents)):
            if not each.exists():
                each.mkdir()
                made.append(each)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (NotADirectoryError, FileExistsError):
        pass  # a file is in the way, and `criticism.check_folder` says which
    except OSError as error:
        raise OutputError(
            f"output folder {folder}: it cannot be made or written ({error.strerror}); choose"
            " another path"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            for each in reversed(made):
                each.rmdir()
