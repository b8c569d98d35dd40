"""Many logs with a stand-in for the loop that does at once what each log's file says."""

import json
import os
import signal
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from pbrl_ppl.criticism.loop import FILES
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.reporting import Source, close_loop_many
from pbrl_ppl.reporting.logs import Log
from pbrl_ppl.reporting.many_page import page

#: One line a log that was begun and one a log that was kept: what was done how often.
BEGUN, KEPT = "begun.txt", "kept.txt"


def made_logs(folder: Path, **what: str) -> list[Log]:
    """Write logs by name and behaviour: wait, fail, crash, die, die-once, warn, or an effect."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text("a scene")
    for name, text in what.items():
        (folder / f"{name}.csv").write_text(text)
    return [Log(name, folder / "scene.toml", folder / f"{name}.csv") for name in what]


@contextmanager
def cluster(folder: Path) -> Iterator[Any]:
    """Return a client of a Dask cluster of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", local_directory=folder
        ) as workers,
        distributed.Client(workers) as client,
    ):
        yield client


def lines(folder: Path, name: str) -> list[str]:
    """Return the started or finished logs, in order."""
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


#: Effects of the page's logs: more than one table has beside each other.
MANY = ("angular_drag", "linear_drag", "quadratic_drag", "some_longer_name_of_a_drag", "air_drag")


def many_page(folder: Path) -> tuple[str, tuple[str, ...]]:
    """A page of logs of all kinds with a pooled one, and the files that it leads to."""
    what = {f"cart_of_floor_{i}": effect for i, effect in enumerate(MANY)}
    logs = made_logs(folder, **what, plain="", lost="fail", told="warn")
    rows = close_loop_many(logs, folder / "out", run=pretend).rows
    row = {
        "parameter": "some_longer_name_of_a_drag_coefficient[cart]", "scale": "logarithm",
        "mean": 0.2, "mean_low": 0.123456, "mean_high": 0.23456,
        "spread": 0.03, "spread_low": 0.012345, "spread_high": 0.23456,
        "next_median": 0.2, "next_low": 0.123456, "next_high": 0.23456,
        "informed": 5, "p_same": 1e-9,
    }  # fmt: skip
    pooled: Any = SimpleNamespace(names=tuple(what), table=lambda: pd.DataFrame([row] * 3))
    waiting = {"name": "late", "kind": "", "status": "waiting"}
    source = Source(command=f"pbrl-ppl close-logs {'logs' * 40}.csv -o out")
    reason = "1 adequate model(s), expected at least 2"
    html = page((*rows, waiting), {"cart": pooled}, {"arm": reason}, source)
    files = [f"{name}/report.html" for name in (*what, "plain", "told")]
    files += ["lost/error.json", "kind-cart.toml", "kind-cart.csv"]
    return html, (*files, "summary.csv", "effects.csv", "summary.json")
