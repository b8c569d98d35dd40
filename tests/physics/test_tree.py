"""Joined bodies and bodies on friction, in reduced coordinates: the limit of the engine's steps."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from pbrl_ppl.effects import Effect, EffectParameter, Force
from pbrl_ppl.parameters import Prior
from pbrl_ppl.physics import Physics, Simulator, compiled
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.chains import LINK, cart_with_trailers, case, chain
from tests.helpers.engines import BOX
from tests.helpers.examples import EXAMPLES
from tests.helpers.plain import PlainSimulator
from tests.helpers.worlds import BY_NAME, G

pytestmark = pytest.mark.one_stack

PIVOT = ("pivot_friction", "pivot_damping")
ON_A_WHEEL = Scene(time_step=0.1, normal_gravity=G, bodies=(Body("cart", BOX, wheel=True),))
CASES = {
    "double pendulum": (chain("hh"), ("com_offset", "inertia_scale", *PIVOT)),
    "four links": (chain("hhhh", turned=(0, 2)), ("com_offset", *PIVOT, "linear_drag")),
    "hung on a rod": (chain("rh", turned=(0,)), ("com_offset", "actuator_delay")),
    "on a post": (chain("hrh", holder="post"), ("com_offset", "gravity_tilt", *PIVOT)),
    "free": (chain("-hh"), ("com_offset", "inertia_scale", *PIVOT)),
    "free, with a payload": (chain("-hr", turned=(1,)), ("com_offset", "mass_change")),
    "sliding": (chain("-h", normal_gravity=G), ("com_offset", "sliding_friction")),
    "trailers": (cart_with_trailers(), ("com_offset", "angular_drag")),
    "a wheel on friction": (ON_A_WHEEL, ("sliding_friction", "linear_drag")),
}


def like(sim: Simulator, **options) -> Simulator:
    return Simulator(sim.physics.changed(**options))


@pytest.fixture
def engine_items(monkeypatch) -> list[tuple[int, int]]:
    """What goes to the engine: item, and the first of its intervals that do."""
    items: list[tuple[int, int]] = []
    rollout = compiled.rollout_engine

    def counted(*arguments):
        chosen, begins = arguments[3].tolist(), arguments[4].tolist()
        done = rollout(*arguments)
        items.extend(zip(chosen, begins, strict=True))
        return done

    monkeypatch.setattr(compiled, "rollout_engine", counted)
    return items


def convergence(sim: Simulator, phi, start, inputs, coarse: int = 80) -> tuple[float, float]:
    """The order at which the engine's steps approach the tree's motion, and how near they come.

    By the median over positions and angles: single items switch between sticking and slipping.
    """
    got = sim(phi, start, inputs)
    assert np.isfinite(got).all()
    off = [
        np.median(abs(like(sim, engine="chipmunk", extrapolate=False, substeps=n)(
            phi, start, inputs) - got)[..., :3][got[..., :3] != 0.0])
        for n in (coarse, 4 * coarse)
    ]  # fmt: skip
    return float(np.log(off[0] / off[1]) / np.log(4)), float(off[1])


def by_interval(sim: Simulator, phi, start, inputs, states) -> np.ndarray:
    """Each interval alone by the plain reference, from where ``states`` had it.

    ``states`` are (proposal, transition, H, body, 6).
    """
    first = np.broadcast_to(start, (len(phi), *start.shape))
    begins = np.concatenate([first[:, :, None], states[:, :, :-1]], axis=2)
    begins = begins.reshape(len(phi), -1, *start.shape[1:])
    alone = PlainSimulator(sim.physics.changed(extrapolate=False))
    return alone(phi, begins, inputs.reshape(-1, 1, *inputs.shape[2:])).reshape(states.shape)


@pytest.mark.parametrize("name", CASES)
def test_the_engine_converges_to_it(name, engine_items) -> None:
    sim, phi, start, inputs = case(*CASES[name], seed=1)
    sim(phi, start, inputs)
    assert not engine_items
    order, off = convergence(sim, phi, start, inputs)
    assert 0.9 < order < 1.1
    assert off < 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_random_chains(seed) -> None:
    rng = np.random.default_rng(seed)
    kinds = "".join(rng.choice(list("hr"), rng.integers(2, 5)))
    turned = tuple(np.flatnonzero(rng.random(len(kinds)) < 0.5))
    scene = chain(kinds, turned=turned, substeps=int(rng.integers(3, 20)))
    sim, phi, start, inputs = case(
        scene, ("com_offset", "inertia_scale", *PIVOT[: kinds.count("h")]), seed, 6, 3
    )
    assert 0.8 < convergence(sim, phi, start, inputs, coarse=160)[0] < 1.2


@pytest.mark.parametrize("what", ["sliding", "sliding wheel", "hinge", "rod"])
def test_single_bodies(what) -> None:
    """A centre off the origin, a drag at the origin and a command that lags."""
    effects = ["com_offset", "linear_drag", "actuator_delay"]
    if what in ("hinge", "rod"):
        scene = chain(what[0], turned=(0,))
        effects += PIVOT if what == "hinge" else ()
    else:
        single = Body("b0", BOX, wheel=what == "sliding wheel")
        scene = Scene(time_step=0.1, normal_gravity=G, bodies=(single,))
        effects += ["sliding_friction"]
    sim, phi, start, inputs = case(scene, effects, seed=9, n=30, horizon=3)
    assert 0.9 < convergence(sim, phi, start, inputs)[0] < 1.1


def test_a_delay_too_short_to_split_an_interval_is_none() -> None:
    """A step that began with the command before would be off by the tolerance."""
    sim, phi, start, inputs = case(chain("h"), ("actuator_delay",), seed=3, n=20)
    inputs[:, 0, :, 3:6] = -inputs[:, 0, :, :3]
    phi = np.tile(phi[:1], (3, 1))
    phi[:, sim.physics.layout.labels.index("actuator_delay_share[b0]")] = 0.0, 5e-7, 1e-3
    none, short, long = sim(phi, start, inputs)
    np.testing.assert_array_equal(short, none)
    assert np.abs(long - none).max() > 1e-5


def test_energy_and_momentum_are_kept() -> None:
    """Of links whose mass is anywhere, to the tolerance; and better with a smaller one."""
    offs, masses = np.array([(0.03, -0.05), (-0.02, 0.04), (0.01, 0.06)]), np.array([0.5, 0.9, 0.3])
    for kinds in ("hh", "-hh", "-rr"):
        free, k = kinds.startswith("-"), len(kinds)
        scene = chain(kinds, gravity=(0.0, 0.0 if free else -G), time_step=0.1)
        known = [{"mass": masses[i], "r": 0.0, "mu_c": 0.0} for i in range(k)]
        bodies = [dataclasses.replace(b, known=v) for b, v in zip(scene.bodies, known, strict=True)]
        sim, _, start, inputs = case(scene.replace(bodies=tuple(bodies)), ("com_offset",), seed=2)
        named = {f"com_offset_{p}[b{i}]": offs[i, d] for i in range(k) for d, p in enumerate("xy")}
        phi = np.array([named[label] for label in sim.physics.layout.labels])
        drift = []
        for tolerance in (1e-6, 1e-9):
            after = like(sim, tolerance=tolerance)(phi, start, 0.0 * inputs)
            first, *rest = (_kept(states, offs[:k], masses[:k], free) for states in (
                after[:, 0], after[:, -1]))  # fmt: skip
            drift.append(max(np.abs(b - a).max() for a, b in zip(first, rest[0], strict=True)))
        assert drift[0] < 1e-4
        assert drift[1] < drift[0] / 30


def _kept(states, offs, masses, free) -> tuple[np.ndarray, ...]:
    """Energy; of free chains momentum and angular momentum as well."""
    c, s = np.cos(states[..., 2]), np.sin(states[..., 2])
    x, y = c * offs[:, 0] - s * offs[:, 1], s * offs[:, 0] + c * offs[:, 1]
    vx, vy = states[..., 3] - states[..., 5] * y, states[..., 4] + states[..., 5] * x
    x, y = states[..., 0] + x, states[..., 1] + y
    spin = masses * LINK.unit_moment * states[..., 5]
    kinetic = (masses * (vx**2 + vy**2) + spin * states[..., 5]) / 2
    energy = (kinetic + masses * G * y * (not free)).sum(axis=-1)
    if not free:
        return (energy,)
    angular = (masses * (x * vy - y * vx) + spin).sum(axis=-1)
    return energy, (masses * vx).sum(axis=-1), (masses * vy).sum(axis=-1), angular


def arm(dt: float = 0.02, *effects: str) -> Scene:
    """A rod of 0.4 m and 0.3 kg, hinged at its end."""
    known = {"mass": 0.3, "r": 0.2, "mu_c": 0.2}
    rod = Body("arm", Shape.box(0.03, 0.4), known=known, effects=effects)
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.2), (0.0, 0.0))
    return Scene(time_step=dt, gravity=(0.0, -G), bodies=(rod,), joints=(hinge,))


def hung(theta: float, omega: float = 0.0) -> np.ndarray:
    """The arm's state, shape (1, 1, 6)."""
    s, c = np.sin(theta), np.cos(theta)
    return np.array([[[0.2 * s, -0.2 * c, theta, 0.2 * c * omega, 0.2 * s * omega, omega]]])


