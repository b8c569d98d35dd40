"""The catalogue: each effect's law, its null value, what is said of it, and attaching."""

import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pbrl_ppl.effects import Effect, EffectParameter, Noise, attach, catalogue
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.places import ROOT
from tests.helpers.worlds import BY_NAME, G, body, predict, simulator, state

pytestmark = pytest.mark.one_stack

BOX = Shape.box(0.9, 0.55)
MASS = 2.0
INERTIA = MASS * BOX.unit_moment
NAMES = [effect.name for effect in catalogue]
#: Limits that nothing reaches.
LIMITS = ("saturation", "torque_saturation", "rate_limit", "torque_rate_limit")
#: How far from nothing shows an effect, where 0.3 is too little or too much.
AWAY = {
    "dead_zone": 5.0,
    "force_cutoff": 5.0,
    "magnus_force": 0.01,
    "quadratic_angular_drag": 1e-3,
    "pivot_hysteresis": 1e-2,
}
#: What changes dry friction under a body needs some.
BESIDE = {"sliding_stribeck": "sliding_friction"}
PATHS = pytest.mark.parametrize("path", ["auto", "python"])


def free(time_step: float = 1.0, substeps: int = 200) -> Scene:
    bodies = (body("puck", BOX, mass=MASS),)
    return Scene(time_step=time_step, substeps=substeps, bodies=bodies)


def full_scene(name: str = "") -> Scene:
    """A wheeled cart with an arm hinged to it, between walls; or with the arm on a rail.

    ``name`` is that of the effect that it is for.
    """
    joint = Joint("hinge", ("cart", "arm"), (0.5, 0.0), (0.0, 0.2))
    if name.startswith("slider"):
        joint = Joint("slider", ("arm", "world"), (0.0, 0.2), (0.5, 0.0), axis=(1.0, 0.2))
    cart = body("cart", BOX, wheel=True, mass=MASS, r=0.3, mu_c=0.3, mu_x=0.05, mu_y=0.4, w_x=-0.2)
    return Scene(
        time_step=0.1,
        gravity=(0.5, -1.0),
        normal_gravity=G,
        bodies=(cart, body("arm", Shape.box(0.05, 0.4), mass=0.3)),
        walls=(Wall((-1.0, -2.0), (-1.0, 2.0)), Wall((1.0, -2.0), (1.0, 2.0))),
        joints=(joint,),
    )


# -- what is said of them --------------------------------------------------------------------------


def test_catalogue_has_what_the_readme_promises() -> None:
    """The same names in the same order: the earlier is named where two cannot be told apart."""
    readme = (ROOT / "README.md").read_text()
    for start, unusual in (("Common", False), ("Unusual", True)):
        (promised,) = re.findall(rf"^{start}: (.*?)\.", readme, re.M | re.S)
        names = [one.name for one in catalogue if bool(one.unusual) is unusual]
        assert re.findall(r"`(\w+)`", promised) == names


@pytest.mark.parametrize("effect", catalogue, ids=lambda effect: effect.name)
def test_every_effect_says_what_it_is(effect) -> None:
    assert len(effect.sentence) > 20
    assert effect.reference
    assert hash(effect) == hash(dataclasses.replace(effect))
    for parameter in effect.parameters:
        assert parameter.unit
        lower, upper = parameter.prior.support
        assert lower <= parameter.null <= upper
        assert lower <= parameter.prior.centre <= upper
        draws = parameter.prior.sample(np.random.default_rng(0), 100)
        assert np.isfinite(draws).all()


@PATHS
@pytest.mark.parametrize("name", NAMES)
def test_null_value_is_no_effect(name, path) -> None:
    scene = full_scene(name)
    rng = np.random.default_rng(8)
    start = rng.normal(0, 1, (15, 2, 6)) * [0.2, 0.2, 1, 2, 2, 2]
    actions = rng.normal(0, 5, (15, 2, 2, 3))
    inputs = np.concatenate([actions, 0.5 * actions, 0.0 * actions], axis=-1)
    inputs[..., 7] = np.array([0.3, 0.4])[:, None]
    inputs[..., 8] = inputs[..., 7] + scene.time_step
    effect, beside = BY_NAME[name], [BY_NAME[BESIDE[name]]] if name in BESIDE else []
    plain = simulator(scene, beside, engine=path)
    without = plain(np.full(plain.physics.layout.size, 0.3), start, inputs)
    sim = simulator(scene, (*beside, effect), engine=path)
    values = {
        label: null
        for one in sim.physics.effects
        for label, null in zip(one.labels, one.effect.null, strict=True)
    }
    null, moved = np.array([(values[x], x.startswith(name)) for x in sim.physics.layout.labels]).T
    null = np.where(moved > 0, null, 0.3)
    # steps are chosen for a law's own numbers as well
    within = 1e-4 if getattr(effect.stage, "rate", None) else 0.0
    np.testing.assert_allclose(sim(null, start, inputs), without, rtol=0.0, atol=within)
    there = np.where(moved > 0, 1.0, null) if name in LIMITS else null + moved * AWAY.get(name, 0.3)
    away = sim(there, start, inputs)
    if isinstance(effect.stage, Noise):  # it changes the likelihood alone
        np.testing.assert_array_equal(away, without)
    else:
        assert np.abs(away - without).max() > 1e-4


