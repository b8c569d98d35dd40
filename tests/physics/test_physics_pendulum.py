"""Hinges and rods against the pendulum's closed forms, an ODE solver and MuJoCo."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from pbrl_ppl.scene import Joint, Scene, Shape
from tests.helpers.worlds import G, body, predict, state

pytestmark = pytest.mark.one_stack

ARM = Shape.box(0.03, 0.4)
MASS, LEVER = 0.5, 0.18
MOMENT = MASS * ARM.unit_moment + MASS * LEVER**2  # about the hinge, kg m^2


def pendulum(time_step: float, substeps: int, order: int = 1) -> Scene:
    bodies, anchors = ("arm", "world"), ((0.0, LEVER), (0.0, 0.0))
    return Scene(
        time_step=time_step,
        substeps=substeps,
        gravity=(0.0, -G),
        bodies=(body("arm", ARM, mass=MASS),),
        joints=(Joint("hinge", bodies[::order], *anchors[::order]),),
    )


def hanging(theta: float, omega: float = 0.0) -> np.ndarray:
    """State of the arm that its hinge allows."""
    x, y = LEVER * np.sin(theta), -LEVER * np.cos(theta)
    return state(x, y, theta, -omega * y, omega * x, omega)


def solve(theta: float, omega: float, times, damping=0.0, friction=0.0, torque=0.0) -> np.ndarray:
    def rates(_, s):
        moment = torque - MASS * G * LEVER * np.sin(s[0]) - damping * s[1]
        return [s[1], (moment - friction * np.sign(s[1])) / MOMENT]

    times = np.asarray(times)
    solution = solve_ivp(
        rates, (0, times[-1]), (theta, omega), t_eval=times, rtol=1e-10, atol=1e-12
    )
    return solution.y.T


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("amplitude", [0.05, 1.0, 2.5])
def test_period_is_the_elliptic_integral(amplitude, order) -> None:
    period = 4 * np.sqrt(MOMENT / (MASS * G * LEVER)) * ellipk(np.sin(amplitude / 2) ** 2)
    back = predict(pendulum(period / 50, 200, order), hanging(amplitude), horizon=50)[-1, 0]
    assert back[2] == pytest.approx(amplitude, rel=1e-3)
    # the angle is stationary there; a wrong period shows in the speed, in units of its greatest
    greatest = amplitude * 2 * np.pi / period
    assert back[5] == pytest.approx(0.0, abs=2e-3 * greatest)


def test_hinge_holds_its_anchors_together() -> None:
    states = predict(pendulum(0.02, 20), hanging(2.0, 3.0), horizon=100)[:, 0]
    theta = states[:, 2]
    lever = LEVER * np.stack([np.sin(theta), -np.cos(theta)], axis=1)
    np.testing.assert_allclose(states[:, :2], lever, atol=1e-3 * LEVER)


@pytest.mark.parametrize(
    ("damping", "friction", "torque"),
    [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.05, 0.0), (0.01, 0.03, 0.1)],
)
def test_against_an_ode_solver(damping, friction, torque) -> None:
    """And the order: twice the substeps, a quarter of the error or less; half as they come."""
    effects = {"pivot_damping": damping, "pivot_friction": friction}
    exact = solve(0.3, 6.0, [0.1, 0.2], damping, friction, torque)[-1]
    assert exact[1] > 0  # it has not turned back: dry friction would jump, and the order be lost

    def error(substeps: int, extrapolate: bool, engine: str = "chipmunk") -> float:
        got = predict(
            pendulum(0.1, substeps),
            hanging(0.3, 6.0),
            (0, 0, torque),
            horizon=2,
            effects=effects,
            extrapolate=extrapolate,
            engine=engine,
        )
        return float(np.abs(got[-1, 0, [2, 5]] - exact).max())

    assert error(1, False, "auto") < 1e-5
    second = [error(n, True) for n in (40, 80, 160)]
    assert second[-1] < 2e-4
    assert second[0] / second[1] > 3.0
    assert second[1] / second[2] > 3.0
    first = [error(n, False) for n in (40, 80, 160)]
    assert first[0] / first[1] == pytest.approx(2.0, rel=0.15)
    assert first[1] / first[2] == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("path", ["auto", "python"])
def test_under_tilted_gravity_it_swings_about_another_vertical(path) -> None:
    tilted = predict(
        pendulum(0.02, 20),
        hanging(1.0, 3.0),
        horizon=50,
        effects={"gravity_tilt": 0.3},
        engine=path,
    )
    level = predict(pendulum(0.02, 20), hanging(0.7, 3.0), horizon=50, engine=path)
    np.testing.assert_allclose(tilted[:, 0, 2], level[:, 0, 2] + 0.3, atol=1e-9)
    np.testing.assert_allclose(tilted[:, 0, 5], level[:, 0, 5], atol=1e-9)


def test_dry_friction_through_a_reversal() -> None:
    times = 0.05 * np.arange(1, 21)
    exact = solve(0.3, 6.0, times, friction=0.03)
    assert (np.diff(np.sign(exact[:, 1])) != 0).sum() >= 2
    got = predict(
        pendulum(0.05, 40), hanging(0.3, 6.0), horizon=20, effects={"pivot_friction": 0.03}
    )
    np.testing.assert_allclose(got[:, 0, 2], exact[:, 0], atol=2e-3)
    np.testing.assert_allclose(got[:, 0, 5], exact[:, 1], atol=2e-2)


def test_dry_friction_holds_a_pendulum_still() -> None:
    pull = MASS * G * LEVER * np.sin(0.2)
    scene = pendulum(0.1, 20)
    held = predict(scene, hanging(0.2), horizon=5, effects={"pivot_friction": 1.05 * pull})
    np.testing.assert_allclose(held[-1, 0], hanging(0.2), atol=1e-5)
    freed = predict(scene, hanging(0.2), horizon=1, effects={"pivot_friction": 0.9 * pull})
    # while it falls, friction is a constant torque upwards
    exact = solve(0.2, 0.0, [0.1], torque=0.9 * pull)[-1]
    np.testing.assert_allclose(freed[0, 0, [2, 5]], exact, atol=1e-4)


@pytest.mark.parametrize(
    ("pose", "anchor", "start"),
    [
        # its length is the anchors' distance in the reference pose: the scene's, else the origin
        ((1.0, 0.0, 0.0), (0.0, 0.0), state(x=1.0, vy=1.0)),
        (None, (1.0, 0.0), state(x=2.0, vy=1.0)),
    ],
)
def test_rod_keeps_its_length(pose, anchor, start) -> None:
    """A disc on a rod to the world goes round in a circle."""
    disc = dataclasses.replace(body("disc", Shape.circle(0.1)), pose=pose)
    scene = Scene(
        time_step=0.1,
        substeps=50,
        bodies=(disc,),
        joints=(Joint("distance", ("disc", "world"), (0.0, 0.0), anchor),),
    )
    got = predict(scene, start, horizon=20)[:, 0]
    time = 0.1 * np.arange(1, 21)
    x, y = (got[:, :2] - anchor).T
    np.testing.assert_allclose(np.hypot(x, y), 1.0, atol=1e-3)
    np.testing.assert_allclose(np.hypot(got[:, 3], got[:, 4]), 1.0, atol=1e-3)
    np.testing.assert_allclose(np.unwrap(np.arctan2(y, x)), time, atol=3e-3)


MODEL = """
<mujoco><option timestep="0.0005" gravity="0 -9.81 0" integrator="RK4"/>
<compiler angle="radian"/><worldbody>
<body name="upper" pos="0 0 0"><joint type="hinge" axis="0 0 1" damping="{damping}"/>
  <inertial pos="0 -0.18 0" mass="0.5" diaginertia="1 1 {inertia}"/>
  <body name="lower" pos="0 -0.36 0"><joint type="hinge" axis="0 0 1" damping="{damping}"/>
    <inertial pos="0 -0.18 0" mass="0.5" diaginertia="1 1 {inertia}"/></body></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_double_pendulum_against_mujoco(damping) -> None:
    """Damping acts on the relative speed: the lower hinge's on both arms."""
    mujoco = pytest.importorskip("mujoco")
    inertia = MASS * ARM.unit_moment
    model = mujoco.MjModel.from_xml_string(MODEL.format(damping=damping, inertia=inertia))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (1.2, -0.7), (2.0, -3.0)  # the second relative to the first
    expected = []
    for _ in range(4):
        for _ in range(100):
            mujoco.mj_step(model, data)
        expected.append([*np.cumsum(data.qpos), *np.cumsum(data.qvel)])

    scene = Scene(
        time_step=0.05,
        substeps=100,
        gravity=(0.0, -G),
        bodies=(body("upper", ARM, mass=MASS), body("lower", ARM, mass=MASS)),
        joints=(
            Joint("hinge", ("world", "upper"), (0.0, 0.0), (0.0, LEVER)),
            Joint("hinge", ("upper", "lower"), (0.0, -LEVER), (0.0, LEVER)),
        ),
    )
    theta, omega = np.cumsum((1.2, -0.7)), np.cumsum((2.0, -3.0))
    upper = hanging(theta[0], omega[0])
    lower = hanging(theta[1], omega[1])
    lower[[0, 1, 3, 4]] += 2 * upper[[0, 1, 3, 4]]
    got = predict(scene, [upper, lower], horizon=4, effects={"pivot_damping": damping})
    np.testing.assert_allclose(got[:, :, 2], np.array(expected)[:, :2], atol=2e-3)
    np.testing.assert_allclose(got[:, :, 5], np.array(expected)[:, 2:], atol=3e-2)
