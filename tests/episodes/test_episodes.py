"""Episodes and their files, invalid worlds and actions, and processes for episodes."""

import os
import pickle
import time
import warnings
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import active_children

import numpy as np
import pytest
from episodes import (
    Episode,
    EpisodeError,
    Outcome,
    World,
    processes,
    run_episode,
    run_episodes,
)

from pbrl_ppl.agents import Agent, Revision, TrueModelAgent
from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import UninformedWarning
from pbrl_ppl.history import from_segments
from pbrl_ppl.model import physics_model
from pbrl_ppl.posterior import group, load_posterior
from pbrl_ppl.sampling import fit
from tests.helpers.tasks import CART, CART_TRUTH, PUCK, PUCK_TRUTH, puck_world


def known(seed: int) -> Agent:
    return TrueModelAgent(PUCK, PUCK_TRUTH, seed=seed)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return run_episode(known(1), puck_world(0.1), steps=40, seed=1)


def test_file(episode, tmp_path) -> None:
    episode.save(tmp_path / "episode.nc")
    assert [path.name for path in tmp_path.iterdir()] == ["episode.nc"]
    loaded = Episode.load(tmp_path / "episode.nc", PUCK.scene)
    assert loaded.scene == PUCK.scene
    assert loaded.dataset.identical(episode.dataset)
    assert (loaded.agent, loaded.seed, loaded.reached) == ("true model", 1, True)


def test_record(episode) -> None:
    data = episode.dataset
    assert data.sizes["time"] == episode.steps + 1
    distance = PUCK.goal.distance(PUCK.scene, data["states"].to_numpy())
    np.testing.assert_allclose(data["reward"], -distance)
    padded = episode.rewards(40)
    assert padded.shape == (41,) and (padded[episode.steps :] == -distance[-1]).all()


def test_history_is_what_was_observed(episode) -> None:
    """Each transition from its exact state to a noisy one."""
    pieces = episode.history().segments()
    assert pieces.n == episode.steps
    np.testing.assert_array_equal(pieces.start, episode.dataset["states"][:-1])
    np.testing.assert_array_equal(pieces.observed[:, 0], episode.dataset["observed"])
    np.testing.assert_array_equal(pieces.actions[:, 0], episode.dataset["action"])


def test_refused_files(episode, tmp_path) -> None:
    path = tmp_path / "episode.nc"
    with pytest.raises(EpisodeError, match="no such file"):
        Episode.load(path)
    path.write_text("nothing")
    with pytest.raises(EpisodeError, match="not a NetCDF file"):
        Episode.load(path)
    episode.save(path)
    with pytest.raises(EpisodeError, match=r"another scene \(walls differ\)"):
        Episode.load(path, PUCK.scene.replace(walls=()))
    episode.dataset.drop_vars("reward").to_netcdf(path, engine="h5netcdf")
    with pytest.raises(EpisodeError, match="variable 'reward' has dimensions None"):
        Episode.load(path)
    episode.history().save(path)
    with pytest.raises(EpisodeError, match="no episode file"):
        Episode.load(path)


def test_finished_episodes_are_not_run_again(tmp_path) -> None:
    said: list[str] = []
    run = partial(run_episodes, {"true": known}, puck_world(), steps=30, folder=tmp_path)
    (first,) = run(seeds=[1], progress=said.append)["true"]
    end = "reached" if first.reached else "did not reach"
    assert said == [f"1/1 true model, seed 1: {end} the goal in {first.steps} steps, "
                    f"{first.bumps} with bumps"]  # fmt: skip
    said.clear()
    with ThreadPoolExecutor(1) as executor:
        both = run(seeds=[1, 2], executor=executor, progress=said.append)["true"]
    assert said[0] == f"1 of 2 episodes are in {tmp_path}" and len(said) == 2
    assert [each.seed for each in both] == [1, 2]
    assert both[0].dataset.identical(first.dataset)
    with pytest.raises(EpisodeError, match=r"sigma 0.0, expected 0.25; give another folder"):
        run_episodes({"true": known}, puck_world(0.25), [1], tmp_path, steps=30)
    with pytest.raises(EpisodeError, match=r"limit 30, expected 31"):
        run_episodes({"true": known}, puck_world(), [1], tmp_path, steps=31)
    with pytest.raises(EpisodeError, match="episode in another world"):
        run_episodes({"true": known}, World(PUCK, {"mass": 2.1}), [1], tmp_path, steps=30)
    drag = {effect.name: effect for effect in catalogue}["linear_drag"]
    dragged = World(PUCK, PUCK_TRUTH | {"linear_drag_coefficient": 0.0}, (drag,))
    with pytest.raises(EpisodeError, match="episode in another world"):
        run_episodes({"true": known}, dragged, [1], tmp_path, steps=30)
    with pytest.raises(EpisodeError, match="starts elsewhere"):
        run_episodes({"true": known}, World(PUCK, PUCK_TRUTH, spread=0.1), [1], tmp_path, steps=30)


