"""Simulation-based calibration: its statistics on toys, the bookkeeping, and the real pipeline."""

import json
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from pbrl_ppl.cli import main
from pbrl_ppl.errors import FitError, OutputError
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, TransitionLikelihood, declared_problem
from pbrl_ppl.model import build_model, problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.reporting import plot_calibration, png
from pbrl_ppl.sampling import calibrate, calibration, physics_model
from pbrl_ppl.sampling.calibration import Record, Truth, draw_truths, simulated
from pbrl_ppl.sampling.ranks import MOST_DRAWS, Calibration, bins, holm, rank, uniformity
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
QUICK: dict[str, Any] = {"draws": 100, "tune": 100, "chains": 2, "progress": False}


def toy(
    replications: int, *, width: float = 1.0, shift: float = 0.0, data: bool = True, seed: int = 1
) -> Calibration:
    """mu ~ N(0, 1), five y ~ N(mu, 1): exact posterior draws, or too narrow or shifted ones.

    ``width`` and ``shift`` in posterior standard deviations; without ``data``, prior draws.
    """
    rng = np.random.default_rng(seed)
    ranks = np.empty((replications, 2), dtype=int)
    for i in range(replications):
        mu = rng.normal()
        y = rng.normal(mu, 1.0, 5)
        sd = 1 / np.sqrt(6) if data else 1.0
        draws = (y.sum() / 6 if data else 0.0) + sd * (shift + width * rng.normal(size=400))
        likelihood = [-0.5 * ((y - m) ** 2).sum() for m in (*draws, mu)]
        ranks[i, 0] = rank(draws, mu, 400)[0]
        ranks[i, 1] = rank(np.array(likelihood[:-1]), likelihood[-1], 400)[0]
    return Calibration.of(ranks, np.full(ranks.shape, 99), ["mu", "log_likelihood"])


def test_right_posterior_passes() -> None:
    """False-alarm rate 2 %; the seed is fixed."""
    result = toy(400)
    table = result.table()
    assert result.passed, table
    assert (table["p_value"] > 0.01).all()
    assert list(table.index) == ["mu", "log_likelihood"]


@pytest.mark.parametrize(("width", "shift"), [(0.7, 0.0), (1.5, 0.0), (1.0, 0.5), (1.0, -0.5)])
def test_wrong_posterior_is_caught(width: float, shift: float) -> None:
    table = toy(400, width=width, shift=shift).table()
    assert not table.loc["mu", "passed"]
    assert table.loc["mu", "p_holm"] < 1e-4


@pytest.mark.parametrize(("width", "shift"), [(0.4, 0.0), (1.0, 1.5)])
def test_few_replications_catch_gross_faults(width: float, shift: float) -> None:
    """As many as the real test below has time for."""
    assert not toy(20, width=width, shift=shift).passed


def test_posterior_that_ignores_the_data_is_caught() -> None:
    """Its ranks of mu are uniform: the likelihood alone shows it (Modrák et al., 2023)."""
    table = toy(400, data=False).table()
    assert table.loc["mu", "passed"]
    assert not table.loc["log_likelihood", "passed"]


def test_coverage_counts_central_intervals() -> None:
    result = toy(400, width=0.7)
    table = result.table()
    # exact: the interval of relative width 0.7 holds the truth with 2 Phi(0.7 z) - 1; the binomial
    # sd is 0.025 and 0.019 at 400, and this seed's values are within three of them
    for level, sd in ((0.5, 0.025), (0.9, 0.019)):
        exact = 2 * stats.norm.cdf(0.7 * stats.norm.ppf(0.5 + level / 2)) - 1
        assert abs(table.loc["mu", f"coverage_{100 * level:.0f}"] - exact) < 3 * sd
    assert table.loc["mu", "coverage_90"] < table.loc["mu", "low_90"] < 0.9


def test_limits_hold_all_coverages_together() -> None:
    ranks = np.arange(1000).reshape(200, 5) % 100
    table = Calibration.of(ranks, np.full(ranks.shape, 99), list("abcde")).table()
    low, high = np.array(stats.binom.interval(1 - 0.01 / 10, 200, 0.5)) / 200
    assert table["low_50"].iloc[0] == low
    assert table["high_50"].iloc[0] == high


