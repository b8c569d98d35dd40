"""Similar rigs, and one rig in other frames, have the same dimensionless predictions."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pbrl_ppl.effects import attach
from pbrl_ppl.history import with_units
from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.scene import Joint, Scene, Shape, Wall, motion_time
from tests.helpers.histories import simulated_history
from tests.helpers.plain import simulator_of
from tests.helpers.similar import (
    framed,
    similar,
    similar_history,
    similar_phi,
    similar_states,
    similar_wrench,
)
from tests.helpers.worlds import BY_NAME, G, body, phi_of

pytestmark = pytest.mark.one_stack

#: Powers of two change no digit but in the power that is the engine's collision bias: 3e-11 found.
EXACT = 1e-9
#: Rounding (1e-16) of the scaled numbers, magnified by impacts and by drift that is divided by a
#: substep; the largest difference found is 3e-13.
ROUNDING = 1e-10
#: Rounding of places a thousand times larger, and of angles; the largest difference found is 2e-10.
FAR_OFF = 1e-8
ENGINES = ("auto", "chipmunk", "python")


class Rig(NamedTuple):
    """A scene, its effects' parameters, and transitions."""

    scene: Scene
    effects: Mapping[str, Any]
    start: np.ndarray  # (transition, body, 6)
    actions: np.ndarray  # (transition, H, body, 3)

    def simulator(self, scene: Scene, engine: str) -> tuple[Simulator, np.ndarray]:
        """Return a simulator of a scene with these effects, and phi."""
        attached = attach(scene, [BY_NAME[name] for name in self.effects])
        physics = Physics(scene, attached, tolerance=1e-10)
        return simulator_of(physics, engine), phi_of(physics.layout, self.effects)

    def predict(self, engine: str) -> np.ndarray:
        simulator, phi = self.simulator(self.scene, engine)
        return simulator(phi, self.start, self.actions)

    def similar(self, engine: str, scale: tuple[float, float, float]) -> np.ndarray:
        """Return the predictions of the similar rig in the units of this one."""
        simulator, phi = self.simulator(similar(self.scene, *scale), engine)
        start, actions = similar_states(self.start, *scale), similar_wrench(self.actions, *scale)
        moved = similar_phi(phi, simulator.physics.layout, *scale)
        found = simulator(moved, start, actions)
        return similar_states(found, *(1.0 / each for each in scale))


def cart() -> Rig:
    wheel = {"w_x": 0.1, "w_y": 0.05, "w_theta": 0.3, "mu_x": 0.02, "mu_y": 0.3}
    scene = Scene(
        time_step=0.1,
        normal_gravity=G,
        bodies=(body("cart", Shape.box(0.9, 0.55), wheel=True, mass=2.0, **wheel),),
    )
    effects = {
        "linear_drag": 0.5,
        "quadratic_drag": 0.3,
        "angular_drag": 0.1,
        "constant_force": (0.4, -0.3),
        "com_offset": (0.05, -0.02),
        "sliding_friction": (0.05, 0.2),
        "actuator_delay": 0.03,
        "saturation": 15.0,
        "hidden_obstacle": (30.0, 30.0, 0.1),
    }
    rng = np.random.default_rng(1)
    start = rng.normal(0.0, 1.0, (4, 1, 6))
    return Rig(scene, effects, start, rng.normal(0.0, [12, 12, 2], (4, 3, 1, 3)))


def pendulum() -> Rig:
    arm = body("arm", Shape.box(0.03, 0.4), mass=0.5)
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.18), (0.0, 0.0))
    scene = Scene(time_step=0.05, gravity=(0.0, -G), bodies=(arm,), joints=(hinge,))
    rng = np.random.default_rng(2)
    theta, omega = rng.normal(0.0, [2.0, 4.0], (4, 2)).T
    c, s = 0.18 * np.cos(theta), 0.18 * np.sin(theta)
    start = np.stack([s, -c, theta, omega * c, omega * s, omega], axis=-1)[:, None]
    actions = rng.normal(0.0, [0, 0, 0.2], (4, 4, 1, 3))
    return Rig(scene, {"pivot_damping": 0.01, "pivot_friction": 0.02}, start, actions)


def discs() -> Rig:
    pair = (
        body("a", Shape.circle(0.6), mass=2.0, r=0.3, mu_c=0.4),
        body("b", Shape.circle(0.9), mass=4.0, r=0.5, mu_c=0.3),
    )
    floor = Wall((-99.0, 0.0), (99.0, 0.0))
    scene = Scene(time_step=0.1, gravity=(0.0, -G), bodies=pair, walls=(floor,))
    rng = np.random.default_rng(3)
    start = rng.normal(0.0, [0.05, 0.01, 1, 2, 1, 2], (4, 2, 6))
    start[..., :2] += [(0.0, 0.6), (1.45, 0.9)]
    start[:, 0, 3] += 2.0
    actions = rng.normal(0.0, [15, 15, 3], (4, 3, 2, 3))
    return Rig(scene, {"linear_drag": 1.0, "angular_drag": 0.1}, start, actions)


