"""The likelihood of simulated trajectories by name: model, fit, file, update, plan and command."""

import json
from pathlib import Path

import numpy as np
import pymc as pm
import pytest

import pbrl_ppl as pp
from pbrl_ppl.cli import main
from pbrl_ppl.errors import FitError, PosteriorError, RefitWarning
from pbrl_ppl.likelihood import log_posterior
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_simulation_mode
from pbrl_ppl.posterior import PosteriorRecord, group, parameter_draws, problem_of, stored_mode
from tests.helpers.falls import BALL, GRAVITY, MASS, fall
from tests.helpers.marks import OBJECT_MODE

pytestmark = OBJECT_MODE
SCENE = BALL.with_effects("ball", "quadratic_drag")
DRAG, TERMINAL = "quadratic_drag_coefficient", 12.0
TRUTH = MASS * GRAVITY / TERMINAL**2
QUICK = {"method": "laplace", "progress": False}


def history(seed: int, trajectories: int) -> pp.History:
    """Falls with a torque, so that a planner has actions; the angle is not measured."""
    made = fall(seed, terminal=TERMINAL, trajectories=trajectories, memory=0.0, rows=30)
    rows = made.to_dataframe()
    rows["torque"] *= np.nan
    rows.loc[rows["force_x"].notna(), "torque"] = 1e-4
    return pp.History.from_dataframe(rows, SCENE)


@pytest.fixture(scope="module")
def idata():
    return pp.fit(physics_model(SCENE, history(0, 3), likelihood="simulation"), seed=1, **QUICK)


@pytest.fixture(scope="module")
def model(idata) -> pm.Model:
    """The model as it was linearised in the fit."""
    return physics_model(SCENE, history(0, 3), likelihood=idata)


def test_the_truth_is_in_the_interval_from_a_wrong_start(model, idata) -> None:
    """The search begins at the prior's centre; one seed in 17 would fail."""
    drag = group(idata, "posterior")[DRAG].values.ravel()
    (prior,) = problem_in(model).layout.priors
    assert abs(prior.centre - TRUTH) > 20 * drag.std()
    low, high = np.quantile(drag, [0.03, 0.97])
    assert low < TRUTH < high
    assert group(idata, "posterior")["sigma"].values.mean() == pytest.approx(0.01, rel=0.2)
    assert PosteriorRecord.of(idata).likelihood == "simulation"
    assert idata.attrs["min_ess"] > 400 and json.loads(idata.attrs["warnings"]) == []


def test_the_model_is_one_of_pymc(model, idata) -> None:
    """PyMC's density is that of numpy, with its derivative, and it draws."""
    mode = stored_mode(problem_in(model), idata)
    phi, sigma = mode.phi, mode.sigma
    density = model.compile_logp(jacobian=False, mode="FAST_COMPILE")
    point = {f"{DRAG}_log__": np.log(phi), "sigma_log__": np.log(sigma)}
    assert density(point) == pytest.approx(log_posterior(problem_in(model), phi, sigma), abs=1e-6)
    slope, step = model.compile_dlogp(jacobian=False, mode="FAST_COMPILE")(point), 1e-4
    for i, name in enumerate(point):
        ends = [density(point | {name: point[name] + s * step}) for s in (1, -1)]
        assert slope[i] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.05, abs=0.5)
    prior = pm.sample_prior_predictive(
        draws=3, model=model, random_seed=1, compile_kwargs={"mode": "FAST_COMPILE"}
    )
    shape = (1, 3, problem_in(model).segments.n, 29, 1, 1)
    assert group(prior, "prior_predictive")["next_state"].shape == shape
    graphviz = pytest.importorskip("graphviz")
    assert isinstance(pm.model_to_graphviz(model), graphviz.Digraph)


def test_predictions_follow_the_start_states(model, idata) -> None:
    """At any draw, measurements deviate from predictions by both white errors, and no more."""
    predicted = group(idata, "posterior_predictive")["next_state"].values
    measured = group(idata, "observed_data")["next_state"].values
    assert (predicted - measured).std() == pytest.approx(0.01 * np.sqrt(2), rel=0.1)