def test_those_not_judged_do_not_count() -> None:
    ranks = np.stack([np.arange(200) % 100, np.zeros(200, dtype=int)], axis=1)
    size = np.full(ranks.shape, 99)
    assert not Calibration.of(ranks, size, ["mu", "sigma"]).passed
    result = Calibration.of(ranks, size, ["mu", "sigma"], judged=["mu"])
    assert result.passed
    assert result.table()["judged"].to_dict() == {"mu": True, "sigma": False}
    assert not Calibration.of(ranks, size, ["mu", "sigma"], judged=["sigma"]).passed


def test_few_draws_give_uniform_positions() -> None:
    """A chain of few effective draws: ranks among 9 and among 99 on one scale."""
    rng = np.random.default_rng(2)
    size = np.where(np.arange(4000) % 2, 9, 99)
    result = Calibration.of(rng.integers(0, size + 1)[:, None], size[:, None], ["a"])
    # Kolmogorov-Smirnov; false-alarm rate 1 %, fixed seed
    assert stats.kstest(result.dataset["position"].values[:, 0], "uniform").pvalue > 0.01


def test_rank_thins_to_the_effective_draws() -> None:
    draws = np.arange(1000.0)
    assert rank(draws, -1.0, 500.0) == (0, MOST_DRAWS)
    assert rank(draws, 1e9, 500.0) == (MOST_DRAWS, MOST_DRAWS)
    assert rank(draws, 1e9, 12.9) == (12, 12)
    assert rank(draws, 1e9, 0.3) == (1, 1)
    assert rank(draws[:50], 1e9, 500.0) == (50, 50)


def test_position_of_a_replication_does_not_depend_on_the_others() -> None:
    ranks, size = np.arange(20)[:, None], np.full((20, 1), 99)
    whole = Calibration.of(ranks, size, ["a"]).dataset["position"].values
    part = Calibration.of(ranks[[7, 3]], size[:2], ["a"], replication=np.array([7, 3]))
    np.testing.assert_array_equal(part.dataset["position"].values, whole[[7, 3]])


def test_holm_and_bins() -> None:
    np.testing.assert_allclose(holm(np.array([0.5, 0.01, 0.02])), [0.5, 0.03, 0.04])
    assert holm(np.array([0.9, 0.8])).max() <= 1.0
    assert [bins(n) for n in (5, 25, 30, 60, 200)] == [2, 5, 5, 10, 20]
    assert uniformity(np.full(100, 0.5)) < 1e-10


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


def test_coloured_errors_are_correlated_as_stated() -> None:
    """Standard errors of the autocorrelations of 200,000 numbers are below 0.005."""
    errors = calibration.coloured((1000, 100, 2), 0.8, np.random.default_rng(1))
    for lag, expected in enumerate((1.0, 0.8, 0.64, 0.512)):
        product = errors[:, lag:] * errors[:, : 100 - lag]
        assert np.mean(product) == pytest.approx(expected, abs=0.02)
    # stationary from the first row on
    assert np.var(errors[:, 0]) == pytest.approx(1.0, abs=0.15)
    assert np.mean(errors[..., 0] * errors[..., 1]) == pytest.approx(0.0, abs=0.02)
    rng = np.random.default_rng(1)
    np.testing.assert_array_equal(
        calibration.coloured((2, 3), 0.0, np.random.default_rng(1)), rng.standard_normal((2, 3))
    )


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
        bodies=(Body("puck", Shape.circle(0.2), prior={"mass": {"mu": 0.0, "sigma": 800.0}}),)
    )
    truths, redrawn = draw_truths(design_of(history, wild), 6, seed=1)
    # a double holds masses of e^-745 to e^709: about 3 of 8 normals with that sd are outside
    assert 1 <= redrawn <= 30
    assert all(np.isfinite(truth.values).all() for truth in truths)


def test_hopeless_prior_is_an_error(puck: tuple[Scene, History]) -> None:
    scene, history = puck
    wild = scene.replace(
        bodies=(Body("puck", Shape.circle(0.2), prior={"mass": {"mu": 5000.0, "sigma": 1.0}}),)
    )
    with pytest.raises(FitError, match=r"0 of 3 draws .* make the scene's prior narrower"):
        draw_truths(design_of(history, wild), 3, seed=1, most_redrawn=1)


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
    assert len(calibration.labels(design)) == rows.shape[1]


# bookkeeping: the fit itself is left out


