"""Bodies that follow their path whatever they meet, in the engine."""

import numpy as np
import pytest

from pbrl_ppl.effects import attach, candidates
from pbrl_ppl.errors import EffectError
from pbrl_ppl.physics import Simulator, Transition, build_layout, independent_parts
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.plain import PlainSimulator
from tests.helpers.pushes import pushed
from tests.helpers.worlds import BY_NAME, body, simulator, state

pytestmark = pytest.mark.one_stack

PATHS = pytest.mark.parametrize("path", ["auto", "python"])
FINGER = Body("finger", Shape.circle(0.05), kinematic=True, known={"r": 1.0, "mu_c": 1.0})


def beside(*others: Body, **options) -> Scene:
    """The finger, then other bodies."""
    return Scene(**{"time_step": 0.1, "substeps": 20, "bodies": (FINGER, *others)} | options)


def run(scene: Scene, start: np.ndarray, actions: np.ndarray, **options) -> np.ndarray:
    """States (H, body, 6) of one transition of a scene of which all is known."""
    return simulator(scene, **options)(np.zeros(0), start[None], actions[None])[0]


def test_it_has_the_parameters_of_a_contact_alone() -> None:
    finger, puck = (
        Body("finger", Shape.circle(0.1), kinematic=True),
        Body("puck", Shape.circle(0.1)),
    )
    layout = build_layout(Scene(time_step=0.1, bodies=(puck, finger)))
    assert layout.labels == ("mass[puck]", "r[puck]", "r[finger]", "mu_c[puck]", "mu_c[finger]")


@PATHS
def test_it_goes_where_it_is_told_through_a_body_at_a_wall(path) -> None:
    """The puck is jammed, and gives way."""
    puck = body("puck", Shape.circle(0.1), mass=50.0, mu_c=0.5)
    scene = beside(puck, walls=(Wall((0.3, -1.0), (0.3, 1.0)),))
    actions = np.zeros((6, 2, 3))
    actions[:, 0] = np.random.default_rng(0).normal((1.0, 0.0, 0.0), (0.2, 0.2, 1.0), (6, 3))
    start = np.stack([state(x=-0.2, vx=9.0), state()])
    states = run(scene, start, actions, engine=path)
    way = start[0, :3] + 0.1 * np.cumsum(actions[:, 0], axis=0)
    np.testing.assert_allclose(states[:, 0, :3], way, atol=1e-12)
    np.testing.assert_allclose(states[:, 0, 3:], actions[:, 0], atol=1e-12)
    assert np.hypot(*states[-1, 1, :2]) > 0.1  # they met


@PATHS
@pytest.mark.parametrize("r", [0.0, 0.5, 1.0])
def test_a_hit_by_it_is_one_by_an_infinite_mass(r, path) -> None:
    """v' = (1 + r) V, whatever the mass."""
    scene = beside(body("puck", Shape.circle(0.1), mass=7.0, r=r))
    actions = np.zeros((4, 2, 3))
    actions[:, 0, 0] = 2.0
    states = run(scene, np.stack([state(x=-0.3), state()]), actions, engine=path)
    np.testing.assert_allclose(states[-1, 1], [*states[-1, 1, :3], 2.0 * (1 + r), 0, 0], atol=1e-9)


@PATHS
def test_a_hinge_on_it_carries_a_body_along(path) -> None:
    scene = beside(
        body("arm", Shape.box(0.1, 0.4)),
        joints=(Joint("hinge", ("finger", "arm"), (0.0, 0.0), (0.0, 0.2)),),
        gravity=(0.0, -9.81),
    )
    actions = np.zeros((5, 2, 3))
    actions[:, 0, 0] = [1.0, 2.0, 0.0, -1.0, 0.5]
    states = run(scene, np.stack([state(), state(y=-0.2)]), actions, engine=path)
    c, s = np.cos(states[:, 1, 2]), np.sin(states[:, 1, 2])
    hinge = states[:, 1, :2] + 0.2 * np.stack([-s, c], axis=-1)
    np.testing.assert_allclose(hinge, states[:, 0, :2], atol=2e-3)
    assert np.ptp(states[:, 1, 2]) > 0.1


