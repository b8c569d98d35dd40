"""A centre of mass off the origin, against the equations of motion."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pbrl_ppl.scene import Joint, Scene, Shape
from tests.helpers.worlds import BY_NAME, G, body, phi_of, predict, simulator, state

pytestmark = pytest.mark.one_stack

PATHS = pytest.mark.parametrize("path", ["auto", "python"])
BOX = Shape.box(0.9, 0.55)
MASS, OFF = 2.0, (0.13, -0.07)
INERTIA = MASS * BOX.unit_moment


def cross(a, b) -> float:
    return a[0] * b[1] - a[1] * b[0]


def turned(theta, vector=OFF) -> np.ndarray:
    c, s = np.cos(theta), np.sin(theta)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def free(**options) -> Scene:
    return Scene(time_step=0.5, bodies=(body("puck", BOX, mass=MASS),), substeps=400, **options)


def fly(start, wrench, gravity=(0.0, 0.0), force=lambda v: np.zeros(2)) -> np.ndarray:
    """The end of a free flight by the equations of the centre of mass; a force on the origin."""

    def slope(t, s):
        arm = turned(s[2])
        own = s[3:5] + s[5] * np.array([arm[1], -arm[0]])  # the origin's velocity
        push = np.array(wrench[:2]) + force(own)
        turning = (wrench[2] + cross(-arm, push)) / INERTIA
        return [*s[3:], *(push / MASS + gravity), turning]

    arm, omega = turned(start[2]), start[5]
    begin = [*(start[:2] + arm), start[2], start[3] - omega * arm[1], start[4] + omega * arm[0]]
    end = solve_ivp(slope, (0, 0.5), [*begin, omega], rtol=1e-10, atol=1e-12).y[:, -1]
    arm, omega = turned(end[2]), end[5]
    return np.array(
        [*(end[:2] - arm), end[2], end[3] + omega * arm[1], end[4] - omega * arm[0], omega]
    )


@PATHS
def test_a_free_body_turns_about_its_centre_of_mass(path) -> None:
    start = state(0.3, -0.2, 0.7, 1.0, -0.5, 3.0)
    got = predict(free(), start, effects={"com_offset": OFF}, engine=path)[0, 0]
    np.testing.assert_allclose(got, fly(start, (0.0, 0.0, 0.0)), atol=2e-6)


@PATHS
def test_a_push_at_the_origin_turns_the_body_and_gravity_does_not(path) -> None:
    start, wrench, gravity = state(theta=0.4, omega=-1.0), (3.0, -2.0, 0.3), (0.5, -1.0)
    got = predict(
        free(gravity=gravity), start, wrench,
        effects={"com_offset": OFF, "linear_drag": 1.5}, engine=path,
    )[0, 0]  # fmt: skip
    expected = fly(start, wrench, np.array(gravity), lambda v: -1.5 * v)
    np.testing.assert_allclose(got, expected, atol=2e-4)
    without = predict(free(gravity=gravity), start, wrench, effects={"linear_drag": 1.5})[0, 0]
    assert np.abs(got - without).max() > 0.05


def test_gravity_alone_turns_nothing() -> None:
    got = predict(free(gravity=(0.0, -G)), state(), effects={"com_offset": OFF})[0, 0]
    assert got[2] == got[5] == 0.0


@PATHS
def test_physical_pendulum(path) -> None:
    """I theta'' = r x m g, with the moment of the hinge by Steiner's theorem."""
    rod, pivot = Shape.box(0.05, 0.2), (0.0, 0.1)
    scene = Scene(
        time_step=0.5, substeps=400, gravity=(0.0, -G), bodies=(body("rod", rod, mass=MASS),),
        joints=(Joint("hinge", ("rod", "world"), pivot, (0.0, 0.0)),),
    )  # fmt: skip
    off = (0.02, -0.03)
    arm = np.subtract(off, pivot)
    inertia = MASS * rod.unit_moment + MASS * (arm @ arm)

    def slope(t, s):
        return [s[1], cross(turned(s[0], arm), (0.0, -MASS * G)) / inertia]

    end = solve_ivp(slope, (0, 0.5), [0.6, -1.0], rtol=1e-10, atol=1e-12).y[:, -1]
    place = -turned(0.6, pivot)
    speed = -1.0 * np.array([-place[1], place[0]])
    start = state(*place, 0.6, *speed, -1.0)
    got = predict(scene, start, effects={"com_offset": off}, engine=path)[0, 0]
    np.testing.assert_allclose(got[[2, 5]], end, atol=1e-5)
    np.testing.assert_allclose(got[:2], -turned(got[2], pivot), atol=1e-6)


