"""First guesses of a sampler's proposals."""

from types import SimpleNamespace

import numpy as np
import pytest

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import find_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.sampling import starts
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

MODE = SimpleNamespace(sigma=None)
COVARIANCE = np.array([[1.0, 0.24], [0.24, 0.09]])


def gaussian(problem, u, sigma):
    """Log-density of a correlated Gaussian with standard deviations of 1 and 0.3."""
    return -0.5 * np.einsum("...i,ij,...j->...", u, np.linalg.inv(COVARIANCE), u)


@pytest.mark.one_stack
def test_a_gaussian_s_covariance_stays_as_it_is(monkeypatch) -> None:
    monkeypatch.setattr(starts, "_log_density", gaussian)
    found = starts.widened(None, MODE, np.zeros(2), COVARIANCE)
    np.testing.assert_array_equal(found, COVARIANCE)


@pytest.mark.one_stack
def test_it_is_widened_where_the_posterior_falls_off_more_slowly(monkeypatch) -> None:
    """A bump at the top is ten times as narrow as the hill, on one side or on both."""
    narrow = np.diag([0.01, 0.01])

    def bumps(problem, u, sigma):
        wide = -0.5 * (u**2).sum(axis=-1)
        steep = np.where(u[:, 1] > 0, -0.5 * 99 * u[:, 1] ** 2, 0.0)
        return wide + steep + 1e-3 * np.exp(-50 * (u**2).sum(axis=-1))

    monkeypatch.setattr(starts, "_log_density", bumps)
    found = np.sqrt(np.diag(starts.widened(None, MODE, np.zeros(2), narrow)))
    assert 0.5 < found[0] < 2.0  # 1
    assert 0.3 < found[1] < 1.0  # 1 on one side, 0.1 on the other


@pytest.mark.one_stack
def test_its_density_is_that_of_the_model_in_the_sampler_s_space() -> None:
    """But for a constant, which is that of the likelihood."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=6)
    problem = Problem.of(Physics.declare(scene), history)
    mode = find_mode(problem, seed=1)
    pairs = [starts.unconstrain(p, x) for p, x in zip(problem.layout.priors, mode.phi, strict=True)]
    u = np.array(pairs)[:, 0] + 0.01 * np.random.default_rng(1).standard_normal((4, len(pairs)))
    told = starts._log_density(problem, u, mode.sigma)
    for point, value in zip(u, told, strict=True):
        phi = np.array(
            [starts.constrain(p, x) for p, x in zip(problem.layout.priors, point, strict=True)]
        )
        slopes = [
            (starts.constrain(p, x + 1e-6) - starts.constrain(p, x - 1e-6)) / 2e-6
            for p, x in zip(problem.layout.priors, point, strict=True)
        ]
        density = problem.log_density(problem.residual(phi), mode.sigma).sum()
        expected = density + problem.layout.log_prior(phi).sum() + np.log(slopes).sum()
        assert value == pytest.approx(expected, rel=1e-6)


@pytest.mark.one_stack
def test_there_is_no_density_where_numbers_end() -> None:
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    history = simulated_history(scene, CART, seed=7, trajectories=2, intervals=3)
    problem = Problem.of(Physics.declare(scene), history)
    far = np.full((2, problem.layout.size), [[1e4], [-1e4]])
    assert (starts._log_density(problem, far, np.ones(6)) == -np.inf).all()
    nothing = starts.widened(problem, MODE, np.zeros(0), np.zeros((0, 0)))
    assert nothing.shape == (0, 0)
