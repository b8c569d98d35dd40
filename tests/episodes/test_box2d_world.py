"""The same tasks in another engine."""

import numpy as np
import pytest
from episodes import EpisodeError, World, run_episode
from episodes.box2d_world import Box2DWorld
from episodes.environment import Environment

from pbrl_ppl.agents import PBRLAgent, Task
from pbrl_ppl.planning import ActionSet, Goal
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.tasks import CART, CART_TRUTH, PUCK, PUCK_TRUTH

pytestmark = pytest.mark.one_stack


def played(world: World, actions: list[int]) -> np.ndarray:
    """States of an episode in which these actions are taken, the start first."""
    states = [world.reset(seed=1)]
    for action in actions:
        states.append(world.step(world.task.wrenches(states[-1])[action]).state)
    return np.array(states)


def test_a_wheel_in_the_open() -> None:
    """Pushed forwards, sideways and turned: both engines go to the same limit."""
    actions = [17, 17, 12, 3, 5, 0, 9, 9]
    ours = played(World(CART, CART_TRUTH, substeps=400), actions)
    its = played(Box2DWorld(CART, CART_TRUTH), actions)
    assert np.hypot(*(ours[-1] - ours[0])[0, :2]) > 0.5
    np.testing.assert_allclose(its, ours, atol=8e-3)


def test_a_bounce_off_a_wall() -> None:
    """A disc without friction, restitution 0.5: it comes back with half of its speed."""
    known = {"r": 0.5, "mu_c": 0.3}
    puck = Body("puck", Shape.circle(0.2), pose=(-0.8, 0, 0), known=known)
    task = Task(PUCK.scene.replace(bodies=(puck,)), PUCK.goal, PUCK.actions)
    east = 7  # 4 N
    states = played(Box2DWorld(task, PUCK_TRUTH), [east] * 3 + [4] * 3)[:, 0]
    fastest = states[3, 3]
    assert fastest == pytest.approx(4.0 / 2.0 * 0.6, rel=1e-3)
    assert states[-1, 3] == pytest.approx(-0.5 * fastest, rel=0.01)


def two(**options: object) -> Scene:
    """A puck that is pushed into another."""
    bodies = tuple(
        Body(name, Shape.circle(0.2), pose=(x, 0.0, 0.0)) for name, x in (("a", -0.5), ("b", 0.0))
    )
    return Scene(time_step=0.2, substeps=200, bodies=bodies, **options)


def test_restitution_is_the_product_of_two() -> None:
    """Of 0.8 and 0.5; the engine alone would take the larger."""
    task = Task(two(), Goal.of({"b": (3.0, 0.0, None)}), ActionSet.box("a", forces=(0.0, 5.0)))
    truth = {"mass": [1.0, 2.0], "r": [0.8, 0.5], "mu_c": 0.0}
    states = played(Box2DWorld(task, truth), [1, 0, 0, 0])
    before, after = states[1, :, 3], states[-1, :, 3]
    assert (after[1] - after[0]) / before[0] == pytest.approx(0.4, rel=0.02)
    assert after @ [1.0, 2.0] == pytest.approx(before[0], rel=1e-3)  # momentum


def test_a_hinge_and_a_concave_body() -> None:
    corner = Shape.polygon(
        [(-1.0, -0.6), (1.4, -0.6), (1.4, 0.2), (-0.2, 0.2), (-0.2, 1.0), (-1.0, 1.0)]
    )
    scene = Scene(
        time_step=0.2,
        substeps=100,
        bodies=(
            Body("door", Shape.box(0.8, 0.1), pose=(0.4, 0.0, 0.0)),
            Body("sofa", corner, pose=(4.0, 0.0, 0.0)),
        ),
        walls=(Wall((-3.0, -3.0), (6.0, -3.0)),),
        joints=(Joint("hinge", ("door", "world"), (-0.4, 0.0), (0.0, 0.0)),),
    )
    goal = Goal.of({"door": (None, None, 1.5)})
    task = Task(scene, goal, ActionSet.box("door", torques=(0.0, 2.0)))
    truth = {"mass": [6.0, 60.0], "r": 0.1, "mu_c": 0.2}
    ours, its = (played(kind(task, truth), [1] * 5) for kind in (World, Box2DWorld))
    assert its[-1, 0, 2] > 0.5
    np.testing.assert_allclose(its, ours, atol=0.01)
    np.testing.assert_array_equal(its[:, 1], np.tile(task.start[1], (6, 1)))


def test_an_agent_whose_engine_is_another() -> None:
    world = Box2DWorld(CART, CART_TRUTH)
    episode = run_episode(PBRLAgent(CART, seed=1), world, steps=30, seed=1)
    assert episode.reached and episode.steps < 25
    found = episode.dataset["estimate"].isel(interval=-1)
    assert float(found.sel(parameter="mass[cart]")) == pytest.approx(5.0, rel=0.03)
    environment = Environment(world, steps=3)
    environment.reset(seed=0)
    assert environment.step(3)[1] < 0


def test_noise_and_seeds() -> None:
    world = Box2DWorld(PUCK, PUCK_TRUTH, sigma=0.25, spread=0.1)
    state = world.reset(3)
    outcomes = [world.step(PUCK.wrenches(state)[0]) for _ in range(2)]
    world.reset(3)
    again = [world.step(PUCK.wrenches(state)[0]) for _ in range(2)]
    for one, other in zip(outcomes, again, strict=True):
        np.testing.assert_array_equal(one.observed, other.observed)
        assert (one.observed != one.state).all()


def test_refused_scenes() -> None:
    def refused(said: str, scene: Scene = PUCK.scene, **options: object) -> None:
        with pytest.raises(EpisodeError, match=said):
            Box2DWorld(Task(scene, PUCK.goal, PUCK.actions), PUCK_TRUTH, **options)

    refused("puck declares effects", PUCK.scene.with_effects("puck", "linear_drag"))
    refused(r"step is 0.5 s, expected above 0 and at most 0\.2 s", step=0.5)
    refused("sigma is nan", sigma=np.nan)
    rod = Joint("distance", ("puck", "world"), (0.0, 0.0), (0.0, 0.0))
    refused("no known hinge", PUCK.scene.replace(joints=(rod,)))
