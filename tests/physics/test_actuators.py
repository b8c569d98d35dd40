"""Actuators of a scene: the wrench of each against SciPy's integration of its equations."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pbrl_ppl.errors import SceneError
from pbrl_ppl.physics import Transition
from pbrl_ppl.scene import Actuator, Body, Joint, Scene, Shape

pytestmark = pytest.mark.one_stack

DISC = Shape.circle(0.1)
MASS = 0.5
MOMENT = MASS * DISC.unit_moment
STEP = 0.05


def fans(**changes: object) -> Scene:
    """Two fans at the sides of a disc, that push along it."""
    left, right = (
        Actuator(
            name=name, kind="thruster", body="disc", at=(0.02, y),
            known={"gain": 0.8, "loss": 0.3, "direction": turn},
        )
        for name, y, turn in (("left", 0.08, 0.1), ("right", -0.08, -0.2))
    )  # fmt: skip
    body = Body("disc", DISC, known={"mass": MASS, "r": 0.0, "mu_c": 0.0})
    scene = Scene(time_step=STEP, substeps=400, bodies=(body,), actuators=(left, right))
    return scene.replace(**changes)


def test_two_fans_on_a_disc() -> None:
    """Within the engine's error of the second order."""
    scene, u = fans(), (1.0, 0.4)

    def slope(t: float, z: np.ndarray) -> list[float]:
        _, _, theta, vx, vy, omega = z
        force, torque = np.zeros(2), 0.0
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        for actuator, command in zip(scene.actuators, u, strict=True):
            arm = turn @ actuator.at
            along = turn @ [
                np.cos(actuator.numbers["direction"]), np.sin(actuator.numbers["direction"])
            ]  # fmt: skip
            speed = along @ [vx - omega * arm[1], vy + omega * arm[0]]
            push = (0.8 * command - 0.3 * speed) * along
            force += push
            torque += arm[0] * push[1] - arm[1] * push[0]
        return [vx, vy, omega, *(force / MASS), torque / MOMENT]

    start = np.array([0.1, -0.2, 0.7, 0.3, 0.1, -0.5])
    expected = solve_ivp(slope, (0, 10 * STEP), start, rtol=1e-10, atol=1e-12).y[:, -1]
    f = Transition(scene, {})
    commands = np.tile([*u, 0.0], (1, 10, 1, 1))
    np.testing.assert_allclose(
        f.predict(start[None, None], commands)[0, -1, 0], expected, atol=1e-5
    )


def played(u: np.ndarray, width: float) -> np.ndarray:
    """Return commands after a play, which begins where the first one is."""
    acted = [u[0]]
    for command in u[1:]:
        acted.append(np.clip(acted[-1], command - width, command + width))
    return np.array(acted)


@pytest.mark.parametrize(
    ("law", "size", "acted"),
    [
        ("dead_zone", "threshold", lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.4, 0.0)),
        ("saturation", "limit", lambda u: np.clip(u, -0.4, 0.4)),
        ("backlash", "threshold", lambda u: played(u, 0.4)),
    ],
)
def test_a_law_of_one_actuator_is_in_units_of_its_command(law, size, acted) -> None:
    """As if that fan alone had been sent the changed commands."""
    known = {"mass": MASS, "r": 0.0, "mu_c": 0.0}
    one = Body("disc", DISC, effects=(f"right_{law}",), known=known)
    u = np.random.default_rng(1).normal(size=(1, 10, 1, 3)) * (1.0, 1.0, 0.0)
    u[0, 0] = 0.0
    changed = u.copy()
    changed[0, :, 0, 1] = acted(u[0, :, 0, 1])
    start = np.zeros((1, 1, 6))
    with_law = Transition(fans(bodies=(one,)), {f"right_{law}_{size}": 0.4})
    got = with_law.predict(start, u)
    np.testing.assert_allclose(got, Transition(fans(), {}).predict(start, changed), atol=1e-12)
    assert not np.allclose(got, Transition(fans(), {}).predict(start, u), atol=1e-3)


def arms(*actuators: Actuator) -> Scene:
    """Two arms in a row, hinged to each other and free otherwise."""
    known = {"mass": MASS, "r": 0.0, "mu_c": 0.0}
    bodies = tuple(Body(name, Shape.box(0.05, 0.3), known=known) for name in ("upper", "lower"))
    hinge = Joint("hinge", ("upper", "lower"), (0.0, -0.15), (0.0, 0.15))
    return Scene(time_step=STEP, bodies=bodies, joints=(hinge,), actuators=actuators)