def _instead(design: Problem, truth: Truth, seed: int, settings: Any) -> Record:
    """A replication's numbers, made of all that it is given."""
    n = len(truth.phi) + len(truth.sigma) + 1
    value = float(truth.values.sum())
    return {
        "rank": [(seed + i) % 100 for i in range(n)],
        "size": [99] * n,
        "truth": [value + i for i in range(n)],
        "ess": [float(settings["draws"])] * n,
        "r_hat": [1.0] * n,
    }


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds of the replications that were run; put what is to be raised in ``stops``."""
    seen: list[int] = []

    def counted(design: Problem, truth: Truth, seed: int, settings: Any) -> Record:
        seen.append(seed)
        return _instead(design, truth, seed, settings)

    monkeypatch.setattr(calibration, "replicate", counted)
    return seen


def after(monkeypatch: pytest.MonkeyPatch, error: BaseException, n: int) -> list[int]:
    """Let the first n replications pass and the next one raise."""
    seen: list[int] = []

    def stopped(design: Problem, truth: Truth, seed: int, settings: Any) -> Record:
        seen.append(seed)
        if len(seen) == n + 1:
            raise error
        return _instead(design, truth, seed, settings)

    monkeypatch.setattr(calibration, "replicate", stopped)
    return seen


def test_goes_on_after_an_interrupt(
    puck: tuple[Scene, History], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: list[int]
) -> None:
    whole = calibrate(*puck, replications=5, **QUICK)
    assert len(set(runs)) == 5
    folder = tmp_path / "new" / "folder"
    after(monkeypatch, KeyboardInterrupt(), 2)
    with pytest.raises(KeyboardInterrupt):
        calibrate(*puck, replications=5, folder=folder, **QUICK)
    kept = sorted(path.name for path in folder.iterdir())
    assert kept == ["design.json", "replication-00000.json", "replication-00001.json"]
    again = after(monkeypatch, KeyboardInterrupt(), 99)
    resumed = calibrate(*puck, replications=5, folder=folder, **QUICK)
    assert again == runs[2:]
    xr.testing.assert_identical(resumed.dataset, whole.dataset)
    again.clear()
    more = calibrate(*puck, replications=7, folder=folder, **QUICK)
    assert len(again) == 2
    xr.testing.assert_equal(more.dataset.isel(replication=slice(5)), whole.dataset)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 2}, "seed"),
        ({"draws": 101}, "settings"),
        ({"thin": 3}, "settings"),
        ({"horizon": 2}, "horizon"),
        ({"substeps": 3}, "substeps"),
    ],
)
def test_folder_of_other_settings_is_refused(
    puck: tuple[Scene, History], tmp_path: Path, runs: list[int], change: Any, named: str
) -> None:
    calibrate(*puck, replications=2, folder=tmp_path, **QUICK)
    runs.clear()
    with pytest.raises(OutputError, match=rf"another .*{named}.*choose another folder"):
        calibrate(*puck, replications=2, folder=tmp_path, **{**QUICK, **change})
    assert not runs


def test_folder_of_another_design_is_refused(
    puck: tuple[Scene, History], tmp_path: Path, runs: list[int]
) -> None:
    scene, history = puck
    calibrate(scene, history, replications=2, folder=tmp_path, **QUICK)
    with pytest.raises(OutputError, match="another history, sigma_prior"):
        calibrate(scene, history.select([0]), replications=2, folder=tmp_path, **QUICK)
    other = scene.replace(normal_gravity=1.0)
    with pytest.raises(OutputError, match="another scene"):
        calibrate(other, history, replications=2, folder=tmp_path, **QUICK)


def test_other_folders_are_refused(puck: tuple[Scene, History], tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="holds other files"):
        calibrate(*puck, replications=2, folder=tmp_path, **QUICK)
    with pytest.raises(OutputError, match=r"letter\.txt.*cannot be made"):
        calibrate(*puck, replications=2, folder=tmp_path / "letter.txt", **QUICK)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_broken_file_is_named(puck: tuple[Scene, History], tmp_path: Path, runs: list[int]) -> None:
    calibrate(*puck, replications=2, folder=tmp_path, **QUICK)
    (tmp_path / "replication-00001.json").write_text("{")
    with pytest.raises(OutputError, match=r"replication-00001\.json.*delete it"):
        calibrate(*puck, replications=2, folder=tmp_path, **QUICK)


def test_failing_replication_is_reported(
    puck: tuple[Scene, History], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    after(monkeypatch, ZeroDivisionError("no way"), 1)
    with pytest.warns(UserWarning, match=r"1 of 3 .* replication 1: ZeroDivisionError: no way"):
        result = calibrate(*puck, replications=3, folder=tmp_path, **QUICK)
    assert result.failures == ("replication 1: ZeroDivisionError: no way",)
    assert not result.passed
    assert list(result.dataset["replication"].values) == [0, 2]
    again = after(monkeypatch, ZeroDivisionError(), 99)
    assert calibrate(*puck, replications=3, folder=tmp_path, **QUICK).failures == ()
    assert len(again) == 1  # it alone


def test_all_failing_is_an_error(
    puck: tuple[Scene, History], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> Record:
        raise ZeroDivisionError("no way")

    monkeypatch.setattr(calibration, "replicate", fails)
    with pytest.raises(FitError, match=r"all 2 replications failed; .*no way"):
        calibrate(*puck, replications=2, **QUICK)


def test_executor_s_order_does_not_matter(puck: tuple[Scene, History], runs: list[int]) -> None:
    here = calibrate(*puck, replications=6, **QUICK)
    with ThreadPoolExecutor(3) as pool:
        there = calibrate(*puck, replications=6, executor=pool, **QUICK)
    xr.testing.assert_identical(here.dataset, there.dataset)


def test_result_says_what_it_is_of(puck: tuple[Scene, History], runs: list[int]) -> None:
    scene, history = puck
    data = calibrate(scene, history, replications=3, **QUICK).dataset
    assert Scene.from_toml(json.loads(data.attrs["scene"])) == scene
    assert json.loads(data.attrs["history"]) == history.data_sha256
    assert json.loads(data.attrs["settings"]) == {"draws": 100, "tune": 100, "chains": 2}
    assert data.attrs["redrawn"] == 0
    assert list(data["parameter"].values[:2]) == ["mass[puck]", "sigma[x]"]
    assert data["parameter"].values[-1] == "log_likelihood"
    assert data["covered"].dims == ("replication", "parameter", "level")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"replications": 1}, "replications is 1, expected at least 2"),
        ({"likelihood": "simulations"}, "likelihood is 'simulations', expected one of transitions"),
        ({"likelihood": "simulation", "colour": 1.0}, "colour is 1.0, expected a correlation of"),
        ({"likelihood": "simulation", "colour": -0.1}, "colour is -0.1, expected a correlation"),
        ({"likelihood": "simulation", "colour": np.nan}, "colour is nan, expected a correlation"),
        ({"colour": 0.5}, "colour is 0.5 with likelihood 'transitions', expected 0"),
        (
            {"colour": 0.5, "likelihood": "trajectories"},
            "0.5 with likelihood 'trajectories', expected 0",
        ),
        ({"likelihood": "simulation", "horizon": 2}, "'simulation', with horizon or library"),
    ],
)
def test_bad_arguments(puck: tuple[Scene, History], options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        calibrate(*puck, **options)


def test_effects_have_the_model_s_prior(
    puck: tuple[Scene, History], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is in natural units, which a recording shows."""
    given: list[Problem] = []

    def kept(design: Problem, truth: Truth, seed: int, settings: Any) -> Record:
        given.append(design)
        return _instead(design, truth, seed, settings)

    monkeypatch.setattr(calibration, "replicate", kept)
    scene = puck[0].replace(bodies=(replace(puck[0].bodies[0], effects=("linear_drag",)),))
    calibrate(scene, puck[1], replications=2, **QUICK)
    assert given[0].layout.priors == design_of(puck[1], scene).layout.priors


