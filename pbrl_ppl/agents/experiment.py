"""Many episodes: agents by seeds, over any executor; what is finished is kept."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, as_completed
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from pbrl_ppl.agents.agent import Agent
from pbrl_ppl.agents.episode import Episode
from pbrl_ppl.agents.online import AnyWorld, described, run_episode
from pbrl_ppl.agents.processes import processes, processors
from pbrl_ppl.errors import EpisodeError
from pbrl_ppl.posterior import save_posterior

#: Makes an agent of a seed.
MakeAgent = Callable[[int], Agent]


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
        What makes an agent of a seed, by the name of its files: ``{"pbrl": make_pbrl}``. Other
        processes need functions that can be pickled, such as ``functools.partial`` of one in a
        module.
    world : World
        Each episode resets it, or a copy of it.
    seeds : iterable of int
        One episode each.
    folder : str or Path
        Of the files, ``<name>-<seed>.nc``, and ``<name>-<seed>.posterior.nc`` of agents that have a
        posterior: the last, for :func:`pbrl_ppl.load_posterior`. Made if it is not there.
    steps : int
        The most actions of an episode.
    workers : int, optional
        Processes that are started for the episodes, as many as there are processors by default. A
        script must then call this under ``if __name__ == "__main__":``, for each process imports
        it. With 1, or one episode to run, they run here, one after the other.
    executor : Executor, optional
        Where the episodes run instead: threads, Dask.
    progress : callable, optional
        Told of each episode that is finished.

    Returns
    -------
    dict
        Episodes of each agent, in the order of the seeds.

    Raises
    ------
    EpisodeError
        If a file there is of another scene, world, start, noise or limit of steps, what makes an
        agent cannot be sent to another process, one ended too early, or as :func:`run_episode`.
    OutputError
        If a file cannot be written.
    KeyboardInterrupt
        If it is interrupted: the files of finished episodes stay, and the same call goes on. It
        says so.

    Examples
    --------
    ::

        def learner(seed):
            return pp.PBRLAgent(task, seed=seed)

        if __name__ == "__main__":
            done = pp.run_episodes({"pbrl": learner}, world, range(10), "out/cart")
            # with dask.distributed, whose workers write into the same folder
            with Client("tcp://host:8786") as client:
                executor = client.get_executor(pure=False)
                pp.run_episodes({"pbrl": learner}, world, range(20), "out/cart", executor=executor)
    """
    if workers is not None and workers < 1:
        raise EpisodeError(f"episodes: workers is {workers}, expected at least 1")
    folder, seeds = Path(folder), list(seeds)
    folder.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda _: None)
    paths = {(name, seed): folder / f"{name}-{seed}.nc" for name in agents for seed in seeds}
    found = {
        key: _same(path, world, steps, key[1]) for key, path in paths.items() if path.is_file()
    }
    count = len(found)
    if count:
        tell(f"{count} of {len(paths)} episodes are in {folder}")

    def finished(key: tuple[str, int], episode: Episode) -> None:
        found[key] = episode
        tell(f"{len(found)}/{len(paths)} {in_words(episode)}")

    left = [key for key in paths if key not in found]
    at_once = min(processors() if workers is None else workers, len(left))
    try:
        if executor is None and at_once < 2:
            for key in left:
                finished(key, _played(agents[key[0]], world, key[1], steps, paths[key]))
        else:
            if executor is None:
                _check_pickled(agents, world)
            with processes(at_once) if executor is None else nullcontext(executor) as pool:
                futures = {
                    pool.submit(_played, agents[key[0]], world, key[1], steps, paths[key]): key
                    for key in left
                }
                try:
                    for future in as_completed(futures):
                        finished(futures[future], future.result())
                finally:
                    for future in futures:
                        future.cancel()
    except KeyboardInterrupt:
        said = f"{len(found)} of {len(paths)} episodes are in {folder}; run it again"
        raise KeyboardInterrupt(said) from None
    return {name: [found[name, seed] for seed in seeds] for name in agents}


def in_words(episode: Episode) -> str:
    """One line: who, and how it went."""
    how = "reached the goal" if episode.reached else "did not reach the goal"
    return (
        f"{episode.agent}, seed {episode.seed}: {how} in {episode.steps} steps,"
        f" {episode.bumps} with bumps"
    )


def _check_pickled(agents: Mapping[str, MakeAgent], world: AnyWorld) -> None:
    """Refuse what cannot be sent to another process."""
    given = {f"what makes agent {name!r}": make for name, make in agents.items()}
    for what, each in {**given, "the world": world}.items():
        try:
            pickle.dumps(each)
        except Exception as error:  # classes raise what they like
            raise EpisodeError(
                f"episodes: {what} cannot be sent to another process ({error}); use functions and"
                " classes of a module, or give workers=1"
            ) from None


def _played(make: MakeAgent, world: AnyWorld, seed: int, steps: int, path: Path) -> Episode:
    """Run one episode and save it, where it ran; its own file last, for that says it is done."""
    agent = make(seed)
    episode = run_episode(agent, world, steps=steps, seed=seed)
    if agent.posterior is not None:
        save_posterior(agent.posterior, path.with_suffix(".posterior.nc"))
    episode.save(path)
    return episode


def _same(path: Path, world: AnyWorld, steps: int, seed: int) -> Episode:
    """An episode that was run before, of the same experiment."""
    episode = Episode.load(path, world.task.scene)
    expected = {"seed": seed, "sigma": world.sigma, "limit": steps}
    for name, value in expected.items():
        if (got := episode.dataset.attrs[name]) != value:
            raise EpisodeError(
                f"{path}: this is an episode with {name} {got}, expected {value}; give another"
                " folder"
            )
    if episode.dataset.attrs.get("world", "") != described(world):
        raise EpisodeError(
            f"{path}: this is an episode in another world: its engine, true parameters or effects"
            " are not these; give another folder"
        )
    if not np.array_equal(episode.dataset["states"][0], world.reset(seed)):
        raise EpisodeError(f"{path}: this episode starts elsewhere; give another folder")
    return episode
