"""One of many logs in a worker: close its loop, save it, and read it again later."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pbrl_ppl.criticism import Loop, close_loop
from pbrl_ppl.criticism.loop import FILES
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import PbrlError
from pbrl_ppl.history import History, write_atomically
from pbrl_ppl.report.manifest import Log
from pbrl_ppl.report.write import loop_page
from pbrl_ppl.scene import Scene

#: File of a finished log, written last; file of a failed one.
DONE, FAILED = "report.json", "error.json"
#: Warnings and figures belong to the process: one log at a time in each.
_ONE = threading.Lock()
_MAKING = ".making-"


@dataclass(frozen=True)
class Settings:
    """Settings of all logs, as in :func:`pbrl_ppl.close_loop` and `History.load`.

    Parameters
    ----------
    seed, substeps, draws, method, catalogue : optional
        Arguments of the loop; the whole catalogue by default.
    noise : mapping of str to float
        Known measurement noise, by state dimension.
    estimate_velocities, columns, units : optional
        Arguments of `History.load`.
    time_step : float, optional
        Replaces the scene's (s); uneven samples are interpolated to it.
    """

    seed: int = 0
    substeps: int | None = None
    draws: int | None = None
    method: str = "metropolis"
    catalogue: tuple[Effect, ...] | None = None
    noise: Mapping[str, float] = field(default_factory=dict)
    estimate_velocities: bool = False
    columns: Mapping[str, str | float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    time_step: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return all settings that results depend on, for JSON."""
        effects = None
        if self.catalogue is not None:
            effects = [[effect.name, repr(effect.parameters)] for effect in self.catalogue]
        return vars(self) | {"catalogue": effects}


#: Closes the loop on one log; its result has a ``save(folder)`` that writes a loop's files.
Run = Callable[[Log, Settings], Any]


@dataclass(frozen=True, eq=False)
class LoopWithPage:
    """A closed loop, saved together with its page."""

    loop: Loop

    def save(self, folder: Path) -> None:
        """Write the loop's files and its report."""
        self.loop.save(folder, page=loop_page(self.loop))


def close_log(log: Log, settings: Settings) -> LoopWithPage:
    """Read a log's files and close the loop."""
    scene = Scene.load(log.scene)
    if settings.noise:
        scene = scene.replace(noise=dict(scene.noise) | dict(settings.noise))
    if settings.time_step is not None:
        scene = scene.replace(time_step=settings.time_step)
    if settings.substeps is not None:
        scene = scene.replace(substeps=settings.substeps)
    train, test = (
        None
        if path is None
        else History.load(
            path,
            scene,
            estimate_velocities=settings.estimate_velocities,
            columns=settings.columns,
            units=settings.units,
            resample=settings.time_step is not None,
        )
        for path in (log.train, log.test)
    )
    if train is None:  # the manifest does not allow it
        raise ValueError(f"log {log.name} has no train")
    catalogue = full_catalogue if settings.catalogue is None else settings.catalogue
    return LoopWithPage(
        close_loop(
            scene, train, test, catalogue=catalogue, seed=settings.seed, draws=settings.draws,
            method=settings.method,
        )
    )  # fmt: skip


def inputs_sha256(log: Log, settings: Settings) -> str:
    """Return the hash of all that a log's result depends on: files, settings, version."""
    digest = hashlib.sha256()
    for path in (log.scene, log.train, log.test):
        content = b""
        if path is not None and path.is_file():
            content = path.read_bytes()
        digest.update(hashlib.sha256(content).digest() if path else b"none")
    try:
        own = version("pbrl_ppl")
    except PackageNotFoundError:
        own = "not installed"
    digest.update(json.dumps([settings.to_dict(), own], sort_keys=True, default=dict).encode())
    return digest.hexdigest()


def settle(log: Log, folder: Path, settings: Settings, inputs: str, run: Run) -> dict[str, Any]:
    """Close the loop on one log unless it is finished; write a file with the error if it fails.

    Files are written elsewhere and moved into the log's folder, ``report.json`` last, so that a
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
        Hash from :func:`inputs_sha256`.
    run : callable
        :func:`close_log`, or another.

    Returns
    -------
    dict
        Row of the log, see :func:`row_of`.
    """
    with _ONE:
        # a cluster runs a task again whose result was lost with its worker
        if row := row_of(log, folder, inputs):
            return row
        place, begin = folder / log.name, time.monotonic()
        try:
            place.mkdir(parents=True, exist_ok=True)
            for name in (DONE, FAILED):
                (place / name).unlink(missing_ok=True)
            for old in place.glob(f"{_MAKING}*"):  # from a worker that died
                shutil.rmtree(old, ignore_errors=True)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", UserWarning)
                loop = run(log, settings)
            said = list(dict.fromkeys(str(w.message) for w in caught
                                      if issubclass(w.category, UserWarning)))  # fmt: skip
            about = {"name": log.name, "kind": log.kind, "inputs_sha256": inputs,
                     "seconds": round(time.monotonic() - begin, 1), "warnings": said}  # fmt: skip
            _keep(loop, place, about)
        except Exception as error:
            return failed(log, folder, error)
    row = row_of(log, folder, inputs)
    return row or failed(log, folder, OSError(f"{place / DONE}: missing after it was written"))


def _keep(loop: Any, place: Path, about: dict[str, Any]) -> None:
    """Write a loop's files into a log's folder, ``report.json`` last."""
    with tempfile.TemporaryDirectory(prefix=_MAKING, dir=place) as aside:
        made = Path(aside) / "result"
        loop.save(made)
        contents = json.loads((made / DONE).read_text(encoding="utf-8"))
        text = json.dumps({"log": about} | contents, indent=1, allow_nan=False)
        (made / DONE).write_text(text + "\n", encoding="utf-8")
        for name in sorted(FILES, key=DONE.__eq__):
            (made / name).replace(place / name)


def failed(log: Log, folder: Path, error: BaseException) -> dict[str, Any]:
    """Return the row of a log that failed, and write the message into its folder if possible."""
    message = " ".join(str(error).split()) or type(error).__name__
    if not isinstance(error, PbrlError):
        message = f"{type(error).__name__}: {message}"
    trace = "".join(traceback.format_exception(error))
    text = json.dumps({"name": log.name, "message": message, "traceback": trace}, indent=1)
    try:
        (folder / log.name).mkdir(parents=True, exist_ok=True)
        write = partial(Path.write_text, data=text + "\n", encoding="utf-8")
        write_atomically(folder / log.name / FAILED, write)
    except OSError:
        message += " (its folder cannot be written to either)"
    return {"name": log.name, "kind": log.kind, "status": "failed", "message": message}


def row_of(log: Log, folder: Path, inputs: str) -> dict[str, Any] | None:
    """Return the summary of a finished log's ``report.json``; None if its inputs are others.

    Parameters
    ----------
    log, folder, inputs
        Arguments of :func:`settle`.

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
                for added in report["added"]
            ],
            "detectable": {
                f"{each['effect']}[{each['body']}]": each["detectable"]
                for each in report["candidates"]
                if not each.get("caps", False)
            },
            "error_before": error["before"]["normalised_rmse"],
            "error_after": error["after"]["normalised_rmse"],
            "seconds": about["seconds"],
            "warnings": about["warnings"],
        }
    except (OSError, ValueError, KeyError, TypeError):
        return None  # missing, or of other contents: the log is run again