# -- the laws --------------------------------------------------------------------------------------


@PATHS
@pytest.mark.parametrize("c", [0.5, 4.0])
def test_linear_drag_decays_exponentially(c, path) -> None:
    k = c / MASS
    got = predict(free(), state(vx=1.5, vy=-1.0), effects={"linear_drag": c}, engine=path)[0, 0]
    share = -math.expm1(-k) / k
    expected = state(1.5 * share, -share, 0, 1.5 * math.exp(-k), -math.exp(-k))
    np.testing.assert_allclose(got, expected, atol=2e-4 * c)


@PATHS
def test_quadratic_drag(path) -> None:
    """|v| = v0 / (1 + c v0 t / m) along a straight line of length m/c log(1 + c v0 t / m)."""
    c, speed = 1.3, 2.5
    grown = 1 + c * speed / MASS
    start = state(vx=0.6 * speed, vy=0.8 * speed)
    got = predict(free(), start, effects={"quadratic_drag": c}, engine=path)[0, 0]
    way, left = MASS / c * math.log(grown), speed / grown
    expected = state(0.6 * way, 0.8 * way, 0, 0.6 * left, 0.8 * left)
    np.testing.assert_allclose(got, expected, atol=2e-4)


@PATHS
def test_angular_drag_decays_exponentially(path) -> None:
    c = 0.2
    k = c / INERTIA
    got = predict(free(), state(vx=1.0, omega=3.0), effects={"angular_drag": c}, engine=path)[0, 0]
    expected = state(1.0, 0, -3 * math.expm1(-k) / k, 1.0, 0, 3 * math.exp(-k))
    np.testing.assert_allclose(got, expected, atol=1e-4)


@PATHS
def test_constant_wrenches(path) -> None:
    effects = {"constant_force": (1.0, -2.0), "constant_torque": 0.3}
    got = predict(free(), state(omega=1.0), (0.5, 0.5, 0.1), effects=effects, engine=path)[0, 0]
    a = np.array([1.5 / MASS, -1.5 / MASS, 0.4 / INERTIA])
    np.testing.assert_allclose(
        got, np.array([*(a / 2), *a]) + state(theta=1.0, omega=1.0), atol=1e-10
    )


@PATHS
def test_body_force_turns_with_the_body(path) -> None:
    """Turning at omega, a body-fixed force sums to F (sin wt, 1 - cos wt) / (m w)."""
    force, omega = 3.0, 2.0
    got = predict(free(), state(omega=omega), effects={"body_force": (force, 0.0)}, engine=path)[
        0, 0
    ]
    k = force / (MASS * omega)
    np.testing.assert_allclose(
        got[3:5], [k * math.sin(omega), k * (1 - math.cos(omega))], atol=2e-4
    )
    sideways = predict(free(), state(theta=0.4), effects={"body_force": (0.0, force)}, engine=path)
    a = force / MASS
    np.testing.assert_allclose(
        sideways[0, 0, 3:], [-a * math.sin(0.4), a * math.cos(0.4), 0.0], atol=1e-10
    )


@PATHS
def test_push_offset_is_the_moment_of_the_force(path) -> None:
    offset, force, theta = np.array([0.1, -0.05]), np.array([3.0, 1.0]), 0.7
    short = free(time_step=1e-3, substeps=10)
    got = predict(
        short, state(theta=theta), (*force, 0.2), effects={"push_offset": offset}, engine=path
    )[0, 0]
    c, s = math.cos(theta), math.sin(theta)
    arm = np.array([[c, -s], [s, c]]) @ offset
    torque = 0.2 + arm[0] * force[1] - arm[1] * force[0]
    np.testing.assert_allclose(got[3:5] / 1e-3, force / MASS, rtol=1e-9)
    assert got[5] / 1e-3 == pytest.approx(torque / INERTIA, rel=1e-4)


@PATHS
def test_push_offset_moves_only_the_commanded_force(path) -> None:
    effects = {"push_offset": (0.3, 0.2), "constant_force": (5.0, 5.0), "linear_drag": 1.0}
    got = predict(free(), state(vx=1.0), effects=effects, engine=path)
    np.testing.assert_allclose(got[0, 0, [2, 5]], 0.0, atol=1e-12)


