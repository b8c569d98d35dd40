"""World to act in: true dynamics, reward, collisions and noise; and checks of other worlds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from pbrl_ppl import Attached, Dynamics, Effect, PbrlError, Task
from pbrl_ppl.physics import touching
from pbrl_ppl.planning import start_state
from pbrl_ppl.state import STATE, Floats


class EpisodeError(PbrlError, ValueError):
    """A world, an agent or an episode file that does not fit its task."""


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


class AnyWorld(Protocol):
    """Interface of a world; :class:`World` is one.

    A string ``description`` is optional; an episode file is not reused in a world with another one.
    """

    sigma: float | tuple[float, ...]

    @property
    def task(self) -> Task:
        """Return scene, goal and actions."""

    def reset(self, seed: int) -> Floats:
        """Go back to the start and return the state, shape (body, 6), SI units."""

    def step(self, action: Floats) -> Outcome:
        """Hold an action, shape (body, 3), over one sampling interval."""


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
        effects: Iterable[Effect | Attached] = (),
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
        check_action(self.task, self._state, action)
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


def check_action(task: Task, state: Floats, action: Floats, rounding: float = 1e-9) -> None:
    """Check that an action is one of a task's in a state, up to rounding errors.

    Parameters
    ----------
    task : Task
        Has the actions.
    state, action : ndarray
        Shapes (body, 6) and (body, 3), SI units.
    rounding : float
        Largest difference, as a share of the largest force and the largest torque.

    Raises
    ------
    EpisodeError
        If it is not.
    """
    wrenches = task.wrenches(state)
    if action.shape != wrenches.shape[1:]:
        raise EpisodeError(
            f"action: its shape is {action.shape}, expected {wrenches.shape[1:]}: force_x, force_y"
            f" and torque on {', '.join(body.name for body in task.scene.moving)}"
        )
    force, torque = abs(wrenches[..., :2]).max(), abs(wrenches[..., 2]).max()
    allowed = rounding * np.array([force, force, torque])
    if not (abs(wrenches - action) <= allowed).all(axis=(1, 2)).any():
        raise EpisodeError(
            f"action: {action.tolist()} (N, N, N m; world frame) is none of the task's"
            f" {len(wrenches)} actions; choose one of Task.wrenches(state)"
        )


def check_state(task: Task, given: ArrayLike, method: str) -> Floats:
    """Return a state that a world's method returned, shape (body, 6), after a check.

    Raises
    ------
    EpisodeError
        If it has another shape, or is not finite.
    """
    state, expected = np.asarray(given, dtype=float), (len(task.scene.moving), len(STATE))
    if state.shape != expected or not np.isfinite(state).all():
        found = f"states of shape {state.shape}"
        if state.shape == expected:
            found = "a state that is not finite"
        raise EpisodeError(
            f"world: {method} returned {found}, expected finite ones of shape {expected}:"
            f" {', '.join(STATE)} of {', '.join(body.name for body in task.scene.moving)}"
        )
    return state