def crowd() -> tuple[Simulator, np.ndarray, np.ndarray, np.ndarray]:
    """Two fingers among pucks, one of which a finger holds, in a small room."""
    bodies = (
        Body("thumb", Shape.box(0.1, 0.1), kinematic=True),
        Body("a", Shape.circle(0.1)),
        FINGER,
        Body("b", Shape.box(0.2, 0.2), wheel=True),
        Body("c", Shape.box(0.2, 0.1)),
    )
    ends = [(-0.6, -0.6), (0.6, -0.6), (0.6, 0.6), (-0.6, 0.6)]
    scene = Scene(
        time_step=0.05,
        normal_gravity=9.81,
        bodies=bodies,
        walls=tuple(Wall(ends[i - 1], ends[i]) for i in range(4)),
        joints=(Joint("hinge", ("thumb", "c"), (0.0, 0.0), (0.1, 0.0)),),
    )
    rng = np.random.default_rng(3)
    start = rng.normal(0, [0.02, 0.02, 0.3, 1, 1, 1], (30, 5, 6))
    start[..., :2] += [(0.3, 0.3), (-0.3, 0.3), (0.0, 0.0), (0.3, -0.3), (0.2, 0.3)]
    start[:, 4, :2] = start[:, 0, :2] - 0.1 * np.stack(
        [np.cos(start[:, 4, 2]), np.sin(start[:, 4, 2])], axis=-1
    )
    sim = simulator(scene)
    phi = np.random.default_rng(5).uniform(0.1, 0.6, (2, sim.physics.layout.size))
    return sim, phi, start, rng.normal(0, 2.0, (30, 3, 5, 3))


def test_paths_agree_and_order_and_chunks_change_nothing() -> None:
    sim, phi, start, actions = crowd()
    expected = sim(phi, start, actions)
    plain = PlainSimulator(sim.physics)
    np.testing.assert_allclose(
        plain(phi, start[:8], actions[:8]), expected[:, :8], rtol=1e-9, atol=1e-9
    )
    order = np.random.default_rng(6).permutation(len(start))
    np.testing.assert_array_equal(sim(phi, start[order], actions[order]), expected[:, order])
    parts = [sim(phi, start[i : i + 7], actions[i : i + 7]) for i in range(0, 30, 7)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), expected)
    two = Simulator(sim.physics.changed(threads=2))
    np.testing.assert_array_equal(two(phi, start, actions), expected)


def test_bodies_that_it_meets_are_in_its_part() -> None:
    scene, history = pushed()
    assert independent_parts(scene, history) == (("block", "finger"),)
    far = history.dataset.copy(deep=True)
    far["start"][..., 1, 0] += 100.0
    apart = type(history)(far)
    # it stays with a body: an engine needs one that forces move
    assert independent_parts(scene, apart) == (("block", "finger"),)


def test_no_effect_is_put_on_it() -> None:
    scene = beside(Body("puck", Shape.circle(0.1)))
    assert {one.body for one in candidates(scene, ())} == {"puck"}
    with pytest.raises(EffectError, match=r"'finger', which is not .* is kinematic"):
        attach(scene, (BY_NAME["linear_drag"].on("finger"),))


def test_the_transition_takes_its_velocity_as_the_push() -> None:
    scene = beside(body("puck", Shape.circle(0.1), mass=3.0))
    f = Transition(scene, {})
    after = f([*state(x=-0.3), *state(), 0, 1.0, 0.5, 2.0])
    np.testing.assert_allclose(after[:6], [-0.2, 0.05, 0.2, 1.0, 0.5, 2.0], atol=1e-12)
    np.testing.assert_array_equal(after[6:], 0.0)


def test_a_body_coasts_before_a_push_and_after_it() -> None:
    """A block on friction: v^2 = v_0^2 - 2 mu g s, to the tolerance, however long the steps."""
    mu, block = 0.1, body("block", Shape.circle(0.1), mass=2.0)
    scene = beside(block, normal_gravity=9.81, substeps=1)
    sim = simulator(scene, (BY_NAME["sliding_friction"],))
    start = np.stack([state(x=-1.0), state(x=0.0, vx=0.3)])[None]
    actions = np.zeros((1, 12, 2, 3))
    actions[0, :8, 0, 0] = 1.5  # it comes from behind, and stops
    states = sim(np.array([mu, 0.05]), start, actions)[0]
    at_rest = 0.3**2 / (2.0 * mu * 9.81)
    np.testing.assert_allclose(states[3, 1, :4], [at_rest, 0.0, 0.0, 0.0], atol=1e-6)
    assert states[-1, 1, 0] > 0.2
    np.testing.assert_allclose(states[:8, 0, 0], -1.0 + 0.15 * np.arange(1, 9), atol=1e-12)
    left = np.flatnonzero(states[:, 1, 3] > 0.0)[-2:]  # of the last interval of its way
    v, x = states[left, 1, 3], states[left, 1, 0]
    assert v[0] ** 2 - v[1] ** 2 == pytest.approx(2 * mu * 9.81 * (x[1] - x[0]), rel=1e-4)