@PATHS
def test_actuator_rotation_turns_the_commanded_force(path) -> None:
    effects = {"actuator_rotation": 0.3, "constant_force": (0.0, 1.0)}
    got = predict(free(), state(theta=1.0), (4.0, 0.0, 0.2), effects=effects, engine=path)[0, 0]
    a = np.array([4 * math.cos(0.3), 4 * math.sin(0.3) + 1.0]) / MASS
    np.testing.assert_allclose(got[3:], [*a, 0.2 / INERTIA], atol=1e-10)


@PATHS
def test_gravity_tilt_turns_gravity_for_all_masses_alike(path) -> None:
    """A free fall, beside a force that stays as it is."""
    scene = free().replace(gravity=(0.6, -G))
    effects = {"gravity_tilt": 0.2, "constant_force": (1.0, 0.0)}
    got = predict(scene, state(omega=1.0), effects=effects, engine=path)[0, 0]
    c, s = math.cos(0.2), math.sin(0.2)
    a = np.array([c * 0.6 + s * G + 1.0 / MASS, s * 0.6 - c * G])
    np.testing.assert_allclose(got, [*(a / 2), 1.0, *a, 1.0], atol=1e-10)


def test_gravity_tilt_needs_gravity_in_the_plane() -> None:
    assert not BY_NAME["gravity_tilt"].applies(free(), free().bodies[0])
    assert BY_NAME["gravity_tilt"].applies(free().replace(gravity=(0.0, -G)), free().bodies[0])


@PATHS
@pytest.mark.parametrize(
    ("effects", "factors"),
    [
        ({"force_gain": 1.3}, (1.3, 1.3, 1.0)),
        ({"torque_gain": 0.7}, (1.0, 1.0, 0.7)),
        ({"anisotropic_gain": (1.2, 0.5)}, (1.2, 0.5, 1.0)),
        ({"saturation": 2.5}, (0.5, 0.5, 1.0)),  # of a push of 5 N
        ({"saturation": 6.0}, (1.0, 1.0, 1.0)),
    ],
)
def test_gains_are_of_the_command_alone(effects, factors, path) -> None:
    """Along the world's axes, whatever the heading, and not of what else acts."""
    effects = effects | {"constant_force": (0.0, 2.0)}
    got = predict(free(), state(theta=0.7), (4.0, 3.0, 0.2), effects=effects, engine=path)[0, 0]
    x, y, turn = np.array([4.0, 3.0, 0.2]) * factors
    np.testing.assert_allclose(got[3:], [x / MASS, (y + 2.0) / MASS, turn / INERTIA], atol=1e-10)


@PATHS
def test_magnus_force_turns_the_motion(path) -> None:
    """Without a torque the velocity turns at c omega / m and keeps its size."""
    c, omega = 0.5, 2.0
    got = predict(
        free(), state(vx=1.0, vy=0.5, omega=omega), effects={"magnus_force": c}, engine=path
    )[0, 0]
    turned = complex(1.0, 0.5) * np.exp(1j * c * omega / MASS)
    np.testing.assert_allclose(got[3:], [turned.real, turned.imag, omega], atol=2e-4)


@PATHS
def test_a_spring_swings_about_its_anchor(path) -> None:
    k, anchor = 3.0, np.array([0.5, -1.0])
    rate = math.sqrt(k / MASS)
    got = predict(free(), state(vx=0.4), effects={"spring": (k, *anchor)}, engine=path)[0, 0]
    c, s = math.cos(rate), math.sin(rate)
    place = anchor - c * anchor + np.array([0.4 / rate * s, 0.0])
    np.testing.assert_allclose(got[:2], place, atol=2e-4)
    np.testing.assert_allclose(got[3:5], rate * s * anchor + np.array([0.4 * c, 0.0]), atol=2e-4)
    assert got[2] == got[5] == 0.0


@PATHS
def test_a_torsion_spring_turns_back_the_shorter_way(path) -> None:
    k = 0.3
    rate = math.sqrt(k / INERTIA)
    got = predict(free(), state(theta=3.0), effects={"torsion_spring": (k, -3.1)}, engine=path)[
        0, 0
    ]
    off = 6.1 - 2 * math.pi  # 0.18 rad short of it
    assert got[2] == pytest.approx(3.0 - off + off * math.cos(rate), abs=2e-4)
    assert got[5] == pytest.approx(-off * rate * math.sin(rate), abs=2e-4)
    np.testing.assert_array_equal(got[[0, 1, 3, 4]], 0.0)


@PATHS
def test_inertia_scale(path) -> None:
    got = predict(free(), state(), (1.0, 0, 0.3), effects={"inertia_scale": 1.7}, engine=path)[0, 0]
    np.testing.assert_allclose(got[3:], [1 / MASS, 0, 0.3 / (1.7 * INERTIA)], atol=1e-10)


