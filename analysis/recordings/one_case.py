"""One case from data to row: the oracle and the package on the same recording."""

from __future__ import annotations

import json
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from running import cache_file, limited, sources

import pbrl_ppl as pp
from pbrl_ppl import close_loop
from pbrl_ppl.criticism import ADEQUATE
from recordings.cases import Case
from recordings.oracle import Oracle, ask

#: Changes of the generator, the oracle or a row's fields make cached rows useless.
_FORMAT = 1


@dataclass(frozen=True)
class Row:
    """Result of a case.

    Parameters
    ----------
    name, world, shape, noise, effect : str
        Of the case.
    rate : int
        Samples a second (Hz).
    clean : bool
        Whether the effect is absent.
    answers : dict
        Right effects; of each, a parameter and its true value, or None.
    oracle : Oracle, optional
        Whether the data show the effect.
    findings : dict, optional
        As in ``report.json``; None if the case failed.
    error : str, optional
        Why it failed.
    seconds : float
        Duration of the loop.
    sources : str
        Hash of the package's files.
    """

    name: str
    world: str
    rate: int
    shape: str
    noise: str
    effect: str
    clean: bool
    answers: dict[str, Any]
    oracle: Oracle | None = None
    findings: dict[str, Any] | None = None
    error: str | None = None
    seconds: float = 0.0
    sources: str = field(default="", compare=False)

    @property
    def verdict(self) -> str:
        """Return the loop's verdict, or ``failed``."""
        return "failed" if self.findings is None else str(self.findings["verdict"])

    @property
    def added(self) -> list[dict[str, Any]]:
        """Return the effects that the loop added."""
        return [] if self.findings is None else list(self.findings["added"])

    @property
    def detectable(self) -> bool:
        """Return whether there is an effect that the oracle detects."""
        return not self.clean and self.oracle is not None and self.oracle.detects

    @property
    def named(self) -> bool:
        """Return whether only the right effect, or a group that contains it, was added."""
        return bool(self.added) and all(map(self._right, self.added)) and not self.clean

    @property
    def extra(self) -> bool:
        """Return whether there is a wrong name beside the right one."""
        right = [self._right(one) for one in self.added]
        return not self.clean and any(right) and not all(right)

    @property
    def names_nothing(self) -> bool:
        """Return whether the loop calls the model adequate and adds nothing."""
        return self.verdict == ADEQUATE and not self.added

    def _right(self, one: dict[str, Any]) -> bool:
        return any(name in self.answers for name in (one["effect"], *one["not_separable_from"]))

    @property
    def inside(self) -> list[bool]:
        """Return, for each added effect with a true coefficient, whether its interval has it."""
        found = []
        for one in self.added:
            known = None if self.clean else self.answers.get(one["effect"])
            if known is not None:
                low, high = one["parameters"][known[0]]["hdi"]
                found.append(low <= known[1] <= high)
        return found


def run_case(case: Case, seed: int, bare: bool, limit: int) -> Row:
    """Simulate a case, fit the oracle, run the loop; a failure gives a row with its message.

    A case that takes longer than ``limit`` seconds is one; 0 is no limit.
    """
    known: dict[str, Any] = {}
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings(), limited(limit, "allow more with --limit"):
            warnings.simplefilter("ignore")
            recordings = case.recordings()
            known["oracle"] = ask(case, recordings[0])
            train, test = (case.history(each, bare) for each in recordings)
            begin = time.perf_counter()
            found = close_loop(case.scene, train, test, method="laplace", seed=seed)
            known["findings"] = found.to_dict()
    except Exception as error:
        known["error"] = f"{type(error).__name__}: {error} ({_where(error)})"
    about = {name: getattr(case, name) for name in _ABOUT}
    return Row(**about, **known, seconds=time.perf_counter() - begin, sources=sources())


_ABOUT = ("name", "world", "rate", "shape", "noise", "effect", "clean", "answers")


def _where(error: Exception) -> str:
    """Return the line at which an error left the package, or was raised outside of it."""
    places = traceback.extract_tb(error.__traceback__)
    own = [each for each in places if Path(pp.__file__).parent in Path(each.filename).parents]
    place = (own or places)[-1]
    return f"{Path(place.filename).name}:{place.lineno}"


def cache_path(folder: Path, case: Case, seed: int, bare: bool) -> Path:
    """Return the path of a case's row: its name, and a hash of the settings."""
    return cache_file(folder, case.name, (_FORMAT, case, case.scene.to_toml(), seed, bare))


def load(path: Path) -> Row | None:
    """Return a stored row, if any."""
    if not path.is_file():
        return None
    kept = json.loads(path.read_text())
    return Row(**kept | {"oracle": kept["oracle"] and Oracle(**kept["oracle"])})
