"""Output-error likelihood: initial states are eliminated exactly, correlation is measured."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    Problem,
    first_states,
    in_pieces,
    linearised_pieces,
)
from pbrl_ppl.modes import fit_pieces
from pbrl_ppl.physics import Physics
from tests.helpers.falls import BALL, GRAVITY, fall

pytestmark = pytest.mark.one_stack  # nothing is sampled here


@pytest.fixture(scope="module")
def history() -> History:
    return fall(0, trajectories=3, memory=0.0)


def pieces(history: History, length: int) -> Problem:
    problem = Problem.of(Physics(BALL), history)
    return in_pieces(problem, length, first_states(history))


def test_start_states_are_eliminated_exactly(history) -> None:
    """A fall is linear in its start: the projection leaves what a regression on 1 and t leaves."""
    problem = fit_pieces(pieces(history, 44), np.zeros(0)).problem
    sigma = np.array([0.01])
    z = problem.likelihood.whiten(problem.residual(np.zeros(0)), sigma)
    y = history.dataset["observed"].to_numpy()[:, :, 0, 1]
    t = np.arange(45) / 30
    basis = np.column_stack([np.ones(45), t])
    own = y + 0.5 * GRAVITY * t**2
    left = own - (basis @ np.linalg.lstsq(basis, own.T)[0]).T
    tau = problem.likelihood.tau[0]
    assert (z**2).sum() == pytest.approx((left**2).sum() / 0.01**2 / tau, rel=1e-6)


def test_a_velocity_recorded_at_the_start_alone_is_given(history) -> None:
    """Released from rest, says the first row: what is left is that of a regression on 1 alone."""
    frame = history.to_dataframe()
    frame.loc[frame["step"] == 0, ["vx", "vy", "omega"]] = 0.0
    problem = fit_pieces(pieces(History.from_dataframe(frame, BALL), 44), np.zeros(0)).problem
    initial_states = problem.likelihood.initial_states
    assert initial_states.given[:, initial_states.coordinates.places == 4].all()
    sigma = np.array([0.01])
    z = problem.likelihood.whiten(problem.residual(np.zeros(0)), sigma)
    own = history.dataset["observed"].to_numpy()[:, :, 0, 1]
    own = own + 0.5 * GRAVITY * (np.arange(45) / 30) ** 2
    left = own - own.mean(axis=1, keepdims=True)
    tau = problem.likelihood.tau[0]
    assert (z**2).sum() == pytest.approx((left**2).sum() / 0.01**2 / tau, rel=1e-6)


def test_noise_is_not_underestimated_on_short_pieces() -> None:
    """Pieces of 4 intervals give two of five rows to their start: sigma is unbiased all the same.

    600 degrees of freedom: the interval of four standard errors is missed once in 16,000.
    """
    own = fall(3, trajectories=25, memory=0.0)
    truth = 0.01
    mode = fit_pieces(pieces(own, 4), np.zeros(0))
    freedom = mode.problem.likelihood.initial_states.counts.sum()
    assert 0.5 < freedom / own.n_transitions < 0.8
    assert np.log(mode.sigma[0] / truth) == pytest.approx(0.0, abs=4 / np.sqrt(2 * freedom))


def test_the_result_does_not_depend_on_the_start_states(history) -> None:
    """Initial states elsewhere, of a linear motion: the same whitened residual."""
    problem = fit_pieces(pieces(history, 44), np.zeros(0)).problem
    likelihood = problem.likelihood
    moved = problem.segments.start + np.array([0.0, 0.3, 0.0, 0.0, -0.7, 0.0])
    other = linearised_pieces(
        problem, moved, likelihood.initial_states.slope, np.array(likelihood.tau)
    )
    sigma = np.array([0.01])
    here, there = (
        own.likelihood.whiten(own.residual(np.zeros(0)), sigma) for own in (problem, other)
    )
    assert there == pytest.approx(here, abs=1e-6)


def test_pieces_cover_every_row_once(history) -> None:
    segments = pieces(history, 16).segments
    assert segments.start.shape == (9, 1, 6)  # 44 intervals: 16, 16 and 12
    seen = np.isfinite(segments.observed[..., 1]).sum()
    assert seen == 3 * 44


def test_a_short_rest_is_left_out() -> None:
    assert pieces(fall(0, rows=20), 16).segments.n == 1  # 3 of 16 intervals are left


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_the_correlation_time_is_that_of_the_errors(memory) -> None:
    """Of an AR(1) process it is (1 + a) / (1 - a); the estimate of 40 long ones is within 15 %."""
    history = fall(0, trajectories=2)
    problem = replace(pieces(history, 44))
    likelihood = problem.likelihood
    rng = np.random.default_rng(1)
    n = 400
    error = lfilter([1.0], [1.0, -memory], rng.standard_normal((40, n + 100)))[:, 100:]
    initial_states = replace(
        likelihood.initial_states,
        seen=np.ones((40, n, 1, 1), dtype=bool),
        slope=np.zeros((40, n, 1, 1, likelihood.initial_states.slope.shape[-1])),
        begin=np.full((40, likelihood.initial_states.begin.shape[1]), np.nan),
        given=np.zeros((40, likelihood.initial_states.begin.shape[1]), dtype=bool),
    )
    times = replace(likelihood, initial_states=initial_states).correlation_times(
        error[:, :, None, None], np.ones(1)
    )
    assert times[0] == pytest.approx((1 + memory) / (1 - memory), rel=0.15)
