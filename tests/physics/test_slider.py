"""Bodies that slide on an axis, against closed forms, the textbook and the other engines."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from pbrl_ppl.errors import SceneError, SimulationError
from pbrl_ppl.history import History, fill_joints
from pbrl_ppl.likelihood.coordinates import observed_coordinates
from pbrl_ppl.physics import check_placement
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, Shape
from tests.helpers.worlds import G, body, predict, simulator, state

BOX, ARM = Shape.box(0.2, 0.1), Shape.box(0.04, 0.6)
SLOPE = 0.5
C, S = math.cos(0.4), math.sin(0.4)
ALONG = np.array([math.cos(SLOPE), math.sin(SLOPE)])


def on_a_rail(
    *, turned: bool = False, backwards: bool = False, post: bool = False, **options
) -> Scene:
    """A mass of 2 kg on an inclined rail, with a given angle against it.

    It is that of the world, or of a static body that is turned by 0.4 rad.
    """
    cart = dataclasses.replace(body("cart", BOX, mass=2.0), pose=(0.0, 0.0, 0.3))
    angle = SLOPE + math.pi * backwards - 0.3 * turned
    ends = [("cart", (0.05, 0.02)), (WORLD, (0.1, 0.2))]
    (a, at_a), (b, at_b) = ends[::-1] if turned else ends
    joint = Joint("slider", (a, b), at_a, at_b, axis=(math.cos(angle), math.sin(angle)))
    bodies = (cart,)
    if post:
        at = np.array([[C, S], [-S, C]]) @ (0.1 - 2.0, 0.2 - 1.0)
        way = (math.cos(angle - 0.4), math.sin(angle - 0.4))
        joint = Joint("slider", ("cart", "post"), (0.05, 0.02), tuple(at), axis=way)
        bodies += (Body("post", BOX, static=True, pose=(2.0, 1.0, 0.4)),)
    given = {"time_step": 0.1, "gravity": (0.0, -G), "bodies": bodies, "joints": (joint,)}
    return Scene(**given | options)


def start_of(scene: Scene, x: float = 0.0, speed: float = 0.0) -> np.ndarray:
    """A state on the rail, from x and the speed along it."""
    start = np.full((1, 1, 1, 6), np.nan)
    start[..., 0], start[..., 3] = x, speed * ALONG[0]
    fill_joints(start, scene)
    return start[0, 0]


def cart_pole(**options) -> Scene:
    bodies = (body("cart", BOX, mass=1.5), body("pole", ARM, mass=0.7))
    joints = (
        Joint("slider", ("cart", WORLD), (0.0, 0.0), (0.0, 0.0), axis=(1.0, 0.0)),
        Joint("hinge", ("pole", "cart"), (0.0, 0.3), (0.0, 0.0)),
    )
    given = {"time_step": 0.05, "gravity": (0.0, -G), "bodies": bodies, "joints": joints}
    return Scene(**given | options)


def cart_pole_start(angle: float, rate: float, speed: float = 0.0) -> np.ndarray:
    s, c = math.sin(angle), math.cos(angle)
    pole = state(0.3 * s, -0.3 * c, angle, speed + 0.3 * rate * c, 0.3 * rate * s, rate)
    return np.array([state(vx=speed), pole])


@pytest.mark.parametrize("engine", ["auto", "chipmunk", "python"])
@pytest.mark.parametrize("mu", [0.0, 3.0, 20.0])
def test_a_mass_on_an_inclined_rail(engine, mu) -> None:
    """It slows down uphill, stops, and stays or slides back, as dry friction lets it."""
    scene, speed, horizon = on_a_rail(substeps=40), 1.0, 8
    got = predict(
        scene, start_of(scene, speed=speed), horizon=horizon, effects={"slider_friction": mu},
        engine=engine,
    )[:, 0]  # fmt: skip
    pull, slowing = G * math.sin(SLOPE), mu / 2.0
    stop = speed / (pull + slowing)
    t = 0.1 * np.arange(1, horizon + 1)
    late, back = np.maximum(t - stop, 0.0), max(pull - slowing, 0.0)
    v = speed - (pull + slowing) * np.minimum(t, stop) - back * late
    way = speed * np.minimum(t, stop) - (pull + slowing) * np.minimum(t, stop) ** 2 / 2
    way -= back * late**2 / 2
    begin = start_of(scene)[0]
    near = 1e-9 if engine == "auto" else 3e-3
    np.testing.assert_allclose(got[:, :2], begin[:2] + way[:, None] * ALONG, atol=near)
    np.testing.assert_allclose(got[:, 3:5], v[:, None] * ALONG, atol=10 * near)
    np.testing.assert_allclose(got[:, [2, 5]], [[0.3, 0.0]] * horizon, atol=1e-12)


@pytest.mark.parametrize("engine", ["auto", "python"])
def test_damping_is_exponential(engine) -> None:
    scene = on_a_rail(gravity=(0.0, 0.0), substeps=40)
    got = predict(
        scene, start_of(scene, speed=1.0), horizon=5, effects={"slider_damping": 3.0}, engine=engine
    )
    speed = np.exp(-1.5 * 0.1 * np.arange(1, 6))
    np.testing.assert_allclose(got[:, 0, 3:5], speed[:, None] * ALONG, atol=1e-5)


def test_a_pendulum_on_a_cart_is_that_of_the_textbook() -> None:
    damping, turning, push, m, big, r, steps = 0.8, 0.05, 1.3, 0.7, 1.5, 0.3, 60
    moment = m * ARM.unit_moment

    def rate(t, q):
        v, w, s, c = q[2], q[3], math.sin(q[1]), math.cos(q[1])
        mass = np.array([[m + big, m * r * c], [m * r * c, moment + m * r * r]])
        force = [push - damping * v + m * r * w * w * s, -turning * w - m * G * r * s]
        return [v, w, *np.linalg.solve(mass, force)]

    times = 0.05 * np.arange(1, steps + 1)
    solved = solve_ivp(
        rate, (0.0, times[-1]), [0.0, 2.5, 0.4, -1.0], "DOP853", times, rtol=1e-12, atol=1e-12
    ).y.T
    got = predict(
        cart_pole(), cart_pole_start(2.5, -1.0, 0.4), [[push, 0.0, 0.0], [0.0, 0.0, 0.0]],
        horizon=steps, effects={"slider_damping": damping, "pivot_damping": turning},
        tolerance=1e-10,
    )  # fmt: skip
    np.testing.assert_allclose(got[:, 0, [0, 3]], solved[:, [0, 2]], atol=1e-7)
    np.testing.assert_allclose(got[:, 1, [2, 5]], solved[:, [1, 3]], atol=1e-7)
    np.testing.assert_allclose(got[:, 0, [1, 2, 4, 5]], 0.0, atol=1e-12)


def turning_rail(*, turned: bool = False) -> Scene:
    """A bead on an arm that turns about the world, and a pendulum far below on the bead."""
    bodies = (
        dataclasses.replace(body("arm", ARM, mass=1.2), pose=(0.0, 0.0, 0.2)),
        dataclasses.replace(body("bead", BOX, mass=0.4), pose=(0.0, 0.0, 0.9)),
        body("pole", ARM, mass=0.3),
    )
    ends = [("bead", (0.03, 0.01), 0.5), ("arm", (0.02, 0.1), 1.2)]
    (a, at_a, _), (b, at_b, angle) = ends[::-1] if turned else ends  # 1.2 + 0.2 = 0.5 + 0.9
    joints = (
        Joint("hinge", ("arm", WORLD), (0.0, 0.2), (0.0, 0.0)),
        Joint("slider", (a, b), at_a, at_b, axis=(math.cos(angle), math.sin(angle))),
        Joint("hinge", ("bead", "pole"), (0.0, -0.05), (0.0, 1.5)),
    )
    return Scene(time_step=0.05, gravity=(0.0, -G), bodies=bodies, joints=joints)


def turning_start(scene: Scene) -> np.ndarray:
    start = np.full((1, 1, 3, 6), np.nan)
    start[0, 0, 0, [2, 5]] = 0.7, 2.0
    start[0, 0, 1, [0, 3]] = 0.2, 0.5
    start[0, 0, 2, [2, 5]] = -0.4, 1.0
    fill_joints(start, scene)
    return start[0, 0]


@pytest.mark.parametrize("free", [False, True])
def test_energy_is_kept_on_a_turning_rail(free) -> None:
    """Which a hinge holds, or which falls."""
    scene = turning_rail()
    start = turning_start(scene)
    if free:
        scene = scene.replace(joints=scene.joints[1:])
    got = np.concatenate([start[None], predict(scene, start, horizon=40, tolerance=1e-10)])
    mass = np.array([1.2, 0.4, 0.3])
    moment = mass * [b.shape.unit_moment for b in scene.bodies]
    energy = 0.5 * (got[..., 3] ** 2 + got[..., 4] ** 2) @ mass + 0.5 * got[..., 5] ** 2 @ moment
    energy += G * got[..., 1] @ mass
    assert np.ptp(got[:, 1, 0]) > 0.1
    np.testing.assert_allclose(energy, energy[0], atol=1e-8)
    np.testing.assert_allclose(got[:, 1, 2] - got[:, 0, 2], 0.7, atol=1e-12)
    check_placement(scene, got)
    if not free:  # all follows from two angles and one position
        known = np.array([2, 1, 2])[:, None] == np.arange(6) % 3
        again = np.where(known, got, np.nan)[None]
        fill_joints(again, scene)
        np.testing.assert_allclose(again[0], got, atol=1e-9)


@pytest.mark.parametrize("change", ["turned", "backwards", "post"])
def test_the_order_of_bodies_and_the_way_of_the_axis_do_not_matter(change) -> None:
    effects = {"slider_friction": 3.0, "slider_damping": 0.5, "com_offset": (0.02, 0.01)}
    one, other = on_a_rail(), on_a_rail(**{change: True})
    for engine in ("auto", "chipmunk"):
        both = [
            predict(s, start_of(one, speed=1.0), horizon=8, effects=effects, engine=engine)
            for s in (one, other)
        ]
        np.testing.assert_allclose(*both, atol=1e-9)
    if change == "turned":
        scene = turning_rail()
        both = [
            predict(s, turning_start(scene), horizon=20) for s in (scene, turning_rail(turned=True))
        ]
        np.testing.assert_allclose(*both, atol=1e-9)


@pytest.mark.parametrize("dry", [0.0, 0.6])
def test_the_engines_agree(dry) -> None:
    """On a cart with a pendulum, in proportion to Chipmunk's step; a table of two sliders too."""
    effects = {"slider_friction": dry, "slider_damping": 0.4, "pivot_damping": 0.02}
    start, off = cart_pole_start(1.0, 2.0, 1.0), []
    exact = predict(cart_pole(), start, horizon=10, effects=effects)
    for n in (40, 160):
        scene = cart_pole(substeps=n)
        off.append(
            [
                abs(
                    predict(scene, start, horizon=10, effects=effects, engine=e, extrapolate=False)
                    - exact
                )
                for e in ("chipmunk", "python")
            ]
        )
        np.testing.assert_allclose(*off[-1], atol=1e-9)
    assert off[1][0].max() < 0.02
    assert 0.8 < np.log(np.median(off[0][0]) / np.median(off[1][0])) / np.log(4) < 1.2


