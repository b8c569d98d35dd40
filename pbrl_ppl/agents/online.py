"""The online loop: act, observe, update, until the goal is reached."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.agents.agent import Agent
from pbrl_ppl.agents.episode import Episode
from pbrl_ppl.agents.task import Task
from pbrl_ppl.agents.world import Outcome
from pbrl_ppl.errors import EpisodeError
from pbrl_ppl.state import STATE

Array = NDArray[np.float64]


class AnyWorld(Protocol):
    """What the loop needs of a world; :class:`World` is one.

    A string ``description`` is optional: files of worlds with another are not taken for this one's.
    """

    sigma: float

    @property
    def task(self) -> Task:
        """Scene, goal and actions."""

    def reset(self, seed: int) -> Array:
        """Back to the start; the state, shape (body, 6), SI units."""

    def step(self, action: Array) -> Outcome:
        """Hold an action, shape (body, 3), over one sampling interval."""


def run_episode(
    agent: Agent,
    world: AnyWorld,
    *,
    steps: int = 100,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Episode:
    """Let an agent act in a world, and learn, until the goal is reached or the steps are over.

    Parameters
    ----------
    agent : Agent
        Goes on with what it knows: give a new one for a new episode.
    world : World
        Is reset.
    steps : int
        The most actions.
    seed : int
        Of the world's noise. With an agent of the same seed, the same episode.
    progress : callable, optional
        Told where it is.

    Returns
    -------
    Episode
        What happened.

    Raises
    ------
    EpisodeError
        If ``steps`` is below 1, the agent's task is not the world's, the world returns states of
        another shape or that are not finite, or an action is none of the task's.

    Examples
    --------
    ::

        episode = pp.run_episode(pp.PBRLAgent(task, seed=1), world, seed=1)
        episode.steps, episode.bumps
        idata = pp.fit(pp.physics_model(task.scene, episode.history()))
    """
    if steps < 1:
        raise EpisodeError(f"episode: steps is {steps}, expected at least 1")
    if agent.task != world.task:
        raise EpisodeError("episode: the agent and the world have different tasks; give both one")
    task = world.task
    state = checked(task, world.reset(seed), "reset")
    states, rewards, reached = [state], [task.reward(state)], task.reached(state)
    rows: dict[str, list[Any]] = {
        name: [] for name in ("action", "observed", "bumped", "planned", "seconds")
    }
    estimates = []
    while not reached and len(states) <= steps:
        begin = time.monotonic()
        action = np.asarray(agent.act(state), dtype=float)
        task.check_action(state, action)
        chosen = time.monotonic() - begin
        outcome = world.step(action)
        after = checked(task, outcome.state, "step")
        observed = checked(task, outcome.observed, "step")
        begin = time.monotonic()
        agent.observe(state, action, observed)
        agent.update()
        rows["seconds"].append(chosen + time.monotonic() - begin)
        rows["action"].append(action)
        rows["observed"].append(observed)
        rows["bumped"].append(outcome.bumped)
        rows["planned"].append(agent.planned)
        estimates.append(agent.estimates)
        state, reached = after, outcome.reached
        states.append(state)
        rewards.append(outcome.reward)
        if progress is not None:
            progress(f"step {len(estimates)}, {-outcome.reward:.2f} m from the goal")
    recorded = {
        **rows,
        "reward": rewards,
        "bumped": np.array(rows["bumped"], dtype=bool),
        "planned": np.array(rows["planned"], dtype=bool),
        "seconds": np.array(rows["seconds"], dtype=float),
    }
    added = [
        {"effect": each.effect, "body": each.body, "transitions": each.transitions}
        for each in agent.added
    ]
    return Episode.of(
        task.scene, np.array(states), estimates, recorded, agent=agent.name, seed=seed,
        sigma=world.sigma, limit=steps, reached=int(reached), world=described(world),
        added=json.dumps(added),
    )  # fmt: skip


def described(world: AnyWorld) -> str:
    """What the episode's file says of the world; nothing of one that does not describe itself."""
    return str(getattr(world, "description", ""))


def checked(task: Task, given: Any, what: str) -> Array:
    """States that a world returned, shape (body, 6).

    Raises
    ------
    EpisodeError
        If they have another shape, or are not finite.
    """
    state, expected = np.asarray(given, dtype=float), (len(task.scene.moving), len(STATE))
    if state.shape != expected or not np.isfinite(state).all():
        found = f"states of shape {state.shape}"
        if state.shape == expected:
            found = "a state that is not finite"
        raise EpisodeError(
            f"world: {what} returned {found}, expected finite ones of shape {expected}:"
            f" {', '.join(STATE)} of {', '.join(body.name for body in task.scene.moving)}"
        )
    return state
