"""Models of `physics_model` as a PyMC user takes them: set_data, missing cells, few draws."""

import warnings

import numpy as np
import pandas as pd
import pymc as pm
import pytest

from pbrl_ppl.errors import FitError
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import declared, declared_problem
from pbrl_ppl.model import build_model, physics_model, problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import group
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE

PUCK = Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}, effects=("linear_drag",))
SCENE = Scene(time_step=0.1, substeps=4, bodies=(PUCK,))
TRUTH = {"mass": 2.0, "linear_drag_coefficient": 0.8}
WHOLE = ("trajectories", "simulation")
pytestmark = [pytest.mark.filterwarnings("error::pymc.exceptions.ImputationWarning"), OBJECT_MODE]


def recorded(seed: int, missing: bool = False) -> History:
    history = simulated_history(SCENE, TRUTH, seed=seed, trajectories=2, intervals=4)
    if not missing:
        return history
    frame = history.to_dataframe()
    frame.loc[4, "theta"] = np.nan  # last of trajectory 0: it starts no transition
    return History.from_dataframe(frame, SCENE)


@pytest.fixture
def smoothed(monkeypatch) -> list[int]:
    """Calls of the smoother."""
    calls, real = [], declared.along_trajectories
    monkeypatch.setattr(
        declared, "along_trajectories", lambda *given: (calls.append(1), real(*given))[1]
    )
    return calls


def density(model: pm.Model) -> float:
    return float(model.compile_logp()(model.initial_point()))


@pytest.mark.parametrize("likelihood", WHOLE)
def test_trajectories_are_smoothed_when_first_evaluated(smoothed, likelihood) -> None:
    model = physics_model(SCENE, recorded(1), likelihood=likelihood)
    assert [variable.name for variable in model.observed_RVs] == ["next_state"]
    model.compile_logp()
    assert not smoothed
    physics = Physics.declare(with_units(SCENE, recorded(1)))
    problem = declared_problem(physics, recorded(1), kind=likelihood)
    smoothed.clear()
    assert density(model) == density(build_model(problem))
    assert density(model) == density(model)
    assert len(smoothed) == 1
    assert problem_in(model).noise_prior[0].tolist() == problem.noise_prior[0].tolist()
    np.testing.assert_array_equal(problem_in(model).segments.start, problem.segments.start)


def test_graphviz_draws_trajectories() -> None:
    pytest.importorskip("graphviz", reason="graphviz draws models")
    model = physics_model(SCENE, recorded(1), likelihood="trajectories")
    source = pm.model_to_graphviz(model).source
    for name in ("mass", "sigma", "unexplained_acceleration", "next_state", "start", "actions"):
        assert name in source


@pytest.mark.parametrize("missing", [False, True])
def test_another_recording_is_set(missing) -> None:
    """The likelihood is that of a model of the other recording."""
    model, other = (physics_model(SCENE, recorded(seed, missing)) for seed in (1, 2))
    problem = problem_in(other)
    data = {"start": problem.segments.start, "actions": problem.inputs}
    likelihoods = [each.compile_logp(vars=each.observed_RVs) for each in (model, other)]
    point = model.initial_point()
    assert likelihoods[0](point) != pytest.approx(likelihoods[1](point))
    with model:
        pm.set_data(data | {"measured": problem.measured})
        drawn = pm.sample_prior_predictive(draws=2, random_seed=1)
    assert likelihoods[0](point) == pytest.approx(likelihoods[1](point), rel=1e-12)
    found = group(drawn, "observed_data")["next_state"].to_numpy()
    np.testing.assert_array_equal(found, problem.measured)


@pytest.mark.parametrize("likelihood", WHOLE)
def test_another_recording_is_refused_where_it_was_linearised_along_one(likelihood) -> None:
    model = physics_model(SCENE, recorded(1), likelihood=likelihood)
    start = model["start"].get_value()
    with model:
        pm.set_data({"start": start + 0.01})
    with pytest.raises(FitError, match=f"'{likelihood}' is linearised along the declared"):
        density(model)


def test_other_measurements_of_simulated_pieces_are_refused() -> None:
    model = physics_model(SCENE, recorded(1), likelihood="simulation")
    with model:
        pm.set_data({"measured": problem_in(model).measured + 0.01})
    with pytest.raises(FitError, match="measured are set, and the likelihood 'simulation'"):
        density(model)


def test_another_recording_of_bodies_apart_is_refused() -> None:
    bodies = (PUCK, Body("far", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}))
    scene = Scene(time_step=0.1, substeps=4, bodies=bodies)
    history = simulated_history(SCENE, TRUTH, seed=1, trajectories=1, intervals=3).to_dataframe()
    away = history.assign(body="far", x=history["x"] + 100.0)
    both = pd.concat([history, away]).sort_values(["trajectory", "time"], kind="stable")
    model = physics_model(scene, History.from_dataframe(both, scene))
    assert len(problem_in(model).physics.simulator.parts) == 2
    with model:
        pm.set_data({"start": model["start"].get_value() + 0.01})
    with pytest.raises(FitError, match="simulated in 2 worlds because they never meet"):
        density(model)


@pytest.mark.parametrize("likelihood", ["transitions", *WHOLE])
def test_missing_cells_are_not_observed_as_zero(likelihood) -> None:
    """Neither in the model nor in what PyMC stores, and PyMC does not infer them."""
    history = recorded(1, missing=True)
    model = physics_model(SCENE, history, likelihood=likelihood)
    measured = problem_in(model).measured
    assert np.isnan(measured).any()
    value = model.rvs_to_values[model["next_state"]].get_value()
    np.testing.assert_array_equal(value, measured)
    whole = physics_model(SCENE, recorded(1), likelihood=likelihood)
    names = [[variable.name for variable in each.free_RVs] for each in (model, whole)]
    assert names[0] == names[1]
    with model, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # few draws
        idata = pm.sample(
            draws=3, tune=2, chains=1, cores=1, step=pm.Metropolis(), progressbar=False,
            random_seed=1, compute_convergence_checks=False,
        )  # fmt: skip
    stored = group(idata, "observed_data")["next_state"].to_numpy()
    np.testing.assert_array_equal(stored, measured)
    assert np.isfinite(group(idata, "posterior")["mass"]).all()


@pytest.mark.parametrize("likelihood", WHOLE)
def test_prior_draws_are_of_smoothed_trajectories(smoothed, likelihood) -> None:
    model = physics_model(SCENE, recorded(1), likelihood=likelihood)
    with model:
        idata = pm.sample_prior_predictive(draws=200, random_seed=1)
    assert len(smoothed) == 1
    median = problem_in(model).noise_prior[0]
    drawn = group(idata, "prior")["sigma"].to_numpy()[0]
    # the logarithm's standard deviation is 2: five standard errors of a median of 200
    off = np.median(np.log(drawn), axis=0) - np.log(median[: drawn.shape[1]])
    assert (np.abs(off) < 5 * 1.25 * 2.0 / np.sqrt(200)).all()
