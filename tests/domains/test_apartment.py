"""The apartment: a table on a hinge, and a goal that can be reached."""

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.history import lever
from pbrl_ppl.physics import Physics, Simulator, build_layout, overlap
from tests.helpers.places import MODELS

pytestmark = pytest.mark.one_stack  # nothing is fitted here
FOLDER = MODELS / "apartment"
TABLE, CART = "kitchen_table", "shopping_cart"


@pytest.fixture(scope="module")
def scene() -> pp.Scene:
    return pp.Scene.load(FOLDER / "scene.toml")


@pytest.fixture(scope="module")
def truth(scene) -> dict[str, object]:
    """Masses at the prior's medians."""
    mass = [np.exp(dict(dict(body.prior)["mass"])["mu"]) for body in scene.dynamic]
    wheel = {"w_x": 0.0, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.1, "mu_y": 0.3}
    return {"mass": mass, "r": 0.2, "mu_c": 0.3} | wheel


def place(scene, name: str) -> int:
    return [body.name for body in scene.dynamic].index(name)


def test_the_kitchen_table_turns_about_its_post_and_clears_the_walls(scene, truth) -> None:
    """A push of 20 N on its free end for 2 s; a turn in 24 steps, all of it free."""
    (post,) = (joint for joint in scene.joints if joint.kind == "hinge")
    assert post.bodies == (TABLE, "world")
    i, layout = place(scene, TABLE), build_layout(scene)
    start = np.array([[*body.pose, 0, 0, 0] for body in scene.dynamic])[None]
    actions = np.zeros((1, 20, len(scene.dynamic), 3))
    actions[..., i, 2] = 3.0
    states = Simulator(Physics(scene))(layout.to_vector(truth), start, actions)[0, :, i]
    held = states[:, :2] + lever(states, post.anchor_a)[0]
    np.testing.assert_allclose(held, np.tile(post.anchor_b, (20, 1)), atol=0.01)
    assert states[-1, 2] - start[0, i, 2] > 1.0
    turns = np.zeros((24, 1, 6))
    turns[:, 0, 2] = np.linspace(0, 2 * np.pi, 24)
    turns[:, 0, :2] = np.array(post.anchor_b) - lever(turns[:, 0], post.anchor_a)[0]
    # joined to the world, it would go through walls
    free = scene.subset([TABLE]).replace(joints=())
    assert overlap(free, turns[..., :3]).max() < 0


def test_the_goal_is_free_and_can_be_reached(scene, truth) -> None:
    goal = pp.Goal.load(FOLDER / "goals.toml")
    goal.check(scene)
    pushes = pp.ActionSet.box(
        CART, forces=(-60.0, 0.0, 60.0), lateral=(-60.0, 0.0, 60.0), torques=(-6.0, 0.0, 6.0),
        durations=(0.2, 0.5),
    )  # fmt: skip
    turns = tuple(pp.Action(TABLE, torque=torque) for torque in (-6.0, 6.0))
    actions = pp.ActionSet((*pushes.actions, *turns), pushes.durations)
    known = pp.Dynamics.known(scene, truth, threads=1)
    assert not goal.shortfall(scene, pp.plan(known, {}, goal, actions, nodes=1).start) <= 1
    plan = pp.plan(known, {}, goal, actions, weight=5.0, nodes=100_000)
    assert plan.reached
    end = plan.predicted["predicted"].values[0, -1]
    assert goal.shortfall(scene, end) <= 1
