"""A world to act in: true dynamics, reward, bumps, and noise on what is observed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.agents.task import Task
from pbrl_ppl.errors import EpisodeError
from pbrl_ppl.physics import touching
from pbrl_ppl.planning import Dynamics, start_state

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of an action.

    Attributes
    ----------
    state : ndarray
        Where it led, shape (body, 6), SI units: the agent acts from there.
    observed : ndarray
        The same as an agent observes it to learn from, with noise.
    reward : float
        Minus the L2 distance from the goal (m).
    bumped : bool
        Whether a body touched a wall or another.
    reached : bool
        Whether the goal is reached: the episode ends.
    """

    state: Array
    observed: Array
    reward: float
    bumped: bool
    reached: bool


class World:
    """The true dynamics of a task, by the package's own engine.

    Noise is on the next state that an agent learns from, Eq. 7's epsilon, as the paper's "training
    observations corrupted by Gaussian noise" (section 5.1). The state that it acts from is exact:
    with 0.25 m of noise on it, bodies would start inside walls.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    parameters : mapping
        True parameters by name, as of :meth:`pbrl_ppl.Dynamics.known`.
    effects : iterable of Effect or Attached
        True effects beside those that the scene declares.
    sigma : float
        Noise of each observed state dimension (m, rad, m/s, rad/s).
    spread : float
        How far an episode's start may be from the task's, either way (m, m, rad): episodes without
        noise differ by it alone.
    substeps : int, optional
        Engine steps an interval; the scene's by default.

    Raises
    ------
    EpisodeError
        If ``sigma`` or ``spread`` is negative or not finite, or a start is to be varied of bodies
        that joints hold.
    ParameterError
        If a parameter is missing, unknown or impossible.

    Examples
    --------
    >>> from pbrl_ppl.planning import ActionSet, Goal
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.2, bodies=(Body("puck", Shape.circle(0.2), pose=(0, 0, 0)),))
    >>> pushes = ActionSet.box("puck", forces=(-4.0, 0.0, 4.0))
    >>> task = Task(scene, Goal.of({"puck": (2.0, 0.0, None)}), pushes)
    >>> world = World(task, {"mass": 2.0, "r": 0.0, "mu_c": 0.0})
    >>> state = world.reset(seed=0)
    >>> round(world.step(task.wrenches(state)[2]).reward, 2)  # pushed for 0.2 s
    -1.96
    """

    def __init__(
        self,
        task: Task,
        parameters: Mapping[str, object],
        effects: Any = (),
        *,
        sigma: float = 0.0,
        spread: float = 0.0,
        substeps: int | None = None,
    ) -> None:
        for name, value in (("sigma", sigma), ("spread", spread)):
            if not 0 <= value < np.inf:
                raise EpisodeError(f"world: {name} is {value}, expected a finite number from 0 up")
        if spread and task.scene.joints:
            raise EpisodeError("world: joints hold bodies of the scene at their start; spread is 0")
        self.task, self.sigma, self.spread = task, float(sigma), float(spread)
        self._truth = Dynamics.known(task.scene, parameters, effects, threads=1, substeps=substeps)
        self.reset(0)

    @property
    def description(self) -> str:
        """Engine and true parameters, those of effects too, as JSON; an episode's file keeps it."""
        truth = self._truth
        values = dict(zip(truth.layout.labels, truth.phi[0].tolist(), strict=True))
        return json.dumps({"engine": type(self).__name__, **values})

    def reset(self, seed: int) -> Array:
        """Back to the start; the seed is that of the noise and the start.

        Returns
        -------
        ndarray
            The state, shape (body, 6), SI units.

        Raises
        ------
        GoalError
            If bodies lie inside each other there.
        """
        self._rng = np.random.default_rng([seed, 1])  # [seed, 0] is the agent's
        state = self.task.start.copy()
        state[:, :3] += self._rng.uniform(-self.spread, self.spread, state[:, :3].shape)
        self._state, self._last = start_state(self.task.scene, state), self._truth.before
        return self._state.copy()

    def step(self, action: Array) -> Outcome:
        """Hold an action over one sampling interval.

        Parameters
        ----------
        action : ndarray
            Wrench on each body, shape (body, 3), world frame, N and N m: one of the task's.

        Raises
        ------
        EpisodeError
            If it is none of the task's actions.
        """
        action = np.asarray(action, dtype=float)
        self.task.check_action(self._state, action)
        begin = self._state
        state = self._play(begin, action)
        self._state, self._last = state, action
        noise = self.sigma * self._rng.standard_normal(state.shape)
        return Outcome(
            state=state.copy(),
            observed=state + noise,
            reward=self.task.reward(state),
            bumped=bool(touching(self.task.scene, begin[None], state[None])[0]),
            reached=self.task.reached(state),
        )

    def _play(self, state: Array, action: Array) -> Array:
        """State (body, 6) after an interval from another."""
        after = self._truth.step(state[None, None], action[None], self._last[None])
        return np.asarray(after[0, 0])
