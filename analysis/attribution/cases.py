"""Cases of the scoreboard: the hidden effect, its body, and the loop's catalogue."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from attribution.bodies import (
    ARM,
    CART,
    CHAIN,
    CONTAIN,
    LEVER,
    PAIR,
    PUCK,
    SLED,
    Body,
    Hidden,
    Rng,
    draw_body,
    indistinguishable,
)  # fmt: skip
from attribution.outside import CONTAINING
from attribution.sizes import EFFECTS, OUTSIDE_OF, STEPS, STRONGEST, makes_sense, value
from attribution.worlds import simulate

#: The kinds of cases.
CATALOGUED, LEFT_OUT, OUTSIDE = "catalogued", "left-out", "outside"
CLEAN, NONSENSE = "clean", "nonsense"
KINDS = (CATALOGUED, LEFT_OUT, OUTSIDE, CLEAN, NONSENSE)
#: Cases of each kind and sort of body.
_COUNTS = {
    CATALOGUED: {CART: 17, PUCK: 17, ARM: 9, SLED: 13, LEVER: 6, PAIR: 4, CHAIN: 4},
    LEFT_OUT: {CART: 8, PUCK: 8, ARM: 4, SLED: 6, LEVER: 2, PAIR: 1, CHAIN: 1},
    OUTSIDE: {CART: 9, PUCK: 9, ARM: 2, SLED: 8, LEVER: 2},
    CLEAN: {CART: 15, PUCK: 15, ARM: 8, SLED: 11, LEVER: 5, PAIR: 4, CHAIN: 4},
}
#: Over the smallest strength that the oracle detects.
_FACTORS = (1.3, 50.0)
#: Strengths of what has no such limit, for it comes in steps.
_STRENGTHS = (0.15, 1.0)
#: Draws a chain with which no chains converge.
_TOO_FEW = 5
#: The samplers: each tenth case has the loop's own, which takes longer.
IMPORTANCE, LAPLACE = "importance", "laplace"
METHODS = (IMPORTANCE, LAPLACE)
_TENTH = 10


@dataclass(frozen=True)
class Case:
    """A case of the scoreboard.

    Parameters
    ----------
    name : str
        Tells cases apart, and makes their data.
    kind : str
        One of `KINDS`.
    body : Body
        What moves.
    method : str
        The loop's sampler, one of `METHODS`.
    effect, on : str, optional
        What is hidden in the data, and on which body.
    factor : float, optional
        Its strength over the smallest that the oracle detects.
    strength : float, optional
        Its strength, as :func:`attribution.sizes.value` takes it; None until it is known.
    turn : float
        Its direction (rad).
    wrong : str, optional
        What is wrong with the log, as in `WRONG`.
    draws : int, optional
        Posterior draws a chain; the loop's own by default.
    """

    name: str
    kind: str
    body: Body
    method: str = LAPLACE
    effect: str | None = None
    on: str | None = None
    factor: float | None = None
    strength: float | None = None
    turn: float = 0.0
    wrong: str | None = None
    draws: int | None = None

    @property
    def value(self) -> Hidden | None:
        """Return the effect's size, as an argument of the generator."""
        if self.effect is None or self.on is None or self.strength is None:
            return None
        return value(self.effect, self.body, self.on, self.strength, self.turn)

    @property
    def left_out(self) -> tuple[str | None, ...]:
        """Return what is removed from the loop's catalogue: the effect, its equivalents, family."""
        if self.kind == OUTSIDE:
            return (CONTAINING.get(str(self.effect)),)
        if self.kind != LEFT_OUT:
            return ()
        richer = (outer for outer, own in CONTAIN[self.body.sort] if own == self.effect)
        families = {one.family for one in pp.catalogue if one.name == self.effect} - {""}
        family = (one.name for one in pp.catalogue if one.family in families)
        return (*indistinguishable(self.body.sort, self.effect), *richer, *family)

    @property
    def catalogue(self) -> tuple[pp.Effect, ...]:
        """Return the loop's catalogue."""
        return tuple(effect for effect in pp.catalogue if effect.name not in self.left_out)

    def at(self, strength: float) -> Case:
        """Return the same case with an effect of this strength."""
        return replace(self, strength=min(strength, STRONGEST))

    def histories(self, seed: int, coarse: bool = False) -> tuple[pp.History, pp.History]:
        """Return the training and the test recording; ``coarse`` ones have longer steps."""
        own = zlib.crc32(f"{self.name} {seed} {coarse}".encode())
        hidden = {} if self.effect is None or self.value is None else {self.effect: self.value}
        frames = simulate(own, self.body, self.on, hidden, coarse)
        if self.wrong is not None:
            frames = tuple(WRONG[self.wrong](frame) for frame in frames)
        train, test = (pp.History.from_dataframe(frame, self.body.scene) for frame in frames)
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
_FEW_DRAWS = "few-draws"
#: Logs that are wrong, and chains too short.
_NONSENSE = (
    (CART, "degrees"), (CART, "no-forces"), (CART, _FEW_DRAWS), (PUCK, "millinewtons"),
    (PUCK, _FEW_DRAWS), (SLED, "no-forces"), (SLED, "millinewtons"), (ARM, "degrees"),
)  # fmt: skip


