"""Worlds as Gymnasium environments."""

import os
import runpy
import subprocess
import sys

import numpy as np
import pytest
from episodes import EpisodeError, World, run_episode
from episodes.environment import Environment
from gymnasium.utils.env_checker import check_env

from pbrl_ppl.agents import TrueModelAgent
from tests.helpers.places import ROOT
from tests.helpers.tasks import PUCK, PUCK_TRUTH, puck_world


# bodies may be anywhere, and as fast as they are pushed
@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
@pytest.mark.parametrize("sigma", [0.0, 0.25])
def test_gymnasium_accepts_it(sigma) -> None:
    check_env(Environment(puck_world(sigma), steps=20), skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
@pytest.mark.parametrize("model", ["shopping_cart", "apartment"])
def test_gymnasium_accepts_the_papers_worlds(model) -> None:
    task = runpy.run_path(str(ROOT / "models" / model / "task.py"))
    environment = Environment(World(task["TASK"], task["TRUTH"], sigma=0.25), steps=20)
    check_env(environment, skip_render_check=True)
    assert environment.observation_space.shape == (len(task["SCENE"].moving), 6)


def test_an_agent_gets_what_the_world_gives() -> None:
    """The actions of an episode, played again: the same observations, rewards and end."""
    episode = run_episode(TrueModelAgent(PUCK, PUCK_TRUTH), puck_world(0.1), steps=40, seed=4)
    data, environment = episode.dataset, Environment(puck_world(0.1))
    observation, info = environment.reset(seed=4)
    np.testing.assert_array_equal(observation, data["states"][0])
    for i, wrench in enumerate(data["action"].to_numpy()):
        every = PUCK.wrenches(info["state"])
        number = int(abs(every - wrench).sum(axis=(1, 2)).argmin())
        observation, reward, terminated, truncated, info = environment.step(number)
        np.testing.assert_array_equal(observation, data["observed"][i])
        np.testing.assert_array_equal(info["state"], data["states"][i + 1])
        assert (reward, info["bumped"]) == (data["reward"][i + 1], data["bumped"][i])
        assert (terminated, truncated) == (i + 1 == episode.steps, False)
    with pytest.raises(EpisodeError, match="call reset first"):
        environment.step(0)


def test_truncation_and_seeds() -> None:
    environment = Environment(puck_world(0.1), steps=2)
    environment.reset(seed=1)
    assert environment.step(0)[2:4] == (False, False)
    assert environment.step(0)[2:4] == (False, True)
    environment.reset()
    first = environment.step(0)[0]
    environment.reset()
    assert (environment.step(0)[0] != first).all()  # the noise goes on without a seed


@pytest.mark.parametrize("action", [9, -1, 1.0, True, None, np.zeros(3), "0"])
def test_actions_outside_the_bounds(action) -> None:
    environment = Environment(puck_world())
    environment.reset(seed=0)
    with pytest.raises(EpisodeError, match=r"outside its bounds, expected .* from 0 to 8"):
        environment.step(action)


def test_bad_requests() -> None:
    with pytest.raises(EpisodeError, match="steps is 0"):
        Environment(puck_world(), steps=0)

    class Broken:
        task, sigma = PUCK, 0.0

        def reset(self, seed):
            return np.zeros(6)

    with pytest.raises(EpisodeError, match=r"reset returned states of shape \(6,\)"):
        Environment(Broken()).reset(seed=0)


@pytest.mark.one_stack
@pytest.mark.parametrize(
    ("module", "missing"), [("environment", "gymnasium"), ("box2d_world", "Box2D")]
)
def test_what_is_not_installed_is_named(module, missing) -> None:
    code = f"import sys; sys.modules[{missing!r}] = None; import episodes.{module}"
    ran = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT / "analysis",
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "EpisodeError" in ran.stderr and "pip install 'pbrl_ppl[paper]'" in ran.stderr