def swung(scene: Scene, u: float, omega: float = 0.0, steps: int = 10) -> np.ndarray:
    """Return the states of both arms, stretched out at first, shape (body, 6)."""
    start = np.zeros((1, 2, 6))
    start[0, 1] = 0.0, -0.15, 0.0, 0.15 * omega, 0.0, omega
    start[0, 0] = 0.0, 0.15, 0.0, 0.0, 0.0, 0.0
    commands = np.zeros((1, steps, 2, 3))
    commands[..., 1, 0] = u
    return Transition(scene, {}).predict(start, commands)[0, -1]


def test_a_motor_acts_back_on_what_it_hangs_on() -> None:
    """Angular momentum is conserved, and the arms turn against each other."""
    motor = Actuator(name="motor", kind="motor", body="lower", known={"gain": 0.05, "loss": 0.001})
    states = swung(arms(motor), 1.0)
    moment = MASS * Shape.box(0.05, 0.3).unit_moment
    momentum = (moment * states[:, 5]).sum() + MASS * (
        states[:, 0] * states[:, 4] - states[:, 1] * states[:, 3]
    ).sum()
    assert abs(momentum) < 1e-8
    assert states[1, 5] > 0.5
    np.testing.assert_allclose(states[0, 5], -states[1, 5], atol=1e-7)


def test_a_motor_that_is_shorted_brakes_the_relative_motion() -> None:
    motor = Actuator(name="motor", kind="motor", body="lower", known={"gain": 0.05, "loss": 0.01})
    free = Actuator(name="motor", kind="motor", body="lower", known={"gain": 0.05})
    braked, coasting = (swung(arms(one), 0.0, omega=2.0) for one in (motor, free))
    assert abs(braked[1, 5] - braked[0, 5]) < 0.5 * abs(coasting[1, 5] - coasting[0, 5])


def test_data_of_an_electric_motor_are_its_gain_and_loss() -> None:
    """Torque k (U u - k omega) / R."""
    known = {"torque_constant": 0.02, "resistance": 2.0, "supply": 12.0}
    motor = Actuator(name="motor", kind="motor", body="arm", known=known)
    assert motor.numbers == pytest.approx({"gain": 0.12, "loss": 2e-4})


@pytest.mark.parametrize(("of", "goal"), [("angle", 0.6), ("speed", 1.5)])
@pytest.mark.parametrize("limit", [0.0, 0.02])
def test_a_servo_drives_an_arm_to_its_goal(of: str, goal: float, limit: float) -> None:
    """Against SciPy, with the limit of the torque and without."""
    servo = Actuator(
        name="servo", kind="servo", body="arm", of=of, known={"kp": 0.2, "kd": 0.02, "limit": limit}
    )
    arm = Body("arm", Shape.box(0.05, 0.3), known={"mass": MASS, "r": 0.0, "mu_c": 0.0})
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.15), (0.0, 0.0))
    scene = Scene(time_step=STEP, bodies=(arm,), joints=(hinge,), actuators=(servo,))
    moment = MASS * (arm.shape.unit_moment + 0.15**2)

    def slope(t: float, z: np.ndarray) -> list[float]:
        torque = 0.2 * (goal - z[0]) - 0.02 * z[1] if of == "angle" else 0.2 * (goal - z[1])
        return [z[1], (np.clip(torque, -limit, limit) if limit else torque) / moment]

    expected = solve_ivp(slope, (0, 8 * STEP), [0.0, 0.0], rtol=1e-9, atol=1e-11, max_step=1e-3)
    start, commands = np.zeros((1, 1, 6)), np.zeros((1, 8, 1, 3))
    start[0, 0, 1], commands[..., 0] = -0.15, goal
    state = Transition(scene, {}).predict(start, commands)[0, -1, 0]
    np.testing.assert_allclose(state[[2, 5]], expected.y[:, -1], atol=2e-6)


def test_a_scene_is_written_and_read() -> None:
    scene = fans()
    assert Scene.from_toml(scene.to_toml()) == scene
    assert scene.subset(["disc"]).actuators == scene.actuators


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "thrusters"}, 'did you mean "thruster"'),
        ({"body": "disk"}, "no body that moves freely"),
        ({"known": {"gian": 1.0}}, 'did you mean "gain"'),
        ({"known": {"gain": 1.0}, "prior": {"gain": {"mu": 0.0}}}, "both known and prior"),
        ({"frame": "room"}, "expected body or world"),
        ({"name": "left fan"}, "use letters and _"),
    ],
)
def test_what_is_wrong_is_said(change: dict, message: str) -> None:
    table = {"name": "fan", "kind": "thruster", "body": "disc"} | change
    with pytest.raises(SceneError, match=message):
        fans(actuators=(Actuator(**table),))


def test_a_body_has_three_actuators_at_most() -> None:
    four = tuple(Actuator(name=n, kind="thruster", body="disc") for n in "abcd")
    with pytest.raises(SceneError, match="expected at most 3"):
        fans(actuators=four)
