"""Agents: observe a transition, update a model, plan with it, act."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.agents.revision import Revision
from pbrl_ppl.agents.task import Task
from pbrl_ppl.planning import TransitionModel, plan, rollout

Array = NDArray[np.float64]


class Agent(ABC):
    """Agent that plans with its model of transitions; subclasses say how the model is learned.

    A plan is kept for as long as the model of today says that it leads from the state of today to
    the goal; otherwise a new one is made. With a plan that ends elsewhere, the nearest place to the
    goal that the search found, one action is taken. Where there is no plan at all, because nothing
    is known yet, the model has no answer, or it leads nowhere nearer, an action is taken at random.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    seed : int
        Of the random actions.
    nodes : int
        States that a search for a plan generates at most.
    **options
        Of :func:`pbrl_ppl.plan`.

    Attributes
    ----------
    planned : bool
        Whether the last action was planned rather than random.
    posterior : InferenceData or DataTree or None
        What it believes in, as :func:`pbrl_ppl.fit` made it; None where there is none.
    added : tuple of Revision
        Effects that it found missing from its model.
    """

    #: What episodes and figures call it.
    name: ClassVar[str]
    posterior: Any = None
    added: tuple[Revision, ...] = ()

    def __init__(self, task: Task, *, seed: int = 0, nodes: int = 20_000, **options: Any) -> None:
        self.task, self.seed = task, seed
        self._options = {"nodes": nodes, **options}
        self._rng = np.random.default_rng([seed, 0])  # [seed, 1] is the world's
        self._ahead = np.empty((0, len(task.scene.moving), 3))
        self._last = np.zeros((len(task.scene.moving), 3))  # an actuator may remember it
        self.planned = False

    @property
    @abstractmethod
    def model(self) -> TransitionModel | None:
        """What it plans with; None before it knows anything."""

    @abstractmethod
    def observe(self, state: Array, action: Array, next_state: Array) -> None:
        """Take note of a transition.

        Parameters
        ----------
        state, next_state : ndarray
            At the ends of one sampling interval, shape (body, 6), SI units.
        action : ndarray
            Held in between, shape (body, 3), world frame, N and N m.
        """

    def update(self) -> None:  # noqa: B027 - regression learns as it observes
        """Bring the model up to date with what was observed."""

    @property
    def estimates(self) -> Mapping[str, float]:
        """Physical parameters that it believes in now, by label; none by default."""
        return {}

    def act(self, state: Array) -> Array:
        """The next action: planned, or at random where there is no plan.

        Parameters
        ----------
        state : ndarray
            Shape (body, 6), SI units.

        Returns
        -------
        ndarray
            One of the task's actions, shape (body, 3), world frame, N and N m.

        Raises
        ------
        KeyboardInterrupt
            If the search was interrupted.
        """
        every = self.task.wrenches(state)
        model = self.model
        self._ahead = self._ahead[:0] if model is None else self._planned(model, state)
        self.planned = len(self._ahead) > 0
        if self.planned:
            wanted, self._ahead = self._ahead[0], self._ahead[1:]
            # a body's heading is not quite what the plan foretold, and with it the wrench
            chosen = int(np.argmin(((every - wanted) ** 2).sum(axis=(1, 2))))
        else:
            chosen = int(self._rng.integers(len(every)))
        self._last = every[chosen]
        return self._last.copy()

    def _planned(self, model: TransitionModel, state: Array) -> Array:
        """Wrenches ahead, shape (time, body, 3): those of before if they still lead to the goal."""
        task = self.task
        if len(self._ahead):
            end = rollout(model.after(self._last), state, self._ahead)[:, -1]
            if float(task.goal.shortfall(task.scene, end).mean()) <= 1.0:  # not where NaN
                return self._ahead
        found = plan(model, state, task.goal, task.actions, before=self._last, **self._options)
        if found.stopped == "interrupted":  # the search keeps it to itself
            raise KeyboardInterrupt
        return found.wrenches if found.reached else found.wrenches[:1]