@PATHS
def test_pivot_effects_at_the_centroid(path) -> None:
    """A disc that spins about its own centre: pure torque laws, without gravity's share."""
    disc = body("disc", Shape.circle(0.2), mass=MASS)
    joint = Joint("hinge", ("world", "disc"), (0.0, 0.0), (0.0, 0.0))
    scene = Scene(time_step=1.0, substeps=200, bodies=(disc,), joints=(joint,))
    inertia = MASS * 0.2**2 / 2
    c = 0.05
    damped = predict(scene, state(omega=3.0), effects={"pivot_damping": c}, engine=path)[0, 0]
    assert damped[5] == pytest.approx(3.0 * math.exp(-c / inertia), abs=1e-3)
    rubbed = predict(scene, state(omega=3.0), effects={"pivot_friction": c}, engine=path)[0, 0]
    assert rubbed[5] == pytest.approx(3.0 - c / inertia, abs=1e-6)
    stopped = predict(scene, state(omega=3.0), effects={"pivot_friction": 4 * c}, engine=path)[0, 0]
    assert stopped[5] == pytest.approx(0.0, abs=1e-9)
    assert stopped[2] == pytest.approx(3.0**2 / 2 * inertia / (4 * c), abs=1e-3)


def test_pivot_damping_acts_on_the_relative_speed() -> None:
    """Two discs that turn together about one axle lose nothing to the hinge between them."""
    discs = tuple(body(name, Shape.circle(0.2), mass=MASS) for name in ("one", "two"))
    joint = Joint("hinge", ("one", "two"), (0.0, 0.0), (0.0, 0.0))
    scene = Scene(time_step=0.5, substeps=50, bodies=discs, joints=(joint,))
    together = [state(omega=2.0), state(omega=2.0)]
    effects = {"pivot_damping": 0.05, "pivot_friction": 0.02}
    got = predict(scene, together, effects=effects)[0]
    np.testing.assert_allclose(got[:, 5], 2.0, atol=1e-9)
    got = predict(scene, [state(omega=3.0), state(omega=1.0)], effects={"pivot_damping": 0.05})[0]
    inertia = MASS * 0.2**2 / 2
    half = math.exp(-2 * 0.05 / inertia * 0.5)  # the difference decays at twice the rate
    np.testing.assert_allclose(got[:, 5], [2 + half, 2 - half], atol=2e-3)


# -- a user's own ----------------------------------------------------------------------------------


def cubic(state, command, parameters, wrench):
    wrench[0] -= parameters[0] * state[3] ** 3


def gust(state, command, parameters, wrench):
    wrench[1] += parameters[0] * math.sin(parameters[1] * state[0])


def own_effects() -> tuple[Effect, Effect]:
    drag = Prior("half_normal", sigma=10.0)
    return (
        Effect(
            "cubic_drag_x",
            (EffectParameter("coefficient", "N s^3/m^3", drag),),
            "a force against the motion along x that grows with the cube of the speed",
            "an example",
            force=cubic,
        ),
        Effect(
            "gust",
            (
                EffectParameter("force", "N", Prior("normal")),
                EffectParameter("wave_number", "1/m", Prior("normal"), null=1.0),
            ),
            "a force along y that changes with the place",
            "an example",
            force=gust,
        ),
    )


@settings(max_examples=20)
@given(st.floats(0.0, 3.0), st.floats(-2.0, 2.0))
def test_own_effect_on_both_paths(c, speed) -> None:
    """v = v0 / sqrt(1 + 2 c v0^2 t / m)."""
    drag, wind = own_effects()
    for path in ("auto", "python"):
        sim = simulator(free(substeps=50), (wind, drag), engine=path)
        phi = sim.physics.layout.to_vector(
            {"cubic_drag_x_coefficient": c, "gust_force": 0.4, "gust_wave_number": 2.0}
        )
        got = sim(phi, state(vx=speed)[None, None], np.zeros((1, 1, 1, 3)))[0, 0, 0]
        expected = speed / math.sqrt(1 + 2 * c * speed**2 / MASS)
        assert got[3] == pytest.approx(expected, abs=5e-3)
        if path == "auto":
            first = got
    np.testing.assert_allclose(got, first, rtol=1e-12, atol=1e-12)


def test_own_effect_may_be_declared_by_name() -> None:
    drag, _ = own_effects()
    puck = Body("puck", BOX, effects=("cubic_drag_x",))
    scene = Scene(time_step=0.1, bodies=(puck,))
    (one,) = attach(scene, effects=(*catalogue, drag))
    assert (one.effect, one.body) == (drag, "puck")
