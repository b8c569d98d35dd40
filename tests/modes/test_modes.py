"""Modes: recovery from a wrong start, the wheel's symmetry, whole trajectories, derivatives."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_info, threadpool_limits

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood, TransitionLikelihood
from pbrl_ppl.modes import mode_of_more, search, trajectory_mode
from pbrl_ppl.modes.search import climb, covariance_of, find_mode, find_modes, sandwich
from pbrl_ppl.parameters import by_prior, covariance_factor, differentiate
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import NOISE, simulated_history

pytestmark = pytest.mark.one_stack  # nothing is sampled here
WHEEL = ("w_x", "w_y", "w_theta", "mu_x", "mu_y")
# r and mu_c matter in contacts only, and there is none
KNOWN_CONTACT = {"known": {"r": 0.2, "mu_c": 0.3}}


@pytest.fixture(scope="module")
def history() -> History:
    return simulated_history(cart_scene(), CART, seed=5, trajectories=8, intervals=12)


@pytest.fixture(scope="module")
def problem(history):
    return Problem.of(Physics(cart_scene(**KNOWN_CONTACT)), history)


@pytest.fixture(scope="module")
def modes(problem):
    return find_modes(problem, seed=3)


def z_scores(mode, truth) -> dict[str, float]:
    """Distance from the truth in posterior standard deviations, by name."""
    deviation = np.sqrt(np.diag(mode.covariance))
    labels = [label.split("[")[0] for label in mode.problem.layout.labels]
    distance = (mode.phi - [truth[name] for name in labels]) / deviation
    return dict(zip(labels, distance, strict=True))


def test_recovers_the_truth_from_prior_draws(modes) -> None:
    """No start is told anything: the best mode has the truth within 4 sd.

    Six numbers, if they were normal: false alarm 4e-4.
    """
    z = z_scores(modes[0], CART)
    assert set(z) == {"mass", *WHEEL}
    assert max(np.abs(list(z.values()))) < 4, z


def test_the_standard_deviations_are_useful(modes) -> None:
    """96 transitions pin the cart down: a wide posterior would pass the test above for nothing."""
    deviation = dict(
        zip(
            ("mass", *WHEEL),
            np.sqrt(np.diag(modes[0].covariance)),
            strict=True,
        )
    )
    assert deviation["mass"] < 0.3
    assert max(deviation["w_x"], deviation["w_y"]) < 0.05
    assert deviation["w_theta"] < 0.1
    assert max(deviation["mu_x"], deviation["mu_y"]) < 0.05


def test_recovers_from_a_wrong_start(problem) -> None:
    wrong = {"mass": 2.0, "w_x": 0.1, "w_y": 0.1, "w_theta": -0.5, "mu_x": 0.3, "mu_y": 0.6}
    mode = find_mode(problem, initial=problem.layout.to_vector(wrong))
    z = z_scores(mode, CART)
    assert max(np.abs(list(z.values()))) < 4, z


def test_modes_are_sorted_and_describe_themselves(problem, modes) -> None:
    assert all(a.log_posterior >= b.log_posterior for a, b in pairwise(modes))
    mode = modes[0]
    p, n_cells = problem.layout.size, problem.observations.values.size
    assert mode.jacobian.shape == (n_cells, p)
    assert mode.covariance.shape == (p, p)
    assert np.linalg.eigvalsh(mode.covariance).min() > 0
    assert problem.layout.to_dict(mode.phi)["mass"] == pytest.approx(mode.phi[:1])
    # where sigma is the most probable, the slope of the log-posterior by its logarithm vanishes
    z = mode.whitened_residual.reshape(problem.observations.values.shape)
    n, (median, spread) = problem.segments.n, problem.noise_prior
    square = n + 1 + np.log(mode.sigma / median) / spread**2
    np.testing.assert_allclose((z**2).sum(axis=(0, 1, 2)), square, rtol=1e-6)
    assert mode.whitened_residual is mode.whitened_residual
    other = replace(mode, problem=problem.with_physics(substeps=2))
    assert not np.array_equal(other.whitened_residual, mode.whitened_residual)


def test_same_seed_same_modes(problem, modes) -> None:
    again = find_modes(problem, seed=3)
    for one, other in zip(modes, again, strict=True):
        np.testing.assert_array_equal(one.phi, other.phi)
        np.testing.assert_array_equal(one.sigma, other.sigma)


def blas_threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_a_search_takes_one_thread_of_linear_algebra(problem, modes, monkeypatch) -> None:
    seen = []

    def watched(*arguments, **options):
        seen.append(blas_threads())
        return climb(*arguments, **options)

    monkeypatch.setattr(search, "climb", watched)
    with threadpool_limits(2, "blas"):
        find_mode(problem, initial=modes[0].phi)
        assert blas_threads() == {2}  # as it was
    assert seen
    assert all(threads == {1} for threads in seen)


def test_scalar_sigma(history) -> None:
    problem = Problem.of(
        Physics(cart_scene(**KNOWN_CONTACT)), history, likelihood=TransitionLikelihood(scalar=True)
    )
    mode = find_mode(problem, initial=problem.layout.to_vector(CART))
    assert np.ptp(mode.sigma) == 0.0
    residual = problem.residual(mode.phi)
    # P(sigma) moves the root mean square by less than 1 / n
    rms = np.sqrt((residual**2).mean())
    assert mode.sigma[0] == pytest.approx(rms, rel=1.0 / residual.size)


@pytest.mark.slow
def test_recovers_what_another_engine_made(make_history) -> None:
    """Data from Box2D at 1 ms steps; 6 numbers within 4 sd."""
    train, _ = make_history.simulate(21)
    scene = cart_scene(**KNOWN_CONTACT)
    history = History.from_dataframe(train, scene)
    assert history.n_transitions == 360
    problem = Problem.of(Physics(scene, substeps=20), history)
    truth = dict(zip(WHEEL, vars(make_history.CART.wheel).values(), strict=True))
    truth["mass"] = make_history.CART.mass
    z = z_scores(find_mode(problem, seed=2), truth)
    assert max(np.abs(list(z.values()))) < 4, z


ANGLE = st.floats(-3.1, 3.1)
PLACE = st.floats(-0.2, 0.2)
FRICTION = st.floats(0.01, 0.99)


@given(x=PLACE, y=PLACE, angle=ANGLE, mu_x=FRICTION, mu_y=FRICTION)
def test_four_descriptions_of_a_wheel_are_one(problem, x, y, angle, mu_x, mu_y) -> None:
    """w_theta + pi, and w_theta +- pi/2 with mu_x and mu_y swapped: the same predictions."""
    layout = problem.layout
    base = {"mass": 5.0, "w_x": x, "w_y": y}
    same = [
        {"w_theta": angle, "mu_x": mu_x, "mu_y": mu_y},
        {"w_theta": angle + np.pi, "mu_x": mu_x, "mu_y": mu_y},
        {"w_theta": angle + np.pi / 2, "mu_x": mu_y, "mu_y": mu_x},
        {"w_theta": angle - np.pi / 2, "mu_x": mu_y, "mu_y": mu_x},
    ]
    phis = np.array([layout.to_vector(base | one) for one in same])
    folded = np.array([by_prior(problem.layout, phi) for phi in phis])
    first = layout.to_dict(folded[0])
    assert first["mu_x"] <= first["mu_y"]
    assert -np.pi / 2 - 1e-12 < first["w_theta"] <= np.pi / 2  # to rounding
    np.testing.assert_allclose(by_prior(problem.layout, folded[0]), folded[0])
    if mu_x != mu_y:
        turn = 2 * layout.to_dict(folded)["w_theta"]
        np.testing.assert_allclose(np.cos(turn - turn[0]), 1.0)
        others = [i for i, name in enumerate(layout.labels) if not name.startswith("w_theta")]
        np.testing.assert_array_equal(folded[:, others], folded[[0]][:, others].repeat(4, 0))
    some = slice(0, 5)
    states = problem.physics.simulator(
        np.vstack([phis, folded]), problem.segments.start[some], problem.segments.actions[some]
    )
    # the solver goes over the wheel's axes one after the other until they agree
    np.testing.assert_allclose(states, states[[0]].repeat(8, 0), atol=1e-4)


def test_fold_leaves_a_body_without_wheel_alone(history) -> None:
    problem = Problem.of(Physics(cart_scene(wheel=False)), history)
    phi = np.array([1.0, 0.2, 0.3])
    np.testing.assert_array_equal(by_prior(problem.layout, phi), phi)


def test_a_partly_known_wheel_is_not_turned(history) -> None:
    """With w_theta given, the axes have names: mu_x may be the larger."""
    known = KNOWN_CONTACT["known"] | {"w_theta": 0.1}
    problem = Problem.of(Physics(cart_scene(known=known)), history)
    phi = problem.layout.to_vector(CART | {"mu_x": 0.9, "mu_y": 0.1})
    np.testing.assert_array_equal(by_prior(problem.layout, phi), phi)


def test_whole_trajectories_tell_the_sensor_s_noise(problem, modes) -> None:
    """The start is as noisy as the end: Eq. 11's sigma is too wide, along trajectories it is not.

    Nothing but the sensors was noisy: next to no acceleration is left unexplained.
    """
    mode = modes[0]
    again = trajectory_mode(problem, mode.phi)
    assert isinstance(again.problem.likelihood, TrajectoryLikelihood)
    sensors, steps = np.split(again.sigma, [6])
    # sqrt(1 / 2N) each, twice as much for what the states and the fitted parameters take: 4 such
    # for 6 numbers, false alarm below 1e-3
    error = 2 * np.sqrt(0.5 / problem.segments.n)
    assert (np.abs(np.log(sensors / NOISE)) < 4 * error).all(), sensors / NOISE
    assert (mode.sigma[:2] / NOISE[:2] > 1.3).all()
    # what a step adds to the velocities is far below the error of measuring them
    assert (steps * problem.scene.time_step < 0.5 * np.array(NOISE[3:])).all(), steps
    z = z_scores(again, CART)
    assert max(np.abs(list(z.values()))) < 4, z


def test_whole_trajectories_do_not_change_the_problem_otherwise(problem, modes) -> None:
    whole = trajectory_mode(problem, modes[0].phi).problem
    assert isinstance(problem.likelihood, TransitionLikelihood)
    assert whole.physics is problem.physics
    assert whole.data.history is problem.data.history


def test_the_mode_of_a_recording_is_found_from_that_of_its_part(history, problem, modes) -> None:
    """As from prior draws, within half a nat; the part has half of the trajectories."""
    part = history.select(range(history.n_trajectories // 2))
    of_part = trajectory_mode(problem.with_data(history=part), modes[0].phi)
    whole, found = trajectory_mode(problem, modes[0].phi), mode_of_more(problem, of_part)
    assert found.problem.segments.n == whole.problem.segments.n > of_part.problem.segments.n
    assert found.log_posterior > whole.log_posterior - 0.5


def test_prior_alone_where_data_say_nothing() -> None:
    """r and mu_c without contacts: the mode is the prior's, and so is the width."""
    history = simulated_history(cart_scene(), CART, seed=6, trajectories=2, intervals=6)
    wheel = {name: CART[name] for name in ("mass", *WHEEL)}
    problem = Problem.of(Physics(cart_scene(known=wheel)), history)
    mode = find_mode(problem, seed=1)
    found = problem.layout.to_dict(mode.phi)
    assert found["mu_c"] == pytest.approx(0.5, abs=1e-3)
    # a log-normal's mode, exp(mu - sigma^2)
    assert found["r"] == pytest.approx(np.exp(-2.5), rel=1e-2)
    index = problem.layout.index("mu_c", "cart")
    assert mode.covariance[index, index] == pytest.approx(1.0, rel=1e-6)


