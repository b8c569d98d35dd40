"""What an agent is told: the scene's geometry, the goal, the actions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import EpisodeError, GoalError
from pbrl_ppl.planning import ActionSet, Goal, start_state
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: By how much an action may differ from one of the set (N and N m): rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Task:
    """A goal in a scene, and the actions that may lead there; nothing of the dynamics.

    Attributes
    ----------
    scene : Scene
        Known geometry. Its bodies start at rest where their ``pose`` says.
    goal : Goal
        An episode ends where it is reached.
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
                f" {self.scene.time_step:g} s; an agent chooses anew after each"
            )
        start_state(self.scene, {})

    @cached_property
    def start(self) -> Array:
        """State where an episode begins, shape (body, 6), SI units."""
        return start_state(self.scene, {})

    def reward(self, state: Array) -> float:
        """Minus the L2 distance of the bodies from their goal (m), as in the paper's section 5."""
        return -float(self.goal.distance(self.scene, state))

    def reached(self, state: Array) -> bool:
        """Whether a state (body, 6) is within the goal's tolerances."""
        return bool(self.goal.shortfall(self.scene, state) <= 1.0)

    def wrenches(self, state: Array) -> Array:
        """All actions in a state (body, 6), shape (action, body, 3), world frame, N and N m."""
        count = len(self.actions.actions)
        heading = np.repeat(state[None, :, 2], count, axis=0)
        return self.actions.wrenches(self.scene, np.arange(count), heading)

    def check_action(self, state: Array, action: Array) -> None:
        """Refuse what is not an action of the set in this state.

        Raises
        ------
        EpisodeError
            It says what was got and what was expected.
        """
        every = self.wrenches(state)
        if action.shape != every.shape[1:]:
            raise EpisodeError(
                f"action: its shape is {action.shape}, expected {every.shape[1:]}: force_x, force_y"
                f" and torque on {', '.join(body.name for body in self.scene.moving)}"
            )
        size = max(1.0, float(abs(every).max()))
        if not (abs(every - action).max(axis=(1, 2)) <= _ROUNDING * size).any():
            raise EpisodeError(
                f"action: {action.tolist()} (N, N, N m; world frame) is none of the task's"
                f" {len(every)} actions; choose one of Task.wrenches(state)"
            )
