"""Likelihood of whole trajectories: whitening, smoothing, derivatives, simulated data."""

from dataclasses import replace

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from pytensor import function
from pytensor.graph.traversal import ancestors
from scipy.stats import multivariate_normal
from simulated_data import simulated_trajectories, with_measurements

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    Problem,
    along_trajectories,
    declared_problem,
    single_transitions,
    smoothed,
)
from pbrl_ppl.likelihood.kalman import gains
from pbrl_ppl.model import LazyProblem, LogLikelihoodOp, build_model, physics_model, problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import wrapped
from tests.helpers.histories import simulated_history

pytestmark = pytest.mark.one_stack

PUCK = Scene(
    time_step=0.1,
    substeps=2,
    bodies=(
        Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}, effects=("linear_drag",)),
    ),
)
TRUTH = {"mass": 2.0, "linear_drag_coefficient": 0.8}
PHI = np.array([2.0, 0.8])
#: Errors of measuring x, y, theta, vx, vy, omega, and unexplained accelerations.
NOISE = np.array([2e-3, 2e-3, 4e-3, 1e-2, 1e-2, 2e-2, 0.3, 0.3, 0.5])


@pytest.fixture(scope="module")
def problem() -> Problem:
    history = simulated_history(PUCK, TRUTH, seed=1, trajectories=3, intervals=4, substeps=2)
    return along_trajectories(Problem.of(Physics.declare(PUCK), history), PHI, NOISE)


def dense(noise, sigma) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the first trajectory's measurements after the first, given a flat start."""
    n = int(np.flatnonzero(noise.first)[1])
    d = len(noise.coordinates.places)
    push = noise.coordinates.push
    step = (push.T * sigma[noise.coordinates.pushed] ** 2) @ push
    r = np.diag(noise.coordinates.errors(sigma) ** 2)
    # residuals e' - F e + w of neighbours share the error e of a measured state
    whole = np.zeros((n * d, n * d))
    for k in range(n):
        f, own = noise.slope[k], slice(k * d, (k + 1) * d)
        whole[own, own] = r + f @ r @ f.T + step
        if k + 1 < n:
            then = slice((k + 1) * d, (k + 2) * d)
            whole[own, then] = -r @ noise.slope[k + 1].T
            whole[then, own] = whole[own, then].T
    return whole, np.arange(n)


def test_whitening_is_that_of_the_whole_covariance(problem) -> None:
    """DESIGN section 7: R + F R F' + Q with itself, -R F' with its successor."""
    noise = problem.likelihood.noise
    covariance, own = dense(noise, NOISE)
    residual = noise.coordinates.of_residual(problem.residual(PHI))[own]
    begin = np.where(
        noise.first[own][:, None], noise.begin[own], np.roll(noise.measured, 1, 0)[own]
    )
    # z' - f(s) - F (z - s), with z' = s' + y'
    equation = noise.measured[own] + residual - np.einsum("kab,kb->ka", noise.slope[own], begin)
    expected = multivariate_normal(np.zeros(len(covariance)), covariance).logpdf(equation.ravel())
    density = problem.log_density(problem.residual(PHI), NOISE)[own].sum()
    np.testing.assert_allclose(density, expected, rtol=1e-9)


