"""Eqs. 2 and 7 as plain functions."""

import numpy as np
import pytest

from pbrl_ppl.errors import ParameterError, SimulationError
from pbrl_ppl.physics import Transition
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.worlds import G

pytestmark = pytest.mark.one_stack  # plain numpy
PUCK = Shape.circle(0.1)


def scene(k: int = 2, **options) -> Scene:
    bodies = tuple(Body(f"b{i}", PUCK) for i in range(k))
    return Scene(time_step=0.5, bodies=bodies, **options)


def given(**values) -> dict[str, object]:
    return {"mass": 2.0, "r": 0.5, "mu_c": 0.0} | values


def apart(k: int) -> np.ndarray:
    """States of k bodies at rest, 5 m apart, one after the other."""
    states = np.zeros((k, 6))
    states[:, 0] = 5.0 * np.arange(k)
    return states.ravel()


@pytest.mark.parametrize("k", [1, 2, 5])
def test_equation_2_pushes_one_body(k) -> None:
    f = Transition(scene(k), given(mass=1.0 + np.arange(k)))
    for pushed in range(k):
        after = f([*apart(k), pushed, 3.0, -1.0, 0.01]).reshape(k, 6)
        expected = apart(k).reshape(k, 6)
        mass = 1.0 + pushed
        acceleration = np.array([3.0 / mass, -1.0 / mass, 0.01 / (mass * 0.1**2 / 2)])
        expected[pushed, :3] += acceleration * 0.5**2 / 2
        expected[pushed, 3:] += acceleration * 0.5
        np.testing.assert_allclose(after, expected, atol=1e-9)


def test_leading_axes_are_kept() -> None:
    f = Transition(scene(), given())
    rng = np.random.default_rng(1)
    x = np.concatenate([apart(2), [1, 2.0, 0.0, 0.0]]) + rng.normal(0, 0.1, (3, 4, 16))
    x[..., 12] = rng.integers(0, 2, (3, 4))
    together = f(x)
    assert together.shape == (3, 4, 12)
    np.testing.assert_array_equal(together[2, 1], f(x[2, 1]))
    assert f(x[:0]).shape == (0, 4, 12)


def test_general_form_pushes_all_bodies_for_many_intervals() -> None:
    f = Transition(scene(), given())
    wrenches = np.zeros((1, 3, 2, 3))
    wrenches[0, :, 0, 0], wrenches[0, :, 1, 1] = 1.0, -2.0
    got = f.predict(apart(2).reshape(1, 2, 6), wrenches)
    assert got.shape == (1, 3, 2, 6)
    time = 0.5 * np.arange(1, 4)
    np.testing.assert_allclose(got[0, :, 0, 3], 0.5 * time, atol=1e-12)
    np.testing.assert_allclose(got[0, :, 1, 4], -1.0 * time, atol=1e-12)


def test_effects_and_wheels_take_part() -> None:
    cart = Body("cart", Shape.box(0.9, 0.55), wheel=True, effects=("linear_drag",))
    room = Scene(time_step=0.1, normal_gravity=G, bodies=(cart,))
    wheel = {"w_x": 0.0, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.0, "mu_y": 0.5}
    f = Transition(room, given(**wheel, linear_drag_coefficient=1.0), substeps=50)
    after = f([0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0])
    assert after[3] == pytest.approx(np.exp(-0.1 / 2.0), abs=1e-6)


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (np.zeros(12), r"shape \(12,\), expected \(..., 16\).*for each of 2 bodies"),
        (0.0, "expected"),
        ([*apart(2), 2, 0, 0, 0], "pushed is 2, expected a whole number from 0 to 1: b0, b1"),
        ([*apart(2), 0.5, 0, 0, 0], "pushed is 0.5"),
        ([*apart(2), np.nan, 0, 0, 0], "pushed is nan"),
        ([*apart(2)[:-1], np.nan, 0, 0, 0, 0], "finite"),
        ([*apart(2), 0, np.inf, 0, 0], "finite"),
        ([*np.zeros(12), 0, 0, 0, 0], 'bodies "b0" and "b1" overlap'),
    ],
)
def test_bad_input(x, message) -> None:
    with pytest.raises(SimulationError, match=message):
        Transition(scene(), given())(x)


def test_body_deep_in_a_wall() -> None:
    f = Transition(scene(1, walls=(Wall((0.0, -1.0), (0.0, 1.0)),)), given())
    with pytest.raises(SimulationError, match='body "b0" and the wall from'):
        f(np.zeros(10))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mass": -1.0}, "body 'b0': mass is -1"),
        ({"mass": [1.0, 0.0]}, "body 'b1': mass is 0"),
        ({"mu_c": np.nan}, "body 'b0': mu_c is not finite"),
        ({"mass": [1.0, 2.0, 3.0]}, "mass has 3 values, expected 2"),
        ({"mas": 1.0}, '"mas" is not among the unknown ones.*did you mean "mass"'),
    ],
)
def test_bad_parameters_are_refused_at_once(values, message) -> None:
    with pytest.raises(ParameterError, match=message):
        Transition(scene(), given(**values))


def test_a_missing_parameter_is_named() -> None:
    with pytest.raises(ParameterError, match="r is missing"):
        Transition(scene(), {"mass": 1.0, "mu_c": 0.1})


@pytest.mark.parametrize("options", [{"substeps": 0}, {"threads": 0}])
def test_bad_options(options) -> None:
    with pytest.raises(SimulationError, match="at least 1"):
        Transition(scene(), given(), **options)


def test_divergence_is_nan() -> None:
    f = Transition(scene(1), given())
    assert np.isnan(f([0, 0, 0, 0, 0, 0, 0, 1e12, 0, 0])).all()
