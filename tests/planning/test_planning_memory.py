"""Plans for an actuator that remembers: what acted before a node is on the tree."""

import numpy as np
import pytest

from pbrl_ppl.agents import act
from pbrl_ppl.physics import Physics
from pbrl_ppl.planning import Action, ActionSet, Dynamics, Goal, plan
from pbrl_ppl.scene import Scene, Shape
from tests.helpers.worlds import BY_NAME, body

pytestmark = pytest.mark.one_stack  # nothing is fitted here
MASS = 2.0
FORCES = ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0), (0.0, 0.0))
PUSHES = ActionSet(tuple(Action("puck", force, 0.0, "world") for force in FORCES))


def scene() -> Scene:
    return Scene(time_step=0.5, substeps=20, bodies=(body("puck", Shape.circle(0.2), mass=MASS),))


def dynamics(share: float) -> Dynamics:
    late = BY_NAME["actuator_delay"]
    return Dynamics.known(scene(), {"actuator_delay_share": share}, (late,))


def test_a_step_begins_with_what_acted_before() -> None:
    late, states = dynamics(0.5), np.zeros((1, 2, 1, 6))
    now = np.array([[[4.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]])
    speed = late.step(states, now)[0, :, 0, 3]
    assert speed == pytest.approx([0.5, 0.0])
    speed = late.step(states, now, np.array([[[8.0, 0, 0]], [[8.0, 0, 0]]]))[0, :, 0, 3]
    assert speed == pytest.approx([1.5, 1.0])
    speed = late.after([[8.0, 0.0, 0.0]]).step(states, now)[0, :, 0, 3]
    assert speed == pytest.approx([1.5, 1.0])


@pytest.mark.parametrize("method", ["astar", "mppi"])
def test_the_plan_ends_where_it_says(method) -> None:
    """The predicted states are those of the whole sequence in one call, memory and all."""
    late, goal = dynamics(0.6), Goal.of({"puck": (0.9, 0.3, None)}, tolerance=0.2)
    found = plan(late, {"puck": (0, 0, 0)}, goal, PUSHES, method=method, nodes=200_000)
    assert found.reached
    physics = Physics.declare(scene(), (BY_NAME["actuator_delay"],))
    whole = physics.predict(late.phi[0], np.zeros((1, 1, 6)), found.wrenches[None])[0]
    np.testing.assert_allclose(found.predicted["predicted"].values[0, 1:], whole, atol=1e-9)


def test_acting_goes_on_from_what_was_played() -> None:
    late = dynamics(1.0)  # each push comes a whole interval late
    state, last = np.zeros((1, 6)), np.zeros((1, 3))

    def world(wrench):
        nonlocal state, last
        state = late.step(state[None, None], wrench[None], last[None])[0, 0]
        last = wrench
        return state

    goal = {"puck": (0.5, 0.0, None)}
    done = act(world, late, {"puck": (0, 0, 0)}, goal, PUSHES, every=2, nodes=20_000)
    assert done.reached
