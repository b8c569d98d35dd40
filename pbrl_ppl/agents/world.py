"""Task of an agent, and the world to act in: true dynamics, reward, collisions and noise."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbrl_ppl.errors import EpisodeError, GoalError
from pbrl_ppl.physics import touching
from pbrl_ppl.planning import ActionSet, Dynamics, Goal, start_state
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

#: Largest difference of an action from one of the set, for rounding, as a share of the largest
#: force and the largest torque.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Task:
    """Scene, goal and actions of an agent; the dynamics are unknown to it.

    Attributes
    ----------
    scene : Scene
        Known geometry. Its bodies start at rest at their ``pose``.
    goal : Goal
        An episode ends when it is reached.
    actions : ActionSet
        One is held over each sampling interval: one duration, the scene's ``time_step``.

    Raises
    ------
    GoalError
        If the goal or the actions do not fit the scene, an action is longer than an interval, or a
        body has no pose.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.2, bodies=(Body("puck", Shape.circle(0.2), pose=(0, 0, 0)),))
    >>> pushes = ActionSet.box("puck", forces=(-4.0, 0.0, 4.0))
    >>> task = Task(scene, Goal.of({"puck": (2.0, 0.0, None)}), pushes)
    >>> task.reward(task.start)
    -2.0
    """

    scene: Scene
    goal: Goal
    actions: ActionSet

    def __post_init__(self) -> None:
        self.goal.check(self.scene)
        self.actions.check(self.scene)
        if self.actions.intervals(self.scene) != (1,):
            raise GoalError(
                f"task: actions last {self.actions.durations} s, expected one sampling interval of"
                f" {self.scene.time_step:g} s; an agent chooses an action for each"
            )
        start_state(self.scene, {})

    @property
    def start(self) -> Floats:
        """Return the state at which an episode begins, shape (body, 6), SI units."""
        return start_state(self.scene, {})

    def reward(self, state: Floats) -> float:
        """Return minus the L2 distance of the bodies from their goal (m), as in section 5."""
        return -float(self.goal.distance(self.scene, state))

    def reached(self, state: Floats) -> bool:
        """Return whether a state (body, 6) is within the goal's tolerances."""
        return bool(self.goal.shortfall(self.scene, state) <= 1.0)

    def wrenches(self, state: Floats) -> Floats:
        """Return all actions in a state (body, 6), shape (action, body, 3), world frame, N, N m."""
        count = len(self.actions.actions)
        heading = np.repeat(state[None, :, 2], count, axis=0)
        return self.actions.wrenches(self.scene, np.arange(count), heading)

    def check_action(self, state: Floats, action: Floats) -> None:
        """Check that an action is one of the set in this state.

        Raises
        ------
        EpisodeError
            If it is not.
        """
        every = self.wrenches(state)
        if action.shape != every.shape[1:]:
            raise EpisodeError(
                f"action: its shape is {action.shape}, expected {every.shape[1:]}: force_x, force_y"
                f" and torque on {', '.join(body.name for body in self.scene.moving)}"
            )
        force, torque = abs(every[..., :2]).max(), abs(every[..., 2]).max()
        allowed = _ROUNDING * np.array([force, force, torque])
        if not (abs(every - action) <= allowed).all(axis=(1, 2)).any():
            raise EpisodeError(
                f"action: {action.tolist()} (N, N, N m; world frame) is none of the task's"
                f" {len(every)} actions; choose one of Task.wrenches(state)"
            )


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of an action.

    Attributes
    ----------
    state : ndarray
        Exact next state, shape (body, 6), SI units: the agent acts from it.
    observed : ndarray
        Next state with noise: the agent learns from it.
    reward : float
        Minus the L2 distance from the goal (m).
    bumped : bool
        Whether a body touched a wall or another body.
    reached : bool
        Whether the goal is reached, which ends the episode.
    """

    state: Floats
    observed: Floats
    reward: float
    bumped: bool
    reached: bool


class World:
    """True dynamics of a task, simulated by the package's engine.

    Noise is added to the next state that an agent learns from, Eq. 7's epsilon: the paper's
    "training observations corrupted by Gaussian noise" (section 5.1). The state that it acts from
    is exact: with 0.25 m of noise, bodies would start inside walls.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    parameters : mapping
        True parameters by name, as for :meth:`pbrl_ppl.Dynamics.known`.
    effects : iterable of Effect or Attached
        True effects in addition to those that the scene declares.
    sigma : float or sequence of float
        Noise of each observed state dimension (m, m, rad, m/s, m/s, rad/s): six numbers, or one
        for all.
    spread : float or sequence of float
        Largest offset of an episode's start from the task's, either way (m, m, rad): three numbers,
        or one for all. Without noise, episodes of a deterministic agent differ only by it.
    substeps : int, optional
        Engine steps per interval; the scene's by default.

    Raises
    ------
    EpisodeError
        If ``sigma`` or ``spread`` is negative, not finite or of another length, or ``spread`` is
        given for a scene with joints.
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
        sigma: float | Sequence[float] = 0.0,
        spread: float | Sequence[float] = 0.0,
        substeps: int | None = None,
    ) -> None:
        self.task = task
        self.sigma, self.spread = _sizes("sigma", sigma, 6), _sizes("spread", spread, 3)
        if np.any(self.spread) and task.scene.joints:
            raise EpisodeError("world: joints hold bodies of the scene at their start; spread is 0")
        self._truth = Dynamics.known(task.scene, parameters, effects, threads=1, substeps=substeps)
        self.reset(0)

    @property
    def description(self) -> str:
        """Return engine and true parameters, those of effects too, as JSON for episode files."""
        truth = self._truth
        values = dict(zip(truth.layout.labels, truth.phi[0].tolist(), strict=True))
        return json.dumps({"engine": type(self).__name__, **values})

    def reset(self, seed: int) -> Floats:
        """Go back to the start; the seed is that of the noise and the start.

        Returns
        -------
        ndarray
            The state, shape (body, 6), SI units.

        Raises
        ------
        GoalError
            If bodies overlap there.
        """
        self._rng = np.random.default_rng([seed, 1])  # [seed, 0] is the agent's
        state = self.task.start
        spread = np.asarray(self.spread)
        state[:, :3] += self._rng.uniform(-spread, spread, state[:, :3].shape)
        self._state, self._last = start_state(self.task.scene, state), self._truth.before
        return self._state.copy()

    def step(self, action: Floats) -> Outcome:
        """Hold an action over one sampling interval.

        Parameters
        ----------
        action : ndarray
            Wrench on each body, shape (body, 3), world frame, N and N m: one of the task's.

        Raises
        ------
        EpisodeError
            If it is not one of the task's actions.
        """
        action = np.asarray(action, dtype=float)
        self.task.check_action(self._state, action)
        begin = self._state
        state = self._play(begin, action)
        self._state, self._last = state, action
        noise = np.asarray(self.sigma) * self._rng.standard_normal(state.shape)
        return Outcome(
            state=state.copy(),
            observed=state + noise,
            reward=self.task.reward(state),
            bumped=bool(touching(self.task.scene, begin[None], state[None])[0]),
            reached=self.task.reached(state),
        )

    def _play(self, state: Floats, action: Floats) -> Floats:
        """Return the state (body, 6) after an interval."""
        after = self._truth.step(state[None, None], action[None], self._last[None])
        return np.asarray(after[0, 0])


def _sizes(name: str, given: float | Sequence[float], count: int) -> float | tuple[float, ...]:
    """Return a size, or one for each dimension, after a check."""
    values = np.asarray(given, dtype=float)
    if values.shape not in ((), (count,)) or not ((values >= 0) & (values < np.inf)).all():
        raise EpisodeError(
            f"world: {name} is {given}, expected a finite number from 0 up, or {count} of them"
        )
    return tuple(values.tolist()) if values.ndim else float(values)
