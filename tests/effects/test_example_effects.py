"""Example files of effects: they load, vanish at their null values, and follow their formulas."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pbrl_ppl.cli.options import own_effects
from pbrl_ppl.effects import catalogue
from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics
from pbrl_ppl.physics.trial import try_effect
from pbrl_ppl.scene import Body, Joint, Scene, Shape, units_of
from pbrl_ppl.state import Floats
from tests.helpers.examples import EXAMPLES, FILES
from tests.helpers.places import ROOT
from tests.helpers.worlds import BY_NAME, G

pytestmark = pytest.mark.one_stack

NAMES = {
    "angle_friction": ("pivot_angle_friction",),
    "askew_angle": ("askew_angle",),
    "cable": ("cable",),
    "command_power": ("command_power",),
    "fading_gain": ("fading_gain",),
    "friction_by_place": ("friction_by_place", "slider_place_friction"),
    "gain_by_place": ("gain_by_place",),
    "gain_by_sign": ("gain_by_sign",),
    "gain_by_speed": ("gain_by_speed",),
    "hardening_spring": ("cubic_spring", "cubic_torsion_spring"),
    "one_way_damping": ("pivot_one_way_damping",),
    "periodic": ("periodic_force", "periodic_torque"),
    "point_attractor": ("point_attractor",),
    "power_drag": ("power_drag", "power_angular_drag"),
    "power_limit": ("power_limit",),
    "ripple": ("ripple",),
    "sensor_drift": ("sensor_drift",),
    "sloshing": ("sloshing",),
}
MASS, STEP, N = 2.0, 0.1, 15
DISC = Shape.circle(0.2)
MOMENT = MASS * DISC.unit_moment
PUSH = np.array([1.5, -0.8, 0.05])
START = np.array([0.5, -0.3, 0.2, 0.8, 0.6, 0.5])
#: Mean place and range of the body, which laws by place have as constants (m).
MEAN, RANGE = np.array([0.3, 0.1]), 2.0
#: Its typical speeds, which laws by speed have as constants (m/s, rad/s).
SPEED, TURN_RATE = 0.9, 0.6
FLAT = np.array([1.0, 1.0, 0.0])
Wrench = Callable[[float, Floats], Floats]


def world(rig: str = "", substeps: int = 400) -> Scene:
    """A disc in free space, on a floor, on a hinge at its centre or on a rail along x."""
    typical = {"x": MEAN[0], "y": MEAN[1], "range": RANGE, "speed": SPEED, "turn_rate": TURN_RATE}
    disc = Body("disc", DISC, known={"mass": MASS, "r": 0.0, "mu_c": 0.0}, typical=typical)
    joint = {
        "hinge": Joint("hinge", ("disc", "world"), (0.0, 0.0), (0.0, 0.0)),
        "rail": Joint("slider", ("disc", "world"), (0.0, 0.0), (0.0, 0.0), axis=(1.0, 0.0)),
    }
    joints = (joint[rig],) if rig in joint else ()
    down = G if rig == "floor" else 0.0
    return Scene(
        time_step=STEP, substeps=substeps, bodies=(disc,), joints=joints, normal_gravity=down
    )


def states(
    scene: Scene, values: Mapping[str, tuple[float, ...]], start: Floats, push: Floats, **settings
) -> Floats:
    """States (N, 6) from a start under a steady push, with laws and their parameters."""
    laws = [(EXAMPLES | BY_NAME)[name] for name in values]
    physics = Physics(scene, tuple(law.on("disc").in_si(scene) for law in laws), **settings)
    numbers = {
        label: value
        for attached in physics.effects
        for label, value in zip(attached.labels, values[attached.effect.name], strict=True)
    }
    phi = np.array([numbers[label] for label in physics.layout.labels])
    wrenches = np.broadcast_to(push, (1, N, 1, 3)).copy()
    rows = np.broadcast_to(start, (1, N + 1, 1, 6)).copy()
    segments = History.of_arrays(rows, scene, wrenches).pieces(rows, N)
    return physics.predict(phi, segments.start, physics.inputs(segments))[0, :, 0]


# -- the files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_loads_and_its_effects_say_what_they_are(path) -> None:
    effects = own_effects([path])
    assert tuple(effect.name for effect in effects) == NAMES[path.stem]
    for effect in effects:
        assert len(effect.sentence) > 20 and effect.reference and effect.unusual
        assert hash(effect) == hash(dataclasses.replace(effect))
        assert effect.name not in {one.name for one in catalogue}


def test_the_guide_lists_every_file_and_effect() -> None:
    assert {path.stem for path in FILES} == set(NAMES)
    guide = (ROOT / "analysis/docs/pages/guides/own_effect.md").read_text()
    for path in FILES:
        assert f"../../../examples/effects/{path.name})" in guide
        assert all(f"`{name}`" in guide for name in NAMES[path.stem])


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_effect_vanishes_at_its_null_value_and_has_points_to_try(name) -> None:
    """On every rig that it applies to, as before a fit."""
    effect, tried = EXAMPLES[name], 0
    path = np.linspace(0.0, 1.0, 40)
    rows = np.zeros((2, 40, 1, 6))
    rows[..., 0, 0], rows[..., 0, 2:4], rows[..., 0, 5] = path, path[:, None], 1.0
    for rig in ("", "floor", "hinge", "rail"):
        scene = world(rig, substeps=2)
        if effect.applies(scene, scene.bodies[0]):
            tried += 1
            history = History.of_arrays(rows, scene, np.ones((2, 39, 1, 3)))
            try_effect(effect, scene, history)
            assert effect.scan is None or len(effect.scan(scene, history, scene.bodies[0])) > 0
    assert tried > 0


# -- the laws --------------------------------------------------------------------------------------


def along(angle: float, size: float) -> Floats:
    return np.array([np.cos(angle), np.sin(angle), 0.0]) * size


def ripple(t: float, z: Floats) -> Floats:
    phase = 2 * np.pi / 0.8 * (np.cos(0.6) * z[0] + np.sin(0.6) * z[1])
    return PUSH + along(0.6, 0.5 * np.cos(phase) + 0.3 * np.sin(phase))


def taut(t: float, z: Floats) -> Floats:
    off = np.array([z[0] + 0.5, z[1], 0.0])
    return PUSH - 4.0 * off * max(0.0, 1.0 - 0.7 / np.hypot(*off[:2]))


def shaken(t: float, z: Floats) -> Floats:
    phase = 2 * np.pi * t / 0.7
    return PUSH + along(0.3, 0.4 * np.cos(phase) + 0.6 * np.sin(phase))


def twisted(t: float, z: Floats) -> Floats:
    phase = 2 * np.pi * t / 0.7
    return PUSH + np.array([0.0, 0.0, 0.02 * np.cos(phase) + 0.03 * np.sin(phase)])


def limited(t: float, z: Floats) -> Floats:
    return PUSH * min(1.0, 0.6 / max(PUSH @ z[3:], 1e-12))


def by_place(t: float, z: Floats) -> Floats:
    return PUSH * (1.0 + np.array([0.3, -0.2]) @ (z[:2] - MEAN) / RANGE)


def rough(t: float, z: Floats) -> Floats:
    mu = 0.02 * (1.0 + np.array([0.4, 0.3]) @ (z[:2] - MEAN) / RANGE)
    return -mu * MASS * G * FLAT * z[3:] / np.hypot(z[3], z[4])


def rubbed(t: float, z: Floats) -> Floats:
    return np.array([-(0.3 + 0.2 * (z[0] - MEAN[0]) / RANGE), 0.0, 0.0])


def dragged(t: float, z: Floats) -> Floats:
    speed = np.hypot(z[3], z[4])
    return PUSH - 0.7 * (speed / SPEED) ** 1.6 / speed * FLAT * z[3:]


def slowed(t: float, z: Floats) -> Floats:
    against = 0.03 * (abs(z[5]) / TURN_RATE) ** 1.4 * np.sign(z[5])
    return PUSH - np.array([0.0, 0.0, against])


def by_speed(t: float, z: Floats) -> Floats:
    along = PUSH[:2] @ z[3:5] / np.hypot(*PUSH[:2])
    shares = np.array([along / SPEED, along / SPEED, z[5] / TURN_RATE])
    return PUSH * (1.0 - 0.2 * shares)  # its torque is positive


def bent(t: float, z: Floats) -> Floats:
    """Return the push to the power of 1.5, in units of the typical force and torque."""
    units = units_of(world(), "disc")
    share = np.hypot(*PUSH[:2]) / units.force
    return PUSH * np.sqrt((share, share, PUSH[2] / units.torque))


def hard(t: float, z: Floats) -> Floats:
    way = (z[:3] - (0.8, -0.4, 0.0)) * FLAT
    return PUSH - 1.5 * (way @ way) * way


def hard_to_turn(t: float, z: Floats) -> Floats:
    return PUSH - (0.0, 0.0, 0.5 * (z[2] - 0.1) ** 3)


def worn(t: float, z: Floats) -> Floats:
    return np.array([0.0, 0.0, -0.006 * (1.0 + 0.4 * np.cos(z[2]) + 0.3 * np.sin(z[2]))])


def damped(t: float, z: Floats) -> Floats:
    return np.array([0.0, 0.0, -0.03 * abs(z[5])])


def steady(t: float, z: Floats) -> Floats:
    return PUSH


def drifted(t: Floats, z: Floats) -> Floats:
    rates = np.array([[0.05], [-0.03], [0.02]])
    return z + np.concatenate([rates * t, rates + 0.0 * t])


def askew(t: Floats, z: Floats) -> Floats:
    c, s = np.cos(2.0 * z[2]), np.sin(2.0 * z[2])
    seen = z.copy()
    seen[2] += 0.05 * c + 0.1 * s
    seen[5] *= 1.0 + 2.0 * (0.1 * c - 0.05 * s)
    return seen


class Case(NamedTuple):
    """A law's parameters with those of laws beside it, its formula, and what it acts on.

    ``seen(t, z)`` is what is measured of states (6, n) at times (n,).
    """

    values: Mapping[str, tuple[float, ...]]
    wrench: Wrench
    rig: str = ""
    start: Floats = START
    push: Floats = PUSH
    seen: Callable[[Floats, Floats], Floats] = lambda t, z: z


STILL = np.zeros(3)
CASES = (
    Case({"ripple": (0.5, 0.3, 0.8, 0.6)}, ripple),
    Case({"cable": (4.0, -0.5, 0.0, 0.7)}, taut),
    Case({"periodic_force": (0.4, 0.6, 0.7, 0.3)}, shaken),
    Case({"periodic_torque": (0.02, 0.03, 0.7)}, twisted),
    Case({"fading_gain": (0.5,)}, lambda t, z: PUSH * np.exp(-0.5 * t)),
    Case({"power_limit": (0.6,)}, limited),
    Case({"gain_by_place": (0.3, -0.2)}, by_place),
    Case({"gain_by_speed": (0.2,)}, by_speed),
    Case({"gain_by_sign": (0.3,)}, lambda t, z: PUSH * (1.3, 0.7, 1.3)),
    Case({"command_power": (1.5,)}, bent),
    Case({"cubic_spring": (1.5, 0.8, -0.4)}, hard),
    Case({"cubic_torsion_spring": (0.5, 0.1)}, hard_to_turn),
    Case({"sensor_drift": (0.05, -0.03, 0.02)}, steady, seen=drifted),
    Case({"power_drag": (0.7, 1.6)}, dragged),
    Case({"power_angular_drag": (0.03, 1.4)}, slowed),
    Case(
        {"sliding_friction": (0.02, 0.1), "friction_by_place": (0.4, 0.3)},
        rough, "floor", START * (1, 1, 1, 1, 1, 0), STILL,
    ),
    Case(
        {"slider_friction": (0.3,), "slider_place_friction": (0.2, 0.0)},
        rubbed, "rail", START * (1, 0, 0, 1, 0, 0), STILL,
    ),
    Case(
        {"pivot_friction": (0.006,), "pivot_angle_friction": (0.4, 0.3)},
        worn, "hinge", START * (0, 0, 1, 0, 0, 1), STILL,
    ),
    Case(
        {"pivot_one_way_damping": (0.03,)}, damped, "hinge", START * (0, 0, 1, 0, 0, 1), STILL
    ),
    Case(
        {"askew_angle": (0.05, 0.1)},
        lambda t, z: PUSH * (0, 0, 1), "hinge", START * (0, 0, 1, 0, 0, 1), seen=askew,
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: [*case.values][-1])
def test_a_law_is_its_formula(case) -> None:
    """Against SciPy, to the error of the engine's substeps."""

    def slope(t: float, z: Floats) -> Floats:
        return np.concatenate([z[3:], case.wrench(t, z) / (MASS, MASS, MOMENT)])

    times = STEP * np.arange(1, N + 1)
    expected = solve_ivp(slope, (0, times[-1]), case.start, "DOP853", times, rtol=1e-9, atol=1e-9)
    start = case.seen(np.zeros(1), case.start[:, None])[:, 0]
    got = states(world(case.rig), case.values, start, case.push)
    np.testing.assert_allclose(got, case.seen(times, expected.y).T, atol=2e-3)


