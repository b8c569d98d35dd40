"""Held-out errors: what they cost, and what they refuse."""

import numpy as np
import pytest

from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import find_mode
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

PUCK = Scene(
    time_step=0.1, bodies=(Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}),)
)


@pytest.fixture(scope="module")
def histories() -> tuple[History, History]:
    return tuple(simulated_history(PUCK, {"mass": 2.0}, seed=seed) for seed in (1, 2))


def test_start_noise_is_linearised_once_for_each_mode_and_horizon(histories, monkeypatch) -> None:
    train, test = histories
    problem = Problem.of(PUCK, train, substeps=5)
    before, after = find_mode(problem, seed=1), find_mode(problem.with_noise(nu=4.0), seed=1)
    seen: list[tuple[float, int]] = []
    sensitivity = Problem.sensitivity

    def counted(problem, phi, *options):
        seen.append((float(phi[0]), problem.data.horizon))
        return sensitivity(problem, phi, *options)

    monkeypatch.setattr(Problem, "sensitivity", counted)
    held_out = HeldOut(test, seed=1)
    gains = held_out.gains(before, after)
    np.testing.assert_array_equal(held_out.gains(before, after), gains)
    held_out.fall(before, after)
    held_out.residuals(before, after)
    held_out.noise_floor(after, 5)
    assert len(seen) == len(set(seen)) == 3  # both modes one step ahead, and the later one five


def test_other_dimensions_are_refused(histories) -> None:
    train, test = histories
    mode = find_mode(Problem.of(PUCK, train, substeps=5), seed=1)
    frame = test.to_dataframe().drop(columns="omega")
    blind = History.from_dataframe(frame, PUCK, estimate_velocities=True)
    with pytest.raises(HistoryError, match=r"test history measures x, y, theta, vx, vy, the"):
        HeldOut(blind, seed=1).gains(mode, mode)
