"""An undeclared wheel: the declared one's physics, under parameters of its own."""

import numpy as np
import pytest

from pbrl_ppl.effects import attach
from pbrl_ppl.scene import Scene, Shape
from tests.helpers.worlds import BY_NAME, G, body, predict, simulator, state

PATHS = pytest.mark.parametrize("path", ["compiled", "plain"])
BOX = Shape.box(0.9, 0.55)
WHEEL = {"w_x": -0.2, "w_y": 0.05, "w_theta": 0.3, "mu_x": 0.02, "mu_y": 0.4}


def floor(wheel: bool = False, normal_gravity: float = G, **known: float) -> Scene:
    puck = body("puck", BOX, mass=2.0, wheel=wheel, **known)
    return Scene(time_step=0.1, substeps=20, normal_gravity=normal_gravity, bodies=(puck,))


@PATHS
def test_it_is_what_a_declared_one_is(path) -> None:
    rng = np.random.default_rng(1)
    start = rng.normal(0.0, (1, 1, 1, 1, 1, 2), (10, 1, 6))
    actions = rng.normal(0.0, (6.0, 6.0, 1.0), (10, 3, 1, 3))
    declared = simulator(floor(wheel=True, **WHEEL), path=path)(np.zeros(0), start, actions)
    effect = simulator(floor(), (BY_NAME["wheel"],), path=path)
    found = effect(
        effect.layout.to_vector({f"wheel_{k}": v for k, v in WHEEL.items()}), start, actions
    )
    np.testing.assert_array_equal(found, declared)


@PATHS
@pytest.mark.parametrize(("speed", "mu"), [((1.0, 0.0), 0.1), ((0.0, 1.0), 0.5)])
def test_it_slows_more_across_than_along(speed, mu, path) -> None:
    """v = v0 - mu g t, a quarter turn on too."""
    at_centre = {"wheel": (0.0, 0.0, np.pi / 2, 0.5, 0.1)}
    got = predict(floor(), state(vx=speed[0], vy=speed[1]), effects=at_centre, path=path)[0, 0]
    np.testing.assert_allclose(got[3:5], np.array(speed) * (1 - 0.1 * mu * G), atol=1e-9)


def test_it_applies_where_a_body_has_none_and_is_pressed_on_a_floor() -> None:
    assert attach(floor(), (BY_NAME["wheel"],))
    for scene in (floor(wheel=True), floor(normal_gravity=0.0)):
        assert not BY_NAME["wheel"].applies(scene, scene.body("puck"))
