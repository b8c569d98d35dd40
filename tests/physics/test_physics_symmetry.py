"""Invariances of the engine: it knows no place, no direction and no handedness."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.scene import Joint, Scene, Shape, Wall
from tests.helpers.worlds import G, body, predict

pytestmark = pytest.mark.one_stack

BOX = Shape.box(0.9, 0.55)
number = st.floats(-3.0, 3.0)
states = st.tuples(number, number, number, number, number, number)
wrenches = st.tuples(number, number, number)
wheels = st.fixed_dictionaries(
    {
        "w_x": st.floats(-0.4, 0.4),
        "w_y": st.floats(-0.25, 0.25),
        "w_theta": number,
        "mu_x": st.floats(0.0, 1.0),
        "mu_y": st.floats(0.0, 1.0),
    }
)
DRAG = {"quadratic_drag": 0.7, "angular_drag": 0.05}


def cart(wheel: dict[str, float], **kwargs) -> Scene:
    known = body("cart", BOX, wheel=True, mass=2.0, **wheel)
    return Scene(time_step=0.1, substeps=10, normal_gravity=G, bodies=(known,), **kwargs)


def turned(vector, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]) @ np.asarray(vector)


@given(states, wrenches, wheels, number, number)
def test_translation(start, wrench, wheel, x, y) -> None:
    scene = cart(wheel)
    shift = np.array([x, y, 0, 0, 0, 0])
    here = predict(scene, start, wrench, effects=DRAG)
    there = predict(scene, start + shift, wrench, effects=DRAG)
    np.testing.assert_allclose(there, here + shift, atol=1e-8)


@given(states, wrenches, wheels, number)
def test_rotation(start, wrench, wheel, angle) -> None:
    def turn(state: np.ndarray) -> np.ndarray:
        place, velocity = turned(state[:2], angle), turned(state[3:5], angle)
        return np.array([*place, state[2] + angle, *velocity, state[5]])

    scene = cart(wheel)
    there = predict(
        scene,
        turn(np.array(start)),
        (*turned(wrench[:2], angle), wrench[2]),
        effects=DRAG,
    )[0, 0]
    here = predict(scene, start, wrench, effects=DRAG)[0, 0]
    # a solver short of convergence depends on its axes, but those of the wheel turn with the body
    np.testing.assert_allclose(there, turn(here), atol=1e-7)


@given(states, wrenches, wheels)
def test_mirror(start, wrench, wheel) -> None:
    """In a mirror along x: y, theta, vy, omega, force_y, torque, w_y, w_theta change sign."""
    flip = np.array([1, -1, -1, 1, -1, -1])
    mirrored = wheel | {"w_y": -wheel["w_y"], "w_theta": -wheel["w_theta"]}
    here = predict(cart(wheel), start, wrench, effects=DRAG)
    there = predict(cart(mirrored), flip * start, np.array([1, -1, -1]) * wrench, effects=DRAG)
    np.testing.assert_allclose(there, flip * here, atol=1e-8)


@given(st.floats(-1.0, 1.0), st.floats(1.0, 3.0), number, number, st.integers(1, 7))
def test_impact_is_the_same_in_every_direction(y, vx, vy, angle, shift) -> None:
    """A disc meets a wall; disc and wall are turned and moved together."""

    def world(turn: float, x: float) -> Scene:
        ends = [tuple(turned(end, turn) + x) for end in ((0.8, -9.0), (0.8, 9.0))]
        puck = body("puck", Shape.circle(0.1), r=0.4, mu_c=0.3)
        return Scene(time_step=1.0, substeps=50, bodies=(puck,), walls=(Wall(*ends),))

    start = np.array([0.0, y, 0.0, vx, vy, 0.0])
    moved = np.array([*turned(start[:2], angle) + shift, 0, *turned(start[3:5], angle), 0.0])
    here = predict(world(0.0, 0.0), start)[0, 0]
    there = predict(world(angle, float(shift)), moved)[0, 0]
    # the substep in which they meet may differ by rounding; the velocities after may not
    np.testing.assert_allclose(there[3:5], turned(here[3:5], angle), atol=1e-6)
    assert there[5] == pytest.approx(here[5], abs=1e-6)


@given(number, number, st.floats(0.0, 0.02), st.floats(0.0, 0.02))
def test_mirrored_pendulum(theta, omega, damping, friction) -> None:
    scene = Scene(
        time_step=0.05,
        gravity=(0.0, -G),
        bodies=(body("arm", Shape.box(0.03, 0.4), mass=0.5),),
        joints=(Joint("hinge", ("arm", "world"), (0.0, 0.18), (0.0, 0.0)),),
    )

    def swing(angle: float, spin: float) -> np.ndarray:
        lever = np.array([np.sin(angle), -np.cos(angle)]) * 0.18
        start = (*lever, angle, -spin * lever[1], spin * lever[0], spin)
        pivot = {"pivot_damping": damping, "pivot_friction": friction}
        return predict(scene, start, horizon=5, effects=pivot)[:, 0]

    flip = np.array([-1, 1, -1, -1, 1, -1])
    np.testing.assert_allclose(swing(-theta, -omega), flip * swing(theta, omega), atol=1e-8)
