"""Posteriors of whole trajectories: from a file, brought up to date, and planned with."""

import json
import warnings

import numpy as np
import pytest
from simulated_data import simulated_trajectories

import pbrl_ppl as pp
from pbrl_ppl.errors import ConvergenceWarning, RefitWarning
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    TrajectoryLikelihood,
    along_trajectories,
    declared_problem,
)
from pbrl_ppl.model import physics_model
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import convergence, group, parameter_draws, problem_of
from pbrl_ppl.posterior.store import scalars
from pbrl_ppl.reporting import render_posterior
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import STATE
from tests.helpers.histories import simulated_history
from tests.helpers.samplers import shorten

pytestmark = pytest.mark.first(3)

SCENE = Scene(
    time_step=0.1,
    substeps=4,
    bodies=(
        Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}, effects=("linear_drag",)),
    ),
)
PHI = np.array([2.0, 0.8])
#: Errors of measuring x, y, theta, vx, vy, omega, and unexplained accelerations.
NOISE = np.array([2e-3, 2e-3, 4e-3, 1e-2, 1e-2, 2e-2, 0.3, 0.3, 0.5])
QUICK = {"draws": 300, "tune": 200, "chains": 2, "cores": 1, "progress": False}


def quiet(function, *arguments, **options):
    """Few draws, on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return function(*arguments, **options)


@pytest.fixture(scope="module")
def both() -> History:
    """Fourteen trajectories with both noises, some of them shorter."""
    truth = {"mass": PHI[0], "linear_drag_coefficient": PHI[1]}
    design = simulated_history(SCENE, truth, seed=1, trajectories=14, intervals=5, noise=0.0)
    problem = declared_problem(Physics.declare(SCENE), design, kind="trajectories")
    measured = simulated_trajectories(problem, PHI, NOISE, np.random.default_rng(2))
    dataset = design.dataset.copy()
    dataset["observed"] = dataset["observed"].copy(data=measured)
    rows = History(dataset).to_dataframe()
    short = (rows["trajectory"] % 3 == 2) & (rows["step"] > 3)
    last = (rows["trajectory"] % 3 == 2) & (rows["step"] == 3)
    rows.loc[last, ["force_x", "force_y", "torque"]] = np.nan
    return History.from_dataframe(rows[~short], SCENE)


@pytest.fixture(scope="module")
def first(both):
    """The posterior of the first twelve."""
    model = physics_model(SCENE, both.select(range(12)), likelihood="trajectories")
    return quiet(pp.fit, model, seed=3, **QUICK)


@pytest.fixture(scope="module")
def whole(both):
    """The posterior of all."""
    return quiet(pp.fit, physics_model(SCENE, both, likelihood="trajectories"), seed=4, **QUICK)


def test_the_truth_is_in_the_posterior(first) -> None:
    """Eleven numbers within 4 standard deviations, noises by their logarithms: 7e-4."""
    problem = problem_of(first)
    phi, sigma = parameter_draws(problem, first)
    log_off = np.log(sigma / NOISE)
    z = np.hstack([(phi - PHI) / phi.std(axis=0), log_off / log_off.std(axis=0)]).mean(axis=0)
    assert (np.abs(z) < 4).all(), z


def test_a_file_holds_the_problem(first, tmp_path) -> None:
    pp.save_posterior(first, tmp_path / "puck.nc")
    idata = pp.load_posterior(tmp_path / "puck.nc")
    problem, here = problem_of(idata), problem_of(first)
    assert isinstance(problem.likelihood, TrajectoryLikelihood)
    assert problem.noise_variables == here.noise_variables
    np.testing.assert_array_equal(problem.noise_prior[0], here.noise_prior[0])
    stored = group(idata, "log_likelihood")["next_state"].values.reshape(600, -1)[::150]
    phi, sigma = (each[::150] for each in parameter_draws(problem, idata))
    for each in (problem, here):
        np.testing.assert_allclose(each.log_density(each.residual(phi), sigma), stored, rtol=1e-9)
    # what was measured, not what was smoothed
    np.testing.assert_array_equal(group(idata, "observed_data")["next_state"].values, here.measured)
    # and it can be smoothed again elsewhere
    again = along_trajectories(problem, PHI, NOISE, problem.likelihood.noise.coordinates)
    assert again.segments.n == 12 * 5 - 4 * 2
    assert np.isfinite(again.log_density(again.residual(PHI), NOISE)).all()


def test_units_and_names_are_in_the_file(first) -> None:
    posterior = group(first, "posterior")
    assert posterior["unexplained_acceleration"].dims == ("chain", "draw", "velocity")
    assert list(posterior["velocity"].values) == ["vx", "vy", "omega"]
    assert posterior["unexplained_acceleration"].attrs["units"] == "m/s^2, of omega rad/s^2"


def agree(idata, other) -> None:
    """Means of 11 numbers within 4 Monte Carlo errors: false alarm 7e-4.

    The linearisations differ: of the first data's mode, or of all data's.
    """
    ess = [convergence(each)[1] for each in (idata, other)]
    for name, b in scalars(other).items():
        a = scalars(idata)[name]
        error = float(b.std()) * np.sqrt(sum(1 / each[name] for each in ess))
        assert abs(float(a.mean() - b.mean())) < 4 * error, name


def test_an_update_is_the_fit_of_all(both, first, whole, monkeypatch) -> None:
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 0)
    new = quiet(pp.update, first, both.select([12, 13]), seed=5)
    (entry,) = json.loads(new.attrs["updates"])
    assert (entry["did"], entry["transitions"]) == ("reweighted", 10)
    agree(new, whole)
    problem = problem_of(new)
    assert problem.data.history.n_trajectories == 14
    # the file's own problem has the stored likelihoods
    phi, sigma = parameter_draws(problem, new)
    stored = group(new, "log_likelihood")["next_state"].values.reshape(len(phi), -1)
    some = slice(None, None, 150)
    np.testing.assert_allclose(
        problem.log_density(problem.residual(phi[some]), sigma[some]), stored[some], rtol=1e-9
    )
    np.testing.assert_array_equal(
        problem.measured,
        declared_problem(Physics.declare(SCENE), both, kind="trajectories").measured,
    )


@pytest.mark.slow
def test_a_first_contact_brings_a_noise_of_its_own(monkeypatch) -> None:
    """Two pucks far apart, then side by side: the posterior knows no noise of contacts."""
    shorten(monkeypatch, draws=200)
    shape, known = Shape.circle(0.3), {"r": 0.5, "mu_c": 0.2}
    bodies = (Body("one", shape, known=known), Body("two", shape, known=known | {"mass": 1.0}))
    scene = Scene(time_step=0.1, substeps=4, bodies=bodies)
    made = {"trajectories": 3, "intervals": 5, "wrench_sd": (1.5, 1.5, 0.1), "substeps": 8}
    apart = simulated_history(scene, {"mass": [2.0]}, seed=1, **made)
    beside = [(0.0, 0.0, 0.0), (0.61, 0.0, 0.0)]
    together = simulated_history(scene, {"mass": [2.0]}, seed=2, poses=beside, **made)
    first = quiet(pp.fit, physics_model(scene, apart, likelihood="trajectories"), seed=1, **QUICK)
    assert "contact_acceleration" not in group(first, "posterior")
    with pytest.warns(RefitWarning, match=r"contact_acceleration\[vx\].* refitted"):
        both = quiet(pp.update, first, together, seed=2, progress=False)
    assert set(group(both, "posterior")["contact_acceleration"]["velocity"].values) >= {"vx", "vy"}
    assert problem_of(both).likelihood.noise.touching.any()
    more = simulated_history(scene, {"mass": [2.0]}, seed=3, **made | {"trajectories": 1})
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 30)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RefitWarning)
        assert len(json.loads(quiet(pp.update, both, more, seed=3).attrs["updates"])) == 2


@pytest.mark.one_stack
@pytest.mark.parametrize("stated", [6, 3])
def test_stated_errors_of_measuring_leave_a_whole_posterior(stated, tmp_path) -> None:
    """Of all sensors or some: what is not inferred is no variable, and nothing asks for it."""
    puck = Body("puck", Shape.circle(0.2), known={"r": 0.0, "mu_c": 0.0})
    noise = dict(zip(STATE[:stated], NOISE, strict=False))
    scene = Scene(time_step=0.1, substeps=4, bodies=(puck,), noise=noise)
    made = {"trajectories": 3, "intervals": 5, "substeps": 8}
    history = simulated_history(scene, {"mass": [2.0]}, seed=1, **made)
    model = physics_model(scene, history, likelihood="trajectories")
    pp.save_posterior(quiet(pp.fit, model, method="laplace", seed=1), tmp_path / "puck.nc")
    loaded = pp.load_posterior(tmp_path / "puck.nc")
    assert ("sigma" in group(loaded, "posterior")) == (stated < 6)
    masses = group(loaded, "posterior")["mass"].values
    assert abs(masses.mean() - 2.0) < 4.5 * masses.std()  # a false alarm in 1e-5
    assert pp.identify(loaded).table().loc["mass[puck]", "verdict"] == "informed"
    few = made | {"trajectories": 1, "intervals": 1}
    new = simulated_history(scene, {"mass": [2.0]}, seed=2, **few)
    assert len(json.loads(quiet(pp.update, loaded, new, seed=1).attrs["updates"])) == 1
    assert "mass" in render_posterior(loaded)
