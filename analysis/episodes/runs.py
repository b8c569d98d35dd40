"""Episodes: an agent acts in a world and learns; many agents and seeds over an executor."""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from episodes.episode import VARIABLES, Episode
from episodes.processes import as_ended, processes, processors
from episodes.world import AnyWorld, EpisodeError, check_action, check_state
from pbrl_ppl import Agent, save_posterior

#: Makes an agent from a seed.
MakeAgent = Callable[[int], Agent]


def run_episode(
    agent: Agent,
    world: AnyWorld,
    *,
    steps: int = 100,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Episode:
    """Let an agent act in a world, and learn, until the goal or the limit of steps is reached.

    Parameters
    ----------
    agent : Agent
        Keeps what it has learned: pass a new one for an independent episode.
    world : World
        Is reset first.
    steps : int
        Largest number of actions.
    seed : int
        Seed of the world's noise. With an agent of the same seed, the episode is reproducible.
    progress : callable, optional
        Called with a message after each action.

    Returns
    -------
    Episode
        States, actions, observations, rewards and estimates.

    Raises
    ------
    EpisodeError
        If ``steps`` is below 1, the agent's task is not the world's, the world returns states of
        another shape or that are not finite, or an action is none of the task's.

    Examples
    --------
    ::

        episode = run_episode(pp.PBRLAgent(task, seed=1), world, seed=1)
        episode.steps, episode.bumps
        idata = pp.fit(pp.physics_model(task.scene, episode.history()))
    """
    if steps < 1:
        raise EpisodeError(f"episode: steps is {steps}, expected at least 1")
    if agent.task != world.task:
        raise EpisodeError("episode: the agent and the world have different tasks; give both one")
    task = world.task
    state = check_state(task, world.reset(seed), "reset")
    reached = task.reached(state)
    rows: dict[str, list[Any]] = {name: [] for name in VARIABLES}
    rows["states"].append(state)
    rows["reward"].append(task.reward(state))
    while not reached and len(rows["action"]) < steps:
        begin = time.monotonic()
        action = np.asarray(agent.act(state), dtype=float)
        check_action(task, state, action)
        chosen = time.monotonic() - begin
        outcome = world.step(action)
        after = check_state(task, outcome.state, "step")
        observed = check_state(task, outcome.observed, "step")
        begin = time.monotonic()
        agent.observe(state, action, observed)
        agent.update()
        row = {
            "seconds": chosen + time.monotonic() - begin,
            "action": action,
            "observed": observed,
            "bumped": outcome.bumped,
            "planned": agent.planned,
            "estimate": agent.estimates,
            "states": after,
            "reward": outcome.reward,
        }
        for name, value in row.items():
            rows[name].append(value)
        state, reached = after, outcome.reached
        if progress is not None:
            progress(f"step {len(rows['action'])}, {-outcome.reward:.3g} m from the goal")
    added = [
        {"effect": each.effect, "body": each.body, "transitions": each.transitions}
        for each in agent.added
    ]
    return Episode.of(
        task.scene, rows, agent=agent.name, seed=seed, sigma=world.sigma, limit=steps,
        reached=int(reached), world=_description(world), added=json.dumps(added),
    )  # fmt: skip


def run_episodes(
    agents: Mapping[str, MakeAgent],
    world: AnyWorld,
    seeds: Iterable[int],
    folder: str | Path,
    *,
    steps: int = 100,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[str], None] | None = None,
) -> dict[str, list[Episode]]:
    """Run each agent with each seed; skip the episodes whose files are in the folder.

    Parameters
    ----------
    agents : mapping
        Functions that make an agent from a seed, by the name of their files:
        ``{"pbrl": make_pbrl}``. Other processes need functions that can be pickled, such as
        ``functools.partial`` of one in a module.
    world : World
        Each episode resets it, or a copy of it.
    seeds : iterable of int
        One episode each.
    folder : str or Path
        Folder of the files ``<name>-<seed>.nc``, and of ``<name>-<seed>.posterior.nc``, the last
        posterior of agents that have one, for :func:`pbrl_ppl.load_posterior`. Made if missing.
    steps : int
        Largest number of actions of an episode.
    workers : int, optional
        Processes to start for the episodes; as many as there are processors by default. A script
        must then call this under ``if __name__ == "__main__":``, because each process imports it.
        With 1, or a single episode to run, episodes run in this process, one after the other.
    executor : Executor, optional
        Runs the episodes instead: threads, Dask.
    progress : callable, optional
        Called with a message after each episode.

    Returns
    -------
    dict
        Episodes of each agent, in the order of the seeds.

    Raises
    ------
    EpisodeError
        If a file in the folder is of another scene, world, start, noise or limit of steps, a
        function cannot be sent to another process, a process ended too early, or as
        :func:`run_episode`.
    OutputError
        If a file cannot be written.
    KeyboardInterrupt
        If it is interrupted, with a message: the files of finished episodes stay, and the same call
        continues.

    Examples
    --------
    ::

        def learner(seed):
            return pp.PBRLAgent(task, seed=seed)

        if __name__ == "__main__":
            done = run_episodes({"pbrl": learner}, world, range(10), "out/cart")
            # with dask.distributed, whose workers write into the same folder
            with Client("tcp://host:8786") as client:
                executor = client.get_executor(pure=False)
                run_episodes({"pbrl": learner}, world, range(20), "out/cart", executor=executor)
    """
    if workers is not None and workers < 1:
        raise EpisodeError(f"episodes: workers is {workers}, expected at least 1")
    folder, seeds = Path(folder), list(seeds)
    folder.mkdir(parents=True, exist_ok=True)
    report = progress or (lambda _: None)
    paths = {(name, seed): folder / f"{name}-{seed}.nc" for name in agents for seed in seeds}
    found = {
        key: _stored(path, world, steps, key[1]) for key, path in paths.items() if path.is_file()
    }
    if found:
        report(f"{len(found)} of {len(paths)} episodes are in {folder}")
    waiting = {
        (name, seed): (agents[name], world, seed, steps, path)
        for (name, seed), path in paths.items()
        if (name, seed) not in found
    }

    def finished(key: tuple[str, int], episode: Episode) -> None:
        found[key] = episode
        how = "reached the goal" if episode.reached else "did not reach the goal"
        report(
            f"{len(found)}/{len(paths)} {episode.agent}, seed {episode.seed}: {how} in"
            f" {episode.steps} steps, {episode.bumps} with bumps"
        )

    at_once = min(processors() if workers is None else workers, len(waiting))
    try:
        tasks = {key: partial(_run_and_save, *arguments) for key, arguments in waiting.items()}
        pool: AbstractContextManager[Executor | None] = nullcontext(executor)
        if executor is None and at_once > 1:
            _check_pickled(agents, world)
            pool = processes(at_once)
        with pool as runner, closing(as_ended(tasks, runner)) as ended:
            for key, result in ended:
                finished(key, result())
    except KeyboardInterrupt:
        message = f"{len(found)} of {len(paths)} episodes are in {folder}; run it again"
        raise KeyboardInterrupt(message) from None
    return {name: [found[name, seed] for seed in seeds] for name in agents}