def cubic(points: np.ndarray) -> np.ndarray:
    """(x^3, x y) of points (n, 2), finite inside the unit square only."""
    outside = ((points < 0) | (points > 1)).any(axis=1)
    x, y = points.T
    return np.where(outside[:, None], np.nan, np.stack([x**3, x * y], axis=1))


@pytest.mark.parametrize(
    ("point", "error"),
    [
        pytest.param((0.5, 0.5), 1e-7, id="central"),
        pytest.param((0.0, 0.5), 1e-3, id="at the lower bound"),
        pytest.param((1.0, 1.0), 4e-3, id="at the upper bounds"),
        pytest.param((0.9999, 0.3), 3e-3, id="near a bound"),
    ],
)
def test_differentiate(point, error) -> None:
    """Against the analytic derivative, without a look outside the bounds."""
    x, y = point
    calls = []

    def function(points):
        calls.append(len(points))
        return cubic(points)

    steps = np.array([1e-3, 1e-3]) if error > 1e-6 else np.array([1e-4, 1e-4])
    found = differentiate(function, np.array(point), steps, np.zeros(2), np.ones(2))
    np.testing.assert_allclose(found, [[3 * x**2, 0.0], [y, x]], atol=error)
    assert calls == [4]  # all columns in one call


@pytest.mark.parametrize("seed", range(20))
def test_covariances_of_parameters_that_nearly_depend(seed) -> None:
    """Rounding makes none indefinite, in units from 1e-6 to 1e6."""
    rng = np.random.default_rng(seed)
    common, own = rng.normal(size=(2, 40, 8))
    jacobian = common[:, :1] + 10.0 ** rng.uniform(-10, 0, 8) * own
    jacobian *= 10.0 ** rng.uniform(-6, 6, 8)
    precision = jacobian.T @ jacobian
    inverse = covariance_of(precision)
    for covariance in (inverse, sandwich(inverse, 1.5 * precision)):
        factor = covariance_factor(covariance)
        unit = np.sqrt(np.diag(covariance))
        error = (factor @ factor.T - covariance) / np.outer(unit, unit)
        np.testing.assert_allclose(error, 0.0, atol=1e-11)