RIGS = {make.__name__: make() for make in (cart, pendulum, discs)}
scales = st.tuples(*(st.floats(*ends) for ends in ((-3, 3), (-6, 6), (-3, 2))))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", RIGS)
@settings(max_examples=6)
@given(powers=scales)
def test_similar_rigs_move_alike(name, engine, powers) -> None:
    length, mass, time = (10.0**power for power in powers)
    if name == "discs":  # below, overlaps are corrected too slowly: see `World`
        time = max(time, 1e-2)
    rig = RIGS[name]
    found = rig.similar(engine, (length, mass, time))
    np.testing.assert_allclose(found, rig.predict(engine), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize(
    "powers", [(-10, -20, -6), (10, 20, 6), (0, 0, -6), (-10, 0, 0), (3, 1, 2)]
)
def test_powers_of_two_change_nothing(name, engine, powers) -> None:
    rig = RIGS[name]
    found = rig.similar(engine, tuple(2.0**power for power in powers))
    np.testing.assert_allclose(found, rig.predict(engine), rtol=0, atol=EXACT)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", RIGS)
def test_similar_rigs_diverge_alike(name, engine) -> None:
    rig = RIGS[name]
    rig = rig._replace(actions=1e7 * rig.actions)
    found = rig.predict(engine)
    assert np.isnan(found).all(axis=(1, 2, 3)).any()
    for scale in ((1e-3, 1.0, 1.0), (1e3, 1e3, 1e-1)):
        np.testing.assert_array_equal(np.isnan(rig.similar(engine, scale)), np.isnan(found))


def test_similar_recordings_have_similar_units() -> None:
    scene, scale = RIGS["cart"].scene.replace(noise={"x": 0.01, "omega": 0.1}), (8.0, 0.25, 0.5)
    history = simulated_history(scene, {}, seed=1)
    here = similar(with_units(scene, history), *scale)
    there = with_units(similar(scene, *scale), similar_history(history, scene, *scale))
    for name, size in here.body("cart").typical:
        assert dict(there.body("cart").typical)[name] == pytest.approx(size, rel=1e-12)
    assert motion_time(there) == pytest.approx(scale[2] * motion_time(with_units(scene, history)))
    assert there.noise == here.noise == (("x", 0.08), ("omega", 0.2))
    fine, coarse = Physics(there), Physics(with_units(scene, history))
    assert fine.fine_enough == coarse.fine_enough
    assert fine.coarse.substeps == coarse.coarse.substeps


def test_an_anchor_is_sought_about_the_bodies() -> None:
    """Where the scene has neither walls nor poses: two ranges about their mean places."""
    puck = body("puck", Shape.circle(0.1))
    scene = Scene(
        time_step=0.1,
        bodies=(replace(puck, typical={"range": 3.0, "x": 500.0, "y": -20.0}),),
        joints=(Joint("hinge", ("puck", "world"), known=False),),
    )
    supports = dict(zip(Physics(scene).layout.labels, Physics(scene).layout.priors, strict=True))
    assert supports["b_x[joint1]"].support == (494.0, 506.0)
    assert supports["b_y[joint1]"].support == (-26.0, -14.0)


def moved(rig: Rig, turn: float, shift: tuple[float, float], mirrored: bool = False) -> Rig:
    """Return the rig in another frame: mirrored along x, turned (rad), then shifted (m)."""
    flip = -1.0 if mirrored else 1.0
    c, s = math.cos(turn), math.sin(turn)
    axes = np.array([[c, -flip * s], [s, flip * c]])
    start, actions = rig.start.copy(), rig.actions.copy()
    for vectors in (start[..., :2], start[..., 3:5], actions[..., :2]):
        vectors[:] = vectors @ axes.T
    start[..., :2] += shift
    for scalars in (start[..., 2], start[..., 5], actions[..., 2]):
        scalars *= flip
    start[..., 2] += turn
    scene = framed(rig.scene, lambda point: axes @ point + shift, turn, mirrored)
    return Rig(scene, rig.effects, start, actions)


#: Effects without a direction.
ISOTROPIC = {
    "cart": {"linear_drag": 0.5, "angular_drag": 0.1, "sliding_friction": (0.05, 0.2)},
    "pendulum": RIGS["pendulum"].effects,
    "discs": RIGS["discs"].effects,
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", RIGS)
@settings(max_examples=4)
@given(
    turn=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
    mirrored=st.booleans(),
)
def test_a_rig_moves_alike_in_every_frame(name, engine, turn, shift, mirrored) -> None:
    """Also a thousand bodies from the origin."""
    rig = RIGS[name]._replace(effects=ISOTROPIC[name])
    far = tuple(x * rig.scene.bodies[0].shape.bounding_radius for x in shift)
    here = moved(rig._replace(start=rig.predict(engine)[:, -1]), turn, far, mirrored).start
    there = moved(rig, turn, far, mirrored).predict(engine)[:, -1]
    np.testing.assert_allclose(there, here, rtol=0, atol=FAR_OFF)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("turns", [-1000, 3])
def test_whole_turns_change_nothing(name, engine, turns) -> None:
    rig, full = RIGS[name], [0, 0, 2.0 * math.pi * turns, 0, 0, 0]
    found = rig._replace(start=rig.start + full).predict(engine) - full
    np.testing.assert_allclose(found, rig.predict(engine), rtol=0, atol=FAR_OFF)
