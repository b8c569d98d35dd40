"""The contact-free fast path of joined bodies agrees with the engine."""

import dataclasses

import numpy as np
import pytest

from pbrl_ppl.physics import Simulator, calls, compiled
from pbrl_ppl.scene import Body, Scene, Wall
from tests.helpers.chains import LINK, cart_with_trailers, case, chain
from tests.helpers.engines import BOX
from tests.helpers.worlds import G

pytestmark = [
    pytest.mark.one_stack,
    pytest.mark.skipif(
        not calls.AVAILABLE, reason="the compiled path cannot call the engine on this platform"
    ),
]

PIVOT = ("pivot_friction", "pivot_damping")
CASES = {
    "double pendulum": (chain("hh"), ("com_offset", "inertia_scale", *PIVOT)),
    "four links": (chain("hhhh", turned=(0, 2)), ("com_offset", *PIVOT, "linear_drag")),
    "hung on a rod": (chain("rh", turned=(0,)), ("com_offset", "actuator_delay")),
    "on a post": (chain("hrh", holder="post"), ("com_offset", "gravity_tilt", *PIVOT)),
    "free": (chain("-hh"), ("com_offset", "inertia_scale", *PIVOT)),
    "free, with a payload": (chain("-hr", turned=(1,)), ("com_offset", "mass_change")),
    "sliding": (chain("-h", normal_gravity=G), ("com_offset", "sliding_friction")),
    "trailers": (cart_with_trailers(), ("com_offset", "angular_drag")),
}


def like(sim: Simulator, **options) -> Simulator:
    return Simulator(sim.physics.changed(**options))


@pytest.fixture
def engine_items(monkeypatch) -> list[int]:
    """Items that go to the engine."""
    items: list[int] = []
    rollout = compiled.rollout

    def counted(*arguments):
        items.extend(arguments[-2])
        return rollout(*arguments)

    monkeypatch.setattr(compiled, "rollout", counted)
    return items


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("extrapolate", [True, False])
def test_it_agrees_with_the_engine(name, extrapolate, engine_items) -> None:
    sim, phi, start, inputs = case(*CASES[name], seed=1)
    sim = like(sim, extrapolate=extrapolate)
    got = sim(phi, start, inputs)
    expected = like(sim, extrapolate=extrapolate, engine="python")(phi, start, inputs)
    assert not engine_items  # the fast path predicted all of them
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("seed", range(6))
def test_random_chains(seed, engine_items) -> None:
    rng = np.random.default_rng(seed)
    kinds = "".join(rng.choice(list("hr"), rng.integers(2, 5)))
    turned = tuple(np.flatnonzero(rng.random(len(kinds)) < 0.5))
    scene = chain(kinds, turned=turned, substeps=int(rng.integers(3, 20)))
    sim, phi, start, inputs = case(
        scene, ("com_offset", "inertia_scale", *PIVOT[: kinds.count("h")]), seed, 6, 3
    )
    got = sim(phi, start, inputs)
    expected = like(sim, engine="python")(phi, start, inputs)
    assert len(engine_items) < got[..., 0, 0, 0].size / 2  # some may fold up, and touch
    np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)


def unequal() -> tuple[Simulator, np.ndarray, np.ndarray, np.ndarray]:
    """Seven proposals that take 30 to 2000 iterations, in no order."""
    sim, phi, start, inputs = case(*CASES["double pendulum"], seed=5, n=9)
    phi = np.repeat(phi[:1], 7, axis=0)
    phi[:, sim.physics.layout.index("mass", "b0")] = 1.0
    phi[:, sim.physics.layout.index("mass", "b1")] = [40.0, 1.0, 0.01, 2000.0, 3.0, 25.0, 1.0]
    return sim, phi, start, inputs


def test_iterations_depend_on_each_proposal_alone(engine_items) -> None:
    sim, phi, start, inputs = unequal()
    whole = sim(phi, start, inputs)
    for one, expected in zip(phi, whole, strict=True):
        np.testing.assert_array_equal(sim(one, start, inputs), expected)
    np.testing.assert_array_equal(sim(phi[::-1], start[::-1], inputs[::-1]), whole[::-1, ::-1])
    np.testing.assert_array_equal(sim(phi, start[4:5], inputs[4:5]), whole[:, 4:5])
    assert not engine_items
    plain = like(sim, engine="python")(phi, start[:2], inputs[:2])
    np.testing.assert_allclose(whole[:, :2], plain, rtol=1e-11, atol=1e-11)
    # the most unequal masses do depend on the number of iterations
    fewer = sim(phi[1], start[:2], inputs[:2])
    assert np.abs(fewer - whole[3, :2]).max() > 1e-3


@pytest.mark.parametrize("name", ["sliding", "trailers"])
def test_wheels_and_patches_rest_when_their_iterations_are_done(name) -> None:
    sim, phi, start, inputs = case(*CASES[name], seed=7)
    last = [
        place for place, label in enumerate(sim.physics.layout.labels) if label.startswith("mass")
    ][-1]
    phi[:, last] *= [1.0, 60.0, 25.0]
    whole = sim(phi, start, inputs)
    for one, expected in zip(phi, whole, strict=True):
        np.testing.assert_array_equal(sim(one, start, inputs), expected)
    np.testing.assert_array_equal(sim(phi, start[:1], inputs[:1]), whole[:, :1])


