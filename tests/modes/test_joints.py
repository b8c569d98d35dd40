"""Joints whose bodies and anchors are inferred: the engine, phi's layout and the model."""

import numpy as np
import pymc as pm
import pytest

from pbrl_ppl.effects import attach, candidates
from pbrl_ppl.errors import FitError, ParameterError
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.physics import Physics, Simulator, build_layout
from pbrl_ppl.scene import WORLD, Joint, Scene
from tests.helpers.histories import simulated_history
from tests.helpers.joints import HINGED, NAMES, POSES, reference_anchors, scene
from tests.helpers.plain import simulator_of

KINDS = pytest.mark.parametrize("kind", ["hinge", "distance"])
PATHS = pytest.mark.parametrize("path", ["auto", "python"])


def simulator(*joints: Joint, **options) -> Simulator:
    return simulator_of(Physics(scene(*joints)), **options)


def data(n: int = 10) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    start = np.zeros((n, 4, 6))
    start[..., :3] = POSES
    start[..., 3:] = rng.normal(0, 0.5, (n, 4, 3))
    return start, rng.normal(0, [8.0, 8.0, 1.0], (n, 2, 4, 3))


# -- the engine ------------------------------------------------------------------------------------


@PATHS
@KINDS
@pytest.mark.parametrize(("first", "second"), [("a", "b"), ("c", "b"), ("d", WORLD), (WORLD, "a")])
def test_inferred_joint_is_the_known_one(path, kind, first, second) -> None:
    index = {name: i for i, name in enumerate((*NAMES, WORLD))}
    anchors = (
        [0.3, 0.1, -0.2, 0.05]
        if kind == "distance"
        else reference_anchors(
            *(min(index[name], 3) for name in (first, second)), (0.6, 0.05), POSES
        )
    )
    if kind == "hinge" and WORLD in (first, second):  # the world's frame is the world
        at = 2 if second == WORLD else 0
        anchors[at : at + 2] = (0.6, 0.05)
    a, b = tuple(anchors[:2]), tuple(anchors[2:])
    known = simulator(Joint(kind, (first, second), a, b), engine=path)
    start, actions = data()
    expected = known(np.zeros(0), start, actions)

    held = simulator(Joint(kind, (first, second), known=False), engine=path)
    assert held.physics.layout.labels == (
        "a_x[joint1]",
        "a_y[joint1]",
        "b_x[joint1]",
        "b_y[joint1]",
    )
    np.testing.assert_array_equal(held(np.array(anchors), start, actions), expected)

    free = simulator(Joint(kind, known=False), engine=path)
    assert free.physics.layout.labels[:2] == ("i_a[joint1]", "i_b[joint1]")
    phi = np.array([index[first], index[second], *anchors])
    np.testing.assert_array_equal(free(phi, start, actions), expected)
    # and it does something
    without = simulator(engine=path)(np.zeros(0), start, actions)
    assert np.abs(expected - without).max() > 0.05


@PATHS
@KINDS
@pytest.mark.parametrize("index", range(5))
def test_equal_indices_nullify(path, kind, index) -> None:
    start, actions = data()
    without = simulator(engine=path)(np.zeros(0), start, actions)
    phi = np.array([index, index, 0.1, 0.2, -0.3, 0.1])
    joined = simulator(Joint(kind, known=False), engine=path)
    np.testing.assert_array_equal(joined(phi, start, actions), without)


def test_proposals_with_different_indices_in_one_call() -> None:
    """Two inferred joints; each proposal is what it would be alone, whatever the threads."""
    joints = (Joint("distance", known=False), Joint("hinge", known=False))
    rng = np.random.default_rng(5)
    start, actions = data()
    sim = simulator(*joints)
    phi = np.zeros((40, sim.physics.layout.size))
    phi[:, :4] = rng.integers(0, 5, (40, 4))
    phi[:, 4:] = rng.uniform(-0.2, 0.2, (40, 8))
    together = sim(phi, start, actions)
    np.testing.assert_array_equal(simulator(*joints, threads=2)(phi, start, actions), together)
    for one, answer in zip(phi, together, strict=True):
        np.testing.assert_array_equal(sim(one, start, actions), answer)
    engine = simulator(*joints, engine="chipmunk")(phi[:3], start[:3], actions[:3])
    plain = simulator(*joints, engine="python")(phi[:3], start[:3], actions[:3])
    np.testing.assert_allclose(plain, engine, rtol=1e-9, atol=1e-9)


def test_joint_of_a_to_b_is_the_joint_of_b_to_a() -> None:
    start, actions = data()
    sim = simulator(Joint("distance", known=False))
    one = sim(np.array([0.0, 1.0, 0.3, 0.1, -0.2, 0.05]), start, actions)
    other = sim(np.array([1.0, 0.0, -0.2, 0.05, 0.3, 0.1]), start, actions)
    np.testing.assert_allclose(one, other, atol=1e-6)  # the solver's rows change places


def test_rod_of_no_length_is_a_hinge() -> None:
    apart = reference_anchors(0, 1, (0.6, 0.05), POSES)
    a, b = (tuple(each) for each in np.reshape(apart, (2, 2)))
    start, actions = data()
    rod = simulator(Joint("distance", ("a", "b"), a, b))
    hinge = simulator(Joint("hinge", ("a", "b"), a, b))
    got = rod(np.zeros(0), start, actions)
    np.testing.assert_array_equal(got, hinge(np.zeros(0), start, actions))