def test_many_noises_are_whitened_as_one_by_one(problem) -> None:
    """Each residual with its own noise; one that diverged is no number, and leaves the others."""
    rng, noise = np.random.default_rng(1), problem.likelihood.noise
    sigma = NOISE * np.exp(0.3 * rng.standard_normal((40, len(NOISE))))
    residual = problem.residual(PHI) + 1e-3 * rng.standard_normal((40, *problem.measured.shape))
    residual[7, 2, 0, 0, 1] = np.nan
    white, log_scale = noise.whitened(residual, sigma)
    alone = [noise.whitened(*each) for each in zip(residual, sigma, strict=True)]
    np.testing.assert_allclose(white, [each[0] for each in alone], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(log_scale, [each[1] for each in alone], rtol=1e-9)
    assert np.isnan(white[7]).any() and np.isfinite(np.delete(white, 7, axis=0)).all()
    density = problem.log_density(residual, sigma).sum(axis=1)
    assert np.isneginf(density[7]) and np.isfinite(np.delete(density, 7)).all()


def test_what_was_not_measured_is_left_out(problem) -> None:
    """A cell that is missing is one of a very large error, but for its own density."""
    dataset = problem.data.history.dataset.copy()
    observed = dataset["observed"].values.copy()
    observed[:, 2, 0, [0, 3]] = np.nan
    dataset["observed"] = dataset["observed"].copy(data=observed)
    gaps = problem.with_data(history=History(dataset), states=None)
    gaps = along_trajectories(gaps, PHI, NOISE, problem.likelihood.noise.coordinates)
    noise, whole = gaps.likelihood.noise, problem.likelihood.noise
    assert (~noise.seen).sum() == 6
    covariance, own = dense(whole, NOISE)
    vague = covariance.copy()
    d = len(whole.coordinates.places)
    huge = 10.0
    jitter = np.zeros((len(own) * d, 2))
    for j, cell in enumerate((0, 3)):  # measured at the second transition's end
        jitter[d + cell, j] = 1.0
        jitter[2 * d : 3 * d, j] = -whole.slope[2][:, cell]
    vague += huge**2 * jitter @ jitter.T
    residual = whole.coordinates.of_residual(problem.residual(PHI))[own]
    begin = np.where(
        whole.first[own][:, None], whole.begin[own], np.roll(whole.measured, 1, 0)[own]
    )
    equation = whole.measured[own] + residual - np.einsum("kab,kb->ka", whole.slope[own], begin)
    expected = multivariate_normal(np.zeros(len(vague)), vague).logpdf(equation.ravel())
    expected += np.log(huge**2 * 2 * np.pi)
    seen = np.where(noise.seen, whole.measured, 0.0)
    fixed = replace(whole, seen=noise.seen, measured=seen)
    gaps = problem.along(fixed)
    value = gaps.log_density(problem.residual(PHI), NOISE)[own].sum()
    np.testing.assert_allclose(value, expected, rtol=1e-6)


@pytest.mark.parametrize("missing", [False, True])
def test_score_of_the_noise_is_that_of_differences(problem, missing) -> None:
    """By the logarithm of every noise parameter; the first states are measured, or not at all."""
    noise = problem.likelihood.noise
    if missing:
        seen, initial_variance = noise.seen.copy(), noise.initial_variance.copy()
        seen[1, 2:4] = seen[5] = False
        initial_variance[:, 4] = 3.0
        noise = replace(noise, seen=seen, initial_variance=initial_variance)
        problem = problem.along(noise)
    residual, at = problem.residual(PHI * 1.2), np.log(NOISE * np.linspace(0.5, 2.0, len(NOISE)))
    value, slope = noise.score(residual, np.exp(at))

    def density(log_sigma) -> float:
        return float(problem.log_density(residual, np.exp(log_sigma), PHI).sum())

    assert value == pytest.approx(density(at), rel=1e-12)
    steps = 1e-5 * np.eye(len(at))
    by_differences = [(density(at + h) - density(at - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(slope, by_differences, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def test_the_score_of_innovations_beyond_the_numbers_is_minus_infinity(problem) -> None:
    """A climb comes by where the filter diverges: no warning."""
    residual = 1e160 * problem.residual(PHI * 1.2)
    assert problem.likelihood.noise.score(residual, NOISE)[0] == -np.inf
    assert np.isneginf(problem.log_density(residual, NOISE)).any()


def test_smoothed_states_are_the_most_probable(problem) -> None:
    """No state is moved once the smoother has converged, and the fit of all is a minimum there."""
    converged = smoothed(problem, PHI, NOISE)
    noise = converged.likelihood.noise
    before, after = noise.smoothed(noise.coordinates.of_residual(converged.residual(PHI)), NOISE)
    moved = np.vstack([before[noise.first], after]) / noise.coordinates.errors(NOISE)
    assert np.abs(moved).max() < 0.05
    # a puck with drag is linear: there is one answer, wherever smoothing began
    moved = replace(problem.data, states=problem.data.states + 1e-3)
    again = smoothed(replace(problem, data=moved), PHI, NOISE)
    difference = (again.data.states - converged.data.states)[..., :3]
    assert np.abs(difference).max() < 1e-4


def test_smoothing_stops_where_no_motion_fits(problem) -> None:
    """The engine diverges from speeds beyond measure: states stay where they were."""
    states = problem.data.smoothed_states.copy()
    states[..., 3] = 1e9
    lost = replace(problem, data=replace(problem.data, states=states))
    again = smoothed(lost, PHI, NOISE)
    np.testing.assert_array_equal(again.data.smoothed_states, states)


@pytest.mark.parametrize("likelihood", ["transitions", "trajectories"])
@pytest.mark.parametrize("nu", [None, 5.0])
def test_derivative_is_that_of_differences(problem, likelihood, nu) -> None:
    if likelihood == "transitions":
        problem = single_transitions(problem)
    problem = problem.with_likelihood(nu=nu)
    given = [pt.tensor4("value"), pt.tensor4("predicted"), pt.vector("sigma"), pt.vector("phi")]
    rng = np.random.default_rng(3)
    weights = rng.normal(size=problem.segments.n)
    total = (LogLikelihoodOp(LazyProblem(problem))(*given) * weights).sum()
    value = function(given, total)
    slopes = function(given, pt.grad(total, given[1:3]))
    states = problem.predict(PHI)[..., problem.observations.columns]
    predicted = states + 1e-3 * rng.normal(size=states.shape)
    noise = NOISE[: len(problem.noise_labels)]
    point = problem.measured, predicted, noise, PHI
    slope = slopes(*point)
    for _ in range(5):
        for i, size in ((1, 1e-6), (2, 1e-6 * noise)):
            step = size * rng.normal(size=point[i].shape)
            ends = [
                value(*(x + sign * step if j == i else x for j, x in enumerate(point)))
                for sign in (1, -1)
            ]
            expected = pytest.approx(ends[0] - ends[1], rel=1e-4)
            assert 2 * (slope[i - 1] * step).sum() == expected


def density_of_the_model(problem) -> float:
    model = build_model(problem)
    assert [variable.name for variable in model.free_RVs] == [
        "mass", "linear_drag_coefficient", "sigma", "unexplained_acceleration",
    ]  # fmt: skip
    point = {
        "mass": PHI[:1], "linear_drag_coefficient": PHI[1:],
        "sigma": NOISE[:6], "unexplained_acceleration": NOISE[6:],
    }  # fmt: skip
    return model.compile_logp(vars=model.observed_RVs)(
        {model.rvs_to_values[v].name: np.log(point[v.name]) for v in model.free_RVs}
    )


def test_the_model_is_the_problem(problem) -> None:
    value = density_of_the_model(problem)
    np.testing.assert_allclose(value, problem.log_density(problem.residual(PHI), NOISE).sum())


def test_the_data_are_in_the_model_s_graph(problem) -> None:
    """Other measurements have the density that the filter gives them; a gap makes no difference."""
    observed = problem.data.history.dataset["observed"].to_numpy().copy()
    observed[1, 2, 0, :3] = np.nan
    gappy = along_trajectories(with_measurements(problem, observed), PHI, NOISE)
    model = build_model(gappy)
    density = model.logp(model.observed_RVs)
    assert model.rvs_to_values[model["next_state"]] in ancestors([density])
    other = gappy.measured + 1e-3 * np.random.default_rng(5).normal(size=gappy.measured.shape)
    (moved,) = model.replace_rvs_by_values([pm.logp(model["next_state"], other)])
    point = {"mass": PHI[:1], "linear_drag_coefficient": PHI[1:],
             "sigma": NOISE[:6], "unexplained_acceleration": NOISE[6:]}  # fmt: skip
    found = model.compile_fn(moved)(
        {model.rvs_to_values[v].name: np.log(point[v.name]) for v in model.free_RVs}
    )
    noise = gappy.likelihood.noise
    deviation = noise.coordinates.of_residual(np.nan_to_num(other) - gappy.observations.values)
    there = gappy.along(replace(noise, measured=deviation))
    np.testing.assert_allclose(found, there.log_density(there.residual(PHI), NOISE))
    assert abs(found.sum() - gappy.log_density(gappy.residual(PHI), NOISE).sum()) > 0.1


def test_the_model_is_the_problem_where_a_body_turns_by_more_than_half_a_turn() -> None:
    """An interval's turn of 4 rad is one of -2.3 rad to the sensor, whichever way it is counted."""
    history = simulated_history(PUCK, TRUTH, seed=3, trajectories=2, intervals=5, substeps=2)
    dataset = history.dataset.copy()
    for name in ("start", "observed"):
        values = dataset[name].to_numpy().copy()
        values[..., 2] = wrapped(values[..., 2] + 4.0 * np.arange(values.shape[1])[:, None])
        values[..., 5] += 40.0
        dataset[name] = dataset[name].copy(data=values)
    fast = along_trajectories(Problem.of(Physics.declare(PUCK), History(dataset)), PHI, NOISE)
    density = fast.log_density(fast.residual(PHI), NOISE).sum()
    assert density_of_the_model(fast) == pytest.approx(density, rel=1e-9)
    assert density > -1e4  # a turn more or less would cost a million


def test_draws_of_the_model_have_its_covariance(problem) -> None:
    """Posterior predictive draws: mean and covariance of a measurement, given those before."""
    noise = problem.likelihood.noise
    rng = np.random.default_rng(4)
    drawn = np.array([problem.next_states(problem.predict(PHI), NOISE, rng) for _ in range(4000)])
    mean, covariance = noise.predictive(noise.coordinates.of_residual(problem.residual(PHI)), NOISE)
    coordinates = drawn[:, :, 0, 0] - problem.observations.values[:, 0, 0]
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    # 72 means and 72 variances of 4000 draws: 5 standard errors, chance of a false alarm 1e-4
    assert (np.abs(coordinates.mean(axis=0) - mean) < 5 * sd / np.sqrt(4000)).all()
    ratio = coordinates.var(axis=0) / sd**2
    assert (np.abs(ratio - 1) < 5 * np.sqrt(2 / 4000)).all()


def test_simulated_trajectories_have_both_noises(problem) -> None:
    """Innovations of simulated data at the truth are standard normal and white."""
    rng = np.random.default_rng(5)
    white = []
    for _ in range(40):
        made = with_measurements(problem, simulated_trajectories(problem, PHI, NOISE, rng))
        made = smoothed(made, PHI, NOISE)
        white.append(made.whitened(PHI, NOISE).reshape(3, 4, 6))
    z = np.array(white)
    # 2880 numbers: sd of the mean square 0.026, of a correlation over 2160 pairs 0.022; 4 of each
    assert abs((z**2).mean() - 1) < 0.105
    assert abs((z[:, :, 1:] * z[:, :, :-1]).mean()) < 0.086


def test_a_sensor_far_better_than_what_was_known(problem) -> None:
    """After a measurement of 1e-10 m of a place known to 0.1 m, the covariance is one still."""
    sensor = np.full(6, 1e-20)
    slope = np.eye(6) + np.diag(np.full(3, 0.004), 3)
    arguments = slope[None], np.array([1]), np.ones((1, 6), dtype=bool), np.full((1, 6), 0.01)
    covariance = gains(*arguments, sensor, np.zeros((1, 6, 6)), np.array([False]))[2][0]
    np.testing.assert_allclose(np.diag(covariance), sensor, rtol=1e-3)
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.linalg.eigvalsh(correlation).min() > 0.99


def test_what_never_moves_has_no_noise() -> None:
    """A fall seen as x = 0: its error is given, and no noise parameter is inferred from it."""
    history = simulated_history(PUCK, TRUTH, seed=1, trajectories=3, intervals=4, substeps=2)
    frame = history.to_dataframe().assign(x=0.0, vx=0.0)
    still = physics_model(PUCK, History.from_dataframe(frame, PUCK), likelihood="trajectories")
    noise = problem_in(still).noise_variables
    assert noise["sigma"] == ("y", "theta", "vy", "omega")
    assert noise["unexplained_acceleration"] == ("vy", "omega")


@pytest.mark.parametrize("options", [{"horizon": 2}, {"sigma": "scalar"}])
def test_options_that_do_not_go_together_are_refused(options) -> None:
    history = simulated_history(PUCK, TRUTH, seed=1, trajectories=2, intervals=4, substeps=2)
    with pytest.raises(ValueError, match="trajectories"):
        physics_model(PUCK, history, likelihood="trajectories", **options)


@pytest.mark.parametrize("stated", [("x", "omega"), ("x", "y", "theta", "vx", "vy", "omega")])
def test_a_stated_noise_is_not_inferred(problem, stated) -> None:
    truth = dict(zip(("x", "y", "theta", "vx", "vy", "omega"), NOISE, strict=False))
    scene = PUCK.replace(noise={name: truth[name] for name in stated})
    history = problem.data.history
    known = along_trajectories(Problem.of(Physics.declare(scene), history), PHI)
    free = [name for name in truth if name not in stated]
    assert list(known.noise_variables.get("sigma", ())) == free
    sigma = np.array([*(truth[name] for name in free), *NOISE[6:]])
    np.testing.assert_array_equal(known.likelihood.noise.coordinates.errors(sigma), NOISE[:6])
    # linearised where all are inferred, the density is the same
    same = known.likelihood.noise.coordinates
    states = problem
    noise = replace(states.likelihood.noise, coordinates=same)
    there = states.along(noise)
    residual = problem.residual(PHI)
    np.testing.assert_allclose(
        there.log_density(residual, sigma), problem.log_density(residual, NOISE), rtol=1e-12
    )
    model = build_model(known)
    assert ("sigma" in [variable.name for variable in model.free_RVs]) == bool(free)
    assert np.isfinite(model.compile_logp()(model.initial_point()))


def test_computed_velocities_are_left_out_of_the_model() -> None:
    history = simulated_history(PUCK, TRUTH, seed=1, trajectories=6, intervals=40, substeps=2)
    frame = history.to_dataframe()
    for rows in frame.groupby("trajectory").groups.values():
        for position, rate in (("x", "vx"), ("y", "vy"), ("theta", "omega")):
            angles = np.unwrap(frame.loc[rows, position])
            frame.loc[rows, rate] = np.gradient(angles, PUCK.time_step)
    computed = History.from_dataframe(frame, PUCK)
    problem = declared_problem(Physics.declare(PUCK), computed, kind="trajectories")
    assert problem.noise_variables["sigma"] == ("x", "y", "theta")
    eq_11 = problem_in(physics_model(PUCK, computed))
    assert len(eq_11.noise_variables["sigma"]) == 6  # the paper's likelihood takes what it is given
