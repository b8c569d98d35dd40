"""Smoothed states that follow the parameters."""

import numpy as np
import pandas as pd
import pytest
from simulated_data import simulated_trajectories, with_measurements

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    Problem,
    along_trajectories,
    declared_problem,
    smoothed,
    with_sensitivity,
)
from pbrl_ppl.model import LazyProblem, PredictionOp, build_model
from pbrl_ppl.parameters import change_from
from pbrl_ppl.physics import PartedSimulator, Physics, Simulator, build_layout
from pbrl_ppl.posterior import parameter_draws, problem_of
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE, WRENCH
from tests.helpers.histories import simulated_history

PUCK = Scene(
    time_step=0.1,
    substeps=2,
    bodies=(Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}),),
)
CART = Scene(
    time_step=0.1,
    substeps=5,
    normal_gravity=9.81,
    bodies=(
        Body("cart", Shape.box(0.9, 0.55), wheel=True, known={"r": 0.2, "mu_c": 0.3}),
        Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}),
    ),
)
#: Errors of x, y, theta, vx, vy, omega, and accelerations: the heading is hardly measured.
BLIND = np.array([2e-3, 2e-3, 0.2, 2e-3, 2e-3, 5e-3, 0.02, 0.02, 0.05])


def simulated(
    scene: Scene, truth: dict, noise: np.ndarray, seed: int
) -> tuple[Problem, np.ndarray]:
    """Simulated with both noises, linearised at the truth; and the truth."""
    design = simulated_history(
        scene, truth, seed=seed, trajectories=6, intervals=8, noise=0.0, substeps=scene.substeps
    )
    problem = declared_problem(Physics.declare(scene), design, kind="trajectories")
    phi = problem.layout.to_vector(truth)
    measured = simulated_trajectories(problem, phi, noise, np.random.default_rng(seed))
    problem = along_trajectories(with_measurements(problem, measured), phi, noise)
    return problem, phi


@pytest.fixture(scope="module")
def cart() -> tuple[Problem, np.ndarray]:
    truth = {
        "mass": [8.0, 2.0], "w_x": -0.25, "w_y": 0.02, "w_theta": 0.1, "mu_x": 0.05, "mu_y": 0.5,
    }  # fmt: skip
    return simulated(CART, truth, BLIND, seed=2)


def likelihood(problem: Problem, phi: np.ndarray) -> float:
    return float(problem.log_density(problem.residual(phi), BLIND, phi).sum())


def test_nothing_changes_where_the_motion_is_linear() -> None:
    """A free puck's next state is linear in its state, so any point of linearisation will do."""
    noise = np.array([2e-3, 2e-3, 4e-3, 1e-2, 1e-2, 2e-2, 0.3, 0.3, 0.5])
    still, phi = simulated(PUCK, {"mass": 2.0}, noise, seed=1)
    follows = with_sensitivity(still, phi, noise)
    assert np.abs(follows.likelihood.noise.sensitivity.before).max() > 1e-3
    others = phi * np.array([0.7, 0.99, 1.3])[:, None]
    np.testing.assert_allclose(follows.residual(others), still.residual(others), atol=1e-10)


def test_it_is_the_likelihood_linearised_at_the_states_of_each(cart) -> None:
    """A wheel's angle and the headings are known together: held fast, states speak against both."""
    still, phi = cart
    angle = still.layout.labels.index("w_theta[cart]")
    follows = with_sensitivity(still, phi, BLIND)
    for turn in (-0.02, 0.02):
        other = phi.copy()
        other[angle] += turn
        there = likelihood(smoothed(still, other, BLIND), other)
        assert abs(likelihood(follows, other) - there) < 1.0
        assert likelihood(still, other) < there - 10.0


def test_many_parameters_are_as_one_by_one(cart) -> None:
    still, phi = cart
    follows = with_sensitivity(still, phi, BLIND)
    others = phi * (1.0 + 0.02 * np.random.default_rng(1).standard_normal((3, len(phi))))
    each = [follows.predict(other) for other in others]
    np.testing.assert_allclose(follows.predict(others), each, rtol=0, atol=1e-12)
    assert np.abs(each[0] - still.predict(others[0])).max() > 1e-4


def test_the_op_remembers_what_follows(cart) -> None:
    """In any order of parameters, and whatever a graph writes into what it was given."""
    still, phi = cart
    follows = with_sensitivity(still, phi, BLIND)
    given = follows.segments.start, follows.inputs
    op = PredictionOp(LazyProblem(follows))
    others = phi * (1.0 + 0.02 * np.random.default_rng(2).standard_normal((6, len(phi))))
    expected = [follows.predict(other) for other in others]
    for i in (0, 1, 0, 0, 5, 4, 3, 2, 1, 0):
        predicted = op.predict(others[i], *given)
        np.testing.assert_allclose(predicted, expected[i], rtol=0, atol=1e-12)
        predicted[:] = 0.0


def test_absurd_parameters_have_no_likelihood(cart) -> None:
    still, phi = cart
    absurd = phi.copy()
    absurd[0] = 1e300
    follows = with_sensitivity(still, phi, BLIND)
    assert not np.isfinite(follows.residual(absurd)).all()
    assert np.isfinite(follows.residual(np.stack([phi, absurd]))[0]).all()


