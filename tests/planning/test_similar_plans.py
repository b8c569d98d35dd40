"""Plans of physically similar carts: the same actions, and the same result without dimension."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pbrl_ppl.planning import Dynamics, plan
from pbrl_ppl.scene import Wall
from tests.helpers.similar_plan import RIGS, Similar
from tests.helpers.tasks import CART, CART_TRUTH

pytestmark = pytest.mark.one_stack
ONE = Similar(1.0, 1.0, 1.0)
#: Powers of two: every number is the same but for its exponent.
EXACT = Similar(2.0**-10, 2.0**-20, 2.0**-7)
#: Default tolerance.
FREE = replace(
    CART, goal=replace(CART.goal, targets=(replace(CART.goal.targets[0], tolerance=None),))
)
#: Walls that the cart has to pass without touching them.
WALLED = replace(
    FREE,
    scene=FREE.scene.replace(walls=(Wall((1.3, -3.0), (1.3, -0.9)), Wall((-4, -3), (4, -3)))),
    goal=replace(FREE.goal, contact_penalty=2.0),
)


@cache
def planned(rig: Similar, method: str, **options):
    task = rig.task(WALLED if method == "astar" else FREE)
    dynamics = Dynamics.known(task.scene, rig.parameters(CART_TRUTH), threads=1)
    return plan(dynamics, {}, task.goal, task.actions, method=method, seed=1, **options)


def same(rig: Similar, *, within: float, **options) -> None:
    there, here = planned(rig, **options), planned(ONE, **options)
    assert (there.reached, there.nodes) == (here.reached, here.nodes)
    np.testing.assert_allclose(there.wrenches / rig.wrench, here.wrenches, atol=within)
    ends = [each.predicted["predicted"].values for each in (there, here)]
    np.testing.assert_allclose(ends[0] / rig.state, ends[1], atol=within)
    assert there.distance / rig.length == pytest.approx(here.distance, abs=within)


@pytest.mark.parametrize("rig", RIGS)
def test_a_similar_cart_has_the_same_plan(rig) -> None:
    assert planned(ONE, "astar").reached
    same(rig, method="astar", within=1e-9)


@pytest.mark.parametrize("rig", RIGS)
def test_a_receding_horizon_begins_the_same(rig) -> None:
    """Rounding errors grow tenfold an interval: each plan starts from the last one's states."""
    same(rig, method="mppi", samples=64, intervals=3, within=1e-6)


def test_a_receding_horizon_reaches_the_goal_the_same_way() -> None:
    assert planned(ONE, "mppi", samples=128).reached
    same(EXACT, method="mppi", samples=128, within=1e-9)