def test_a_table_of_two_sliders() -> None:
    bodies = (body("low", BOX), body("high", Shape.circle(0.05), mass=0.5))
    joints = (
        Joint("slider", (WORLD, "low"), (0.0, 0.0), (0.0, 0.0), axis=(1.0, 0.0)),
        Joint("slider", ("high", "low"), (0.0, 0.0), (0.0, 0.05), axis=(0.0, 2.0)),
    )
    scene = Scene(time_step=0.1, bodies=bodies, joints=joints, normal_gravity=G, substeps=100)
    start = [state(vx=0.2), state(y=0.1, vx=0.2, vy=-0.3)]
    wrench = [[0.0, 0.0, 0.0], [1.0, 2.0, 0.4]]
    got = predict(scene, start, wrench, horizon=4)
    t = 0.1 * np.arange(1, 5)
    x, y = 0.2 * t + t**2 / 3, 0.1 - 0.3 * t + 2 * t**2
    np.testing.assert_allclose(got[:, 1, :2], np.stack([x, y], -1), atol=1e-9)
    np.testing.assert_allclose(got[:, 0, 0], x, atol=1e-9)
    assert not got[..., [2, 5]].any()
    effects = {"sliding_friction": (0.1, 0.03)}
    one, other = (
        predict(scene, start, wrench, horizon=4, effects=effects, engine=engine, extrapolate=False)
        for engine in ("auto", "python")
    )
    np.testing.assert_allclose(one, other, atol=2e-3)