def test_double_pendulum_with_heavy_ends() -> None:
    """Lagrange's equations of two links, each with a mass, a moment and a centre of its own."""
    upper, lower = Shape.box(0.05, 0.2), Shape.box(0.05, 0.3)
    masses, offs = np.array([0.6, 0.5]), (np.array([0.01, -0.06]), np.array([-0.01, -0.05]))
    scales, torques = (1.3, 0.8), np.array([0.4, -0.1])
    scene = Scene(
        time_step=0.1, substeps=160, gravity=(0.0, -G),
        bodies=(body("upper", upper, mass=masses[0]), body("lower", lower, mass=masses[1])),
        joints=(
            Joint("hinge", ("upper", "world"), (0.0, 0.1), (0.0, 0.0)),
            Joint("hinge", ("upper", "lower"), (0.0, -0.1), (0.0, 0.15)),
        ),
    )  # fmt: skip
    own = np.array(
        [m * s * b.unit_moment for m, s, b in zip(masses, scales, (upper, lower), strict=True)]
    )
    # from a link's upper hinge to its centre of mass, and to the next hinge
    near = offs[0] - (0.0, 0.1), offs[1] - (0.0, 0.15)
    elbow = np.array([0.0, -0.2])

    def slope(t, s):
        angle, rate = s[:2], s[2:]
        a, b, e = turned(angle[0], near[0]), turned(angle[1], near[1]), turned(angle[0], elbow)
        coupling = masses[1] * (e @ b)
        inertia = np.array(
            [
                [own[0] + masses[0] * (a @ a) + masses[1] * (e @ e), coupling],
                [coupling, own[1] + masses[1] * (b @ b)],
            ]
        )
        swing = masses[1] * cross(e, b)  # d(e.b)/d(angle)
        bias = np.array([-swing * -(rate[1] ** 2), -swing * rate[0] ** 2])
        weight = -G * np.array([masses[0] * a[0] + masses[1] * e[0], masses[1] * b[0]])
        return [*rate, *np.linalg.solve(inertia, torques + weight + bias)]

    begin = np.array([0.4, -0.3, 1.5, -2.0])
    end = solve_ivp(slope, (0, 0.1), begin, rtol=1e-11, atol=1e-12).y[:, -1]

    def states(angle, rate):
        first, joint = -turned(angle[0], (0.0, 0.1)), turned(angle[0], elbow)
        second = joint - turned(angle[1], (0.0, 0.15))
        v_first = rate[0] * np.array([-first[1], first[0]])
        arm = second - joint
        v_second = rate[0] * np.array([-joint[1], joint[0]]) + rate[1] * np.array([-arm[1], arm[0]])
        return np.array(
            [[*first, angle[0], *v_first, rate[0]], [*second, angle[1], *v_second, rate[1]]]
        )

    sim = simulator(scene, (BY_NAME["com_offset"], BY_NAME["inertia_scale"]))
    values = dict(zip(("upper", "lower"), offs, strict=True))
    phi = np.zeros(sim.physics.layout.size)
    for i, label in enumerate(sim.physics.layout.labels):
        name, owner = label[:-1].split("[")
        which = ("upper", "lower").index(owner)
        phi[i] = (
            scales[which] if name == "inertia_scale_scale" else values[owner][int(name[-1] == "y")]
        )
    actions = np.zeros((1, 1, 2, 3))
    actions[..., 2] = torques
    got = sim(phi, states(begin[:2], begin[2:])[None], actions)[0, 0]
    np.testing.assert_allclose(got, states(end[:2], end[2:]), atol=3e-4)


@pytest.mark.parametrize("timed", [False, True])
def test_paths_agree(timed) -> None:
    """With a wheel, a wall and a load that is taken up on the way, for which mass is set again."""
    scene = dataclasses.replace(
        free(normal_gravity=G), substeps=20, time_step=0.1,
        bodies=(body("puck", BOX, wheel=True, mass=MASS, mu_x=0.1, mu_y=0.5, w_x=-0.2),),
    )  # fmt: skip
    effects = {"com_offset": OFF, "sliding_friction": (0.1, 0.2)}
    if timed:
        effects["mass_change"] = (1.5, 0.0, 0.15)
    rng = np.random.default_rng(4)
    start = rng.normal(0, 1, (6, 1, 6))
    actions = np.zeros((6, 3, 1, 9))
    actions[..., :6] = rng.normal(0, 3, (6, 3, 1, 6))
    actions[..., 7] = 0.1 * np.arange(3)[:, None]
    actions[..., 8] = 0.1 * np.arange(1, 4)[:, None]
    sims = [
        simulator(scene, tuple(BY_NAME[name] for name in effects), engine=path)
        for path in ("chipmunk", "python")
    ]
    got, plain = (sim(phi_of(sim.physics.layout, effects), start, actions) for sim in sims)
    np.testing.assert_allclose(got, plain, atol=1e-11)
