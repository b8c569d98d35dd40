"""Simulation-based calibration: its statistics on toys, what is simulated, the real pipeline."""

import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import calibration
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from calibration import MOST_DRAWS, calibrate, draw_truths, rank, simulated, table
from scipy import stats

from pbrl_ppl.errors import FitError
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, TransitionLikelihood, declared_problem
from pbrl_ppl.model import build_model, physics_model, problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import Fit, from_groups
from pbrl_ppl.posterior.store import groups
from pbrl_ppl.sampling import sample
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE

# from here on every model is also drawn from
pytestmark = [
    pytest.mark.first(4),
    OBJECT_MODE,
]
PRIOR = {
    "mass": {"mu": 1.8, "sigma": 0.3},
    "w_x": {"mu": -0.25, "sigma": 0.05},
    "w_y": {"mu": 0.0, "sigma": 0.05},
    "w_theta": {"mu": 0.1, "kappa": 10.0},
    "mu_x": {"mu": 0.1, "sigma": 0.1},
    "mu_y": {"mu": 0.5, "sigma": 0.15},
}


def toy(
    simulations: int, *, width: float = 1.0, shift: float = 0.0, data: bool = True, seed: int = 1
) -> pd.DataFrame:
    """mu ~ N(0, 1), five y ~ N(mu, 1): exact posterior draws, or too narrow or shifted ones.

    ``width`` and ``shift`` in posterior standard deviations; without ``data``, prior draws.
    """
    rng = np.random.default_rng(seed)
    ranks = np.empty((simulations, 2), dtype=int)
    for i in range(simulations):
        mu = rng.normal()
        y = rng.normal(mu, 1.0, 5)
        sd = 1 / np.sqrt(6) if data else 1.0
        draws = (y.sum() / 6 if data else 0.0) + sd * (shift + width * rng.normal(size=400))
        likelihood = [-0.5 * ((y - m) ** 2).sum() for m in (*draws, mu)]
        ranks[i, 0] = rank(draws, mu, 400)[0]
        ranks[i, 1] = rank(np.array(likelihood[:-1]), likelihood[-1], 400)[0]
    return judged(ranks, np.full(ranks.shape, 99), ["mu", "log_likelihood"])


def judged(ranks: Any, size: Any, names: list[str]) -> pd.DataFrame:
    """The table of these ranks, shape (simulation, parameter)."""
    dims = ("simulation", "parameter")
    every = {"rank": ranks, "size": size, "ess": size, "r_hat": np.ones(ranks.shape)}
    data = xr.Dataset({key: (dims, value) for key, value in every.items()}, {"parameter": names})
    return table(data.assign(judged=("parameter", [True] * len(names))))


def test_right_posterior_passes() -> None:
    """False-alarm rate 2 %; the seed is fixed."""
    rows = toy(400)
    assert rows["passed"].all(), rows
    assert (rows["p"] > 0.01).all()
    assert list(rows.index) == ["mu", "log_likelihood"]


@pytest.mark.parametrize(("width", "shift"), [(0.7, 0.0), (1.5, 0.0), (1.0, 0.5), (1.0, -0.5)])
def test_wrong_posterior_is_caught(width: float, shift: float) -> None:
    rows = toy(400, width=width, shift=shift)
    assert not rows.loc["mu", "passed"]
    assert rows.loc["mu", "p_corrected"] < 1e-4


@pytest.mark.parametrize(("width", "shift"), [(0.4, 0.0), (1.0, 1.5)])
def test_few_simulations_catch_gross_faults(width: float, shift: float) -> None:
    """As many as the real test below has time for."""
    assert not toy(20, width=width, shift=shift)["passed"].all()


def test_posterior_that_ignores_the_data_is_caught() -> None:
    """Its ranks of mu are uniform: the likelihood alone shows it (Modrák et al., 2023)."""
    rows = toy(400, data=False)
    assert rows.loc["mu", "passed"]
    assert not rows.loc["log_likelihood", "passed"]