class Here(Executor):
    """Runs what could be sent to another process at once."""

    def submit(self, fn, /, *args) -> Future:
        future = Future()
        future.set_result(pickle.loads(pickle.dumps(fn))(*pickle.loads(pickle.dumps(args))))
        return future


def test_processes_by_default(tmp_path, monkeypatch) -> None:
    """As many as there are processors, but no more than episodes, and none for a single one."""
    asked: list[int] = []

    @contextmanager
    def started(workers):
        asked.append(workers)
        yield Here()

    monkeypatch.setattr("episodes.runs.processes", started)
    monkeypatch.setattr("episodes.runs.processors", lambda: 4)
    run = partial(run_episodes, {"true": known}, puck_world(), folder=tmp_path, steps=1)
    for seeds in (range(1), range(3), range(9)):
        assert [each.seed for each in run(seeds=seeds)["true"]] == list(seeds)
    assert asked == [2, 4]
    run(seeds=range(12), workers=2)
    assert asked == [2, 4, 2]
    with pytest.raises(EpisodeError, match="workers is 0, expected at least 1"):
        run(seeds=[1], workers=0)
    with pytest.raises(EpisodeError, match=r"what makes agent 'own' cannot be sent .* workers=1"):
        run_episodes({"own": lambda seed: known(seed)}, puck_world(), range(2), tmp_path)