INERTIA = 0.3 * (Shape.box(0.03, 0.4).unit_moment + 0.2**2)  # about the hinge


def test_a_pendulum_s_period_is_the_elliptic_integral() -> None:
    """Released at 2.6 rad; after a quarter of the period it hangs down."""
    root = np.sqrt(0.3 * G * 0.2 / INERTIA)
    quarter = ellipk(np.sin(1.3) ** 2) / root
    physics = Physics.declare(arm(quarter / 50))
    after = physics.predict(np.zeros(0), hung(2.6), np.zeros((1, 50, 1, 3)))[0, -1, 0]
    assert after[2] == pytest.approx(0.0, abs=1e-5)
    assert after[5] == pytest.approx(-2 * root * np.sin(1.3), rel=1e-5)


def test_dry_friction_agrees_with_an_integrator_with_events() -> None:
    """SciPy's DOP853 stops at every turning point; the arm sticks in the end."""
    torque, damping = 0.05, 0.004
    physics = Physics.declare(arm(0.02, "pivot_friction", "pivot_damping"))
    named = {"pivot_friction_torque[arm]": torque, "pivot_damping_coefficient[arm]": damping}
    phi = np.array([named[label] for label in physics.layout.labels])
    got = physics.predict(phi, hung(2.0), np.zeros((1, 400, 1, 3)))[0, :, 0, 2]
    times, theta, sign, t = 0.02 * np.arange(1, 401), 2.0, -1.0, 0.0
    expected = np.full(400, np.nan)
    while True:

        def rate(_, y, sign=sign):
            return [
                y[1],
                (-0.3 * G * 0.2 * np.sin(y[0]) - damping * y[1] - sign * torque) / INERTIA,
            ]

        def turns(_, y):
            return y[1]

        turns.terminal, turns.direction = True, -sign
        some = times[times > t]
        one = solve_ivp(
            rate, (t, 8.1), [theta, 1e-14 * sign], "DOP853", some, events=turns, rtol=1e-12,
            atol=1e-14,
        )  # fmt: skip
        expected[np.searchsorted(times, one.t)] = one.y[0]
        if not len(one.t_events[0]):
            break
        t, theta = one.t_events[0][0], one.y_events[0][0][0]
        if abs(0.3 * G * 0.2 * np.sin(theta)) <= torque:
            expected[times > t] = theta
            break
        sign = -np.sign(theta)
    assert t < 8.0  # it has stopped
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_derivatives_do_not_depend_on_their_step() -> None:
    """Through stops and turning points of dry friction, 2 s of random torques."""
    physics = Physics.declare(arm(0.02, "pivot_friction", "pivot_damping"))
    named = {"pivot_friction_torque[arm]": 0.05, "pivot_damping_coefficient[arm]": 0.004}
    phi = np.array([named[label] for label in physics.layout.labels])
    torques = np.zeros((1, 100, 1, 3))
    torques[..., 2] = 0.1 * np.random.default_rng(0).normal(size=(1, 100, 1))
    (part,) = physics.simulator.parts
    slopes = [part.simulator.jacobian(phi, hung(1.5), torques, h) for h in (1e-3, 1e-4, 1e-5)]
    size = np.abs(slopes[-1]).max()
    for one in slopes[:-1]:
        assert np.abs(one - slopes[-1]).max() < 1e-4 * size


