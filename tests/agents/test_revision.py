"""An agent that finds in the middle of an episode what its model lacks."""

import numpy as np
import pytest
from episodes import World

from pbrl_ppl.agents import PBRLAgent, Revision
from pbrl_ppl.effects import Effect, EffectParameter, Force, catalogue
from pbrl_ppl.errors import EffectError
from pbrl_ppl.parameters import Prior
from tests.helpers.tasks import CART, CART_TRUTH

pytestmark = [pytest.mark.one_stack, pytest.mark.first(2)]

EFFECTS = {effect.name: effect for effect in catalogue}
SIZES = {
    "linear_drag": {"linear_drag_coefficient": 4.0},
    "constant_force": {"constant_force_force_x": 0.0, "constant_force_force_y": 4.0},
    "actuator_rotation": {"actuator_rotation_angle": 0.4},
}


def pushed(agent: PBRLAgent, effect: str | None, *, sigma: float, steps: int, seed: int) -> list:
    """Show an agent one episode of random pushes; what it had added after each step.

    It learns from the fourth on: before, it does not look for what is missing.
    """
    truth = CART_TRUTH | (SIZES[effect] if effect else {})
    world = World(CART, truth, (EFFECTS[effect],) if effect else (), sigma=sigma)
    rng, state, seen = np.random.default_rng(seed), world.reset(seed), []
    for i in range(steps):
        wrenches = CART.wrenches(state)
        if i % 3 == 0:
            chosen = rng.integers(len(wrenches))
        outcome = world.step(wrenches[chosen])
        agent.observe(state, wrenches[chosen], outcome.observed)
        if i >= 3:
            agent.update()
        state = outcome.state
        seen.append([each.effect for each in agent.added])
    return seen


@pytest.mark.parametrize("effect", ["constant_force", "actuator_rotation"])
@pytest.mark.parametrize("seed", [1, 2])
def test_names_what_is_missing(effect, seed) -> None:
    """Of seeds 0 to 4 it does in all."""
    agent = PBRLAgent(CART, seed=seed, revise=True, growth=0.5)
    seen = pushed(agent, effect, sigma=0.0, steps=8, seed=seed)
    assert seen[-1] == [effect]
    (found,) = agent.added
    assert found.body == "cart" and 4 <= found.transitions <= 8
    assert found.nats > 10.0 and found.share > 0.5
    for label, size in SIZES[effect].items():
        assert agent.estimates[f"{label}[cart]"] == pytest.approx(size, rel=0.01, abs=0.01)


@pytest.mark.parametrize("seed", [1, 2])
def test_adds_nothing_to_a_true_model(seed) -> None:
    agent = PBRLAgent(CART, seed=seed, revise=True, growth=0.5)
    seen = pushed(agent, None, sigma=0.01, steps=6, seed=seed)
    assert not any(seen) and agent.criticisms >= 1


def test_drops_what_later_data_do_not_bear_out() -> None:
    agent = PBRLAgent(CART, seed=1, revise=True, growth=10.0)
    drag = EFFECTS["quadratic_drag"].on("cart")
    agent.added = (Revision(drag, 4, 10.0, 0.5),)
    pushed(agent, "linear_drag", sigma=0.0, steps=5, seed=1)
    assert [each.effect for each in agent.added] == ["linear_drag"]
    agent = PBRLAgent(CART, seed=1, revise=True, growth=10.0)
    agent.added = (Revision(drag, 4, 10.0, 0.5),)
    pushed(agent, None, sigma=0.01, steps=5, seed=1)
    assert agent.added == () and "quadratic_drag_coefficient[cart]" not in agent.estimates


def test_an_effect_that_it_knows_of() -> None:
    agent = PBRLAgent(CART, seed=1, effects=(EFFECTS["linear_drag"],), revise=True)
    pushed(agent, "linear_drag", sigma=0.0, steps=5, seed=1)
    assert agent.estimates["linear_drag_coefficient[cart]"] == pytest.approx(4.0, rel=0.02)
    assert agent.added == ()
    with pytest.raises(EffectError, match="applies to no body"):
        PBRLAgent(CART, effects=(EFFECTS["pivot_friction"],))


def _raises(state, command, parameters, wrench):
    raise ZeroDivisionError("of course")


def test_tries_an_own_effect_that_is_added_after_the_first_fit() -> None:
    agent = PBRLAgent(CART, seed=1, growth=0.0)
    pushed(agent, None, sigma=0.01, steps=5, seed=1)
    assert agent.fits > 0
    size = EffectParameter("size", "N", Prior("half_normal", sigma=1.0))
    own = Effect("own", (size,), "made up", "a test", Force(_raises))
    agent.added = (Revision(own.on("cart"), 4, 10.0, 0.5),)
    with pytest.raises(EffectError, match="raised ZeroDivisionError when it was tried"):
        pushed(agent, None, sigma=0.01, steps=5, seed=1)


@pytest.mark.long
@pytest.mark.parametrize("effect", list(SIZES))
def test_names_what_is_missing_under_noise(effect) -> None:
    agent = PBRLAgent(CART, seed=1, revise=True)
    seen = pushed(agent, effect, sigma=0.01, steps=25, seed=1)
    assert seen[-1] == [effect]


@pytest.mark.long
def test_false_alarms() -> None:
    """At most 2 clean episodes of 20; the level of trying is one in a hundred."""
    alarms = 0
    for seed in range(20):
        agent = PBRLAgent(CART, seed=seed, revise=True)
        alarms += any(pushed(agent, None, sigma=(0.01, 0.1)[seed % 2], steps=20, seed=seed))
    assert alarms <= 2