@pytest.mark.parametrize("engine", ["auto", "chipmunk"])
def test_a_mass_that_sloshes(engine: str) -> None:
    """Two masses on a spring, against SciPy; momentum is conserved without a push."""
    mass, rate, ratio = 0.6, 2.0 * np.pi * 1.2, 0.05

    def slope(t: float, z: Floats) -> list[float]:
        x, v, p, w = z
        pull = rate**2 * (p - x) + 2.0 * ratio * rate * (w - v)
        return [v, (1.5 + mass * pull) / MASS, w, -pull]

    times = STEP * np.arange(1, N + 1)
    expected = solve_ivp(slope, (0, times[-1]), [0.0, 0.3, 0.0, 0.3], "DOP853", times, rtol=1e-10)
    start, push = np.zeros(6), np.array([1.5, 0.0, 0.0])
    start[3] = 0.3
    got = states(world(), {"sloshing": (mass, 1.2, ratio)}, start, push, engine=engine)
    np.testing.assert_allclose(got[:, 0], expected.y[0], atol=3e-3)


@pytest.mark.parametrize("engine", ["auto", "chipmunk"])
def test_a_point_attractor_conserves_energy_and_angular_momentum(engine: str) -> None:
    strength, place = 2.0, np.array([1.0, 0.5])
    start = np.array([0.0, 0.0, 0.0, 0.3, -0.6, 0.0])
    values = {"point_attractor": (strength, *place, 0.05)}
    got = states(world(substeps=200), values, start, STILL, engine=engine)
    way, speed = got[:, :2] - place, got[:, 3:5]

    def energy(way, speed) -> np.ndarray:
        far = np.sqrt((way**2).sum(axis=-1) + 0.05**2)
        return 0.5 * MASS * (speed**2).sum(axis=-1) - strength / far

    np.testing.assert_allclose(energy(way, speed), energy(-place, start[3:5]), atol=2e-3)
    about = way[:, 0] * speed[:, 1] - way[:, 1] * speed[:, 0]
    np.testing.assert_allclose(about, 0.6 * 1.0 + 0.5 * 0.3, atol=2e-3)
    assert np.ptp(np.hypot(*way.T)) > 0.3  # it fell, and sped up