def all_cases(seed: int = 0, method: str | None = None) -> list[Case]:
    """Return all cases of a seed.

    Parameters
    ----------
    seed : int
        Of bodies, recordings, noises, effects and their sizes.
    method : str, optional
        The sampler of all; by default each tenth case has the loop's own and the others Laplace's
        approximation.
    """
    cases = [
        case
        for kind, counts in _COUNTS.items()
        for sort, count in counts.items()
        for case in _drawn(kind, sort, count, seed)
    ]
    for sort, wrong in _NONSENSE:
        name = f"{NONSENSE}-{sort}-{wrong}"
        body = draw_body(sort, _rng(seed, name))
        log = {"draws": _TOO_FEW} if wrong == _FEW_DRAWS else {"wrong": wrong}
        cases.append(Case(name, NONSENSE, body, **log))
    names = {effect.name for effect in pp.catalogue}
    # without the cutoff, what is called a dead zone is the cutoff
    names -= set() if "force_cutoff" in names else {"dead_zone"}
    return [
        replace(case, method=IMPORTANCE if case.draws else method or _usual(number))
        for number, case in enumerate(cases)
        if case.kind not in (CATALOGUED, LEFT_OUT) or case.effect in names
    ]


def _usual(number: int) -> str:
    return IMPORTANCE if number % _TENTH == _TENTH // 2 else LAPLACE


def _rng(seed: int, name: str) -> Rng:
    return np.random.default_rng((seed, zlib.crc32(name.encode())))


def _drawn(kind: str, sort: str, count: int, seed: int) -> list[Case]:
    """Draw cases of one kind and sort of body; no effect repeats before each was drawn once."""
    if kind == CLEAN:
        named = [f"{kind}-{sort}-{i:02d}" for i in range(count)]
        return [Case(name, kind, draw_body(sort, _rng(seed, name))) for name in named]
    known = OUTSIDE_OF[sort] if kind == OUTSIDE else EFFECTS[sort]
    order = [str(effect) for effect in _rng(seed, f"{kind}-{sort}").permutation(known)]
    cases: list[Case] = []
    for i in range(count):
        rng = _rng(seed, f"{kind}-{sort}-{i}")
        body = draw_body(sort, rng)
        effect = next(effect for effect in order if makes_sense(effect, body))
        order.remove(effect)
        order.append(effect)
        low, high = np.log(_STRENGTHS if effect in STEPS else _FACTORS)
        size = float(np.exp(rng.uniform(low, high)))
        amount: dict[str, Any] = {"strength" if effect in STEPS else "factor": size}
        if effect == "hidden_obstacle":
            near = replace(body.setups[0], start_range=(1.0, 1.0, math.pi))
            body = replace(body, setups=(near,))
        on = body.names[int(rng.integers(len(body.names)))]
        turn = float(rng.uniform(0, 2 * math.pi))
        name = f"{kind}-{sort}-{effect}-{i:02d}"
        cases.append(Case(name, kind, body, effect=effect, on=on, turn=turn, **amount))
    return cases


def a_tenth(cases: list[Case]) -> list[Case]:
    """Return about a tenth of each kind, at least one."""
    return [case for kind in KINDS for case in [each for each in cases if each.kind == kind][::11]]