def _check_pickled(agents: Mapping[str, MakeAgent], world: AnyWorld) -> None:
    """Check that agents' functions and the world can be sent to another process."""
    given = {f"what makes agent {name!r}": make for name, make in agents.items()}
    for what, each in {**given, "the world": world}.items():
        try:
            pickle.dumps(each)
        except Exception as error:  # classes may raise anything
            raise EpisodeError(
                f"episodes: {what} cannot be sent to another process ({error}); use functions and"
                " classes of a module, or give workers=1"
            ) from None


def _run_and_save(make: MakeAgent, world: AnyWorld, seed: int, steps: int, path: Path) -> Episode:
    """Run one episode and save it, the episode's file last: it marks a finished episode."""
    agent = make(seed)
    episode = run_episode(agent, world, steps=steps, seed=seed)
    if agent.posterior is not None:
        save_posterior(agent.posterior, path.with_suffix(".posterior.nc"))
    episode.save(path)
    return episode


def _stored(path: Path, world: AnyWorld, steps: int, seed: int) -> Episode:
    """Return the episode of a file; check seed, noise, limit, world and start."""
    episode = Episode.load(path, world.task.scene)
    expected = {"seed": seed, "sigma": world.sigma, "limit": steps}
    for name, value in expected.items():
        if not np.array_equal(got := episode.dataset.attrs[name], value):
            raise EpisodeError(
                f"{path}: this is an episode with {name} {got}, expected {value}; give another"
                " folder"
            )
    if episode.dataset.attrs.get("world", "") != _description(world):
        raise EpisodeError(
            f"{path}: this is an episode in another world: its engine, true parameters or effects"
            " are not these; give another folder"
        )
    if not np.array_equal(episode.dataset["states"][0], world.reset(seed)):
        raise EpisodeError(f"{path}: this episode starts elsewhere; give another folder")
    return episode


def _description(world: AnyWorld) -> str:
    """Return a world's description for an episode's file; empty if it has none."""
    return str(getattr(world, "description", ""))
