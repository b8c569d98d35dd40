"""Eqs. 11 and 12: numpy and scipy say the same, and draws have the covariance claimed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import Segments
from pbrl_ppl.likelihood import (
    Observations,
    TransitionLikelihood,
    estimate_sigma,
    next_state_random,
)
from tests.helpers.carts import cart_scene

EQ_11 = TransitionLikelihood()
N, H, K = 7, 2, 2
COLUMNS = (0, 2, 5)  # x, theta, omega
D = len(COLUMNS)
CELLS = H * K * D
SIGMA = np.array([0.1, 0.3, 0.7])


def case(seed: int = 0, missing: bool = True):
    """Observations (N, H, K, D), some cells missing, and predictions (N, H, K, 6)."""
    rng = np.random.default_rng(seed)
    predicted = rng.normal(0.0, 1.0, (N, H, K, 6))
    values = predicted[..., COLUMNS] + rng.normal(0.0, 1.0, (N, H, K, D)) * SIGMA
    if missing:
        values[rng.random(values.shape) < 0.2] = np.nan
        values[0, :, 0, 1] = np.nan
    return Observations(values, COLUMNS), predicted


def test_plain_equals_scipy() -> None:
    observations, predicted = case()
    residual = observations.residual(predicted)
    ours = EQ_11.log_density(residual, SIGMA, observations.measured, None)
    # the difference of angles is at most a few sigma here: wrapping it into (-pi, pi] is a no-op
    cells = stats.norm(predicted[..., COLUMNS], SIGMA).logpdf(observations.values)
    np.testing.assert_allclose(ours, np.nansum(cells, axis=(1, 2, 3)))


def test_leading_axes_of_draws() -> None:
    """Residuals and sigmas of many draws at once give what each draw gives alone."""
    observations, predicted = case()
    moved = predicted + np.linspace(-0.1, 0.1, 4)[:, None, None, None, None]
    sigmas = SIGMA * np.array([0.5, 1.0, 1.5, 2.0])[:, None]
    seen = observations.measured
    together = EQ_11.log_density(observations.residual(moved), sigmas, seen, None)
    assert together.shape == (4, N)
    for i in range(4):
        alone = EQ_11.log_density(observations.residual(moved[i]), sigmas[i], seen, None)
        np.testing.assert_allclose(together[i], alone)


@given(turns=hnp.arrays(np.int64, (N, H, K), elements=st.integers(-50, 50)))
def test_full_turns_of_measured_angles_change_nothing(turns) -> None:
    observations, predicted = case()
    shifted = observations.values.copy()
    shifted[..., COLUMNS.index(2)] += 2 * math.pi * turns
    turned = Observations(shifted, COLUMNS)
    before = EQ_11.log_density(observations.residual(predicted), SIGMA, observations.measured, None)
    after = EQ_11.log_density(turned.residual(predicted), SIGMA, turned.measured, None)
    np.testing.assert_allclose(after, before, rtol=1e-9)


@given(
    measured=st.floats(-100.0, 100.0),
    predicted=st.floats(-100.0, 100.0),
)
def test_angle_residuals_are_wrapped(measured: float, predicted: float) -> None:
    """In (-pi, pi], and the measured angle is the predicted one turned by it."""
    observations = Observations(np.full((1, 1, 1, 1), measured), (2,))
    states = np.zeros((1, 1, 1, 6))
    states[..., 2] = predicted
    residual = observations.residual(states).item()
    assert -math.pi < residual <= math.pi
    assert math.cos(predicted + residual - measured) == pytest.approx(1.0, abs=1e-12)


def test_half_a_turn_is_plus_pi() -> None:
    observations = Observations(np.array([[[[-math.pi]]], [[[math.pi]]]]), (2,))
    np.testing.assert_array_equal(observations.residual(np.zeros((2, 1, 1, 6))).ravel(), math.pi)


def test_missing_cells_take_no_part() -> None:
    observations, predicted = case()
    residual, seen = observations.residual(predicted), observations.measured
    assert (residual[~seen] == 0.0).all()
    moved = predicted.copy()
    moved[..., COLUMNS] = np.where(seen, moved[..., COLUMNS], 99.0)
    np.testing.assert_array_equal(observations.residual(moved), residual)
    # the prediction of an unmeasured state dimension is not looked at
    moved[..., [1, 3, 4]] = np.nan
    np.testing.assert_array_equal(observations.residual(moved), residual)
    z = EQ_11.whiten(residual, SIGMA)
    np.testing.assert_array_equal(z.reshape(seen.shape)[~seen], 0.0)


def test_a_transition_with_nothing_measured_says_nothing() -> None:
    observations, predicted = case()
    values = observations.values.copy()
    values[3] = np.nan
    observations = Observations(values, COLUMNS)
    logp = EQ_11.log_density(observations.residual(predicted), SIGMA, observations.measured, None)
    assert logp[3] == pytest.approx(0.0, abs=1e-12)


def test_a_diverged_transition_is_impossible() -> None:
    observations, predicted = case()
    predicted[2] = np.nan
    ours = EQ_11.log_density(observations.residual(predicted), SIGMA, observations.measured, None)
    assert ours[2] == -np.inf
    assert np.isfinite(np.delete(ours, 2)).all()


def test_draws_have_the_covariance_claimed() -> None:
    _, predicted = case(missing=False)
    n_draws = 20_000
    mean = predicted[..., COLUMNS]
    tiled = np.broadcast_to(mean, (n_draws, *mean.shape))
    drawn = next_state_random(tiled, SIGMA, np.random.default_rng(3))
    assert drawn.shape == tiled.shape
    deviation = (drawn - mean).reshape(n_draws, N, CELLS)
    claimed = np.diag(np.tile(SIGMA, CELLS // D) ** 2)
    worst = 0.0
    for i in range(N):
        sample = deviation[:, i].T @ deviation[:, i] / n_draws
        variance = np.diag(claimed)
        error = np.sqrt((np.outer(variance, variance) + claimed**2) / n_draws)
        worst = max(worst, np.abs((sample - claimed) / error).max())
        z_mean = deviation[:, i].mean(axis=0) / np.sqrt(variance / n_draws)
        worst = max(worst, np.abs(z_mean).max())
    # 7 * (78 + 12) numbers within 5 standard errors: false alarm below 4e-4
    assert worst < 5.0


def test_whitened_draws_are_standard_normal() -> None:
    _, predicted = case(missing=False)
    tiled = np.broadcast_to(predicted[..., COLUMNS], (2000, N, H, K, D))
    drawn = next_state_random(tiled, SIGMA, np.random.default_rng(4))
    z = EQ_11.whiten(drawn - predicted[..., COLUMNS], SIGMA)
    assert z.shape == (2000, N, CELLS)
    # a false alarm once in 10 000 seeds
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-4


def test_estimate_sigma_recovers_the_noise() -> None:
    rng = np.random.default_rng(11)
    n = 400
    residual = rng.standard_normal((n, CELLS)) * np.tile(SIGMA, CELLS // D)
    measured = rng.random((n, CELLS)) < 0.9
    residual[~measured] = 0.0
    shape = (n, H, K, D)
    observations = Observations(np.where(measured, 0.0, np.nan).reshape(shape), tuple(range(D)))
    found = estimate_sigma(residual.reshape(shape), observations, cart_scene())
    # the Fisher information of log sigma is 2 a measured cell
    error = np.sqrt(0.5 / measured.reshape(shape).sum((0, 1, 2)))
    # 3 numbers within 4 standard errors: false alarm 2e-4
    assert (np.abs(np.log(found / SIGMA)) < 4 * error).all()


def test_estimate_sigma_without_noise_still_gives_a_scale() -> None:
    shape = (5, 1, 1, 2)
    observations = Observations(np.ones(shape), (0, 1))
    found = estimate_sigma(np.zeros(shape), observations, cart_scene())
    assert (found > 0).all()


def segments_of(observed: np.ndarray) -> Segments:
    n, h, k, _ = observed.shape
    return Segments(
        np.zeros((n, k, 6)),
        np.zeros((n, h, k, 3)),
        observed,
        np.zeros(n, dtype=int),
        np.arange(n),
        np.zeros((n, h, k, 9)),
    )


def test_observations_keep_the_measured_dimensions() -> None:
    observed = np.full((3, 1, 1, 6), np.nan)
    observed[..., 2] = [[[0.1]], [[np.nan]], [[0.3]]]
    observed[..., 5] = 1.0
    observations = Observations.of(segments_of(observed))
    assert observations.columns == (2, 5)
    assert observations.names == ("theta", "omega")
    assert observations.measured.sum() == 5


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_measured(n: int) -> None:
    with pytest.raises(HistoryError, match="no measured next state"):
        Observations.of(segments_of(np.full((n, 1, 1, 6), np.nan)))
