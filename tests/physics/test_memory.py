"""Laws that remember: against closed forms and SciPy, and carried from piece to piece."""

import re
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from pbrl_ppl.state import Floats
from tests.helpers.places import ROOT
from tests.helpers.plain import simulator_of
from tests.helpers.worlds import BY_NAME

pytestmark = pytest.mark.one_stack

MASS, STEP, N = 2.0, 0.1, 30
KNOWN = {"mass": MASS, "r": 0.0, "mu_c": 0.0}
#: Sizes of the laws of commands that remember.
SIZES = {
    "first_order_lag": {"time": 0.15, "begin": 0.4},
    "actuator_delay": {"share": 2.3},
    "rate_limit": {"rate": 12.0},
    "actuator_backlash": {"threshold": 0.6},
}
RNG = np.random.default_rng(5)
PUSHES = np.repeat(RNG.normal(0.0, 2.0, N // 3), 3)


def puck(substeps: int = 20) -> Scene:
    body = Body("puck", Shape.circle(0.2), known=KNOWN)
    return Scene(time_step=STEP, substeps=substeps, bodies=(body,))


def physics(scene: Scene, name: str, values: dict[str, float], **settings: object):
    """Return the physics with a law, and its parameters as a vector."""
    (body,) = scene.dynamic
    found = Physics(scene, (BY_NAME[name].on(body.name),), **settings)
    by_label = {f"{name}_{key}[{body.name}]": value for key, value in values.items()}
    return found, np.array([by_label[label] for label in found.layout.labels])


def along_x(name: str, values: dict[str, float], engine: str) -> Floats:
    """Return the speed of a pushed puck after each interval, shape (N,)."""
    found, phi = physics(puck(), name, values)
    wrench = np.zeros((1, N, 1, 3))
    wrench[0, :, 0, 0] = PUSHES
    states = np.full((1, N + 1, 1, 6), 0.0)
    history = History.of_arrays(states, puck(), wrench)
    segments = history.pieces(states, N)
    predict = simulator_of(found, engine)
    return predict(phi, segments.start, found.inputs(segments))[0, :, 0, 3]


def reached(name: str, values: dict[str, float], per: int = 2000) -> Floats:
    """Return the impulse of what the actuator does in each interval, by small steps, (N,), N s."""
    f, dt = values.get("begin", 0.0) * PUSHES[0], STEP / per
    impulse = np.zeros(N)
    for k in range(N * per):
        now = k // per
        u = PUSHES[now]
        if name == "first_order_lag":
            f = u + (f - u) * np.exp(-dt / values["time"])
        elif name == "actuator_delay":
            late = int(np.floor((k + 0.5) / per - values["share"]))
            f = PUSHES[late] if late >= 0 else 0.0
        elif name == "rate_limit":
            f += np.clip(u - f, -values["rate"] * dt, values["rate"] * dt)
        else:
            f = min(max(f, u - values["threshold"]), u + values["threshold"])
        impulse[now] += f * dt
    return impulse


@pytest.mark.parametrize("engine", ["auto", "chipmunk", "python"])
@pytest.mark.parametrize("name", SIZES)
def test_the_impulse_is_that_of_the_law(name: str, engine: str) -> None:
    speed = along_x(name, SIZES[name], engine=engine)
    expected = np.cumsum(reached(name, SIZES[name])) / MASS
    np.testing.assert_allclose(speed, expected, atol=4e-3)


@pytest.mark.parametrize("engine", ["auto", "chipmunk", "python"])
@pytest.mark.parametrize("name", SIZES)
def test_pieces_go_on_from_what_was_reached(name: str, engine: str) -> None:
    """Pieces of four intervals from the whole's own states are the whole."""
    scene = puck()
    found, phi = physics(scene, name, SIZES[name])
    predict = simulator_of(found, engine)
    wrench = RNG.normal(0.0, 2.0, (2, N, 1, 3))
    history = History.of_arrays(np.zeros((2, N + 1, 1, 6)), scene, wrench)
    whole = history.pieces(np.zeros((2, N + 1, 1, 6)), N)
    states = predict(phi, whole.start, found.inputs(whole))
    path = np.concatenate([whole.start[:, None], states], axis=1)
    pieces = history.pieces(path, 4)
    again = predict(phi, pieces.start, found.inputs(pieces))
    for i in range(pieces.n):
        rows = slice(pieces.step[i] + 1, min(pieces.step[i] + 5, N + 1))
        expected = path[pieces.trajectory[i], rows]
        np.testing.assert_allclose(again[i, : len(expected)], expected, atol=1e-9)


def test_chunks_of_threads_change_nothing() -> None:
    """Of many proposals on one thread and on two: a chunk begins in the middle of a recording."""
    scene = puck()
    history = History.of_arrays(np.zeros((3, N + 1, 1, 6)), scene, RNG.normal(size=(3, N, 1, 3)))
    pieces = history.pieces(np.zeros((3, N + 1, 1, 6)), 2)
    out = []
    for threads in (1, 2):
        found, phi = physics(scene, "first_order_lag", SIZES["first_order_lag"], threads=threads)
        out.append(found.predict(np.tile(phi, (40, 1)), pieces.start, found.inputs(pieces)))
    np.testing.assert_array_equal(*out)


def test_friction_that_bends() -> None:
    """LuGre friction on an arm, against SciPy."""
    values = {"torque": 0.05, "angle": 0.03, "rise": 0.5, "speed": 0.3}
    body = Body("arm", Shape.box(0.04, 0.3), known=KNOWN)
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.15), (0.0, 0.0))
    scene = Scene(time_step=STEP, gravity=(0.0, -9.81), bodies=(body,), joints=(hinge,))
    found, phi = physics(scene, "pivot_hysteresis", values, tolerance=1e-10)
    moment = MASS * (body.shape.unit_moment + 0.15**2)

    def slope(t: float, z: Floats) -> list[float]:
        theta, omega, bend = z
        rise = 1.0 + 0.5 * np.exp(-((omega / 0.3) ** 2))
        torque = -MASS * 9.81 * 0.15 * np.sin(theta) - 0.05 * bend / 0.03
        return [omega, torque / moment, omega - abs(omega) * bend / (0.03 * rise)]

    times = STEP * np.arange(1, N + 1)
    expected = solve_ivp(slope, (0, times[-1]), [0.4, 0.0, 0.0], "DOP853", times, rtol=1e-10,
                         atol=1e-12)  # fmt: skip
    start = np.zeros((1, 1, 6))
    start[0, 0, :3] = 0.15 * np.sin(0.4), -0.15 * np.cos(0.4), 0.4
    states = found.predict(phi, start, np.zeros((1, N, 1, 3)))[0, :, 0]
    np.testing.assert_allclose(states[:, 2], expected.y[0], atol=2e-6)


def test_a_law_of_a_users_own_remembers() -> None:
    """The valve of the guide to own effects: 2 N more in each interval."""
    guide = (ROOT / "analysis/docs/pages/guides/own_effect.md").read_text()
    (code,) = re.findall(r"```python\n# valve.py\n(.*?)```", guide, re.S)
    names: dict[str, Any] = {}
    exec(code, names)  # of the package's own pages
    valve = names["slow_valve"]
    found = Physics(puck(), (valve.on("puck"),))
    wrench = np.zeros((1, 4, 1, 3))
    wrench[..., 0] = 5.0
    history = History.of_arrays(np.zeros((1, 5, 1, 6)), puck(), wrench)
    segments = history.pieces(np.zeros((1, 5, 1, 6)), 4)
    states = found.predict(np.array([2.0]), segments.start, found.inputs(segments))
    gained = np.diff(states[0, :, 0, 3], prepend=0.0) * MASS / STEP
    np.testing.assert_allclose(gained, [1.0, 3.0, 4.625, 5.0], atol=0.2)