def test_coverage_counts_central_intervals() -> None:
    rows = toy(400, width=0.7)
    # exact: the interval of relative width 0.7 holds the truth with 2 Phi(0.7 z) - 1; the binomial
    # sd is 0.025 and 0.019 at 400, and this seed's values are within three of them
    for level, sd in ((0.5, 0.025), (0.9, 0.019)):
        exact = 2 * stats.norm.cdf(0.7 * stats.norm.ppf(0.5 + level / 2)) - 1
        assert abs(rows.loc["mu", f"coverage_{100 * level:.0f}"] - exact) < 3 * sd


def test_few_draws_give_uniform_positions() -> None:
    """A chain of few effective draws: ranks among 9 and among 99 on one scale."""
    rng = np.random.default_rng(2)
    size = np.where(np.arange(4000) % 2, 9, 99)[:, None]
    rows = judged(rng.integers(0, size + 1), size, ["a"])
    assert rows["passed"].all(), rows  # false-alarm rate 2 %, fixed seed


def test_rank_thins_to_the_effective_draws() -> None:
    draws = np.arange(1000.0)
    assert rank(draws, -1.0, 500.0) == (0, MOST_DRAWS)
    assert rank(draws, 1e9, 500.0) == (MOST_DRAWS, MOST_DRAWS)
    assert rank(draws, 1e9, 12.9) == (12, 12)
    assert rank(draws, 1e9, 0.3) == (1, 1)
    assert rank(draws[:50], 1e9, 500.0) == (50, 50)


# what is simulated


def design_of(history: History, scene: Scene, **options: Any) -> Problem:
    problem: Problem = problem_in(physics_model(scene, history, **options))
    return problem


@pytest.fixture(scope="module")
def cart() -> tuple[Scene, History]:
    scene = cart_scene(prior=PRIOR).replace(substeps=5)
    return scene, simulated_history(scene, CART, seed=7, trajectories=2, intervals=4)


@pytest.fixture(scope="module")
def puck() -> tuple[Scene, History]:
    """Only a mass is unknown: the quickest model."""
    body = Body(
        "puck", Shape.circle(0.2), known={"r": 0.0, "mu_c": 0.0}, prior={"mass": {"sigma": 0.5}}
    )
    scene = Scene(time_step=0.1, bodies=(body,), substeps=2)
    return scene, simulated_history(scene, {"mass": 2.0}, seed=3, trajectories=2, intervals=3)


def test_truths_follow_the_prior(cart: tuple[Scene, History]) -> None:
    """PyMC's prior against the layout's: two-sample Kolmogorov-Smirnov.

    False-alarm rate 1 % over all parameters, fixed seed.
    """
    design = design_of(cart[1], cart[0])
    truths, redrawn = draw_truths(design, 500, seed=1)
    assert redrawn == 0
    rng = np.random.default_rng(2)
    phi = np.array([truth.phi for truth in truths])
    for label, prior, column in zip(design.layout.labels, design.layout.priors, phi.T, strict=True):
        p_value = stats.ks_2samp(column, prior.sample(rng, 2000)).pvalue
        assert p_value > 0.01 / len(phi.T), label


def test_simulated_noise_is_sigma(cart: tuple[Scene, History]) -> None:
    """Eq. 13: what is simulated is off the prediction by sigma. False-alarm rate 1 %."""
    design = design_of(cart[1], cart[0])
    truths, _ = draw_truths(design, 100, seed=1)
    z = [(t.values - design.predict(t.phi)) / t.sigma for t in truths]
    assert stats.kstest(np.ravel(z), "norm").pvalue > 0.01


