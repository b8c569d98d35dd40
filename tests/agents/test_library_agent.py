"""PBRL with a categorical prior."""

import numpy as np
import pytest
from episodes import World, run_episode

from pbrl_ppl.agents import LibraryAgent, Task
from pbrl_ppl.errors import FitError, ParameterError
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.planning import ActionSet, Dynamics, Goal
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.marks import OBJECT_MODE

pytestmark = pytest.mark.one_stack

SCENE = Scene(
    time_step=0.25,
    normal_gravity=9.81,
    bodies=(
        Body("cart", Shape.box(0.9, 0.55), wheel=True, pose=(0.0, 0.0, 0.0)),
        Body("crate", Shape.box(0.5, 0.5), pose=(0.9, 0.0, 0.0)),
        Body("stool", Shape.circle(0.2), pose=(-3.0, 3.0, 0.0)),
    ),
)
TASK = Task(
    SCENE,
    Goal.of({"cart": (-1.5, 0.0, None)}, tolerance=0.2),
    ActionSet.box("cart", forces=(-25.0, 0.0, 25.0), torques=(-3.0, 0.0, 3.0)),
)
WHEEL = {"w_x": -0.2, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.05, "mu_y": 0.4}
NONE = {"w_x": 0.0, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.0, "mu_y": 0.0}
CONTACT = {"r": 0.2, "mu_c": 0.3}
LIBRARY = ParameterLibrary(
    {
        "heavy": {"mass": 30.0} | NONE | CONTACT,
        "light": {"mass": 8.0} | NONE | CONTACT,
        "cart": {"mass": 8.0} | WHEEL | CONTACT,
    },
    {"cart": {"heavy": 1, "light": 1, "cart": 1}, "crate": {"heavy": 1}, "stool": {"light": 1}},
)
TRUTH = {"mass": [8.0, 30.0, 8.0], "r": 0.2, "mu_c": 0.3} | WHEEL


def test_it_finds_which_one_it_pushes() -> None:
    agent = LibraryAgent(TASK, LIBRARY, seed=2, nodes=5000)
    assert agent.model is None and agent.estimates == {}
    episode = run_episode(agent, World(TASK, TRUTH), steps=15, seed=2)
    assert episode.reached
    assert agent.probabilities.loc["cart", "cart"] > 0.99
    assert agent.probabilities.loc["stool", "light"] == 1.0
    assert agent.estimates["mu_y[cart]"] == 0.4 and agent.estimates["mass[crate]"] == 30.0
    assert 0 < agent.fits < episode.steps  # what is foretold teaches nothing


def test_bodies_of_a_class_are_judged_together() -> None:
    """Four pushes of each stool in noise: one choice, surer by both together than by either."""
    kind = {"shape": Shape.circle(0.2), "object_class": "stool", "known": CONTACT}
    bodies = (
        Body("stool1", **kind, pose=(0.0, 0.0, 0.0)),
        Body("stool2", **kind, pose=(4.0, 0.0, 0.0)),
        Body("crate", Shape.box(0.5, 0.5), known=CONTACT, pose=(8.0, 0.0, 0.0)),
    )
    scene = Scene(time_step=0.25, normal_gravity=9.81, bodies=bodies)
    push = ActionSet.box("stool1", forces=(25.0,))
    task = Task(scene, Goal.of({"stool1": (2.0, 0.0, None)}), push)
    sets = ParameterLibrary({"light": {"mass": 8.0}, "heavy": {"mass": 30.0}})
    truth = Dynamics.known(scene, {"mass": [8.0, 30.0]})
    state = task.start
    found = {}
    for chosen in ([0], [0, 1], [1]):
        agent = LibraryAgent(task, sets, seed=1)
        for i in chosen:
            for repeat in range(4):
                action = np.zeros((3, 3))
                action[i, repeat % 2] = 25.0
                after = truth.step(state[None, None], action[None])[0, 0]
                noise = np.random.default_rng([i, repeat]).normal(0.0, 0.6, after.shape)
                agent.observe(state, action, np.where(action.any(1)[:, None], after + noise, state))
        agent.update()
        assert agent.probabilities.index.tolist() == ["stool", "crate"]
        assert agent.fits == 1
        found[tuple(chosen)] = agent.probabilities.loc["stool", "light"]
    assert 0.5 < min(found[0,], found[1,]) < max(found[0,], found[1,]) < 0.97
    assert found[0, 1] > max(found[0,], found[1,])
    assert agent.estimates["mass[stool]"] in (8.0, 30.0)


def test_noise_leaves_doubt() -> None:
    """Of one push in noise as large as the motion."""
    agent = LibraryAgent(TASK, LIBRARY, seed=1)
    world = World(TASK, TRUTH, sigma=1.0)
    state = world.reset(1)
    action = TASK.wrenches(state)[0]
    agent.observe(state, action, world.step(action).observed)
    agent.update()
    assert agent.probabilities.loc["cart"].between(0.01, 0.99).all()


@OBJECT_MODE
def test_the_paper_s_walk_finds_the_same() -> None:
    """One chain of Table 2's row for the apartment: each probability within 4 standard errors.

    Of 400 draws of which 100 count, at least: false alarm below 1e-3 over the three sets.
    """
    found = []
    for method in ("exact", "metropolis"):
        agent = LibraryAgent(TASK, LIBRARY, method=method, seed=1)
        world = World(TASK, TRUTH, sigma=1.0)
        state = world.reset(1)
        action = TASK.wrenches(state)[0]
        agent.observe(state, action, world.step(action).observed)
        agent.update()
        found.append(agent.probabilities.loc["cart"].to_numpy())
    exact, paper = found
    assert (abs(paper - exact) < 4 * np.sqrt(exact * (1 - exact) * (1 / 100 + 1 / 400))).all()
    with pytest.raises(ValueError, match="method is 'sum', expected 'exact' or 'metropolis'"):
        LibraryAgent(TASK, LIBRARY, method="sum")


def test_what_touches_another_is_left_out() -> None:
    agent = LibraryAgent(TASK, LIBRARY, seed=1)
    state = TASK.start
    after = state.copy()
    after[:2, 3] = 0.5  # the cart pushed the crate
    after[0, 0] += 0.3
    after[1, 0] += 0.05
    action = np.zeros((3, 3))
    action[0, 0] = 25.0
    agent.observe(state, action, after)
    agent.update()
    assert agent.fits == 0
    assert agent.probabilities.loc["cart"].to_numpy() == pytest.approx(1 / 3)
    assert agent.model is not None  # the prior's


def test_bad_requests() -> None:
    with pytest.raises(ParameterError, match="library"):
        LibraryAgent(TASK, ParameterLibrary({}))
    with pytest.raises(ParameterError, match="w_x of body 'cart' is missing"):
        LibraryAgent(TASK, ParameterLibrary({"a": {"mass": 1.0} | CONTACT}))
    dragged = Task(SCENE.with_effects("cart", "linear_drag"), TASK.goal, TASK.actions)
    with pytest.raises(FitError, match="effects"):
        LibraryAgent(dragged, LIBRARY)