@pytest.mark.parametrize("name", CASES)
def test_transitions_of_a_block_do_not_depend_on_each_other(name) -> None:
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
    assert 0.1 < len(engine_items) / got[:, :, 0, 0, 0].size < 0.9
    expected = like(sim, engine="python")(phi, start, inputs)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


def test_an_item_that_diverges_is_lost_alone() -> None:
    sim, phi, start, inputs = case(*CASES["double pendulum"], seed=3)
    expected = sim(phi, start, inputs)
    inputs[2, :, :, :3] = 1e9
    got = sim(phi, start, inputs)
    kept = np.arange(len(start)) != 2
    assert np.isnan(got[:, 2]).any()
    np.testing.assert_array_equal(got[:, kept], expected[:, kept])


def test_energy_and_momentum_are_kept() -> None:
    """Of links whose mass is anywhere; kinetic energy is that of the centres of mass."""
    offs, masses = np.array([(0.03, -0.05), (-0.02, 0.04), (0.01, 0.06)]), np.array([0.5, 0.9, 0.3])
    scales = np.array([1.3, 0.8, 1.1])

    def drifts(kinds: str, substeps: int, extrapolate: bool = True) -> tuple[float, float]:
        free = kinds.startswith("-")
        scene = chain(kinds, gravity=(0.0, 0.0 if free else -G), time_step=0.1)
        k = len(kinds)
        known = [{"mass": masses[i], "r": 0.0, "mu_c": 0.0} for i in range(k)]
        bodies = [dataclasses.replace(b, known=v) for b, v in zip(scene.bodies, known, strict=True)]
        scene = scene.replace(bodies=tuple(bodies))
        sim, _, start, inputs = case(scene, ("com_offset", "inertia_scale"), seed=2)
        named = {f"{effect}_{p}[b{i}]": v for i in range(k) for effect, p, v in (
            ("com_offset", "x", offs[i, 0]), ("com_offset", "y", offs[i, 1]),
            ("inertia_scale", "scale", scales[i]))}  # fmt: skip
        phi = np.array([named[label] for label in sim.physics.layout.labels])
        sim = like(sim, substeps=substeps, extrapolate=extrapolate)
        after = sim(phi, start, 0.0 * inputs)
        changes = []
        for states in (start, after[:, -1]):
            c, s = np.cos(states[..., 2]), np.sin(states[..., 2])
            x, y = c * offs[:k, 0] - s * offs[:k, 1], s * offs[:k, 0] + c * offs[:k, 1]
            vx, vy = states[..., 3] - states[..., 5] * y, states[..., 4] + states[..., 5] * x
            x, y, m = states[..., 0] + x, states[..., 1] + y, masses[:k]
            spin = m * LINK.unit_moment * scales[:k] * states[..., 5]
            kinetic = (m * (vx**2 + vy**2) + spin * states[..., 5]) / 2
            energy = (kinetic + m * G * y * (not free)).sum(axis=-1)
            angular = (m * (x * vy - y * vx) + spin).sum(axis=-1)
            changes.append((energy, (m * vx).sum(axis=-1), (m * vy).sum(axis=-1), angular))
        energy, *momentum = (np.abs(b - a).max() for a, b in zip(*changes, strict=True))
        return float(energy), float(max(momentum)) if free else 0.0

    for kinds in ("hh", "-hh"):
        (coarse, _), (fine, _) = drifts(kinds, 40), drifts(kinds, 80)
        assert coarse / fine > 5.0  # of the third order
        assert fine < 1e-3
    # the rod's two impulses lie on one line; a hinge's anchors are apart by the drift to correct
    assert drifts("-rr", 40, extrapolate=False)[1] < 1e-9
    assert drifts("-hh", 40)[1] / drifts("-hh", 80)[1] > 5.0


# -- single bodies ---------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["free", "wheel", "sliding", "hinge", "rod", "payload", "walls"])
def test_a_centre_off_the_origin(what, engine_items) -> None:
    """As the engine has it, with a drag at the origin and a command that lags."""
    effects = ["com_offset", "linear_drag", "actuator_delay"]
    if what in ("hinge", "rod"):
        scene = chain(what[0], turned=(0,))
        effects += PIVOT if what == "hinge" else ()
    else:
        walls = (Wall((2.0, -9.0), (2.0, 9.0)),) if what == "walls" else ()
        single = Body("b0", BOX, wheel=what in ("wheel", "walls"))
        scene = Scene(time_step=0.1, normal_gravity=G, bodies=(single,), walls=walls)
        effects += {"sliding": ["sliding_friction"], "payload": ["mass_change"]}.get(what, [])
    sim, phi, start, inputs = case(scene, effects, seed=9, n=30, horizon=3)
    got = sim(phi, start, inputs)
    share = len(engine_items) / got[..., 0, 0, 0].size
    assert 0.0 < share < 0.5 if what == "walls" else share == 0.0
    expected = like(sim, engine="python")(phi, start, inputs)
    off = np.abs(got - expected) / (1.0 + np.abs(expected))
    assert np.quantile(off, 0.99) < 1e-11
    assert off.max() < (1e-6 if what == "sliding" else 1e-9)  # sticks or slides by a hair
    np.testing.assert_array_equal(sim(phi, start[::-1], inputs[::-1]), got[:, ::-1])
    without = phi.copy()
    off_places = [
        i for i, label in enumerate(sim.physics.layout.labels) if label.startswith("com_offset")
    ]
    without[:, off_places] = 0.0
    mixed = np.concatenate([phi, without])
    np.testing.assert_array_equal(sim(mixed, start, inputs)[3:], sim(without, start, inputs))