def test_a_ring_stops_where_coulomb_says() -> None:
    """Sliding without rotation over v^2 / (2 mu g); spinning for omega r m / (mu m g) I."""
    known = {"mass": 0.5, "r": 0.2, "mu_c": 0.2}
    puck = Body("puck", Shape.circle(0.1), known=known, effects=("sliding_friction",))
    physics = Physics.declare(Scene(time_step=0.02, normal_gravity=G, bodies=(puck,)))
    mu, radius = 0.3, 0.06
    named = {"sliding_friction_mu[puck]": mu, "sliding_friction_radius[puck]": radius}
    phi = np.array([named[label] for label in physics.layout.labels])
    start = np.zeros((2, 1, 6))
    start[0, 0, 3:5], start[1, 0, 5] = (0.6, -0.8), 30.0
    after = physics.predict(phi, start, np.zeros((2, 100, 1, 3)))[:, -1, 0]
    way = 1.0 / (2 * mu * G)
    np.testing.assert_allclose(after[0, :2], [0.6 * way, -0.8 * way], atol=1e-6)
    slowing = mu * G * radius / puck.shape.unit_moment
    np.testing.assert_allclose(after[1, 2], 30.0**2 / (2 * slowing), atol=1e-4)
    np.testing.assert_allclose(after[:, 3:], 0.0, atol=1e-12)


