"""Models of whole trajectories: linearised at their mode, with the data, and gone on with."""

import copy
import warnings

import arviz as az
import numpy as np
import pymc as pm
import pytest
from simulated_data import simulated_trajectories

import pbrl_ppl as pp
from pbrl_ppl.cli import main
from pbrl_ppl.errors import ConvergenceWarning, FitError, PosteriorError
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import declared_problem, smoothed
from pbrl_ppl.model import problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import (
    convergence,
    from_groups,
    group,
    groups,
    parameter_draws,
    stored_mode,
)
from pbrl_ppl.posterior.store import load_posterior, save_posterior, scalars
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import STATE
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

TRUTH = {"mass": 2.0, "linear_drag_coefficient": 0.8}
SENSOR, STEP = [2e-3, 2e-3, 4e-3, 1e-2, 1e-2, 2e-2], [0.3, 0.3, 0.5]
#: The errors of measuring are stated, so that two parameters and three accelerations are left.
SCENE = Scene(
    time_step=0.1,
    substeps=4,
    bodies=(
        Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}, effects=("linear_drag",)),
    ),
    noise=tuple(zip(STATE, SENSOR, strict=True)),
)
FIT = {"tune": 200, "cores": 1, "progress": False}


@pytest.fixture(scope="module")
def history() -> History:
    """Ten trajectories with both noises."""
    design = simulated_history(SCENE, TRUTH, seed=1, trajectories=10, intervals=5, noise=0.0)
    problem = declared_problem(Physics.declare(SCENE), design, kind="trajectories")
    rng = np.random.default_rng(2)
    measured = simulated_trajectories(problem, np.array([2.0, 0.8]), np.array(STEP), rng)
    errors = rng.normal(size=measured.shape) * SENSOR
    dataset = design.dataset.copy()
    dataset["observed"] = dataset["observed"].copy(data=measured + errors)
    return History.from_dataframe(History(dataset).to_dataframe(), SCENE)


@pytest.fixture(scope="module")
def declared(history) -> pm.Model:
    return pp.physics_model(SCENE, history, likelihood="trajectories")


@pytest.fixture(scope="module")
def half(declared):
    return quiet(pp.fit, declared, seed=1, draws=400, chains=4, **FIT)


@pytest.fixture(scope="module")
def model(history, half) -> pm.Model:
    """The model as it was linearised in the fit."""
    return pp.physics_model(SCENE, history, likelihood=half)


def quiet(function, *arguments, **options):
    """Few draws, on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return function(*arguments, **options)


def likelihood(problem, phi, sigma) -> float:
    return float(problem.log_density(problem.residual(phi), sigma).sum())


def at(model, phi, sigma) -> float:
    """The log-likelihood that PyMC's model has there."""
    named = problem_in(model).named(phi, sigma)
    return model.compile_logp(vars=model.observed_RVs)(
        {model.rvs_to_values[v].name: np.log(named[v.name]) for v in model.free_RVs}
    )