@pytest.mark.one_stack
def test_dask(tmp_path) -> None:
    """Its workers as threads: what processes need is above."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(
        processes=False, n_workers=2, threads_per_worker=1, dashboard_address=":0",
        local_directory=tmp_path / "dask",
    ) as client:  # fmt: skip
        done = run_episodes(
            {"true": known}, puck_world(), range(3), tmp_path / "episodes", steps=1,
            executor=client.get_executor(pure=False),
        )["true"]  # fmt: skip
    assert [each.seed for each in done] == [0, 1, 2]
    assert len(list((tmp_path / "episodes").iterdir())) == 3


class Interrupted(Agent):
    """Somebody presses Ctrl-C in the middle of its second action."""

    name = "interrupted"
    model = None

    def observe(self, state, action, next_state) -> None:
        self.seen = True

    def act(self, state):
        if hasattr(self, "seen"):
            raise KeyboardInterrupt
        return super().act(state)


def test_an_interrupt_keeps_finished_episodes(tmp_path) -> None:
    agents = {"true": known, "other": lambda seed: Interrupted(PUCK, seed=seed)}
    with pytest.raises(KeyboardInterrupt, match=f"^1 of 2 episodes are in {tmp_path}; run it"):
        run_episodes(agents, puck_world(), [1], tmp_path, steps=30, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["true-1.nc"]


def test_an_interrupted_search_ends_the_episode(monkeypatch) -> None:
    """A* returns the best plan so far; nobody wants it acted on."""

    def pressed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pbrl_ppl.planning.astar.contact_cost", pressed)
    with pytest.raises(KeyboardInterrupt):
        run_episode(known(1), puck_world())


class Believing(TrueModelAgent):
    """Fits once, after its first action, and finds an effect missing."""

    def update(self) -> None:
        if self.posterior is None:
            drag = {effect.name: effect for effect in catalogue}["linear_drag"]
            state = PUCK.start[None]
            history = from_segments(PUCK.scene, state, 0 * state[:, None, :, :3], state[:, None])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UninformedWarning)
                model = physics_model(PUCK.scene, history, sigma="scalar")
                self.posterior = fit(model, seed=1, method="map", progress=False)
            self.added = (Revision(drag.on("puck"), 1, 10.0, 0.5),)


def test_what_an_agent_believed_is_kept(tmp_path) -> None:
    agents = {"pbrl": lambda seed: Believing(PUCK, PUCK_TRUTH, seed=seed), "true": known}
    done = run_episodes(agents, puck_world(), [1], tmp_path, steps=1, workers=1)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"pbrl-1.nc", "pbrl-1.posterior.nc", "true-1.nc"}
    found = group(load_posterior(tmp_path / "pbrl-1.posterior.nc"), "posterior")
    assert found["mass"].sizes == {"chain": 1, "draw": 1, "body": 1}
    loaded = Episode.load(tmp_path / "pbrl-1.nc")
    assert loaded.added == [{"effect": "linear_drag", "body": "puck", "transitions": 1}]
    assert done["true"][0].added == []


# -- invalid worlds and actions --------------------------------------------------------------------


class Broken(World):
    """Returns something else after the first action."""

    def __init__(self, broken: np.ndarray) -> None:
        super().__init__(PUCK, PUCK_TRUTH)
        self.broken = broken

    def step(self, action: np.ndarray) -> Outcome:
        return replace(super().step(action), state=self.broken)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (np.full((1, 6), np.nan), "step returned a state that is not finite"),
        (np.zeros(6), r"step returned states of shape \(6,\), expected finite ones of shape"),
    ],
)
def test_broken_worlds(broken, said) -> None:
    with pytest.raises(EpisodeError, match=said):
        run_episode(TrueModelAgent(PUCK, PUCK_TRUTH), Broken(broken))


def test_actions_outside_the_set() -> None:
    world = puck_world()
    with pytest.raises(EpisodeError, match="none of the task's 9 actions"):
        world.step([[4.0, 4.0, 0.1]])
    with pytest.raises(EpisodeError, match=r"expected \(1, 3\): force_x, force_y and torque"):
        world.step([4.0, 4.0, 0.0])
    with pytest.raises(EpisodeError, match="none of the task's"):
        world.step([[np.nan, 4.0, 0.0]])
    with pytest.raises(EpisodeError, match="none of the task's"):
        run_episode(_strong(), puck_world())


def _strong() -> TrueModelAgent:
    agent = TrueModelAgent(PUCK, PUCK_TRUTH)
    agent.act = lambda state: 2.0 * TrueModelAgent.act(agent, state)
    return agent


def test_other_bad_requests() -> None:
    with pytest.raises(EpisodeError, match="sigma is -1"):
        World(PUCK, PUCK_TRUTH, sigma=-1.0)
    with pytest.raises(EpisodeError, match="spread is nan"):
        World(PUCK, PUCK_TRUTH, spread=np.nan)
    with pytest.raises(EpisodeError, match="steps is 0"):
        run_episode(TrueModelAgent(PUCK, PUCK_TRUTH), puck_world(), steps=0)
    with pytest.raises(EpisodeError, match="different tasks"):
        run_episode(TrueModelAgent(CART, CART_TRUTH), puck_world())


# -- processes -------------------------------------------------------------------------------------


@pytest.mark.one_stack
def test_an_interrupt_ends_them_at_once() -> None:
    """Of the caller alone, while one is busy for a minute."""
    before, begin = set(active_children()), time.monotonic()
    with pytest.raises(KeyboardInterrupt), processes(2) as executor:
        pids = [executor.submit(os.getpid) for _ in range(2)]
        waiting = [executor.submit(time.sleep, 60.0) for _ in range(4)]
        wait(pids)
        raise KeyboardInterrupt
    for child in set(active_children()) - before:
        child.join(10.0)
    while not all(future.done() for future in waiting) and time.monotonic() - begin < 30.0:
        time.sleep(0.01)  # the executor's own thread cancels what waits
    assert all(future.done() for future in waiting) and time.monotonic() - begin < 30.0
    assert os.getpid() not in {each.result() for each in pids}


@pytest.mark.one_stack
def test_a_process_that_dies() -> None:
    with pytest.raises(EpisodeError, match="ended before its call"), processes(1) as executor:
        executor.submit(os._exit, 1).result()
    with pytest.raises(EpisodeError, match="workers is 0"), processes(0):
        pass
