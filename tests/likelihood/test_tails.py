"""The noise stage: tails that depend on the parameters, in numpy, in PyMC and in a fit."""

import numpy as np
import pytest
from scipy import stats

from pbrl_ppl.effects import Effect, EffectParameter, Noise, catalogue
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.likelihood import log_norm, log_posterior, robust
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.parameters import Prior
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import NOISE, simulated_history

TAILS = next(effect for effect in catalogue if effect.name == "heavy_tails")
SIGMA = np.array(NOISE)


@pytest.fixture(scope="module")
def history():
    """A cart whose measurements have Student-t noise of 3 degrees of freedom."""
    scene = cart_scene()
    clean = simulated_history(scene, CART, seed=3, trajectories=300, intervals=1, noise=0.0)
    frame = clean.to_dataframe()
    rng = np.random.default_rng(5)
    columns = ["x", "y", "theta", "vx", "vy", "omega"]
    # the initial states stay exact: Eq. 11 has noise on the next state alone
    after = (frame["step"] == 1).to_numpy()
    frame.loc[after, columns] += rng.standard_t(3, (after.sum(), 6)) * SIGMA
    return type(clean).from_dataframe(frame, scene)


@pytest.fixture(scope="module")
def model(history):
    return physics_model(cart_scene(), history, [TAILS])


def test_infinite_degrees_of_freedom_are_a_gaussian() -> None:
    z = np.array([-3.0, 0.2, 5.0])
    nu = np.array([np.inf, 4.0, 1e9])
    np.testing.assert_allclose(robust(z, nu), [-3.0, robust(z, 4.0)[1], 5.0])
    expected = [stats.norm.logpdf(0), stats.t.logpdf(0, 4), stats.norm.logpdf(0)]
    np.testing.assert_allclose(log_norm(nu), expected)


@pytest.mark.parametrize("tail", [0.0, 1e-9, 0.2, 0.9])
def test_numpy_is_scipys_student_t(model, tail) -> None:
    problem = problem_in(model)
    phi = problem.layout.to_vector(CART | {"heavy_tails_inverse_nu": tail})
    residual = problem.residual(phi)
    nu = np.inf if tail < 1e-7 else 1.0 / tail
    law = stats.norm if np.isinf(nu) else stats.t(nu)
    expected = (law.logpdf(residual / SIGMA) - np.log(SIGMA)).sum((1, 2, 3))
    np.testing.assert_allclose(problem.log_density(residual, SIGMA, phi), expected, rtol=1e-6)


def test_pymc_says_the_same(model) -> None:
    problem = problem_in(model)
    values = {**CART, "heavy_tails_inverse_nu": 0.3}
    phi = problem.layout.to_vector(values)
    point = {k: np.atleast_1d(v) for k, v in problem.layout.to_dict(phi).items()}
    density = model.compile_logp(sum=True, jacobian=False)
    with model:
        free = {v.name: model.rvs_to_values[v].name for v in model.free_RVs}
    given = {}
    for name, value in (point | {"sigma": SIGMA}).items():
        variable = model[name]
        transform = model.rvs_to_transforms[variable]
        if transform is not None:
            value = transform.forward(value, *variable.owner.inputs).eval()
        given[free[name]] = value
    np.testing.assert_allclose(density(given), log_posterior(problem, phi, SIGMA), rtol=1e-6)


def test_the_tail_has_a_gradient(model) -> None:
    name = next(name for name in model.initial_point() if name.startswith("heavy_tails"))
    point = model.initial_point()
    logp = model.compile_logp(vars=model.observed_RVs)
    gradient = model.compile_dlogp(vars=[model["heavy_tails_inverse_nu"]])(point)
    ends = [float(logp(point | {name: point[name] + h})) for h in (1e-5, -1e-5)]
    prior = model.compile_logp(vars=[model["heavy_tails_inverse_nu"]])
    ends = [
        end + float(prior(point | {name: point[name] + h}))
        for end, h in zip(ends, (1e-5, -1e-5), strict=True)
    ]
    assert gradient.item() == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)


def test_without_parameters_there_is_no_tail(model) -> None:
    problem = problem_in(model)
    with pytest.raises(ParameterError, match="give phi"):
        problem.log_density(np.zeros_like(problem.observations.values), SIGMA)


def test_predictive_draws_have_the_tail(model) -> None:
    # the share of draws beyond 4 sigma is 0.028 for 3 degrees of freedom
    problem = problem_in(model)
    phi = problem.layout.to_vector(CART | {"heavy_tails_inverse_nu": 1 / 3})
    rng = np.random.default_rng(0)
    states = problem.predict(phi)
    drawn = np.stack([problem.next_states(states, SIGMA, rng, phi) for _ in range(20)])
    z = (drawn - states[..., problem.observations.columns]) / SIGMA
    share = (np.abs(z) > 4).mean()
    assert share == pytest.approx(2 * stats.t.sf(4, 3), rel=0.1)  # 36,000 draws: sd 3 %


def test_the_mode_finds_the_tail_and_the_mass(model) -> None:
    problem = problem_in(model)
    phi = problem.layout.to_vector(CART | {"heavy_tails_inverse_nu": 0.02, "mass": 9.0})
    mode = find_mode(problem, initial=phi)
    place = problem.layout.index("heavy_tails_inverse_nu", "cart")
    sd = np.sqrt(mode.covariance[place, place])
    assert 0.005 < sd < 0.06
    assert mode.phi[place] == pytest.approx(1 / 3, abs=3 * sd)
    assert mode.sigma == pytest.approx(SIGMA, rel=0.3)  # 4 sd of 300 measurements each
    best = log_posterior(problem, mode.phi, mode.sigma)
    for other in (0.15, 0.6):
        moved = mode.phi.copy()
        moved[place] = other
        assert log_posterior(problem, moved, mode.sigma) < best


def test_a_tail_of_ones_own() -> None:
    parameters = (EffectParameter("share", "1", Prior("half_normal", sigma=0.1)),)
    mine = Effect("fat", parameters, "tails of my own", "a test", Noise(lambda v: 2.0 * v["share"]))
    scene = cart_scene()
    history = simulated_history(scene, CART, seed=1, trajectories=2)
    problem = problem_in(physics_model(scene, history, [mine]))
    phi = problem.layout.to_vector(CART | {"fat_share": 0.1})
    assert np.ravel(problem.nu(phi)) == pytest.approx([5.0])