@pytest.mark.parametrize("colour", [0.0, 0.7])
def test_simulations_have_errors_of_measurement_alone(
    puck: tuple[Scene, History], colour: float
) -> None:
    scene, history = puck
    frame = history.to_dataframe()
    frame.loc[[1, 6], "vx"] = np.nan
    history = History.from_dataframe(frame, scene)
    design = declared_problem(Physics.declare(scene), history, kind="simulation")
    design = design.with_likelihood(prior=((0.1, 0.2, 0.3, 0.4, 0.5, 0.6), 1.0))
    truths, redrawn = draw_truths(design, 200, seed=1, colour=colour)
    assert redrawn == 0
    measured = np.isfinite(history.dataset["observed"].to_numpy())
    assert not measured.all()
    errors = []
    for truth in truths:
        states = design.data.smoothed_states.copy()
        for row in range(3):  # of the one body, step by step
            inputs = design.inputs[:, row : row + 1]
            states[:, row + 1] = design.physics.one_world(truth.phi, states[:, row], inputs)[:, 0]
        off = np.where(measured, truth.values - states, np.nan) / truth.sigma
        errors.append(off[..., [0, 1, 3, 4]])  # angles may be wrapped
        assert (truth.values[~measured] == 0.0).all()
    every = np.array(errors)
    # standard errors of means over 200 histories are below 0.03
    assert np.nanmean(every**2) == pytest.approx(1.0, abs=0.1)
    assert np.nanmean(every[:, :, 1:] * every[:, :, :-1]) == pytest.approx(colour, abs=0.1)
    again = simulated(design, truths[0].values)
    np.testing.assert_array_equal(
        again.data.history.dataset["observed"], np.where(measured, truths[0].values, np.nan)
    )
    np.testing.assert_array_equal(again.noise_prior[0], design.noise_prior[0])


def test_more_truths_begin_with_the_same(puck: tuple[Scene, History]) -> None:
    design = design_of(puck[1], puck[0])
    few, many = (draw_truths(design, n, seed=5)[0] for n in (3, 5))
    for one, other in zip(few, many, strict=False):
        np.testing.assert_array_equal(one.phi, other.phi)
        np.testing.assert_array_equal(one.values, other.values)


def test_impossible_draws_are_redrawn_and_counted(puck: tuple[Scene, History]) -> None:
    scene, history = puck
    wild = scene.replace(
        bodies=(Body("puck", Shape.circle(0.2), prior={"mass": {"mu": 0.0, "sigma": 300.0}}),)
    )
    truths, redrawn = draw_truths(design_of(history, wild), 6, seed=1)
    # about a third of these masses are too small or too large for the engine
    assert 1 <= redrawn <= 6
    assert all(np.isfinite(truth.values).all() for truth in truths)


def test_hopeless_prior_is_an_error(puck: tuple[Scene, History]) -> None:
    scene, history = puck
    wild = scene.replace(
        bodies=(Body("puck", Shape.circle(0.2), prior={"mass": {"mu": 5000.0, "sigma": 1.0}}),)
    )
    with pytest.raises(FitError, match=r"0 of 6 draws .* make priors narrower"):
        draw_truths(design_of(history, wild), 3, seed=1)


@pytest.mark.parametrize("horizon", [1, 2])
def test_simulated_keeps_the_design(cart: tuple[Scene, History], horizon: int) -> None:
    scene, history = cart
    frame = history.to_dataframe()
    frame.loc[[1, 3], "vx"] = np.nan
    design = design_of(History.from_dataframe(frame, scene), scene, horizon=horizon)
    values = np.random.default_rng(1).normal(size=design.observations.values.shape)
    again = simulated(design, values)
    np.testing.assert_array_equal(again.segments.start, design.segments.start)
    np.testing.assert_array_equal(again.segments.actions, design.segments.actions)
    measured = design.observations.measured
    assert not measured.all()
    np.testing.assert_array_equal(again.observations.values, np.where(measured, values, np.nan))


def test_simulated_pendulum_keeps_what_was_not_measured() -> None:
    """Angles alone are measured; the start is completed through the hinge."""
    rod = Body("rod", Shape.box(0.4, 0.02))
    scene = Scene(
        time_step=0.05,
        gravity=(0.0, -9.81),
        bodies=(rod,),
        joints=(Joint("hinge", ("rod", "world"), (-0.2, 0.0), (0.0, 0.0)),),
    )
    frame = simulated_history(
        scene, {"mass": 1.0, "r": 0.0, "mu_c": 0.0}, seed=1, trajectories=2, intervals=3,
        poses=[(0.2, 0.0, 0.0)], noise=0.0,
    ).to_dataframe()  # fmt: skip
    frame[["x", "y", "vx", "vy"]] = np.nan
    design = design_of(History.from_dataframe(frame, scene), scene)
    again = simulated(design, design.observations.values)
    assert again.observations.columns == design.observations.columns == (2, 5)
    np.testing.assert_array_equal(again.segments.start, design.segments.start)


