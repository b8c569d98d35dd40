"""Plans for an actuator with a lag: what it has reached is carried along the plan."""

import numpy as np
import pytest

from pbrl_ppl.physics import Physics
from pbrl_ppl.planning import Action, ActionSet, Dynamics, Goal, plan, remembered
from pbrl_ppl.scene import Scene, Shape
from tests.helpers.worlds import BY_NAME, body

pytestmark = pytest.mark.one_stack  # nothing is fitted here
FORCES = ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0), (0.0, 0.0))
PUSHES = ActionSet(tuple(Action("puck", force, 0.0, "world") for force in FORCES))
LAG = BY_NAME["first_order_lag"]


def scene() -> Scene:
    return Scene(time_step=0.25, bodies=(body("puck", Shape.circle(0.2), mass=2.0),))


def dynamics(time: float) -> Dynamics:
    return Dynamics.known(
        scene(), {"first_order_lag_time": time, "first_order_lag_begin": 0}, (LAG,)
    )


def test_what_was_reached_goes_on() -> None:
    """After pushes of 1 N for ever, then 0 for two intervals: exp(-2 dt / T) of 1 N is left."""
    late, time = dynamics(0.5), 0.5
    model = late.after([[1.0, 0.0, 0.0]])
    zero, last = np.zeros((1, 1, 3)), model.before[None]
    states = np.zeros((1, 1, 1, 6))
    for _ in range(3):
        before = states
        states = model.step(states, zero, last)
        last = remembered(zero, last)
    gained = (states - before)[0, 0, 0, 3] * 2.0
    left = np.exp(-2 * 0.25 / time)
    assert gained == pytest.approx(left * time * (1 - np.exp(-0.25 / time)), rel=1e-3)


@pytest.mark.parametrize("method", ["astar", "mppi"])
def test_the_plan_ends_where_it_says(method: str) -> None:
    """The predicted states are those of the whole sequence in one call, memory and all."""
    late, goal = dynamics(0.3), Goal.of({"puck": (0.9, 0.3, None)}, tolerance=0.2)
    found = plan(late, {"puck": (0, 0, 0)}, goal, PUSHES, method=method, nodes=200_000)
    assert found.reached
    physics = Physics.declare(scene(), (LAG,))
    phi = np.array([late.phi[0][late.layout.labels.index(x)] for x in physics.layout.labels])
    whole = physics.predict(phi, np.zeros((1, 1, 6)), found.wrenches[None])[0]
    np.testing.assert_allclose(found.predicted["predicted"].values[0, 1:], whole, atol=1e-9)