def test_picture() -> None:
    figure = plot_calibration(toy(200, width=0.5))
    panels = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title().split(":")[0] for axes in panels] == ["mu", "log_likelihood"]
    assert panels[0].get_title().endswith("failed")
    assert png(figure).startswith(b"\x89PNG")


# the command


SCENE = """
[world]
time_step = 0.1
substeps = 2

[[body]]
name = "puck"
shape = { kind = "circle", radius = 0.2 }
known = { r = 0.0, mu_c = 0.0 }
"""


@pytest.fixture
def files(tmp_path: Path, puck: tuple[Scene, History], monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "scene.toml").write_text(SCENE)
    puck[1].save(tmp_path / "train.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*options: str) -> int:
    return main(["calibrate", "scene.toml", "train.csv", "-o", "out", "-q", *options])


def test_command(files: Path, runs: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    """Ranks (seed + i) % 100 of 30 replications are as good as random."""
    assert run("--replications", "30") == 0
    out = capsys.readouterr().out
    assert "mass[puck]" in out
    assert "30 replications, 0 with too few effective draws; expected" in out
    assert out.splitlines()[-1] == "passed: out/ranks.png"
    assert {"ranks.nc", "table.csv", "ranks.png", "design.json"} <= {
        path.name for path in (files / "out").iterdir()
    }
    with xr.open_dataset(files / "out" / "ranks.nc", engine="h5netcdf") as data:
        assert data["rank"].shape == (30, 8)
    runs.clear()
    assert run("--replications", "31") == 0  # its own results are no other files
    assert len(runs) == 1


def test_command_fails_with_code_1(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def low(*given: Any) -> Record:
        record = _instead(*given)
        return record | {"rank": [0] * len(record["rank"])}

    monkeypatch.setattr(calibration, "replicate", low)
    assert run("--replications", "30") == 1
    assert capsys.readouterr().out.splitlines()[-1] == "failed: out/ranks.png"


def test_command_errors(files: Path, runs: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "nowhere.toml", "train.csv", "-o", "out"]) == 2
    assert "nowhere.toml" in capsys.readouterr().err
    assert run("--replications", "1") == 2
    assert run("--jobs", "0") == 2
    capsys.readouterr()
    assert run("--replications", "2", "--seed", "4") in (0, 1)
    capsys.readouterr()
    assert run("--replications", "2", "--seed", "5") == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith("error: out: holds a calibration with another seed (seed: 4, ")


def test_command_s_likelihoods(
    files: Path, runs: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    simulation = ("--likelihood", "simulation", "--colour", "0.8", "--replications", "30")
    assert run(*simulation) in (0, 1)
    out = capsys.readouterr().out
    assert "not judged, for errors are coloured: sigma[x], " in out
    with xr.open_dataset(files / "out" / "ranks.nc", engine="h5netcdf") as data:
        assert json.loads(data.attrs["likelihood"]) == "simulation"
        assert json.loads(data.attrs["colour"]) == 0.8
    main(["calibrate", "scene.toml", "train.csv", "-o", "old", "-q", "--likelihood",
          "trajectories", "--replications", "2"])  # fmt: skip
    about = json.loads((files / "old" / "design.json").read_text())
    assert about["likelihood"] == "trajectories"
    capsys.readouterr()
    assert run("--likelihood", "simulations") == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith("error: calibrate: likelihood is 'simulations', expected one of ")
    assert run("--colour", "0.5") == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith("error: calibrate: colour is 0.5 with likelihood 'transitions'")


def test_command_interrupted(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    after(monkeypatch, KeyboardInterrupt(), 1)
    assert run("--replications", "3") == 130
    assert capsys.readouterr().err.splitlines() == [
        "interrupted; finished replications are in out; the same command goes on"
    ]
    assert (files / "out" / "replication-00000.json").is_file()


# the real thing


def test_whole_trajectories(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two replications: each noise is drawn, simulated along trajectories, fitted and ranked."""
    once = partial(calibration.replicate, most_repeats=0)
    monkeypatch.setattr("pbrl_ppl.sampling.calibration.replicate", once)
    quick = QUICK | {"draws": 50, "tune": 50}
    prior = {"mass": {"mu": 0.7, "sigma": 0.3}}
    body = Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}, prior=prior)
    scene = Scene(time_step=0.1, substeps=2, bodies=(body,))
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=3, intervals=3)
    result = calibrate(scene, history, likelihood="trajectories", replications=2, cores=1, **quick)
    assert not result.failures
    names = [f"sigma[{d}]" for d in ("x", "y", "theta", "vx", "vy", "omega")]
    names += [f"unexplained_acceleration[{d}]" for d in ("vx", "vy", "omega")]
    assert list(result.dataset["parameter"].values) == ["mass[puck]", *names, "log_likelihood"]
    assert (result.dataset["ess"] > 2).all()
    truth = result.dataset["truth"].values
    assert (truth[:, :-1] > 0).all()
    assert (truth[0] != truth[1]).all()
    # what was simulated is the design's, all but its numbers
    problem = declared_problem(Physics.declare(scene), history, kind="trajectories")
    (one,), _ = draw_truths(problem, 1, seed=1)
    again = simulated(problem, one.values)
    assert again.noise_prior[0] == pytest.approx(problem.noise_prior[0])
    np.testing.assert_array_equal(again.data.history.dataset["observed"].values, one.values)
    off = again.whitened(one.phi, one.sigma)
    # 54 innovations: their mean square has sd 0.19, and the first of each trajectory is exact
    assert 0.2 < np.mean(off**2) < 1.8


@pytest.mark.slow
def test_simulations_are_calibrated_with_coloured_errors() -> None:
    """Two replications of a body whose mass is unknown, with draws about the mode."""
    prior = {"mass": {"mu": 0.7, "sigma": 0.3}}
    known = {"r": 0.0, "mu_c": 0.0}
    body = Body("puck", Shape.circle(0.2), known=known, prior=prior)
    scene = Scene(time_step=0.1, substeps=2, bodies=(body,))
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=2, intervals=10)
    options = QUICK | {"likelihood": "simulation", "colour": 0.6, "method": "laplace"}
    result = calibrate(scene, history, replications=2, **options)
    assert not result.failures
    names = [f"sigma[{d}]" for d in ("x", "y", "theta", "vx", "vy", "omega")]
    assert list(result.dataset["parameter"].values) == ["mass[puck]", *names, "log_likelihood"]
    assert {"rank", "size", "truth", "ess", "r_hat", "position"} <= set(result.dataset)
    assert result.dataset["judged"].values.tolist() == [True] + 7 * [False]
    assert (result.dataset["size"] == MOST_DRAWS).all()  # its draws are independent
    truth = result.dataset["truth"].values
    assert (truth[:, :-1] > 0).all()
    assert np.isfinite(truth).all()
    again = calibrate(scene, history, replications=2, **options)
    xr.testing.assert_identical(result.dataset, again.dataset)


def test_all_is_judged_with_white_errors(puck: tuple[Scene, History], runs: list[int]) -> None:
    white = calibrate(*puck, replications=2, likelihood="simulation", **QUICK)
    assert white.dataset["judged"].all()


CASES = ["cart", "trajectories", "pair", "push", "hinge", "positions", "simulation", "laplace"]


@pytest.mark.usefixtures("benchmarks")
def test_benchmark_s_designs(runs: list[int]) -> None:
    """Each is small, and can be simulated almost always."""
    import calibration as benchmark

    assert list(benchmark.CASES) == CASES
    for name, case in benchmark.CASES.items():
        scene, history = case.design()
        assert len(history.segments(1).start) <= 100, name
        result = calibrate(scene, history, replications=20, **case.options | QUICK)
        assert result.dataset.attrs["redrawn"] <= 5, name


@pytest.mark.usefixtures("benchmarks")
@pytest.mark.parametrize("name", ["laplace", pytest.param("hinge", marks=pytest.mark.slow)])
def test_benchmark_s_case_runs(name: str) -> None:
    import calibration as benchmark

    case = benchmark.CASES[name]
    result = calibrate(*case.design(), replications=2, seed=4, **case.options | QUICK)
    assert not result.failures
    assert (result.dataset["ess"] > 50).all()


@pytest.mark.slow
@pytest.mark.usefixtures("benchmarks")
def test_benchmark_prints_its_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import calibration as benchmark

    few = ["--case", "laplace", "--replications", "2", "--jobs", "1", "--json"]
    monkeypatch.setattr(sys, "argv", ["calibration.py", str(tmp_path / "laplace"), *few])
    benchmark.main()
    figures = json.loads(capsys.readouterr().out)
    assert figures["case"] == "laplace"
    assert figures["replications"] == 2
    assert figures["failures"] == 0
    assert figures["seconds_each"] > 0


@pytest.mark.slow
def test_processes_give_the_same_numbers(puck: tuple[Scene, History]) -> None:
    options = {**QUICK, "replications": 2, "sigma": "scalar"}
    here = calibrate(*puck, **options)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        there = calibrate(*puck, executor=pool, **options)
    assert here.failures == there.failures == ()
    assert list(here.dataset["parameter"].values) == ["mass[puck]", "sigma", "log_likelihood"]
    xr.testing.assert_identical(here.dataset, there.dataset)


@pytest.mark.long
def test_cart_is_calibrated() -> None:
    """The whole pipeline on 12 transitions of a wheeled cart; false-alarm rate 2 %, fixed seed."""
    scene = cart_scene(prior=PRIOR, known={"r": 0.2, "mu_c": 0.3}).replace(substeps=5)
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=4)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        result = calibrate(
            scene, history, replications=20, seed=1, draws=800, tune=400, chains=2,
            executor=pool, progress=False,
        )  # fmt: skip
    table = result.table()
    assert result.passed, (result.failures, table)
    # so many effective draws that the ranks say something
    assert (result.dataset["size"].values == MOST_DRAWS).mean() >= 0.9
    assert len(table) == 6 + 6 + 1