def test_sigma_s_prior_is_the_design_s(puck: tuple[Scene, History]) -> None:
    """Whatever is simulated, sigma has the prior that it was drawn from."""
    scene, history = puck
    design = design_of(history, scene)
    fixed = Problem.of(
        Physics(scene, substeps=2),
        history,
        likelihood=TransitionLikelihood(prior=((0.5,) * 6, 1.5)),
    )
    point = {"mass_log__": np.zeros(1), "sigma_log__": np.linspace(-1.0, 1.0, 6)}
    densities = []
    for problem in (fixed, simulated(fixed, 7.0 * design.observations.values)):
        model = build_model(problem)
        logp = model.compile_logp(vars=model["sigma"], mode="FAST_COMPILE")
        densities.append(float(logp(point)))
    expected = stats.norm.logpdf(np.linspace(-1.0, 1.0, 6), np.log(0.5), 1.5).sum()
    np.testing.assert_allclose(densities, expected)


def test_equal_wheels_have_equal_quantities(cart: tuple[Scene, History]) -> None:
    """Where the prior cannot tell them apart; where it can, a wrong choice of one must show."""
    design = design_of(cart[1], cart_scene())
    phi = design.layout.to_vector(CART)
    turned = design.layout.to_vector(
        CART | {"w_theta": CART["w_theta"] - np.pi / 2, "mu_x": CART["mu_y"], "mu_y": CART["mu_x"]}
    )
    rows = calibration.quantities(
        design, np.stack([phi, turned]), np.ones((2, 6)), np.array([3.0, 3.0])
    )
    np.testing.assert_allclose(rows[0], rows[1])
    np.testing.assert_allclose(rows[0], [*phi, *np.ones(6), 3.0])
    known = design_of(cart[1], cart_scene(prior=PRIOR))
    two = calibration.quantities(known, np.stack([phi, turned]), np.ones((2, 6)), np.zeros(2))
    np.testing.assert_array_equal(two[:, : len(phi)], [phi, turned])


# the real thing


def test_whole_trajectories() -> None:
    """Two simulations: each noise is drawn, simulated along trajectories, fitted and ranked."""
    prior = {"mass": {"mu": 0.7, "sigma": 0.3}}
    body = Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}, prior=prior)
    scene = Scene(time_step=0.1, substeps=2, bodies=(body,))
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=3, intervals=3)
    model = physics_model(scene, history, likelihood="trajectories")
    data = calibrate(model, simulations=2, draws=50, tune=50, chains=2)
    names = [f"sigma[{d}]" for d in ("x", "y", "theta", "vx", "vy", "omega")]
    names += [f"unexplained_acceleration[{d}]" for d in ("vx", "vy", "omega")]
    assert list(data["parameter"].values) == ["mass[puck]", *names, "log_likelihood"]
    assert (data["ess"] > 2).all()
    truth = data["truth"].values
    assert (truth[:, :-1] > 0).all()
    assert (truth[0] != truth[1]).all()
    # what was simulated is the design's, all but its numbers
    problem = problem_in(model)
    (one,), _ = draw_truths(problem, 1, seed=1)
    again = simulated(problem, one.values)
    assert again.noise_prior[0] == pytest.approx(problem.noise_prior[0])
    np.testing.assert_array_equal(again.data.history.dataset["observed"].values, one.values)
    off = again.whitened(one.phi, one.sigma)
    # 54 innovations: their mean square has sd 0.19, and the first of each trajectory is exact
    assert 0.2 < np.mean(off**2) < 1.8