def test_a_ring_holds_up_to_its_friction() -> None:
    """Pushed and twisted together it gives way before either alone would do it."""
    known = {"mass": 0.5, "r": 0.2, "mu_c": 0.2}
    puck = Body("puck", Shape.circle(0.1), known=known, effects=("sliding_friction",))
    physics = Physics.declare(Scene(time_step=0.1, normal_gravity=G, bodies=(puck,)))
    named = {"sliding_friction_mu[puck]": 0.3, "sliding_friction_radius[puck]": 0.06}
    phi = np.array([named[label] for label in physics.layout.labels])
    force, torque = 0.3 * 0.5 * G, 0.3 * 0.5 * G * 0.06
    pushes = np.zeros((4, 1, 1, 3))
    pushes[:, 0, 0, 0] = force * np.array([0.99, 1.01, 0.0, 0.8])
    pushes[:, 0, 0, 2] = torque * np.array([0.0, 0.0, 0.99, 0.8])
    moved = np.abs(physics.predict(phi, np.zeros((4, 1, 6)), pushes)[:, 0, 0]).max(axis=1) > 1e-9
    assert moved.tolist() == [False, True, False, True]


@pytest.mark.parametrize(
    ("count", "more"), [(8, ()), (6, (EXAMPLES["sloshing"],))], ids=["bare", "sloshing"]
)
def test_bodies_far_apart_move_alike_up_to_the_largest_tree(count, more) -> None:
    """All coordinates that a tree may have, and force laws whose numbers find no place there."""
    bodies = tuple(Body(f"b{i}", Shape.circle(0.1), pose=(3.0 * i, 0, 0)) for i in range(count))
    scene = Scene(time_step=0.1, substeps=6, normal_gravity=G, bodies=bodies)
    physics = Physics.declare(scene, [BY_NAME["sliding_friction"], *more])
    phi = np.array([prior.centre for prior in physics.layout.priors])
    start = np.zeros((1, count, 6))
    start[:, :, 0] = 3.0 * np.arange(count)
    start[..., 3:5] = 1.0, 0.5
    out = Simulator(physics)(phi, start, np.zeros((1, 3, count, 3)))[0]
    out[..., 0] -= start[0, :, 0]
    np.testing.assert_allclose(out, np.broadcast_to(out[:, -1:], out.shape), atol=1e-6)


def test_a_law_that_no_step_follows_ends() -> None:
    """A torque that jumps with the angle's sign a million times a radian, and a stiff one."""

    def jagged(state, command, parameters, wrench):
        wrench[2] += 50.0 * math.copysign(1.0, math.sin(1e7 * state[2]))

    def broken(state, command, parameters, wrench):
        wrench[2] += math.sqrt(-1.0 - state[2] * state[2])

    for law in (jagged, broken):
        size = EffectParameter("size", "1", Prior("normal", sigma=1.0))
        effect = Effect("jagged", (size,), "a law that no step follows", "none", Force(law))
        physics = Physics(arm(), (effect.on("arm"),))
        after = physics.predict(np.ones(1), hung(0.3), np.zeros((1, 2, 1, 3)))
        assert np.isnan(after).all()


def test_an_error_of_a_step_follows_the_tolerance() -> None:
    physics = Physics.declare(arm(0.2))
    states = [
        physics.changed(tolerance=t).predict(np.zeros(0), hung(2.0), np.zeros((1, 20, 1, 3)))
        for t in (1e-4, 1e-6, 1e-8, 1e-11)
    ]
    off = [np.abs(one - states[-1])[..., 2].max() for one in states[:-1]]
    assert off[0] < 1e-2
    assert off[0] / off[1] > 10
    assert off[1] / off[2] > 10


