"""The planner, with models that were learned by regression."""

import numpy as np
import pytest

from pbrl_ppl.agents import act
from pbrl_ppl.errors import FitError, GoalError
from pbrl_ppl.oomdp import LWR, OOLWR
from pbrl_ppl.planning import plan, predicted_path
from tests.helpers.pucks import ACROSS, FREE, PUSHES, ROOM, known
from tests.helpers.transitions import transitions

pytestmark = pytest.mark.one_stack


@pytest.fixture(scope="module")
def free() -> OOLWR:
    model = OOLWR(FREE)
    model.observe(*transitions(FREE, 200, 1, low=(-2, -2), high=(2, 2)))
    return model


def test_reaches_a_free_goal(free) -> None:
    """And the plan does in the world what the model says it does."""
    found = plan(free, *ACROSS, PUSHES)
    assert found.reached and found.distance < 0.1
    played = predicted_path(known(FREE), found.start, found.wrenches)[0, -1, 0]
    np.testing.assert_allclose(found.predicted["predicted"].to_numpy()[0, -1, 0], played, atol=1e-9)
    np.testing.assert_allclose(played[:2], (1.5, -1.0), atol=0.1)


def test_mppi_takes_it_too(free) -> None:
    found = plan(free, *ACROSS, PUSHES, method="mppi", samples=64, horizon=12)
    assert found.reached


def test_lwr_plans_through_walls() -> None:
    """The paper's section 5.1: it does not see them, and the wall stops what it plans."""
    model = LWR(ROOM)
    model.observe(*transitions(FREE, 200, 1, low=(-2.5, -2), high=(-0.5, 2)))
    found = plan(model, *ACROSS, PUSHES, nodes=50_000)
    assert found.reached
    where = found.predicted["predicted"].isel(draw=0, body=0)
    assert where.sel(state="y").max() < 0.8  # the wall ends at y = 1
    played = predicted_path(known(ROOM), found.start, found.wrenches)[0, :, 0]
    assert played[:, 0].max() < 0.0  # the wall is at x = 0


def test_unknown_contacts_bar_the_way(free) -> None:
    """The same data leave OO-LWR without a model of contact: it plans through none."""
    model = OOLWR(ROOM)
    model.observe(*transitions(FREE, 200, 1, low=(-2.5, -2), high=(-0.5, 2)))
    assert set(model.conditions("puck")) == {frozenset()}
    found = plan(model, *ACROSS, PUSHES, nodes=20_000)
    states = found.predicted["predicted"].isel(draw=0).to_numpy()
    assert np.isfinite(states).all()
    # every interval but the last begins where it has a model
    assert not model.relations[0].of(ROOM, states[:-1]).any()


def test_acts_on_it(free) -> None:
    truth = known(FREE)
    state = np.array([[-1.5, -1.0, 0, 0, 0, 0]])

    def world(wrench):
        nonlocal state
        state = truth.step(state[None, None], wrench[None])[0, 0]
        return state

    done = act(world, free, *ACROSS, PUSHES, every=10, nodes=20_000)
    assert done.reached
    free_again = OOLWR(FREE)
    free_again.learn(done.history())
    assert free_again.transitions == len(done.wrenches)


def test_bad_requests(free) -> None:
    with pytest.raises(GoalError, match="give actions"):
        plan(free, *ACROSS)
    with pytest.raises(FitError, match="nothing was observed yet"):
        plan(OOLWR(FREE), *ACROSS, PUSHES)
