"""One log of many: the manifest that lists it, and its closed loop in a worker."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import shutil
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pbrl_ppl import __version__
from pbrl_ppl.criticism import Loop, close_loop
from pbrl_ppl.criticism.loop import DONE as DONE
from pbrl_ppl.criticism.loop import FILES
from pbrl_ppl.errors import ManifestError, PbrlError
from pbrl_ppl.files import read_text, reason, write_text
from pbrl_ppl.history import read_recording, read_scene
from pbrl_ppl.reporting.reports import render
from pbrl_ppl.scene import nearest

_NEEDED, _OPTIONAL = ("name", "scene", "train"), ("test", "kind")
#: A log's name is the name of its folder, on every system, and of no file beside it.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")


@dataclass(frozen=True)
class Log:
    """One recording of one robot.

    Parameters
    ----------
    name : str
        Name of its folder.
    scene, train : Path
        The declared scene, and the history to fit.
    test : Path, optional
        The held-out history; by default a quarter of the trajectories of ``train``.
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
        In the file's order, with absolute paths, whether or not these files exist.

    Raises
    ------
    ManifestError
        If the file cannot be read, a column is unknown or missing, a cell is empty, or a name is
        there twice or no folder's name.
    """
    path = Path(path)
    where = f"manifest {path}"
    try:
        text = read_text(path, "utf-8-sig")
        table = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines())]
    except FileNotFoundError:
        raise ManifestError(f"{where}: there is no such file; check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{where}: cannot be read: {reason(error)}") from None
    except csv.Error as error:
        raise ManifestError(f"{where}: no CSV table: {error}") from None
    columns = ", ".join(_NEEDED)
    _check(any(map(any, table)), f"{where}: it is empty; expected {columns} and rows")
    head, known = table[0], (*_NEEDED, *_OPTIONAL)
    for name in head:
        hint = f"{nearest(name, known)} Expected {', '.join(known)} (the last two are optional)"
        _check(name in known, f'{where}: unknown column "{name}"{hint}')
    lacking = ", ".join(name for name in _NEEDED if name not in head)
    _check(not lacking, f"{where}: missing column(s) {lacking}")
    _check(len(set(head)) == len(head), f"{where}: a column is there twice; drop one")
    logs = [
        _log(head, row, f"{where}, row {number}", path.parent.absolute())
        for number, row in enumerate(table[1:], start=2)
        if any(row)
    ]
    _check(bool(logs), f"{where}: it has no rows; expected one a log")
    seen: set[str] = set()
    for name in (log.name for log in logs):
        # some file systems ignore case
        twice = f'{where}: the name "{name}" is there twice; expected one each'
        _check(name.lower() not in seen, twice)
        seen.add(name.lower())
    return tuple(logs)


def _check(fine: bool, message: str) -> None:
    """Raise an error with a message unless all is fine."""
    if not fine:
        raise ManifestError(message)


def _log(head: list[str], cells: list[str], where: str, folder: Path) -> Log:
    """Return the log of one row; its paths are relative to the folder."""
    count = f"{len(cells)} cells, expected {len(head)} as in the header"
    _check(len(cells) == len(head), f"{where}: {count}")
    row = dict.fromkeys(_OPTIONAL, "") | dict(zip(head, cells, strict=True))
    for name in _NEEDED:
        _check(bool(row[name]), f"{where}: {name} is empty; fill it in")
    expected = 'expected letters, digits, "_" and "-", for it names a file'
    for name in ("name", "kind"):
        fine = not row[name] or bool(_NAME.fullmatch(row[name]))
        _check(fine, f'{where}: {name} is "{row[name]}"; {expected}')
    test = folder / row["test"] if row["test"] else None
    return Log(row["name"], folder / row["scene"], folder / row["train"], test, row["kind"])


#: The file that a failed log leaves, in place of the one that marks a finished log.
FAILED = "error.json"
#: Warnings and figures belong to a process, not a thread: a process works on one log at a time.
_ONE = threading.Lock()
_MAKING = ".making-"
#: Values by name: the summary of one log, of values that JSON has, or arguments.
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Settings:
    """Settings of all logs: arguments of what reads a scene and a recording, and closes the loop.

    Parameters
    ----------
    scene, recording : mapping of str to object
        Of `history.read_scene` and of `history.read_recording`.
    loop : mapping of str to object
        Of :func:`pbrl_ppl.close_loop`; the whole catalogue without one.
    """

    scene: Row
    recording: Row
    loop: Row

    def to_dict(self) -> dict[str, object]:
        """Return the settings as JSON values."""
        own = self.loop.get("catalogue")
        effects = own and [[effect.name, repr(effect.parameters)] for effect in own]
        return {**self.scene, **self.recording, **self.loop, "catalogue": effects}


class Saves(Protocol):
    """A result that writes a loop's files into a folder."""

    def save(self, folder: Path) -> None:
        """Write the files."""


#: Closes the loop on one log.
Run = Callable[[Log, Settings], Saves]


@dataclass(frozen=True, eq=False)
class LoopWithPage:
    """A closed loop, saved together with its page."""

    loop: Loop

    def save(self, folder: Path) -> None:
        """Write the loop's files and its report."""
        self.loop.save(folder, page=render(self.loop))


