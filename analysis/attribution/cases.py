"""Cases of the scoreboard: what is hidden in the data of which body, and what the loop may name."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from attribution.bodies import BODIES, LEVELS, NEAR_DISC, Hidden, mh

#: The kinds of cases.
CATALOGUED, LEFT_OUT, OUTSIDE = "catalogued", "left-out", "outside"
CLEAN, NONSENSE = "clean", "nonsense"
KINDS = (CATALOGUED, LEFT_OUT, OUTSIDE, CLEAN, NONSENSE)
#: Clean cases a body, about a fifth of all; nonsense of each sort and body.
_CLEAN, _NONSENSE = 30, 2
#: Draws a chain with which no chains converge.
_TOO_FEW = 5


@dataclass(frozen=True)
class Case:
    """A case of the scoreboard.

    Parameters
    ----------
    name : str
        Tells cases apart, and makes their data.
    kind : str
        One of `KINDS`.
    body : str
        Key of `BODIES`.
    effect : str, optional
        What is hidden in the data.
    value : float or tuple of float, optional
        How much of it, as the generator takes it.
    left_out : tuple of str
        What the loop's catalogue lacks.
    wrong : str, optional
        What is wrong with the log, as in `WRONG`.
    draws : int, optional
        Posterior draws a chain; the loop's own by default.
    """

    name: str
    kind: str
    body: str
    effect: str | None = None
    value: Hidden | None = None
    left_out: tuple[str, ...] = ()
    wrong: str | None = None
    draws: int | None = None

    @property
    def scene(self) -> pp.Scene:
        """The declared scene."""
        return BODIES[self.body].scene

    @property
    def setup(self) -> mh.Setup:
        """The truth but for what is hidden."""
        setup = BODIES[self.body].setup
        return replace(setup, start_range=NEAR_DISC) if self.effect == "hidden_obstacle" else setup

    @property
    def catalogue(self) -> tuple[pp.Effect, ...]:
        """What the loop may name."""
        return tuple(effect for effect in pp.catalogue if effect.name not in self.left_out)

    def histories(self, seed: int) -> tuple[pp.History, pp.History]:
        """Make the data to fit and those to judge by; they differ with the case's name too."""
        own = zlib.crc32(f"{self.name} {seed}".encode())
        hidden = {} if self.effect is None else {self.effect: self.value}
        frames = mh.simulate(own, self.setup, **hidden)
        if self.wrong is not None:
            frames = tuple(WRONG[self.wrong](frame) for frame in frames)
        train, test = (pp.History.from_dataframe(frame, self.scene) for frame in frames)
        return train, test


def _degrees(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.assign(theta=np.degrees(frame["theta"]), omega=np.degrees(frame["omega"]))


def _zeros(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.assign(**{name: 0.0 * frame[name] for name in ("force_x", "force_y", "torque")})


def _millinewtons(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.assign(**{name: 1000.0 * frame[name] for name in ("force_x", "force_y")})


#: What may be wrong with a log, and how to make it so.
WRONG: dict[str, Callable[[pd.DataFrame], pd.DataFrame]] = {
    "degrees": _degrees,
    "no-forces": _zeros,
    "millinewtons": _millinewtons,
}


def all_cases(repeats: int = 1) -> list[Case]:
    """Every case, as often as asked, with other data each time."""
    once = [*_effects(CATALOGUED), *_effects(LEFT_OUT), *_effects(OUTSIDE), *_clean(), *_nonsense()]
    again = [
        replace(case, name=f"{case.name}-again{i}") for i in range(1, repeats) for case in once
    ]
    return once + again


def _effects(kind: str) -> list[Case]:
    """Every effect on every body at every size; too small ones are no test of naming nothing."""
    cases = []
    for name, body in BODIES.items():
        effects = body.outside if kind == OUTSIDE else body.catalogued
        for effect, values in effects.items():
            twins = next((same for same in body.twins if effect in same), (effect,))
            twins += tuple(richer for richer, own in body.contain if own == effect)
            for level, value in zip(LEVELS, values, strict=True):
                if kind == LEFT_OUT and level == "small":
                    continue
                cases.append(
                    Case(
                        f"{kind}-{name}-{effect}-{level}", kind, name, effect, value,
                        () if kind == CATALOGUED else twins,
                    )
                )  # fmt: skip
    return cases


def _clean() -> list[Case]:
    return [Case(f"clean-{name}-{i:02d}", CLEAN, name) for name in BODIES for i in range(_CLEAN)]


def _nonsense() -> list[Case]:
    """Logs that are wrong, and chains too short; nothing pushes the pendulum."""
    cases = []
    for name, body in BODIES.items():
        pushed = any(body.setup.wrench_sd)
        for i in range(_NONSENSE):
            own = f"nonsense-{name}"
            cases += [
                Case(f"{own}-{wrong}-{i}", NONSENSE, name, wrong=wrong)
                for wrong in WRONG
                if pushed or wrong == "degrees"
            ]
            cases.append(Case(f"{own}-few-draws-{i}", NONSENSE, name, draws=_TOO_FEW))
    return cases


def a_tenth(cases: list[Case]) -> list[Case]:
    """About a tenth of each kind, one at least; steps of eleven go through the sizes."""
    return [case for kind in KINDS for case in [each for each in cases if each.kind == kind][::11]]
