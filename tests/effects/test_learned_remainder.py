"""The law of a learned remainder: against its formula, compiled and plain, and as a value."""

import json
import pickle

import numpy as np
import pytest

from pbrl_ppl.effects import LEARNED_REMAINDER, candidates, catalogue, learned_remainder
from pbrl_ppl.scene import Scene, Shape
from tests.helpers.worlds import body, simulator, state

pytestmark = pytest.mark.one_stack

TABLE = json.dumps(
    {
        "centre": [[0.5, 0.0, 0.0], [0.0, -1.0, 0.3], [0.2, 0.1, 1.0]],
        "width": [[0.7, 2.0, 3.0], [1.0, 1.0, 1.0], [0.5, 0.6, 0.7]],
        "output": [0, 1, 2],
        "forms": [[2.0, 0.0, 0.0], [0.0, -1.5, 0.0], [0.0, 0.0, 0.4], [1.0, 0.5, 0.0]],
    }
)
WEIGHTS = np.array([0.7, -0.4, 1.3, 0.2])


def force(table: str, theta: float, vx: float, vy: float, omega: float) -> np.ndarray:
    """World-frame wrench by the formula."""
    given = json.loads(table)
    c, s = np.cos(theta), np.sin(theta)
    here = np.array([c * vx + s * vy, c * vy - s * vx, omega])
    off = (here - np.array(given["centre"])) / np.array(given["width"])
    sizes = (WEIGHTS @ np.array(given["forms"])) * np.exp(-0.5 * (off**2).sum(axis=1))
    along, across, torque = (sizes[np.array(given["output"]) == k].sum() for k in range(3))
    return np.array([c * along - s * across, s * along + c * across, torque])


def test_the_law_is_its_formula() -> None:
    effect = learned_remainder(TABLE)
    for theta, vx, vy, omega in np.random.default_rng(1).normal(size=(20, 4)):
        wrench = np.array([1.0, 2.0, 3.0])
        effect.stage.law(state(0, 0, theta, vx, vy, omega), np.zeros(3), WEIGHTS, wrench)
        np.testing.assert_allclose(wrench - (1, 2, 3), force(TABLE, theta, vx, vy, omega))


@pytest.mark.parametrize("path", ["auto", "python"])
def test_the_engine_is_moved_by_it(path: str) -> None:
    """Over a short interval the velocity changes by force over mass."""
    scene = Scene(time_step=1e-3, substeps=2, bodies=(body("puck", Shape.box(0.4, 0.3), mass=2.0),))
    engine = simulator(scene, (learned_remainder(TABLE),), engine=path)
    begin = state(0.0, 0.0, 0.7, 0.4, -0.8, 0.5)
    after = engine(WEIGHTS, begin[None, None], np.zeros((1, 1, 1, 3)))[0, 0, 0]
    moment = 2.0 * scene.bodies[0].shape.unit_moment
    wanted = force(TABLE, *begin[2:]) / (2.0, 2.0, moment)
    np.testing.assert_allclose((after - begin)[3:] / 1e-3, wanted, rtol=0.02, atol=1e-3)


def test_the_same_table_is_the_same_effect() -> None:
    """Also after a process has sent it to another; and no catalogue ever has it."""
    effect = learned_remainder(TABLE)
    assert learned_remainder(TABLE) is effect
    assert pickle.loads(pickle.dumps(effect.on("puck"))) == effect.on("puck")
    assert effect.null == (0.0,) * 4
    assert LEARNED_REMAINDER not in {one.name for one in catalogue}
    scene = Scene(time_step=0.1, bodies=(body("puck", Shape.box(0.4, 0.3)),))
    assert LEARNED_REMAINDER not in {one.effect.name for one in candidates(scene, ())}
