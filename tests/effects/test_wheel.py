"""A wheel that the scene does not declare: the physics of a declared one, found on Box2D's data."""

import numpy as np
import pytest

from pbrl_ppl.effects import attach
from pbrl_ppl.errors import EffectError
from pbrl_ppl.scene import Scene, Shape, Wall
from tests.helpers.worlds import BY_NAME, G, body, simulator

pytestmark = pytest.mark.one_stack

PATHS = pytest.mark.parametrize("path", ["compiled", "plain"])
BOX = Shape.box(0.9, 0.55)
WHEEL = {"w_x": -0.25, "w_y": 0.05, "w_theta": 0.3, "mu_x": 0.05, "mu_y": 0.4}
WALL = (Wall((1.0, -2.0), (1.0, 2.0)),)


def scene(wheel: bool, walls: tuple[Wall, ...] = ()) -> Scene:
    known = WHEEL if wheel else {}
    box = body("box", BOX, wheel=wheel, mass=3.0, r=0.3, mu_c=0.3, **known)
    return Scene(time_step=0.1, substeps=20, normal_gravity=G, bodies=(box,), walls=walls)


@PATHS
@pytest.mark.parametrize("walls", [(), WALL], ids=["alone", "wall"])
def test_it_is_the_wheel_of_table_1(path, walls) -> None:
    rng = np.random.default_rng(2)
    start = rng.normal(0, [0.5, 0.5, 1, 1, 1, 2], (20, 1, 6))
    actions = rng.normal(0, [10, 10, 2], (20, 3, 1, 3))
    declared = simulator(scene(True, walls), path=path)(np.zeros(0), start, actions)
    own = simulator(scene(False, walls), (BY_NAME["wheel"],), path=path)
    added = own(np.array(list(WHEEL.values())), start, actions)
    np.testing.assert_allclose(added, declared, rtol=0, atol=1e-12)
    frictionless = own(np.zeros(5), start, actions)
    assert np.abs(added - frictionless).max() > 0.01


def test_a_body_has_one_wheel() -> None:
    with pytest.raises(EffectError, match="does not apply to body 'box'"):
        attach(scene(True), (BY_NAME["wheel"].on("box"),))


def test_places_are_on_the_body_and_directions_within_a_right_angle() -> None:
    looks = BY_NAME["wheel"].scan(scene(False), None, scene(False).bodies[0])
    x_min, x_max, y_min, y_max = BOX.bounds
    assert ((looks[:, 0] > x_min) & (looks[:, 0] < x_max)).all()
    assert ((looks[:, 1] > y_min) & (looks[:, 1] < y_max)).all()
    assert (looks[:, 2] < 0.5 * np.pi).all()
    assert np.isnan(looks[:, 3:]).all()
