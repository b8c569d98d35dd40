"""A manifest of many logs: one row a log, of a robot and perhaps its kind."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from pbrl_ppl.errors import ManifestError
from pbrl_ppl.scene import nearest

_NEEDED, _OPTIONAL = ("name", "scene", "train"), ("test", "kind")
#: A name is a folder's too, on every system, and none of the files beside it.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")


@dataclass(frozen=True)
class Log:
    """One recording of one robot.

    Parameters
    ----------
    name : str
        Of its folder.
    scene, train : Path
        The declared scene, and what is fitted.
    test : Path, optional
        What errors are measured on; a quarter of the trajectories of ``train`` without it.
    kind : str
        Robots of one kind share hyper-parameters; empty for none.
    """

    name: str
    scene: Path
    train: Path
    test: Path | None = None
    kind: str = ""


def read_manifest(path: str | Path) -> tuple[Log, ...]:
    """Read the rows of a manifest: a CSV file with the columns name, scene, train, test, kind.

    Parameters
    ----------
    path : str or Path
        ``test`` and ``kind`` may be empty or left out. Paths are relative to the manifest's folder.

    Returns
    -------
    tuple of Log
        In the file's order, with absolute paths. Whether these files are there is not looked at.

    Raises
    ------
    ManifestError
        If the file cannot be read, a column is unknown or missing, a cell is empty, or a name is
        there twice or no folder's name.
    """
    path = Path(path)
    where = f"manifest {path}"
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ManifestError(f"{where}: there is no such file; check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{where}: cannot be read: {error}") from None
    try:
        table = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines())]
    except csv.Error as error:
        raise ManifestError(f"{where}: no CSV table: {error}") from None
    if not any(map(any, table)):
        raise ManifestError(f"{where}: it is empty; expected {', '.join(_NEEDED)} and rows")
    head, known = table[0], (*_NEEDED, *_OPTIONAL)
    for name in head:
        if name not in known:
            raise ManifestError(
                f'{where}: unknown column "{name}"{nearest(name, known)} Expected'
                f" {', '.join(known)} (the last two are optional)"
            )
    if lacking := [name for name in _NEEDED if name not in head]:
        raise ManifestError(f"{where}: missing column(s) {', '.join(lacking)}")
    if len(set(head)) < len(head):
        raise ManifestError(f"{where}: a column is there twice; drop one")
    logs = [
        _log(head, row, f"{where}, row {number}", path.parent.absolute())
        for number, row in enumerate(table[1:], start=2)
        if any(row)
    ]
    if not logs:
        raise ManifestError(f"{where}: it has no rows; expected one a log")
    seen: set[str] = set()
    for log in logs:
        # some file systems do not tell capitals
        if log.name.lower() in seen:
            raise ManifestError(f'{where}: the name "{log.name}" is there twice; expected one each')
        seen.add(log.name.lower())
    return tuple(logs)


def _log(head: list[str], cells: list[str], where: str, folder: Path) -> Log:
    """Check one row; its paths are relative to the folder."""
    if len(cells) != len(head):
        raise ManifestError(f"{where}: {len(cells)} cells, expected {len(head)} as in the header")
    row = dict(zip(head, cells, strict=True))
    for name in _NEEDED:
        if not row[name]:
            raise ManifestError(f"{where}: {name} is empty; fill it in")
    for name in ("name", "kind"):
        if row.get(name) and not _NAME.fullmatch(row[name]):
            raise ManifestError(
                f'{where}: {name} is "{row[name]}"; expected letters, digits, "_" and "-", for it'
                " names a file"
            )
    test = folder / row["test"] if row.get("test") else None
    return Log(row["name"], folder / row["scene"], folder / row["train"], test, row.get("kind", ""))
