"""Many logs without a loop: what closes it does what the log's own file says, at once."""

import json
import os
import signal
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.report.loop import FILES
from pbrl_ppl.report.manifest import Log

#: One line a log that was begun and one a log that was kept: what was done how often.
BEGUN, KEPT = "begun.txt", "kept.txt"


def made_logs(folder: Path, **what: str) -> list[Log]:
    """Logs by name; what each does: wait, fail, crash, die, die-once, warn, or an effect's name."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text("a scene")
    for name, text in what.items():
        (folder / f"{name}.csv").write_text(text)
    return [Log(name, folder / "scene.toml", folder / f"{name}.csv") for name in what]


@contextmanager
def cluster(folder: Path) -> Iterator[Any]:
    """A client of a Dask cluster of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", local_directory=folder
        ) as workers,
        distributed.Client(workers) as client,
    ):
        yield client


def lines(folder: Path, name: str) -> list[str]:
    """What was begun or kept, in order."""
    path = folder / name
    return path.read_text().split() if path.exists() else []


def _note(log: Log, name: str) -> None:
    with (log.train.parent / name).open("a") as file:
        file.write(f"{log.name}\n")


class Pretended:
    """A loop's files, small."""

    def __init__(self, log: Log, effect: str) -> None:
        self.log, self.effect = log, effect

    def save(self, folder: Path) -> None:
        folder.mkdir()
        for name in FILES:
            (folder / name).write_text(self.log.name)
        estimate = {"mean": 1.2, "sd": 0.1, "hdi": [1.0, 1.4], "unit": "kg/s"}
        added = {"effect": self.effect, "body": "cart", "p_value": 1e-9,
                 "parameters": {"coefficient": estimate}}  # fmt: skip
        found = bool(self.effect)
        unseen = {"effect": "linear_drag", "body": "cart", "detectable": {"coefficient": 0.03}}
        report = {
            "verdict": "effects-added" if found else "adequate",
            "added": [added] if found else [],
            "candidates": [unseen],
            "error": {"before": {"normalised_rmse": 2.0}, "after": {"normalised_rmse": 1.0}},
        }
        (folder / "report.json").write_text(json.dumps(report))
        _note(self.log, KEPT)


def pretend(log: Log, settings: Any) -> Pretended:
    """Close the loop on a log: do what its file says."""
    _note(log, BEGUN)
    text = log.train.read_text()
    if text == "wait":
        time.sleep(0.4)
    if text == "fail":
        raise HistoryError("row 3: x is lost")
    if text == "crash":
        raise ZeroDivisionError("by zero")
    if text == "interrupt":
        raise KeyboardInterrupt
    if text == "die" or (text == "die-once" and lines(log.train.parent, BEGUN).count(log.name) < 2):
        os.kill(os.getpid(), signal.SIGKILL)
    if text == "warn":
        warnings.warn("rows were\nresampled", UserWarning, stacklevel=2)
    return Pretended(log, text if text.endswith("_drag") else "")
