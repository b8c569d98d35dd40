"""Navigation among movable obstacles: a plan fails, the model learns from it, another is made."""

import importlib.util
import json
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

import pbrl_ppl as pp
from pbrl_ppl.errors import ConvergenceWarning, RefitWarning
from pbrl_ppl.reporting.scene_plots import draw_goal, draw_motion, draw_scene
from tests.helpers.places import ROOT
from tests.helpers.samplers import shorten

#: What the model believes before it has touched anything, roughly: the medians of the prior.
BELIEVED = {
    "mass": [20.0, 20.0, 20.0],
    "mu_x": [0.3, 0.3],
    "mu_y": [0.3, 0.3],
    "linear_drag_coefficient": [100.0],
}


@pytest.fixture(scope="module")
def namo():
    path = ROOT / "models" / "namo" / "world.py"
    spec = importlib.util.spec_from_file_location("namo_world", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def opening(states):
    """Height (m) at which the robot crosses the wall between the rooms; None if it does not."""
    crossed = np.flatnonzero(states[:, 0, 0] > 0)
    return states[crossed[0], 0, 1] if len(crossed) else None


def way(states, body):
    """How far a body ends from where it began (m)."""
    return float(np.hypot(*(states[-1] - states[0])[body, :2]))


TABLE, COUCH = 1, 2


# -- parameters that are known: fast ---------------------------------------------------------------


@pytest.mark.one_stack
def test_a_plan_pushes_the_table_away_if_it_can_be_moved(namo):
    model = pp.Dynamics.known(namo.SCENE, BELIEVED, threads=1)
    plan = pp.plan(model, {}, namo.GOAL, namo.pushes())
    states = plan.predicted["predicted"].to_numpy()[0]
    assert plan.reached
    assert opening(states) > 0
    assert way(states, TABLE) > 0.5


@pytest.mark.one_stack
def test_who_knows_that_the_table_is_bolted_down_pushes_the_couch(namo):
    truth = {name: list(of.values()) for name, of in namo.TRUTH.items()}
    plan = pp.plan(pp.Dynamics.known(namo.SCENE, truth, threads=1), {}, namo.GOAL, namo.pushes())
    states = plan.predicted["predicted"].to_numpy()[0]
    assert plan.reached
    assert opening(states) < 0
    assert way(states, COUCH) > 0.1
    assert way(states, TABLE) < 0.02


@pytest.mark.one_stack
def test_a_push_that_ends_in_the_cell_it_began_in_is_no_dead_end(namo):
    model = pp.Dynamics.known(namo.SCENE, BELIEVED, threads=1)
    actions = replace(namo.pushes(), durations=(0.3,))
    assert pp.plan(model, {}, namo.GOAL, actions).reached


@pytest.mark.one_stack
def test_where_no_cell_is_fine_enough_nothing_is_left_to_try(namo):
    weak = pp.ActionSet((pp.Action("robot", (0.0, 0.0)),))
    plan = pp.plan(pp.Dynamics.known(namo.SCENE, BELIEVED, threads=1), {}, namo.GOAL, weak)
    assert not plan.reached
    assert plan.stopped == "exhausted"


# -- pictures --------------------------------------------------------------------------------------


@pytest.mark.one_stack
def test_bodies_are_drawn_where_they_are(namo):
    axes = Figure().add_subplot()
    states = namo.World(0).states
    states[COUCH, :3] = 1.0, -1.0, np.pi / 2
    draw_scene(axes, namo.SCENE, states, names=True)
    draw_goal(axes, namo.SCENE, namo.GOAL)
    circles = [each for each in axes.patches if isinstance(each, Circle)]
    assert [each.center for each in circles] == [(-2.4, 0.9), (0.0, 0.9), (2.4, 0.9)]
    (couch,) = (each for each in axes.patches if isinstance(each, Polygon))
    np.testing.assert_allclose(couch.get_xy().min(axis=0), [0.25, -1.3])
    assert [text.get_text() for text in axes.texts] == ["robot", "table", "couch"]
    assert len(axes.lines) == len(namo.SCENE.walls)


@pytest.mark.one_stack
def test_only_what_moved_has_a_track(namo):
    axes = Figure().add_subplot()
    states = np.stack([namo.World(0).states] * 3)
    states[1:, 0, 0] += [0.5, 1.0]
    draw_motion(axes, namo.SCENE, states)
    tracks = [line for line in axes.lines if len(line.get_xdata()) == 3]
    np.testing.assert_allclose([line.get_xdata() for line in tracks], [[-2.4, -1.9, -1.4]])


# -- the whole story: long -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def story(namo, tmp_path_factory):
    """Posterior, plan, failure, posterior, and what the second plan comes to."""
    folder = tmp_path_factory.mktemp("namo")
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", RefitWarning)
        shorten(patch, draws=300)  # on purpose, also where the update refits
        world = namo.World(5)
        seen = namo.go_round(world)
        model = pp.physics_model(namo.SCENE, seen.history())
        before = pp.fit(model, seed=5, chains=2, cores=1, progress=False)
        pp.save_posterior(before, folder / "before.nc")
        before = pp.load_posterior(folder / "before.nc")
        plan = pp.plan(before, namo.at_rest(seen.states[-1]), namo.GOAL, namo.pushes())
        expected = plan.predicted["predicted"].to_numpy()[0]
        failed = namo.follow(world, seen.states[-1], plan.wrenches, expected)
        after = pp.update(before, failed.history(), seed=5, progress=False)
        pp.save_posterior(after, folder / "after.nc")
        after = pp.load_posterior(folder / "after.nc")
        done = pp.act(
            world, after, namo.at_rest(failed.states[-1]), namo.GOAL, namo.pushes(), every=10
        )
    return SimpleNamespace(
        before=before, plan=plan, expected=expected, failed=failed, after=after, done=done,
        world=world,
    )  # fmt: skip


@pytest.mark.long
def test_the_first_plan_moves_the_table_in_the_model(namo, story):
    assert namo.movable(story.before, "table") > 0.4
    assert story.plan.reached
    assert opening(story.expected) > 0
    assert way(story.expected, TABLE) > 0.5
    assert way(story.expected, COUCH) < 0.02


@pytest.mark.long
def test_it_fails_where_the_table_is_bolted_down(story):
    assert not story.failed.reached
    assert opening(story.failed.states) is None
    assert way(story.failed.states, TABLE) < 0.02


@pytest.mark.long
def test_the_failed_push_tells_that_the_table_does_not_move(namo, story):
    assert namo.movable(story.after, "table") < 0.05
    assert namo.movable(story.after, "couch") > 0.5  # of which it tells nothing
    masses = [float(each.posterior["mass"].median(("chain", "draw"))[1])
              for each in (story.before, story.after)]  # fmt: skip
    assert masses[1] > 3 * masses[0]
    assert json.loads(story.after.attrs["updates"])[-1]["transitions"] == len(story.failed.wrenches)


@pytest.mark.long
def test_the_second_plan_goes_the_other_way_and_arrives(namo, story):
    states = story.done.states
    assert story.done.reached
    assert namo.GOAL.distance(namo.SCENE, story.world.states) < 0.25  # and not by its noise
    assert opening(states) < 0
    assert way(states, COUCH) > 0.1
    assert way(states, TABLE) < 0.02