def test_a_fit_linearises_at_its_mode() -> None:
    """A cart, whose wheel slips or rolls: linearised elsewhere its mode is improbable."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    history = simulated_history(scene, CART, seed=1, trajectories=6)
    centre = pp.physics_model(scene, history, likelihood="trajectories")
    fitted = quiet(pp.fit, centre, method="map", seed=1, progress=False)
    model = pp.physics_model(scene, history, likelihood=fitted)
    problem, mode = problem_in(model), stored_mode(problem_in(model), fitted)
    found = likelihood(problem, mode.phi, mode.sigma)
    point = model.initial_point()  # in the sampler's space
    assert model.compile_logp(vars=model.observed_RVs)(point) == pytest.approx(found)
    stored = float(group(fitted, "log_likelihood")["next_state"].sum())
    assert stored == pytest.approx(found)
    again = smoothed(problem, mode.phi, mode.sigma)
    assert likelihood(again, mode.phi, mode.sigma) == pytest.approx(found, abs=0.5)
    assert likelihood(problem_in(centre), mode.phi, mode.sigma) < found - 100


def test_the_same_seed_gives_the_same_mode(declared, history) -> None:
    first, second = (
        pp.physics_model(SCENE, history, likelihood=pp.fit(declared, method="map", progress=False))
        for _ in range(2)
    )
    noise, again = (problem_in(each).likelihood.noise for each in (first, second))
    np.testing.assert_array_equal(noise.slope, again.slope)


def test_declaring_searches_for_no_mode(half, history, monkeypatch) -> None:
    monkeypatch.setattr("pbrl_ppl.modes.search.find_mode", None)
    pp.physics_model(SCENE, history, likelihood="trajectories")
    model = pp.physics_model(SCENE, history, likelihood=half)
    phi, sigma = (draws[7] for draws in parameter_draws(problem_in(model), half))
    stored = group(half, "log_likelihood")["next_state"].sum("transition").to_numpy().ravel()[7]
    assert at(model, phi, sigma) == pytest.approx(stored, abs=1e-6)


def test_posteriors_of_something_else_are_refused(half, history) -> None:
    other = history.select(range(9))
    with pytest.raises(PosteriorError, match="50 transitions that are not the model's 45"):
        pp.physics_model(SCENE, other, likelihood=half)
    single = pp.physics_model(SCENE, history)
    with pytest.raises(PosteriorError, match="of trajectories, the model's of transitions"):
        pp.fit(single, resume=half)


def test_changed_models_are_refused(history) -> None:
    """A copy is the same model; with a variable fixed or a factor added it is not."""
    model = pp.physics_model(SCENE, history)
    assert problem_in(copy.copy(model)) is problem_in(model)
    with pytest.raises(FitError, match="changed after physics_model"):
        pp.fit(pm.do(model, {"mass": np.array([2.0])}))
    with model:
        pm.Potential("more", -model["mass"])
    with pytest.raises(FitError, match="changed after physics_model"):
        pp.fit(model)
    with pm.Model() as other:
        pm.Normal("next_state", observed=1.0)
    with pytest.raises(FitError, match="not made by physics_model"):
        pp.fit(other)


@pytest.mark.filterwarnings("ignore:Numba will use object mode")  # PyMC 6, for random draws
def test_pymc_s_predictions_are_of_the_filter(model, half) -> None:
    """Of one draw, repeated: 300 means of 2000 within 5 standard errors, false alarm 2e-4."""
    one = groups(half)["posterior"].isel(chain=[0], draw=[5])
    phi, sigma = (
        each[0] for each in parameter_draws(problem_in(model), from_groups({"posterior": one}, {}))
    )
    many = one.isel(draw=[0] * 2000).assign_coords(draw=np.arange(2000))
    with model:
        drawn = pm.sample_posterior_predictive(many, random_seed=1, progressbar=False)
        prior = pm.sample_prior_predictive(draws=3, random_seed=1)
    drawn = group(drawn, "posterior_predictive")["next_state"].to_numpy()[0]
    noise, problem = problem_in(model).likelihood.noise, problem_in(model)
    mean, covariance = noise.predictive(noise.coordinates.of_residual(problem.residual(phi)), sigma)
    off = (drawn - problem.observations.values)[:, :, 0, 0]
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert (np.abs(off.mean(axis=0) - mean) < 5 * sd / np.sqrt(2000)).all()
    assert np.isfinite(group(prior, "prior_predictive")["next_state"]).all()


def errors(one, other) -> dict[str, float]:
    """Differences of means and standard deviations in their Monte Carlo standard errors."""
    found, both = {}, [scalars(each) for each in (one, other)]
    mean, square = [each.mean() for each in both], [(each - each.mean()) ** 2 for each in both]
    spread = [np.sqrt(each.mean()) for each in square]
    for name in both[0].data_vars:
        of_mean, of_sd = [], []
        for draws, squares, sd in zip(both, square, spread, strict=True):
            width = float(sd[name])
            of_mean.append(width / np.sqrt(ess(draws[name])))
            of_sd.append(float(squares[name].std()) / (2 * width * np.sqrt(ess(squares[name]))))
        found[f"mean of {name}"] = float(mean[1][name] - mean[0][name]) / np.hypot(*of_mean)
        found[f"sd of {name}"] = float(spread[1][name] - spread[0][name]) / np.hypot(*of_sd)
    return found


def ess(values) -> float:
    """Effective sample size of a mean."""
    return float(np.ravel(az.ess(values.to_numpy(), method="mean"))[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")  # PyMC's own
def test_pymc_samples_the_same_posterior(model, half) -> None:
    """Ten differences in standard errors from the effective sizes: beyond 4.5 by chance, 7e-5."""
    with model:
        drawn = pm.sample(
            draws=4000, tune=1000, chains=4, cores=1, step=pm.DEMetropolisZ(model.free_RVs),
            random_seed=1, progressbar=False, compute_convergence_checks=False,
        )  # fmt: skip
    found = errors(drawn, half)
    assert len(found) == 10
    assert max(map(abs, found.values())) < 4.5, found


@pytest.mark.slow
def test_a_fit_in_two_halves_is_one(model, half, history, tmp_path) -> None:
    """The model is made again from the history; the file holds where it is linearised.

    Ten differences from a whole fit beyond 4.5 standard errors come by chance once in 15,000.
    """
    save_posterior(half, tmp_path / "half.nc")
    stored = load_posterior(tmp_path / "half.nc")
    new = pp.physics_model(SCENE, history, likelihood="trajectories")
    gone_on = quiet(pp.fit, new, seed=2, draws=400, resume=stored, **FIT)
    # all draws, old and new, are of one likelihood: that of the first half
    phi, sigma = parameter_draws(problem_in(model), gone_on)
    of_all = group(gone_on, "log_likelihood")["next_state"].sum("transition").to_numpy()
    of_half = group(half, "log_likelihood")["next_state"].sum("transition").to_numpy()
    np.testing.assert_allclose(of_all[:, :400], of_half, atol=1e-6)
    for i in (0, 399, 400, 799):
        assert of_all[0, i] == pytest.approx(
            likelihood(problem_in(model), phi[i], sigma[i]), abs=1e-6
        )
    assert max(convergence(gone_on)[0].values()) <= 1.05
    second = {"posterior": group(gone_on, "posterior").isel(draw=slice(400, None))}
    found = errors(half, from_groups(second, {}))
    assert max(map(abs, found.values())) < 4.5, found


def test_the_command_goes_on_with_the_same_likelihood(history, tmp_path, capsys) -> None:
    """Old draws keep their log-likelihoods: the file says where the trajectories are linearised."""
    (tmp_path / "scene.toml").write_text(SCENE.to_toml())
    history.to_dataframe().to_csv(tmp_path / "train.csv", index=False)
    given = ["fit", str(tmp_path / "scene.toml"), str(tmp_path / "train.csv"), "--quiet"]
    given += ["--draws", "8", "--tune", "20", "--chains", "2"]
    first, second = tmp_path / "first.nc", tmp_path / "second.nc"
    for options in (["-o", str(first)], ["-o", str(second), "--seed", "9", "--resume", str(first)]):
        assert main([*given, *options]) == 3  # so few draws have not converged
    stored, gone_on = (
        group(load_posterior(path), "log_likelihood")["next_state"].sum("transition").to_numpy()
        for path in (first, second)
    )
    assert gone_on.shape == (2, 16)
    np.testing.assert_allclose(gone_on[:, :8], stored, atol=1e-6)