def test_friction_on_the_floor_under_a_slider() -> None:
    """A ring of friction brakes by its whole weight, wherever it is."""
    scene = on_a_rail(gravity=(0.0, 0.0), normal_gravity=G)
    got = predict(
        scene, start_of(scene, speed=1.0), horizon=12, effects={"sliding_friction": (0.1, 0.05)}
    )[:, 0]
    t = np.minimum(0.1 * np.arange(1, 13), 1.0 / (0.1 * G))
    way = t - 0.1 * G * t**2 / 2
    np.testing.assert_allclose(got[:, :2], start_of(scene)[0, :2] + way[:, None] * ALONG, atol=1e-9)


def test_a_cart_meets_an_end_stop() -> None:
    """Momentum is kept between carts on one rail, and a static body stops the second."""
    carts = [
        dataclasses.replace(body(n, BOX, r=1.0), pose=(x, 0, 0)) for n, x in (("a", 0), ("b", 0.6))
    ]
    stop = dataclasses.replace(body("stop", BOX), static=True, pose=(1.2, 0.0, 0.0), known=())
    joints = tuple(Joint("slider", (n, WORLD), (0, 0), (0, 0), axis=(1, 0)) for n in "ab")
    scene = Scene(time_step=0.1, bodies=(*carts, stop), joints=joints, substeps=100)
    got = predict(scene, [state(vx=1.0), state(x=0.6)], horizon=7)
    np.testing.assert_allclose(got[5, :, 3], [0.0, 1.0], atol=0.02)
    assert got[-1, 1, 0] < 1.0
    for engine in ("auto", "chipmunk"):
        got = predict(scene, [state(vx=1.0), state(x=0.6)], horizon=10, engine=engine)
        np.testing.assert_allclose(got[-1, :, 3], [0.0, -1.0], atol=0.02)
        assert not got[..., [1, 2, 4, 5]].any()


