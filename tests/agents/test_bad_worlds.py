"""Worlds and actions that cannot be: one clear error each."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.agents import Outcome, TrueModelAgent, World, run_episode
from pbrl_ppl.errors import EpisodeError
from tests.helpers.tasks import CART, CART_TRUTH, PUCK, PUCK_TRUTH, puck_world


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