@pytest.mark.parametrize("name", CASES)
def test_transitions_do_not_depend_on_each_other(name) -> None:
    sim, phi, start, inputs = case(*CASES[name], seed=4, n=40)
    whole = sim(phi, start, inputs)
    order = np.random.default_rng(1).permutation(len(start))
    np.testing.assert_array_equal(sim(phi, start[order], inputs[order]), whole[:, order])
    np.testing.assert_array_equal(sim(phi[::-1], start[3:10], inputs[3:10]), whole[::-1, 3:10])
    for threads in (2, 3):
        np.testing.assert_array_equal(like(sim, threads=threads)(phi, start, inputs), whole)


def test_contacts_are_left_to_the_engine(engine_items) -> None:
    """A wall beside the chain, and links that fold up."""
    walls = (Wall((0.4, -9.0), (0.4, 9.0)),)
    sim, phi, start, inputs = case(chain("hhh", walls=walls), ("com_offset",), seed=6, n=30)
    got = sim(phi, start, inputs)
    touched = np.zeros((got.shape[0] * got.shape[1], got.shape[2]), dtype=bool)
    touched[tuple(np.transpose(engine_items))] = True
    assert 0.1 < touched.mean() < 0.9
    touched = touched.reshape(got.shape[:3])
    expected = by_interval(sim, phi, start, inputs, got)
    np.testing.assert_allclose(got[touched], expected[touched], rtol=1e-9, atol=1e-9)


def test_an_item_that_diverges_is_lost_alone() -> None:
    sim, phi, start, inputs = case(*CASES["double pendulum"], seed=3)
    expected = sim(phi, start, inputs)
    inputs[2, :, :, :3] = 1e9
    got = sim(phi, start, inputs)
    kept = np.arange(len(start)) != 2
    assert np.isnan(got[:, 2]).any()
    np.testing.assert_array_equal(got[:, kept], expected[:, kept])


def test_a_wheel_and_a_ring_hold_a_body_together() -> None:
    """It stays under less than both hold, and moves under more, whatever each holds alone."""
    sim, _, start, inputs = case(ON_A_WHEEL, ("sliding_friction",), seed=0, n=2, horizon=6)
    given = {"mass": 2.0, "mu_x": 0.3, "mu_y": 0.3, "sliding_friction_mu": 0.2}
    phi = np.array([given.get(label.split("[")[0], 0.0) for label in sim.physics.layout.labels])
    start[:], inputs[..., :6] = 0.0, 0.0
    most = (0.3 + 0.2) * 2.0 * G
    inputs[0, ..., 0], inputs[1, ..., 0] = 0.98 * most, 1.02 * most
    held, moved = sim(phi, start, inputs)[:, -1, 0]
    np.testing.assert_allclose(held, 0.0, atol=1e-9)
    assert moved[3] == pytest.approx(0.02 * most / 2.0 * 0.6, rel=1e-3)


def test_the_engine_steps_near_contacts_alone(engine_items) -> None:
    """A puck on friction between two walls: intervals away from both are the tree's."""
    walls = (Wall((-1.0, -9.0), (-1.0, 9.0)), Wall((1.0, -9.0), (1.0, 9.0)))
    puck = Body("puck", Shape.circle(0.1), known={"mass": 1.0, "r": 0.9, "mu_c": 0.0})
    scene = Scene(time_step=0.1, normal_gravity=G, bodies=(puck,), walls=walls)
    sim, phi, start, inputs = case(scene, ("sliding_friction",), seed=0, n=1, horizon=30)
    phi[:] = (0.01, 0.05)
    start[:], inputs[:] = 0.0, 0.0
    start[0, 0, 3] = 3.0
    got = sim(phi[0], start, inputs)[0, :, 0]
    assert 2 <= len(engine_items) <= 12
    assert got[:, 3].max() > 0.0 > got[:, 3].min()
    free = sim(phi[0], start, inputs[:, :2])[0, :, 0]
    np.testing.assert_array_equal(got[:2], free)


@pytest.mark.parametrize("speed", [3.0, 30.0, 300.0])
def test_no_step_jumps_over_a_wall(speed) -> None:
    """However far a body would move in an interval."""
    wall = (Wall((1.0, -90.0), (1.0, 90.0)),)
    puck = Body("puck", Shape.circle(0.1), known={"mass": 1.0, "r": 0.5, "mu_c": 0.0})
    scene = Scene(time_step=0.1, substeps=400, normal_gravity=G, bodies=(puck,), walls=wall)
    sim, phi, start, inputs = case(scene, ("sliding_friction",), seed=0, n=1, horizon=4)
    start[:], inputs[:] = 0.0, 0.0
    start[0, 0, 3] = speed
    got = sim(phi[0], start, inputs)[0, :, 0]
    assert (got[:, 0] < 1.0).all()
