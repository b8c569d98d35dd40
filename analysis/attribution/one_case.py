"""One case from data to row: the oracle and the loop on the same data."""

from __future__ import annotations

import json
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from running import cache_file, limited, sources

import pbrl_ppl as pp
from attribution.baselines import ask_baselines
from attribution.cases import CATALOGUED, Case
from attribution.oracle import Oracle, ask, declared_mode, sized, true_parameters
from pbrl_ppl import close_loop
from pbrl_ppl.criticism import Stage

#: Parameters of which more than one value is the truth: any number between two trajectories.
_AMBIGUOUS = {("mass_change", "trajectory")}
#: Changes of what a row means make cached ones useless.
_FORMAT = 4


@dataclass(frozen=True)
class Row:
    """Result of a case.

    Parameters
    ----------
    name, kind, body, method : str
        Of the case; the body's sort.
    effect, on : str, optional
        What is hidden, and on which body.
    strength : float, optional
        Its force or torque over the body's usual ones; of angles, gains and shares itself.
    truth : dict of str to float
        Its parameters.
    oracle : Oracle, optional
        Whether the data show it.
    baselines : dict of str to str
        What the usual ways name.
    findings : dict, optional
        As in ``report.json``, and the stages with their seconds; None if the case failed.
    error : str, optional
        Why it failed.
    seconds : float
        What it took.
    sources : str
        Hash of the package's files that it was made with.
    """

    name: str
    kind: str
    body: str
    method: str
    effect: str | None = None
    on: str | None = None
    strength: float | None = None
    truth: dict[str, float] = field(default_factory=dict)
    oracle: Oracle | None = None
    baselines: dict[str, str | None] = field(default_factory=dict)
    findings: dict[str, Any] | None = None
    error: str | None = None
    seconds: float = 0.0
    sources: str = ""

    @property
    def verdict(self) -> str:
        """Return the loop's verdict, or ``failed``."""
        return "failed" if self.findings is None else str(self.findings["verdict"])

    @property
    def added(self) -> list[dict[str, Any]]:
        """Return the effects that the loop added, the largest gain first."""
        return [] if self.findings is None else list(self.findings["added"])

    @property
    def open(self) -> bool:
        """Return whether the loop reports an unexplained remainder."""
        return self.findings is not None and self.findings["unexplained"] is not None

    @property
    def detected(self) -> bool:
        """Return whether the oracle detects the effect."""
        return self.oracle is not None and self.oracle.detects

    @property
    def matters(self) -> bool:
        """Return whether the effect improves the oracle's forecasts."""
        return self.oracle is not None and self.oracle.matters

    @property
    def is_main(self) -> bool:
        """Return whether the effect takes off what the loop asks of a law that it names."""
        return self.oracle is not None and self.oracle.is_main

    @property
    def worse(self) -> bool:
        """Return whether the added effects increase the held-out error."""
        if self.findings is None or not self.added:
            return False
        before, after = (self.findings["error"][key] for key in ("before", "after"))
        return bool(after["normalised_rmse"] > before["normalised_rmse"])

    @property
    def excess(self) -> float | None:
        """Return the relative excess of the revised model's forecast errors over the oracle's.

        The root mean square over what is measured, of errors in units of the oracle's.
        """
        if self.findings is None or self.oracle is None or not self.oracle.rollout_rmse:
            return None
        own, best = self.findings["error"]["after"]["rollout_rmse"], self.oracle.rollout_rmse
        ratios = [own[name] / best[name] for name in best if name in own]
        return float(np.sqrt(np.mean(np.square(ratios)))) - 1.0 if ratios else None

    def within(self) -> list[bool]:
        """Return whether intervals have the truth: each parameter of a correctly named effect."""
        return [
            estimate["hdi"][0] <= self.truth[name] <= estimate["hdi"][1]
            for one in self.added
            if one["effect"] == self.effect and one["body"] == self.on
            for name, estimate in one["parameters"].items()
            if (self.effect, name) not in _AMBIGUOUS
        ]


def run_case(case: Case, seed: int, draws: int | None = None, limit: int = 0) -> Row:
    """Simulate a case, fit the oracle, run the loop; a failure gives a row with its message.

    A case that takes longer than ``limit`` seconds is one; 0 is no limit.
    """
    begin = time.perf_counter()
    known: dict[str, Any] = about(case)
    cure = f"see where with --only {case.name} --workers 1 --verbose --limit 0"
    try:
        with warnings.catch_warnings(), limited(limit, cure):
            warnings.simplefilter("ignore")
            case = sized(case, seed)
            known |= {"strength": case.strength, "truth": true_parameters(case)}
            train, test = case.histories(seed)
            if case.effect is not None:
                declared = declared_mode(case, train, seed)
                known["oracle"] = ask(case, declared, test, seed)
                if case.kind == CATALOGUED and len(case.body.names) == 1:
                    known["baselines"] = ask_baselines(declared)
            known["findings"] = _loop(case, train, test, seed, draws)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        known["error"] = f"{type(error).__name__}: {error} ({where})"
    return Row(**known, seconds=time.perf_counter() - begin)


def about(case: Case) -> dict[str, Any]:
    """Return the fields of a row that describe the case."""
    known = {name: getattr(case, name) for name in ("name", "kind", "method", "effect", "on")}
    return known | {"body": case.body.sort, "sources": sources()}


def _loop(
    case: Case, train: pp.History, test: pp.History, seed: int, draws: int | None
) -> dict[str, Any]:
    """Return the loop's findings, and the start times of its stages (s)."""
    begin = time.perf_counter()
    stages: list[tuple[float, str]] = []

    def begun(stage: str) -> None:
        if stage in tuple(Stage):
            stages.append((time.perf_counter() - begin, stage))

    found = close_loop(
        case.body.scene,
        train,
        test,
        catalogue=case.catalogue,
        seed=seed,
        draws=draws if case.draws is None else case.draws,
        method=case.method,
        progress=begun,
    )
    return found.to_dict() | {"stages": stages, "loop_seconds": time.perf_counter() - begin}


def cache_path(folder: Path, case: Case, seed: int, draws: int | None) -> Path:
    """Return the path of a case's row: its name, and a hash of version and settings."""
    catalogue = [effect.name for effect in case.catalogue]
    settings = (_FORMAT, case, case.body.scene.to_toml(), catalogue, seed, draws)
    return cache_file(folder, case.name, settings)


def load(path: Path) -> Row | None:
    """Return a stored row, if any."""
    if not path.is_file():
        return None
    kept = json.loads(path.read_text())
    return Row(**kept | {"oracle": kept["oracle"] and Oracle(**kept["oracle"])})