def test_covariances_are_inverses_and_sandwiches() -> None:
    """None for a parameter without information."""
    precision, score = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    inverse = np.linalg.inv(precision)
    np.testing.assert_allclose(covariance_of(precision), inverse)
    np.testing.assert_allclose(sandwich(inverse, score), inverse @ score @ inverse)
    np.testing.assert_allclose(covariance_of(np.diag([4.0, 0.0])), np.diag([0.25, 0.0]))


def test_recovers_the_scene_s_effect() -> None:
    """A declared effect is a parameter as any other."""
    scene: Scene = cart_scene(effects=("linear_drag",), **KNOWN_CONTACT)
    truth = CART | {"linear_drag_coefficient": 3.0}
    history = simulated_history(scene, truth, seed=9, trajectories=6, intervals=10)
    problem = Problem.of(Physics.declare(scene), history)
    z = z_scores(find_mode(problem, seed=1), truth)
    assert max(np.abs(list(z.values()))) < 4, z


@pytest.mark.parametrize("seed", range(1, 5))
def test_a_mode_is_found_once(seed) -> None:
    """Searches that a part of the data leads to different peaks end in the same one with all."""
    puck = Body("a", Shape.circle(0.1), known={"r": 0.0, "mu_c": 0.0}, effects=("linear_drag",))
    scene = Scene(time_step=0.1, substeps=4, bodies=(puck,))
    truth = {"mass": 2.0, "linear_drag_coefficient": 1.0}
    history = simulated_history(scene, truth, seed=3, trajectories=32, intervals=1, substeps=4)
    assert len(find_modes(Problem.of(Physics.declare(scene), history), seed=seed)) == 1