def test_hung_bodies_stay_in_their_hinges() -> None:
    """A pendulum's place follows from its angle, whatever the parameters."""
    arm = Body("arm", Shape.box(0.6, 0.1), known={"r": 0.2, "mu_c": 0.3})
    hinge = Joint("hinge", ("world", "arm"), (0.0, 0.0), (-0.3, 0.0))
    scene = Scene(time_step=0.05, substeps=4, gravity=(0.0, -9.81), bodies=(arm,), joints=(hinge,))
    rows = []
    for step in range(9):
        angle, rate = -1.0 - 0.05 * step, -1.0
        x, y = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
        row = dict(zip(STATE, (x, y, angle, -rate * y, rate * x, rate), strict=True))
        acted = dict.fromkeys(WRENCH, 0.0 if step < 8 else np.nan) | {"torque": 0.1 * (step % 3)}
        if step == 8:
            acted["torque"] = np.nan
        rows.append(
            {"trajectory": 0, "step": step, "time": 0.05 * step, "body": "arm"} | row | acted
        )
    history = History.from_dataframe(pd.DataFrame(rows), scene)
    problem = declared_problem(Physics.declare(scene), history, kind="trajectories")
    phi = np.array([1.0])
    sigma = problem.noise_prior[0]
    follows = with_sensitivity(along_trajectories(problem, phi, sigma), phi, sigma)
    follow = follows.likelihood.noise.sensitivity
    others = np.array([[0.7], [1.2]])
    begun = follow.begun(follow.moved(others), follows.segments.start)
    angle = begun[..., 0, 2]
    assert np.abs(angle[0] - angle[1]).max() > 1e-6
    np.testing.assert_allclose(begun[..., 0, 0], 0.3 * np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(begun[..., 0, 1], 0.3 * np.sin(angle), atol=1e-12)
    assert np.isfinite(follows.residual(others)).all()


def test_equal_wheels_are_equally_likely(cart) -> None:
    still, phi = cart
    follows = with_sensitivity(still, phi, BLIND)
    angle, x, y = (still.layout.labels.index(f"{n}[cart]") for n in ("w_theta", "mu_x", "mu_y"))
    near = phi + 1e-3
    half, quarter = near.copy(), near.copy()
    half[angle] += np.pi
    quarter[[angle, x, y]] = near[angle] - np.pi / 2, near[y], near[x]
    for other in (half, quarter):
        np.testing.assert_allclose(change_from(still.layout, other, phi), near - phi, atol=1e-12)
        assert likelihood(follows, other) == pytest.approx(likelihood(follows, near), abs=1e-6)


def test_nothing_unknown_is_followed_by_nothing() -> None:
    body = Body("puck", Shape.circle(0.2), known={"mass": 2.0, "r": 0.2, "mu_c": 0.3})
    still, phi = simulated(PUCK.replace(bodies=(body,)), {}, BLIND, seed=1)
    assert with_sensitivity(still, phi, BLIND) is still


def test_other_parameters_leave_it_behind(cart) -> None:
    still, phi = cart
    follows = with_sensitivity(still, phi, BLIND)
    assert follows.with_physics(substeps=7).likelihood.sensitivity is not None
    drag = next(effect for effect in catalogue if effect.name == "linear_drag")
    more = (*still.physics.effects, *attach(CART, [drag]))
    assert follows.with_physics(effects=more).likelihood.sensitivity is None


@pytest.mark.parametrize(
    "joints", [(), (Joint("hinge", ("world", "puck"), (0.0, 3.0), (0.1, 0.0)),)]
)
def test_each_proposal_from_its_own_start(joints) -> None:
    """The engine as a whole, in parts and in one world."""
    scene = CART.replace(joints=joints)
    rng = np.random.default_rng(3)
    layout = build_layout(scene, attach(scene))
    phi = layout.to_vector({
        "mass": [8.0, 2.0], "w_x": -0.25, "w_y": 0.02, "w_theta": 0.1, "mu_x": 0.05, "mu_y": 0.5,
    }) * (1.0 + 0.02 * rng.standard_normal((3, layout.size)))  # fmt: skip
    start = rng.normal(0.0, 0.3, (3, 4, 2, 6))
    start[..., 1, :2] += (4.0, 0.0)
    if joints:  # it hangs where the hinge has it
        angle = start[..., 1, 2]
        start[..., 1, 0], start[..., 1, 1] = -0.1 * np.cos(angle), 3.0 - 0.1 * np.sin(angle)
        start[..., 1, 3] = 0.1 * np.sin(angle) * start[..., 1, 5]
        start[..., 1, 4] = -0.1 * np.cos(angle) * start[..., 1, 5]
    actions = rng.normal(0.0, 5.0, (4, 2, 2, 3))
    parts = (("cart",), ("puck",))
    for engine in (
        Simulator(Physics(scene)),
        PartedSimulator(Physics(scene, parts=parts)),
        Physics(scene, parts=parts).one_world,
    ):
        each = [engine(*own, actions) for own in zip(phi, start, strict=True)]
        np.testing.assert_array_equal(engine(phi, start, actions), each)


# such headings are where a linearisation ends, and the fit says so
@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.LinearisationWarning")
def test_an_angle_is_known_no_better_than_the_headings_that_tell_it(cart) -> None:
    """54 headings with an error of 0.2 rad; held fast, the states would say five times as much."""
    problem, phi = cart
    angle = problem.layout.labels.index("w_theta[cart]")
    idata = fit(build_model(problem), seed=1, method="laplace", progress=False)
    drawn = parameter_draws(problem_of(idata), idata)[0][:, angle]
    assert 0.5 * 0.2 / np.sqrt(54) < drawn.std() < 1.5 * 0.2 / np.sqrt(54)
    assert abs(drawn.mean() - phi[angle]) < 4 * drawn.std()  # a false alarm in 6e-5