def test_coloured_errors_leave_the_parameters_to_judge(puck: tuple[Scene, History]) -> None:
    model = physics_model(*puck, likelihood="simulation")
    with pytest.raises(ValueError, match=r"colour is 1\.0"):
        calibrate(model, colour=1.0)
    with pytest.raises(ValueError, match=r"colour is 0\.5"):
        calibrate(physics_model(*puck), colour=0.5)
    data = calibrate(model, simulations=2, colour=0.6, method="laplace", draws=100, chains=2)
    assert data["judged"].values.tolist() == [True] + 7 * [False]
    assert (data["size"] == MOST_DRAWS).all()  # its draws are independent


def narrow(problem: Problem, **settings: Any) -> Fit:
    """A sampler whose standard deviations are less than half of what they should be."""
    fit = sample(problem, **settings)
    data = groups(fit.posterior)
    mean = data["posterior"].mean(("chain", "draw"))
    data["posterior"] = mean + 0.4 * (data["posterior"] - mean)
    return Fit(fit.problem, from_groups(data, fit.posterior.attrs))


@pytest.mark.slow
def test_the_default_sampler_is_calibrated(puck: tuple[Scene, History]) -> None:
    """A mass and six noises; false-alarm rate 2 %, fixed seed."""
    data = calibrate(physics_model(*puck), simulations=40, draws=200, tune=200, chains=2)
    assert table(data)["passed"].all(), table(data)


@pytest.mark.slow
def test_a_wrong_sampler_is_found(
    puck: tuple[Scene, History], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "sample", narrow)
    data = calibrate(physics_model(*puck), simulations=40, draws=100, method="laplace", chains=2)
    assert not table(data).loc["mass[puck]", "passed"]


CASES = ["cart", "trajectories", "pair", "push", "hinge", "positions", "simulation", "laplace"]


@pytest.mark.usefixtures("benchmarks")
def test_benchmark_s_designs() -> None:
    """Each is small, and can be simulated almost always."""
    import calibration_cases as benchmark

    assert list(benchmark.CASES) == CASES
    for name, case in benchmark.CASES.items():
        scene, history = case.design()
        assert len(history.segments(1).start) <= 100, name
        design = design_of(history, scene, likelihood=case.likelihood)
        assert draw_truths(design, 20, seed=4)[1] <= 5, name


@pytest.mark.slow
@pytest.mark.usefixtures("benchmarks")
def test_benchmark_prints_its_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import calibration_cases as benchmark

    few = ["--case", "laplace", "--simulations", "2", "--jobs", "1", "--json"]
    monkeypatch.setattr(sys, "argv", ["calibration_cases.py", *few])
    benchmark.main()
    figures = json.loads(capsys.readouterr().out)
    assert figures["case"] == "laplace"
    assert figures["simulations"] == 2
    assert figures["seconds_each"] > 0


@pytest.mark.slow
def test_the_script_says_whether_it_passed(
    puck: tuple[Scene, History],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "scene.toml").write_text(puck[0].to_toml())
    puck[1].save(tmp_path / "train.csv")
    monkeypatch.chdir(tmp_path)
    few = ["--simulations", "2", "--jobs", "1", "--method", "laplace", "--draws", "100"]
    monkeypatch.setattr(sys, "argv", ["calibration.py", "scene.toml", "train.csv", *few])
    with pytest.raises(SystemExit) as stop:
        calibration.main()
    assert stop.value.code in (0, 1)
    assert "mass[puck]" in capsys.readouterr().out


@pytest.mark.long
def test_cart_is_calibrated() -> None:
    """The whole pipeline on 12 transitions of a wheeled cart; false-alarm rate 2 %, fixed seed."""
    scene = cart_scene(prior=PRIOR, known={"r": 0.2, "mu_c": 0.3}).replace(substeps=5)
    model = physics_model(
        scene, simulated_history(scene, CART, seed=7, trajectories=3, intervals=4)
    )
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        data = calibrate(model, simulations=20, draws=800, tune=400, chains=2, run=pool.map)
    rows = table(data)
    assert rows["passed"].all(), rows
    # so many effective draws that the ranks say something
    assert (data["size"].values == MOST_DRAWS).mean() >= 0.9
    assert len(rows) == 6 + 6 + 1
