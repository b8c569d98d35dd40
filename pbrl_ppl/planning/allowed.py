"""Sequences of wrenches allowed in an experiment: within bounds, or from an action set."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pbrl_ppl.errors import GoalError
from pbrl_ppl.planning.actions import ActionSet
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import THETA, WRENCH, Floats

#: Lowest and highest value of components of the wrench, by body.
Bounds = Mapping[str, Mapping[str, Sequence[float]]]
#: Wrenches (n, time, body, 3) to states (n, time + 1, body, 6).
Predict = Callable[[Floats], Floats]

#: Pieces of a sequence within bounds by default.
_PIECES = 8


class Allowed(Protocol):
    """A set of sequences, each made of pieces."""

    @property
    def pieces(self) -> int:
        """Pieces of a sequence."""

    def random(self, rng: np.random.Generator, n: int) -> Floats:
        """Draw sequences from the set, shape (n, piece, ...)."""

    def extreme(self, rng: np.random.Generator, n: int) -> Floats:
        """Draw sequences with more values at the bounds of the set."""

    def wrenches(self, genes: Floats, predict: Predict) -> Floats:
        """Return world-frame wrenches of sequences, shape (n, time, body, 3)."""


def allowed_wrenches(
    scene: Scene, actions: ActionSet | Bounds, steps: int, hold: int | None
) -> Allowed:
    """Return the sequences that an action set or bounds allow.

    Raises
    ------
    GoalError
        If a body or a component is unknown, or a bound is not two numbers.
    """
    if isinstance(actions, ActionSet):
        actions.check(scene)
        return _OfActions(scene, actions, steps)
    names = [body.name for body in scene.moving]
    free = [body.name for body in scene.dynamic]
    low = np.zeros((len(names), len(WRENCH)))
    high = low.copy()
    for body, given in actions.items():
        if body not in free:
            raise GoalError(
                f'bounds: the scene has no moving body "{body}" that can be pushed'
                f"{nearest(body, free)}"
            )
        for component, ends in given.items():
            if component not in WRENCH:
                raise GoalError(
                    f'bounds of {body}: "{component}" is no component of a wrench'
                    f"{nearest(component, WRENCH)}"
                )
            pair = np.asarray(ends, dtype=float).ravel()
            if pair.shape != (2,) or not np.isfinite(pair).all() or pair[0] > pair[1]:
                raise GoalError(
                    f"bounds of {component} on {body}: got {ends!r}, expected the lowest and the"
                    " highest value, two finite numbers"
                )
            at = names.index(body), WRENCH.index(component)
            low[at], high[at] = pair
    if not (high > low).any():
        raise GoalError("bounds: nothing may vary; give a lowest and a higher highest value")
    return _Within(low, high, steps, hold or max(1, round(steps / _PIECES)))


@dataclass(frozen=True, eq=False)
class _Within:
    """Wrenches within bounds (body, 3), each held for some intervals."""

    low: Floats
    high: Floats
    steps: int
    hold: int

    @property
    def pieces(self) -> int:
        return math.ceil(self.steps / self.hold)

    def random(self, rng: np.random.Generator, n: int) -> Floats:
        share = rng.random((n, self.pieces, *self.low.shape))
        return np.asarray(self.low + share * (self.high - self.low))

    def extreme(self, rng: np.random.Generator, n: int) -> Floats:
        inner = self.random(rng, n)
        ends = np.where(rng.random(inner.shape) < 0.5, self.low, self.high)
        nothing = np.clip(0.0, self.low, self.high)
        kind = rng.integers(3, size=inner.shape)
        return np.select(
            [kind == 0, kind == 1], [inner, np.broadcast_to(nothing, inner.shape)], ends
        )

    def wrenches(self, genes: Floats, predict: Predict) -> Floats:
        return np.repeat(genes, self.hold, axis=1)[:, : self.steps]


@dataclass(frozen=True, eq=False)
class _OfActions:
    """Actions of a set, each for one of its durations; a piece has the numbers of both."""

    scene: Scene
    actions: ActionSet
    steps: int

    @property
    def pieces(self) -> int:
        return math.ceil(self.steps / min(self.actions.intervals(self.scene)))

    def random(self, rng: np.random.Generator, n: int) -> Floats:
        kinds = len(self.actions.actions), len(self.actions.intervals(self.scene))
        return rng.integers(kinds, size=(n, self.pieces, 2)).astype(float)

    def extreme(self, rng: np.random.Generator, n: int) -> Floats:
        return self.random(rng, n)

    def wrenches(self, genes: Floats, predict: Predict) -> Floats:
        number, length = genes.astype(np.intp).transpose(2, 0, 1)
        ends = np.cumsum(np.array(self.actions.intervals(self.scene))[length], axis=1)
        time = np.arange(self.steps)
        piece = (time[None, :, None] >= ends[:, None, :]).sum(axis=2)
        which = np.take_along_axis(number, piece, axis=1)
        n, bodies = len(genes), len(self.scene.moving)
        out = np.zeros((n, self.steps, bodies, len(WRENCH)))
        turned = any(action.frame == "body" for action in self.actions.actions)
        heading = np.zeros((n, bodies))
        for t in range(self.steps):
            if turned:  # a force in the body frame depends on the path so far
                heading = np.nan_to_num(predict(out[:, :t])[:, -1, :, THETA])
            out[:, t] = self.actions.wrenches(self.scene, which[:, t], heading)
        return out
