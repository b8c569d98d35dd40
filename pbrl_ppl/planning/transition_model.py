"""What a planner needs of a transition model."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]


@runtime_checkable
class TransitionModel(Protocol):
    """Transition model that :func:`pbrl_ppl.plan` can plan with.

    :class:`pbrl_ppl.Dynamics` is one, and so are :class:`pbrl_ppl.LWR` and :class:`pbrl_ppl.OOLWR`.
    """

    @property
    def scene(self) -> Scene:
        """Known geometry: orders the bodies, and says what is in the way."""

    @property
    def before(self) -> Array:
        """Wrenches that acted before the start, shape (body, 3), N and N m."""

    @property
    def draws(self) -> int:
        """Number of models in it, each with its own states: posterior draws, or 1."""

    def single(self) -> Self:
        """One of them, in the middle of all."""

    def after(self, before: Array) -> Self:
        """The model after these previous wrenches, shape (body, 3), N and N m."""

    def acceleration(self, body: str, force: float, torque: float) -> tuple[Array, Array]:
        """The most that a push can do to a body: m/s^2 and rad/s^2, shape (draw,) each."""

    def step(self, states: Array, wrenches: Array, previous: Array | None = None) -> Array:
        """States after one sampling interval; NaN where the model has no answer.

        Parameters
        ----------
        states : ndarray
            Shape (draw, n, body, 6), SI units.
        wrenches, previous : ndarray
            Now and in the interval before, shape (n, body, 3), world frame, N and N m.
        """

    def noisy(self, states: Array, rng: np.random.Generator) -> Array:
        """States (draw, n, body, 6) with the noise of a step."""


def rollout(
    model: TransitionModel,
    start: Array,
    wrenches: Array,
    rng: np.random.Generator | None = None,
) -> Array:
    """Play wrenches (time, body, 3) from a state (body, 6): shape (draw, time + 1, body, 6).

    With a generator, the noise of a step is added after each interval.
    """
    states = np.broadcast_to(start, (model.draws, 1, *start.shape))
    every = [states]
    last = model.before
    for wrench in wrenches:
        states, last = model.step(states, wrench[None], last[None]), wrench
        if rng is not None:
            states = model.noisy(states, rng)
        every.append(states)
    return np.concatenate(every, axis=1)