def close_log(log: Log, settings: Settings) -> LoopWithPage:
    """Read a log's files and close the loop."""
    scene = read_scene(log.scene, **settings.scene)
    reading = {"resample": settings.scene["time_step"] is not None, **settings.recording}
    train = read_recording(log.train, scene, **reading)
    test = None if log.test is None else read_recording(log.test, scene, **reading)
    return LoopWithPage(close_loop(scene, train, test, **settings.loop))


def inputs_sha256(log: Log, settings: Settings) -> str:
    """Return the hash of a log's inputs: its files, the settings, the package's version."""
    digest = hashlib.sha256()
    for path in (log.scene, log.train, log.test):
        content = path.read_bytes() if path and path.is_file() else b""
        digest.update(hashlib.sha256(content).digest() if path else b"none")
    contents = [settings.to_dict(), __version__]
    digest.update(json.dumps(contents, sort_keys=True, default=dict).encode())
    return digest.hexdigest()


def settle(log: Log, folder: Path, settings: Settings, inputs: str, run: Run) -> Row:
    """Close the loop on one log unless it is finished; write an error into a file.

    Files are written elsewhere and renamed into the log's folder, ``report.json`` last, so that a
    worker may die at any moment.

    Parameters
    ----------
    log : Log
        The log.
    folder : Path
        Folder of all logs.
    settings : Settings
        Settings of all logs.
    inputs : str
        Hash of the inputs, from :func:`inputs_sha256`.
    run : callable
        Closes the loop, such as :func:`close_log`.

    Returns
    -------
    dict
        Row of the log, see :func:`row_of`.
    """
    with _ONE:
        # a cluster repeats a task whose result was lost with its worker
        if row := row_of(log, folder, inputs):
            return row
        place, begin = folder / log.name, time.monotonic()
        try:
            place.mkdir(parents=True, exist_ok=True)
            for name in (DONE, FAILED):
                (place / name).unlink(missing_ok=True)
            for left in place.glob(f"{_MAKING}*"):  # by a worker that died
                shutil.rmtree(left, ignore_errors=True)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", UserWarning)
                loop = run(log, settings)
            shown = (str(w.message) for w in caught if issubclass(w.category, UserWarning))
            about = {"name": log.name, "kind": log.kind, "inputs_sha256": inputs,
                     "seconds": round(time.monotonic() - begin, 1),
                     "warnings": list(dict.fromkeys(shown))}  # fmt: skip
            _keep(loop, place, about)
        except Exception as error:
            return failed(log, folder, error)
    row = row_of(log, folder, inputs)
    return row or failed(log, folder, OSError(f"{place / DONE}: missing after it was written"))


def _keep(loop: Saves, place: Path, about: Row) -> None:
    """Write a loop's files into a log's folder, ``report.json`` last."""
    with tempfile.TemporaryDirectory(prefix=_MAKING, dir=place) as aside:
        made = Path(aside) / "result"
        loop.save(made)
        contents = json.loads((made / DONE).read_text(encoding="utf-8"))
        text = json.dumps({"log": about} | contents, indent=1, allow_nan=False)
        (made / DONE).write_text(text + "\n", encoding="utf-8")
        for name in sorted(FILES, key=DONE.__eq__):
            (made / name).replace(place / name)


def failed(log: Log, folder: Path, error: BaseException) -> Row:
    """Return the row of a log that failed, and write the message into its folder if possible."""
    message = " ".join(str(error).split()) or type(error).__name__
    if not isinstance(error, PbrlError):
        message = f"{type(error).__name__}: {message}"
    trace = "".join(traceback.format_exception(error))
    text = json.dumps({"name": log.name, "message": message, "traceback": trace}, indent=1)
    try:
        (folder / log.name).mkdir(parents=True, exist_ok=True)
        write_text(folder / log.name / FAILED, text + "\n")
    except OSError:
        message += " (its folder cannot be written to either)"
    return {"name": log.name, "kind": log.kind, "status": "failed", "message": message}


def row_of(log: Log, folder: Path, inputs: str) -> Row | None:
    """Return a summary of a finished log's ``report.json``; None if these inputs have none.

    Parameters
    ----------
    log, folder, inputs
        As of :func:`settle`.

    Returns
    -------
    dict or None
        ``name``, ``kind``, ``status`` (done), ``verdict``, ``effects``, ``detectable``,
        ``error_before``, ``error_after`` (in units of noise), ``seconds`` and ``warnings``.
    """
    try:
        report = json.loads((folder / log.name / DONE).read_text(encoding="utf-8"))
        about = report["log"]
        if about["inputs_sha256"] != inputs:
            return None
        error = report["error"]
        return {
            "name": log.name,
            "kind": log.kind,
            "status": "done",
            "verdict": report["verdict"],
            "effects": [
                {key: added[key] for key in ("effect", "body", "parameters", "p_value")}
                | {"main": added.get("main", True)}
                for added in report["added"]
            ],
            "detectable": {
                f"{candidate['effect']}[{candidate['body']}]": candidate["detectable"]
                for candidate in report["candidates"]
                if not candidate.get("caps", False)
            },
            "error_before": error["before"]["normalised_rmse"],
            "error_after": error["after"]["normalised_rmse"],
            "seconds": about["seconds"],
            "warnings": about["warnings"],
        }
    except (OSError, ValueError, KeyError, TypeError):
        return None  # missing, or of another kind: the log is run again