@pytest.mark.parametrize("index", [-1.0, 5.0, 0.5])
def test_an_index_that_names_nothing_is_refused(index) -> None:
    sim = simulator(Joint("hinge", known=False))
    with pytest.raises(ParameterError, match=r"joint index is .*from 0 to 4: a, b, c, d, world"):
        sim(np.array([0.0, index, 0.0, 0.0, 0.0, 0.0]), *data())


def test_an_anchor_that_is_no_number_is_refused() -> None:
    sim = simulator(Joint("hinge", known=False))
    with pytest.raises(ParameterError, match="joint 'joint1': a_y is not finite"):
        sim(np.array([0.0, 1.0, 0.0, np.nan, 0.0, 0.0]), *data())


def test_friction_of_a_hinge_needs_to_know_what_hangs_in_it() -> None:
    unknown, given = scene(Joint("hinge", known=False)), Joint("hinge", ("a", "b"), known=False)
    names = {one.effect.name for one in candidates(unknown, ())}
    assert not {"pivot_friction", "pivot_damping"} & names
    on = [one.body for one in candidates(scene(given), ()) if one.effect.name == "pivot_friction"]
    assert on == ["b"]
    assert attach(scene(given).with_effects("b", "pivot_friction"))


# -- the prior and the model -----------------------------------------------------------------------


# PyMC 6 draws from a truncated normal with numba's object mode
@pytest.mark.filterwarnings("ignore:Numba will use object mode:UserWarning")
def test_anchors_are_bounded_by_the_body_that_holds_them() -> None:
    """Table 1: on the bounds of the body; in the world on those of the scene."""
    free = scene(Joint("hinge", known=False), walls=True)
    model = physics_model(free, recorded(free, with_wall=True))
    assert [v.name for v in model.free_RVs] == ["i_a", "i_b", "a_x", "a_y", "b_x", "b_y", "sigma"]
    draws = pm.draw(
        [model["i_a"], model["a_x"], model["a_y"]], 2000, random_seed=1, mode="FAST_COMPILE"
    )
    i, x, y = (each[:, 0] for each in draws)
    assert set(i) == {0, 1, 2, 3, 4}  # uniform: 400 each, give or take 5 * 18
    assert np.abs(np.bincount(i) - 400).max() < 90
    bodies = i < 4
    assert np.abs(x[bodies]).max() <= 0.4
    assert np.abs(y[bodies]).max() <= 0.25
    x_min, x_max, y_min, y_max = free.extent
    assert ((x_min <= x) & (x <= x_max) & (y_min <= y) & (y <= y_max)).all()
    assert np.abs(x[~bodies]).max() > 5.0
    # and the log-density knows it: an anchor beyond the body that holds it is impossible
    logp = model.compile_logp(jacobian=False, mode="FAST_COMPILE")
    point = model.initial_point()
    assert np.isfinite(logp(point))


def test_a_mode_over_unknown_bodies_is_refused() -> None:
    free = scene(Joint("hinge", known=False))
    with pytest.raises(FitError, match="which bodies a joint of the scene joins is unknown"):
        find_mode(problem_in(physics_model(free, recorded(free))))


def test_a_given_anchor_is_the_centre_of_its_prior() -> None:
    near = Joint("hinge", ("a", "b"), (0.3, 0.0), (-0.2, 0.1), known=False)
    layout = build_layout(scene(near))
    assert [prior.mu for prior in layout.priors] == [0.3, 0.0, -0.2, 0.1]
    assert layout.priors[0].support == (-0.4, 0.4)


def recorded(one: Scene, *, with_wall: bool = False, noise: float = 0.0) -> History:
    """Boxes a and b with a hinge between them, pushed about."""
    a, b = (tuple(each) for each in np.reshape(reference_anchors(0, 1), (2, 2)))
    truth = scene(Joint("hinge", ("a", "b"), a, b), walls=with_wall, poses=HINGED)
    return simulated_history(
        truth,
        {},
        seed=2,
        trajectories=4,
        intervals=10,
        noise=noise,
        poses=HINGED,
        substeps=10,
    )


def test_anchors_of_a_hinge_are_recovered() -> None:
    """From starts anywhere in the bodies; measured with 1 mm of noise."""
    held = scene(Joint("hinge", ("a", "b"), known=False))
    problem = problem_in(physics_model(held, recorded(held, noise=1e-3)))
    found = find_mode(problem, seed=1).phi
    # 40 transitions give 0.3 mm by their positions alone; the engine's error adds as much
    np.testing.assert_allclose(found, reference_anchors(0, 1), atol=2e-3)


def test_the_right_pair_is_the_most_probable() -> None:
    """Of all pairs with their best anchors, on data with noise."""
    free = scene(Joint("hinge", known=False))
    problem = problem_in(physics_model(free, recorded(free, noise=1e-3)))
    anchors = reference_anchors(0, 1)
    cost = {}
    for i in range(5):
        for j in range(i + 1):
            phi = np.array([float(j), float(i), *anchors])
            cost[j, i] = (problem.residual(phi) ** 2).sum()
    assert min(cost, key=cost.get) == (0, 1)