def test_the_file_holds_the_problem(idata, tmp_path) -> None:
    pp.save_posterior(idata, tmp_path / "ball.nc")
    loaded = pp.load_posterior(tmp_path / "ball.nc")
    for name in ("posterior", "sample_stats", "log_likelihood", "posterior_predictive", "prior"):
        assert group(loaded, name).equals(group(idata, name))
    problem = problem_of(loaded)
    phi, sigma = parameter_draws(problem, loaded)
    stored = group(loaded, "log_likelihood")["next_state"].values.reshape(len(phi), -1)
    density = problem.log_density(problem.residual(phi), sigma, phi)
    np.testing.assert_allclose(density, stored, rtol=1e-9)
    again = physics_model(SCENE, history(0, 3), likelihood=loaded)
    assert problem_in(again).likelihood.tau == problem.likelihood.tau
    filtered = physics_model(SCENE, history(0, 3), likelihood="trajectories")
    with pytest.raises(PosteriorError, match="of simulation, the model's of trajectories; make"):
        pp.fit(filtered, resume=loaded)
    assert pp.identify(loaded).table().loc[f"{DRAG}[ball]", "verdict"] == "informed"


def test_a_file_plans_as_memory_does(idata, tmp_path) -> None:
    pp.save_posterior(idata, tmp_path / "ball.nc")
    goal = pp.Goal.of({"ball": (None, -1.0, None)}, tolerance=0.1)
    start = {"ball": (0.0, 0.0, 0.0)}
    plans = [
        pp.plan(each, start, goal, draws=4, seed=1)
        for each in (idata, pp.load_posterior(tmp_path / "ball.nc"))
    ]
    assert plans[0].reached
    assert plans[0].to_dataframe().equals(plans[1].to_dataframe())


def test_an_update_refits_all_data(idata) -> None:
    with pytest.warns(RefitWarning, match="fitted with the parameters"):
        new = pp.update(idata, history(1, 2), seed=1, progress=False)
    (entry,) = json.loads(new.attrs["updates"])
    assert (entry["did"], entry["transitions"]) == ("refitted", 58)
    record = PosteriorRecord.of(new)
    assert record.method == "laplace"
    assert record.likelihood == "simulation"
    assert record.sigma_prior == PosteriorRecord.of(idata).sigma_prior
    assert problem_of(new).data.history.n_trajectories == 5
    sd = [float(group(each, "posterior")[DRAG].std()) for each in (idata, new)]
    assert sd[1] < sd[0]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"likelihood": "innovations"}, "expected one of transitions, trajectories, simulation"),
        ({"likelihood": "simulation", "horizon": 3}, "are for 'transitions': leave"),
        ({"likelihood": "simulation", "nu": 4.0}, "noise is Gaussian: leave out nu"),
        ({"likelihood": "simulation", "sigma": "scalar"}, "expected 'per_dimension'"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, says) -> None:
    with pytest.raises(ValueError, match=says):
        physics_model(SCENE, history(0, 1), **options)


def test_a_mode_of_another_likelihood_is_refused(model) -> None:
    other = physics_model(SCENE, history(0, 3), likelihood="trajectories")
    mode = find_simulation_mode(problem_in(other), seed=0)
    with pytest.raises(FitError, match="likelihood simulation, the model's is trajectories"):
        pp.fit(other, start=mode, **QUICK)


def test_the_command_fits_what_python_fits(idata, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ball.toml").write_text(SCENE.to_toml())
    history(0, 3).save("falls.csv")
    fit = ["fit", "ball.toml", "falls.csv", "-o", "ball.nc", "-q", "--method", "laplace"]
    assert main([*fit, "--likelihood", "simulation"]) == 0
    there = pp.load_posterior("ball.nc")
    assert PosteriorRecord.of(there).likelihood == "simulation"
    for name, values in group(idata, "posterior").items():
        np.testing.assert_allclose(values, group(there, "posterior")[name], rtol=1e-3)
    simulate = ["simulate", "ball.nc", "falls.csv", "-o", "simulated.csv", "-q"]
    assert main(simulate) == 0
    assert main([*fit[:4], "other.nc", "-q", "--likelihood", "innovations"]) == 2
    assert "expected one of transitions, trajectories, simulation" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")
def test_stored_likelihoods_are_those_of_the_widened_draws() -> None:
    """Or an update refuses the posterior, as if it were of another engine."""
    model = physics_model(SCENE, history(0, 3), likelihood="simulation")
    idata = pp.fit(model, seed=1, draws=50, progress=False)
    problem = problem_of(idata)
    phi, sigma = parameter_draws(problem, idata)
    expected = problem.log_density(problem.residual(phi), sigma, phi)
    stored = group(idata, "log_likelihood")["next_state"].to_numpy()
    np.testing.assert_allclose(stored.reshape(expected.shape), expected)
