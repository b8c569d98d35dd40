"""Held-out data: they judge and choose nothing, and forecasts' errors have the floor that is said.

One loop on a free puck with drag, and the same with another test history.
"""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism import close_loop
from pbrl_ppl.criticism.held_out import HeldOut, forecast
from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE
from tests.helpers.free_puck import BOX, DISC, Disc, box2d, fitted
from tests.helpers.histories import NOISE

# a posterior of few draws is enough to test a verdict, and says that it is one
pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")

#: Enough to choose among, and quickly ranked.
CATALOGUE = tuple(e for e in catalogue if e.scan is None)


def history(frame, scene: Scene = BOX) -> History:
    return History.from_dataframe(frame, scene)


@pytest.fixture(scope="module")
def frames(make_history):
    return box2d(make_history, 5, linear_drag=0.3)


@pytest.fixture(scope="module")
def loops(frames, make_history):
    """Findings on one training history, judged by two test histories."""
    train = history(frames[0])
    _, other = box2d(make_history, 6, linear_drag=0.3)
    options = {"catalogue": CATALOGUE, "seed": 1, "method": "laplace"}
    return tuple(close_loop(BOX, train, history(test), **options) for test in (frames[1], other))


@pytest.mark.slow
def test_another_test_history_changes_reported_errors_alone(loops) -> None:
    first, second = loops
    assert first.verdict == second.verdict == "effects-added"
    assert [one.effect for one in first.added] == ["linear_drag"]
    one, other = first.to_dict(), second.to_dict()
    assert one.pop("error") != other.pop("error")
    hashes = [each["provenance"].pop("test_sha256") for each in (one, other)]
    assert hashes[0] != hashes[1]
    tests = [
        [t for t in each.pop("tests") if not t["name"].startswith("held-out")]
        for each in (one, other)
    ]
    assert tests[0] == tests[1]
    # all else is the same to the last digit, which says that the seed alone decides too
    assert one == other
    for before, after in (
        (first.posterior_before, second.posterior_before),
        (first.posterior_after, second.posterior_after),
    ):
        for name in before["posterior"].data_vars:
            np.testing.assert_array_equal(before["posterior"][name], after["posterior"][name])


@pytest.mark.slow
def test_the_revised_model_is_at_the_floor_and_the_declared_one_is_not(loops) -> None:
    found = loops[0]
    for velocity in ("vx", "vy"):
        floor = found.noise_floor.rollout_rmse[velocity]
        # 8 forecasts of a second: the root mean square has a standard error of a quarter
        assert found.after.rollout_rmse[velocity] < 2 * floor
        assert found.before.rollout_rmse[velocity] > 5 * floor
    assert found.after.elpd > found.before.elpd
    # 360 innovations: a standard error of 4 %
    assert found.after.normalised_rmse == pytest.approx(1.0, abs=0.16)


@pytest.mark.parametrize("intervals", [1, 5])
def test_forecasts_of_a_true_model_err_as_the_floor_says(intervals) -> None:
    """Known noise, a law in closed form: errors over the floor are one, cell by cell."""
    stated = dict(zip(STATE, NOISE, strict=True))
    scene = DISC.replace(substeps=40, noise=stated)
    disc = Disc(30, 10, scene)
    mode = disc.mode(np.random.default_rng(9))
    told = forecast(mode.problem, mode.phi, mode.sigma, intervals)
    error, floor = told.rmse(), told.floor()
    for name, size in error.items():
        # 60 forecasts or more, of which half overlap: 13 % is a standard error; 4 of them
        assert size == pytest.approx(floor[name], rel=0.5), name
    z = told.error**2 / told.variance
    # 6 cells of them: 5 % is a standard error
    assert z.mean() == pytest.approx(1.0, abs=0.25)


def test_the_floor_is_of_the_noise_of_measuring_and_grows_with_the_length() -> None:
    scene = DISC.replace(noise=dict(zip(STATE, NOISE, strict=True)))
    mode = Disc(8, 15, scene).mode(np.random.default_rng(9))
    one, ten = (forecast(mode.problem, mode.phi, mode.sigma, n).floor() for n in (1, 10))
    for name, error in zip(STATE, NOISE, strict=True):
        assert error < one[name] < 1.5 * error
        assert one[name] <= ten[name]
    assert ten["x"] > 1.2 * one["x"]  # the error of the speed, over a second


def test_a_forecast_of_an_unstable_motion_has_no_finite_floor() -> None:
    """Its derivatives grow beyond the numbers within a forecast; no warning."""
    mode = Disc(4, 15, DISC).mode(np.random.default_rng(9))
    noise = mode.problem.likelihood.noise
    unstable = mode.problem.along(replace(noise, slope=-1e60 * noise.slope))
    allowed = np.full(3, 1e-3)
    told = forecast(unstable, mode.phi, mode.sigma, 10, allowed=allowed)
    assert np.isposinf(told.variance).any() and not np.isnan(told.variance).any()


def test_a_mode_is_judged_by_other_data_at_the_same_noise(frames) -> None:
    mode = fitted(BOX, frames[0])
    problem = HeldOut.of(mode, history(frames[1])).problem
    assert problem.data.history.n_trajectories == 4
    assert problem.likelihood.noise.coordinates is mode.problem.likelihood.noise.coordinates
    np.testing.assert_array_equal(problem.noise_prior[0], mode.problem.noise_prior[0])


class Begun(Exception):
    """Something was done with the histories."""


def begin(stage: str) -> None:
    raise Begun(stage)


def refused(scene: Scene, train: History, test: History) -> str:
    """The message with which they are, before the loop says that it does anything."""
    with pytest.raises(HistoryError) as caught:
        close_loop(scene, train, test, progress=begin)
    return str(caught.value)


def test_histories_that_fit_are_not_refused(frames) -> None:
    with pytest.raises(Begun):
        close_loop(BOX, *map(history, frames), progress=begin)


def test_other_bodies_are_refused_at_once(frames) -> None:
    other = BOX.replace(bodies=(replace(BOX.bodies[0], name="sledge"),))
    sledge = history(frames[1].assign(body="sledge"), other)
    assert "test history: it is of sledge, the scene has puck" in refused(
        BOX, history(frames[0]), sledge
    )
    assert "training history: it is of sledge" in refused(BOX, sledge, history(frames[0]))


def test_another_time_step_is_refused_at_once(frames) -> None:
    slow = frames[1].assign(time=2 * frames[1]["time"])
    slow = history(slow, BOX.replace(time_step=0.2))
    said = refused(BOX, history(frames[0]), slow)
    assert "test history: it has a row each 0.2 s, the scene each 0.1 s" in said


def test_other_dimensions_are_refused_at_once(frames) -> None:
    blind = History.from_dataframe(frames[0].drop(columns="omega"), BOX, estimate_velocities=True)
    said = refused(BOX, blind, history(frames[1]))
    assert "test history measures omega of puck, which the training history does not" in said


def test_a_test_history_may_measure_less(frames) -> None:
    blind = History.from_dataframe(frames[1].drop(columns="omega"), BOX, estimate_velocities=True)
    with pytest.raises(Begun):
        close_loop(BOX, history(frames[0]), blind, progress=begin)
    mode = fitted(BOX, frames[0])
    told = HeldOut.of(mode, blind).noise_floor(mode.sigma, 5)
    assert set(told.one_step_rmse) == set(STATE) - {"omega"}
