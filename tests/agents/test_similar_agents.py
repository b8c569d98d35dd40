"""Agents and worlds of physically similar carts: the same decisions."""

from contextlib import nullcontext

import numpy as np
import pytest
from episodes import EpisodeError, World

from pbrl_ppl.agents import PBRLAgent, TrueModelAgent
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.scene import body_sizes
from tests.helpers.similar_plan import RIGS, Similar
from tests.helpers.tasks import CART, CART_TRUTH

pytestmark = pytest.mark.one_stack
ONE = Similar(1.0, 1.0, 1.0)


class Refit(Exception):
    """What an agent asks for that is surprised."""


def refit(*_, **__) -> None:
    raise Refit


@pytest.mark.parametrize("rig", [ONE, *RIGS])
@pytest.mark.parametrize("dimension", range(6))
def test_an_agent_is_surprised_by_an_error_of_any_dimension(rig, dimension, monkeypatch) -> None:
    """Not by half a ten-thousandth of the cart (or of it in an interval), but by two."""
    monkeypatch.setattr("pbrl_ppl.agents.pbrl.sample", refit)
    task = rig.task(CART)
    action = task.wrenches(task.start)[0]
    for size, surprised in ((0.5e-4, False), (2e-4, True)):
        agent = PBRLAgent(task)
        agent.model = Dynamics.known(task.scene, rig.parameters(CART_TRUTH), threads=1)
        after = agent.model.step(task.start[None, None], action[None])[0, 0]
        after[:, dimension] += size * body_sizes(task.scene)[:, dimension]
        agent.observe(task.start, action, after)
        with pytest.raises(Refit) if surprised else nullcontext():
            agent.update()


@pytest.mark.parametrize("rig", RIGS)
def test_an_episode_is_similar(rig) -> None:
    """Noise and spread of each dimension, and the action nearest to the plan's."""
    found = []
    for one in (ONE, rig):
        task, truth = one.task(CART), one.parameters(CART_TRUTH)
        spread = 0.1 * one.state[:3]
        world = World(task, truth, sigma=(0.01 * one.state).tolist(), spread=spread.tolist())
        state, agent = world.reset(3), TrueModelAgent(task, truth, seed=1, nodes=4000)
        for _ in range(3):
            outcome = world.step(agent.act(state))
            state = outcome.state
        found.append(
            (state / one.state, outcome.observed / one.state, [outcome.reward / one.length])
        )
    for here, there in zip(*found, strict=True):
        np.testing.assert_allclose(there, here, rtol=1e-9, atol=1e-9)


def test_sizes_of_another_length_are_refused() -> None:
    with pytest.raises(EpisodeError, match=r"sigma is .*, or 6 of them"):
        World(CART, CART_TRUTH, sigma=[0.1, 0.1, 0.1])
    with pytest.raises(EpisodeError, match=r"spread is .*, or 3 of them"):
        World(CART, CART_TRUTH, spread=[0.1, -0.1, 0.1])
