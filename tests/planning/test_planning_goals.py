"""Goals, actions, risk and room: what a planner is asked, and what it refuses."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.errors import GoalError
from pbrl_ppl.physics import overlap
from pbrl_ppl.planning import Action, ActionSet, Goal, Target
from pbrl_ppl.planning.search import tail_mean
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.worlds import body, state

pytestmark = pytest.mark.one_stack  # nothing is fitted here
PUCK = Scene(time_step=0.1, bodies=(body("puck", Shape.circle(0.2)),))
TWO = PUCK.replace(bodies=(*PUCK.bodies, body("box", Shape.box(0.6, 0.8))))
angles = st.floats(-10, 10)


def test_distance_is_l2_with_angles_at_the_rim() -> None:
    """By hand: 3 and 4 m off, and a quarter turn of a box whose corner is 0.5 m out."""
    goal = Goal(
        (Target("puck", 3.0, 4.0, tolerance=0.1), Target("box", theta=np.pi / 2, weight=4.0))
    )
    states = np.stack([state(), state(x=7.0)])
    expected = math.sqrt(25 + 4 * (0.5 * np.pi / 2) ** 2)
    assert goal.distance(TWO, states) == pytest.approx(expected)
    assert goal.shortfall(TWO, states) == pytest.approx(50.0)
    default = Goal.of({"puck": (3.0, 4.0, None)})  # a fifth of a radius of 0.2 m
    assert default.tolerances(TWO) == pytest.approx([0.04])


@given(theta=angles, wanted=angles)
def test_headings_a_turn_apart_are_the_same(theta: float, wanted: float) -> None:
    goal = Goal.of({"puck": (None, None, wanted)})
    here = goal.distance(PUCK, state(theta=theta)[None])
    assert here == pytest.approx(
        goal.distance(PUCK, state(theta=theta + 2 * np.pi)[None]), abs=1e-9
    )
    assert here <= 0.2 * np.pi + 1e-9


def test_a_goal_to_stop_at_is_not_reached_in_motion() -> None:
    goal = Goal.of({"puck": (0.0, 0.0, None)}, speed=0.1)
    assert goal.shortfall(PUCK, state()[None]) <= 1
    assert goal.shortfall(PUCK, state(vx=0.2)[None]) == pytest.approx(2)
    assert goal.shortfall(PUCK, state(omega=1.0)[None]) == pytest.approx(2)  # 0.2 m/s at the rim


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Goal(()), "no target"),
        (lambda: Goal.of({"puck": (None, None, None)}), "all free"),
        (lambda: Goal.of({"puck": (0.0, np.nan, 0.0)}), "y is nan, expected a finite"),
        (lambda: Goal.of({"puck": (0.0, 0.0)}), "got 2 values"),
        (lambda: Goal.of({"puck": (0.0, 0.0, 0.0)}, tolerance=0.0), "tolerance is 0.0"),
        (lambda: Goal.of({"puck": (0.0, 0.0, 0.0)}, tolerence=0.1), 'did you mean "tolerance"'),
        (lambda: Goal.of({"puck": (0.0, 0.0, 0.0)}, contact_penalty=-1.0), "expected 0 or more"),
        (lambda: Goal((Target("a", 0.0), Target("a", 1.0))), "a has 2 targets"),
        (lambda: Goal.of({"pluck": (0.0, 0.0, 0.0)}).check(PUCK), 'did you mean "puck"'),
        (lambda: ActionSet(()), "empty"),
        (lambda: ActionSet((Action("puck"),), ()), "no duration"),
        (lambda: ActionSet((Action("puck"),), (0.0,)), "expected more than 0"),
        (lambda: ActionSet((Action("puck"),), (0.15,)).check(PUCK), "whole number of sampling"),
        (lambda: ActionSet((Action("pluck"),)).check(PUCK), 'did you mean "puck"'),
        (lambda: Action("puck", (1.0,)), "force has 1 numbers, expected 2"),
        (lambda: Action("puck", torque=np.inf), "torque is inf, expected a finite number"),
        (lambda: Action("puck", frame="wold"), "expected body or world"),
    ],
)
def test_what_cannot_be_is_refused(build, message: str) -> None:
    with pytest.raises(GoalError, match=message):
        build()


def test_specs_are_read_from_files(tmp_path: Path) -> None:
    path = tmp_path / "goal.toml"
    path.write_text(
        'contact_penalty = 2.0\n[[target]]\nbody = "puck"\nx = 1\ny = 2.5\ntolerance = 0.2\n'
    )
    assert Goal.load(path) == Goal((Target("puck", 1, 2.5, tolerance=0.2),), 2.0)
    path.write_text('durations = [0.2]\n[[action]]\nbody = "puck"\nforce = [1, 2]\ntorque = 3\n')
    assert ActionSet.load(path) == ActionSet((Action("puck", (1.0, 2.0), 3.0),), (0.2,))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("target = [", "not TOML"),
        ('[[targets]]\nbody = "puck"', 'did you mean "target"'),
        ('[[target]]\nbody = "puck"\nangle = 1', "unknown key"),
        ("[[target]]\nx = 1", 'has no "body"'),
        ("", "no target"),
        ("target = 5", "not an array of tables"),
        ("[[target]]\nbody = 5\nx = 1", "expected text"),
        ('[[target]]\nbody = "puck"\nx = ' + "9" * 400, "expected a finite number"),
        ('contact_penalty = "x"\n[[target]]\nbody = "puck"\nx = 1', "contact_penalty is 'x'"),
        ("contact_penalty = " + "9" * 400 + '\n[[target]]\nbody = "puck"\nx = 1', "finite number"),
    ],
)
def test_a_bad_goal_file_is_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "goal.toml"
    path.write_text(text)
    with pytest.raises(GoalError, match=message):
        Goal.load(path)
    with pytest.raises(GoalError, match="no such file"):
        Goal.load(tmp_path / "gaol.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("durations = 5", "expected a list"),
        ("durations = [inf]", "expected a finite number"),
        ("durations = [" + "9" * 400 + "]", "expected a finite number"),
        ("", "force is inf, expected a finite number"),
    ],
)
def test_bad_actions_are_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "actions.toml"
    force = "[" + ("9" * 400 if not text else "1") + ", 0]"
    path.write_text(f'{text}\n[[action]]\nbody = "puck"\nforce = {force}\n')
    with pytest.raises(GoalError, match=message):
        ActionSet.load(path)


def test_wrenches_turn_with_the_body_in_its_frame_alone() -> None:
    actions = ActionSet((Action("box", (1.0, 0.0), 2.0), Action("puck", (1.0, 0.0), frame="world")))
    wrench = actions.wrenches(TWO, np.array([0, 1]), np.full((2, 2), np.pi / 2))
    np.testing.assert_allclose(wrench[0], [[0, 0, 0], [0, 1, 2]], atol=1e-15)
    np.testing.assert_allclose(wrench[1], [[1, 0, 0], [0, 0, 0]], atol=1e-15)
    assert actions.strongest("box") == (1.0, 2.0)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30))
def test_the_tail_goes_from_the_mean_to_the_worst(values: list[float]) -> None:
    costs = np.array(values)
    tails = [float(tail_mean(costs, tail)) for tail in (1.0, 0.5, 0.25, 1e-9)]
    assert tails[0] == pytest.approx(costs.mean())
    assert tails[-1] == costs.max()
    assert np.diff(tails).min() >= -1e-9


@given(x=st.floats(-2, 2), y=st.floats(-2, 2), turn=angles)
def test_overlap_of_circles_is_their_radii_less_their_distance(x, y, turn) -> None:
    scene = Scene(
        time_step=0.1, bodies=(body("a", Shape.circle(0.5)), body("b", Shape.circle(0.3)))
    )
    poses = np.array([[[0.0, 0.0, turn], [x, y, 0.0]]])
    assert overlap(scene, poses)[0] == pytest.approx(0.8 - math.hypot(x, y), abs=1e-9)


def test_overlap_counts_walls_and_static_bodies() -> None:
    block = Body("block", Shape.box(1.0, 1.0), static=True, pose=(5.0, 0.0, 0.0))
    scene = PUCK.replace(bodies=(*PUCK.bodies, block), walls=(Wall((-1.0, 2.0), (1.0, 2.0)),))
    poses = np.array([[[0.0, 1.9, 0.0]], [[4.4, 0.0, 0.0]], [[0.0, 0.0, 0.0]]])
    depth = overlap(scene, poses)
    np.testing.assert_allclose(depth[:2], [0.1, 0.1], atol=1e-9)
    assert depth[2] < 0
