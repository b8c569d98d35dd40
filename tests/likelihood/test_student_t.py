"""Student-t noise: its density, its draws, and what outliers do to a fit with and without it."""

import numpy as np
import pandas as pd
import pytensor.tensor as pt
import pytest
from scipy.stats import kstest
from scipy.stats import t as student

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import TransitionLikelihood, next_state_random, robust
from pbrl_ppl.model import LazyProblem, LogLikelihoodOp, physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.posterior import draws
from pbrl_ppl.sampling import fit
from pbrl_ppl.state import STATE
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import NOISE, simulated_history

EQ_11 = TransitionLikelihood()
NU = 4.0


@pytest.fixture(scope="module")
def scene():
    return cart_scene(known={"r": 0.2, "mu_c": 0.3})


@pytest.fixture(scope="module")
def clean(scene) -> History:
    return simulated_history(scene, CART, seed=11, trajectories=6, intervals=10)


@pytest.fixture(scope="module")
def spoilt(scene, clean) -> History:
    """One next state in twelve is off by 20 to 60 standard deviations, as after a hidden bump."""
    rng = np.random.default_rng(12)
    frame: pd.DataFrame = clean.to_dataframe()
    columns = list(STATE)
    # the last row of a trajectory is nobody's initial state
    last = frame.groupby("trajectory").tail(1).index[::2]
    off = rng.uniform(20, 60, (len(last), 6)) * rng.choice([-1, 1], (len(last), 6))
    frame.loc[last, columns] += off * NOISE
    return History.from_dataframe(frame, scene)


def test_density() -> None:
    rng = np.random.default_rng(0)
    residual, sigma = rng.normal(size=(5, 1, 2, 3)), np.array([0.5, 1.0, 2.0])
    measured = np.ones_like(residual, dtype=bool)
    measured[0, 0, 0, 0] = False
    residual[~measured] = 0.0
    expected = np.where(measured, student.logpdf(residual, NU, scale=sigma), 0.0).sum((1, 2, 3))
    np.testing.assert_allclose(EQ_11.log_density(residual, sigma, measured, NU), expected)


def test_the_model_s_density_is_the_same(scene, clean) -> None:
    """The Op against numpy, at one point."""
    problem = problem_in(physics_model(scene, clean, nu=NU))
    phi = problem.layout.to_vector(CART)
    mean = problem.predict(phi)[..., problem.observations.columns]
    value, sigma = problem.observations.values, np.array(NOISE)
    op = LogLikelihoodOp(LazyProblem(problem))
    found = op(*map(pt.as_tensor, (value, mean, sigma, phi))).eval()
    residual = problem.residual(phi)
    np.testing.assert_allclose(found, problem.log_density(residual, np.array(NOISE)))


def test_draws_have_the_distribution() -> None:
    """10,000 draws; a false alarm one time in a thousand, at a fixed seed."""
    drawn = next_state_random(
        np.zeros((10_000, 1, 1, 1)), np.array([2.0]), np.random.default_rng(1), nu=NU
    )
    assert kstest(drawn.ravel() / 2.0, student(NU).cdf).pvalue > 1e-3


def test_robust_residuals_square_to_the_density() -> None:
    z = np.linspace(-50, 50, 101)
    expected = student.logpdf(0, NU) - student.logpdf(z, NU)
    np.testing.assert_allclose(0.5 * robust(z, NU) ** 2, expected, atol=1e-12)
    assert (np.diff(robust(z, NU)) > 0).all()


def test_outliers_mislead_a_gaussian_only(scene, clean, spoilt) -> None:
    """The t fit of spoilt data stays by the truth, in units of the clean fit's deviations."""
    right = find_mode(problem_in(physics_model(scene, clean)), seed=1)
    deviation = np.sqrt(np.diag(right.covariance))
    truth = right.problem.layout.to_vector(CART)
    off = {}
    for nu in (None, NU):
        mode = find_mode(problem_in(physics_model(scene, spoilt, nu=nu)), seed=1)
        off[nu] = np.abs((mode.phi - truth) / deviation).max()
    assert off[NU] < 4
    assert off[None] > 2 * off[NU]


def test_scalar_sigma_is_allowed(scene, clean) -> None:
    problem = problem_in(physics_model(scene, clean, nu=NU, sigma="scalar"))
    mode = find_mode(problem, seed=1)
    assert np.ptp(mode.sigma) == 0
    assert np.isfinite(mode.log_posterior)
    assert problem.with_likelihood(nu=None).likelihood.nu is None


@pytest.mark.one_stack
@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")
def test_fit_covers_the_truth(scene, spoilt) -> None:
    """Central 99.9 % intervals of six parameters: a false alarm 6e-3 of the time."""
    model = physics_model(scene, spoilt, nu=NU)
    idata = fit(model, seed=1, draws=300, tune=200, cores=1, progress=False)
    assert idata.attrs["nu"] == NU
    for name in ("mass", "w_x", "w_y", "w_theta", "mu_x", "mu_y"):
        low, high = np.quantile(draws(idata)[name], [0.0005, 0.9995])
        assert low <= CART[name] <= high, name


@pytest.mark.parametrize("nu", [0.0, -1.0, np.inf, np.nan])
def test_impossible_degrees_of_freedom(scene, clean, nu) -> None:
    with pytest.raises(ValueError, match="expected degrees of freedom above 0"):
        physics_model(scene, clean, nu=nu)