def test_a_slider_that_turns_has_no_contacts() -> None:
    scene = turning_rail()
    with pytest.raises(SimulationError, match=r"slider of bead and arm turns.*'auto'"):
        predict(scene, turning_start(scene), engine="chipmunk")


def test_an_inferred_anchor_moves_the_line() -> None:
    scene = on_a_rail()
    (rail,) = scene.joints
    sim = simulator(scene.replace(joints=(dataclasses.replace(rail, known=False),)))
    assert sim.physics.layout.size == 4
    for height in (0.2, 0.5):
        moved = dataclasses.replace(rail, anchor_b=(0.1, height))
        there = scene.replace(joints=(moved,))
        phi = sim.physics.layout.to_vector({"a_x": 0.05, "a_y": 0.02, "b_x": 0.1, "b_y": height})
        start = start_of(there, speed=1.0)
        got = sim(phi, start[None], np.zeros((1, 4, 1, 3)))[0]
        np.testing.assert_allclose(got, predict(there, start, horizon=4), atol=1e-12)


def test_toml() -> None:
    scene = on_a_rail()
    assert Scene.from_toml(scene.to_toml()) == scene
    text = scene.to_toml()
    for old, new, message in (
        ("axis = ", "# axis = ", r"slider without an axis; add axis = \[x, y\].*frame of world"),
        ('kind = "slider"', 'kind = "hinge"', "it is a hinge and has an axis.*drop axis"),
        ("axis = ", "axis = [0, 0] # ", "axis is .*expected a direction"),
        ("axis = ", "axis = [1] # ", "axis has 1 numbers, expected 2"),
    ):
        with pytest.raises(SceneError, match=message):
            Scene.from_toml(text.replace(old, new))
    with pytest.raises(SceneError, match="slider without bodies"):
        Joint("slider", known=False, axis=(1, 0))


@pytest.mark.parametrize("measured", ["x", "y", "xy"])
def test_missing_cells_are_completed(measured) -> None:
    scene, time = on_a_rail(), 0.1 * np.arange(30)
    way = 0.3 * np.sin(time)
    begin = start_of(scene)[0]
    truth = begin[:2] + way[:, None] * ALONG
    rows = pd.DataFrame({"trajectory": 0, "time": time, "body": "cart"})
    for column, values in zip("xy", truth.T, strict=True):
        rows[column] = values if column in measured else np.nan
    columns = ["theta", "vx", "vy", "omega"]
    rows = rows.assign(**dict.fromkeys(columns, np.nan), force_x=0.0, force_y=0.0, torque=0.0)
    history = History.from_dataframe(rows, scene)
    start = history.dataset["start"].to_numpy()[0, :, 0]
    np.testing.assert_allclose(start[:, :2], truth, atol=1e-12)
    np.testing.assert_allclose(start[:, 2], 0.3)
    np.testing.assert_allclose(start[:, 5], 0.0)
    speed = 0.3 * np.cos(time)[:, None] * ALONG
    np.testing.assert_allclose(start[2:-2, 3:5], speed[2:-2], atol=2e-3)
    assert history.dataset["observed"].isnull().to_numpy()[0, :, 0, 2].all()
    # a filter takes one coordinate and its rate, from which the others follow
    coordinates = observed_coordinates(scene, history)
    assert coordinates.places.tolist() == ([1, 4] if measured == "y" else [0, 3])
    states = np.where(np.isin(np.arange(6), coordinates.places), start, 7.0)[:, None]
    np.testing.assert_allclose(coordinates.completed(scene, states)[:, 0], start, atol=1e-9)


def test_a_body_off_its_rail_is_refused() -> None:
    scene = on_a_rail()
    on, off = start_of(scene, x=3.0), start_of(scene)
    check_placement(scene, on[None])
    off[0, :2] += 0.1 * np.array([-ALONG[1], ALONG[0]])
    with pytest.raises(SimulationError, match=r"anchors of the slider joint.*are 0.1 m apart"):
        check_placement(scene, off[None])
    on[0, 2] += 0.5
    with pytest.raises(SimulationError, match=r"cart is turned by 0.5 rad against world.*pose"):
        check_placement(scene, on[None])
