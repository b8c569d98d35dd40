"""OO-LWR of physically similar carts: the same predictions without dimension."""

import numpy as np
import pytest

from pbrl_ppl.oomdp import OOLWR
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.scene import Wall
from tests.helpers.similar_plan import RIGS, Similar
from tests.helpers.tasks import CART, CART_TRUTH

pytestmark = pytest.mark.one_stack
SCENE = CART.scene.replace(walls=(Wall((1.0, -9.0), (1.0, 9.0)),))


def played(n: int, seed: int) -> tuple[np.ndarray, ...]:
    """Return transitions of the cart beside a wall; it is never turned by a torque."""
    rng = np.random.default_rng(seed)
    states, wrenches = rng.uniform(-1, 1, (n, 1, 6)), rng.normal(size=(n, 1, 3)) * [15, 15, 0]
    states[..., 0] *= 0.4
    after = Dynamics.known(SCENE, CART_TRUTH, threads=1).step(states[None], wrenches)[0]
    return states, wrenches, after


def predicted(rig: Similar, **options) -> tuple[np.ndarray, np.ndarray, set]:
    model = OOLWR(rig.scene(SCENE), **options)
    states, wrenches, after = played(400, 1)
    model.observe(states * rig.state, wrenches * rig.wrench, after * rig.state)
    states, wrenches, _ = played(100, 2)
    ends = model.step(states[None] * rig.state, wrenches * rig.wrench)[0] / rig.state
    linear, angular = model.acceleration("cart", rig.force, rig.force * rig.length)
    gains = linear * rig.time**2 / rig.length, angular * rig.time**2
    return ends, np.array(gains), set(model.conditions("cart"))


@pytest.mark.parametrize("options", [{}, {"neighbours": 50}, {"ridge": 0.0}])
@pytest.mark.parametrize("rig", RIGS)
def test_a_similar_cart_is_predicted_alike(rig, options) -> None:
    here, there = predicted(Similar(1.0, 1.0, 1.0), **options), predicted(rig, **options)
    assert len(here[2]) > 1 and there[2] == here[2]
    assert np.isfinite(here[0]).any()
    for one, other in zip(here[:2], there[:2], strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("rig", RIGS)
def test_one_transition_is_enough(rig) -> None:
    """All columns are constant: each counts in its unit."""
    states, wrenches, after = played(1, 1)
    new = played(5, 3)
    ends = []
    for one in (Similar(1.0, 1.0, 1.0), rig):
        model = OOLWR(one.scene(SCENE), relations=())
        model.observe(states * one.state, wrenches * one.wrench, after * one.state)
        ends.append(model.step(new[0][None] * one.state, new[1] * one.wrench) / one.state)
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-6, atol=1e-6)
