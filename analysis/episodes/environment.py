"""A world as a Gymnasium environment, for agents of other libraries."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from episodes.world import AnyWorld, EpisodeError, check_state
from pbrl_ppl.state import STATE, Floats

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:  # an optional dependency
    raise EpisodeError(
        f"environment: {error}; install Gymnasium: pip install 'pbrl_ppl[paper]'"
    ) from None


class Environment(gymnasium.Env[Floats, np.int64]):
    """World as a ``gymnasium.Env``.

    An action is the index of one of the task's actions, which are wrenches in the bodies' frames.
    An observation is the state of every body, with the world's noise; :meth:`reset` returns the
    exact start. ``info`` has the exact ``state`` and whether a body ``bumped`` into something. The
    episode ends (``terminated``) when the goal is reached.

    Parameters
    ----------
    world : World
        Or another object with ``task``, ``reset(seed)`` and ``step(action)``.
    steps : int, optional
        Number of actions after which an episode is ``truncated``; never by default.

    Attributes
    ----------
    world : World
        The world.
    observation_space : gymnasium.spaces.Box
        States, shape (body, 6), SI units.
    action_space : gymnasium.spaces.Discrete
        Indices of the task's actions.

    Raises
    ------
    EpisodeError
        If ``steps`` is below 1, an action is not in the action space, the episode has not begun or
        has ended, or the world returns states of another shape or that are not finite.

    Examples
    --------
    >>> from episodes import World
    >>> from pbrl_ppl.agents import Task
    >>> from pbrl_ppl.planning import ActionSet, Goal
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.2, bodies=(Body("puck", Shape.circle(0.2), pose=(0, 0, 0)),))
    >>> pushes = ActionSet.box("puck", forces=(-4.0, 0.0, 4.0))
    >>> task = Task(scene, Goal.of({"puck": (2.0, 0.0, None)}), pushes)
    >>> environment = Environment(World(task, {"mass": 2.0, "r": 0.0, "mu_c": 0.0}), steps=50)
    >>> observation, info = environment.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = environment.step(2)
    >>> round(reward, 2), terminated, truncated
    (-1.96, False, False)
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, world: AnyWorld, *, steps: int | None = None) -> None:
        if steps is not None and steps < 1:
            raise EpisodeError(f"environment: steps is {steps}, expected at least 1, or None")
        self.world, self._limit = world, steps
        shape = (len(world.task.scene.moving), len(STATE))
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float64)
        self.action_space = spaces.Discrete(len(world.task.actions.actions))
        self._state: Floats | None = None
        self._taken = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Go back to the start.

        Parameters
        ----------
        seed : int, optional
            Seed of the world, as for :func:`episodes.run_episode`; drawn from the environment's
            generator by default.
        options : dict, optional
            Ignored.

        Returns
        -------
        observation : ndarray
            Exact states, shape (body, 6), SI units.
        info : dict
            See :meth:`step`.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._state = check_state(self.world.task, self.world.reset(seed), "reset")
        self._taken = 0
        return self._state.copy(), {"state": self._state.copy(), "bumped": False}

    def step(self, action: np.int64) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Hold an action over one sampling interval.

        Parameters
        ----------
        action : int
            Index of one of the task's actions.

        Returns
        -------
        observation : ndarray
            Shape (body, 6), SI units, with the world's noise.
        reward : float
            Minus the L2 distance from the goal (m), as in the paper's section 5.
        terminated, truncated : bool
            Whether the goal, or the limit of steps, is reached.
        info : dict
            Exact ``state``, and ``bumped``.
        """
        if self._state is None:
            raise EpisodeError("environment: no episode is under way; call reset first")
        # the space contains no numbers of other types, such as Python's int
        whole = isinstance(action, int | np.integer) and not isinstance(action, bool)
        if not whole or not self.action_space.contains(int(action)):
            raise EpisodeError(
                f"environment: action {action!r} is outside its bounds, expected a whole number"
                f" from 0 to {int(self.action_space.n) - 1}"
            )
        task = self.world.task
        outcome = self.world.step(task.wrenches(self._state)[int(action)])
        state = check_state(task, outcome.state, "step")
        observed = check_state(task, outcome.observed, "step")
        self._taken += 1
        reached = bool(outcome.reached)
        truncated = not reached and self._limit is not None and self._taken >= self._limit
        self._state = None if reached or truncated else state
        info = {"state": state.copy(), "bumped": bool(outcome.bumped)}
        return observed.copy(), float(outcome.reward), reached, truncated, info
