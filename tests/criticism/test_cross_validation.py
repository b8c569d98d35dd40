"""Cross-validation by one Newton step: what refits without each fold say."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import logsumexp

from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.cross_validation import Change, folds, leave_out
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, along_trajectories, log_prior
from pbrl_ppl.modes import Mode, find_mode, trajectory_mode
from pbrl_ppl.modes.laplace import LocalMode, finish
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Scene
from tests.helpers.free_puck import DISC, Disc

pytestmark = pytest.mark.one_stack

DRAGGED = DISC.with_effects("puck", "linear_drag")
#: Eight recordings of six intervals, the truth with a drag that shows.
DATA = Disc(trajectories=8, intervals=6, drag=0.3)
FRAME = DATA.frame(np.random.default_rng(4))


@cache
def mode(scene: Scene, trajectories: int = 8) -> Mode:
    history = History.from_dataframe(FRAME[FRAME["trajectory"] < trajectories], scene)
    problem = Problem.of(Physics.declare(scene), history)
    return trajectory_mode(problem, find_mode(problem, seed=1).phi)


def by_quadrature(mode: Mode, fold: np.ndarray) -> np.ndarray:
    """Log density of each fold under the posterior of the others, on a grid of all parameters.

    The noise is that which the others give.
    """
    problem, p = mode.problem, len(mode.phi)
    # seven standard deviations either way, four or more points to each
    axes = np.meshgrid(*[np.linspace(-7, 7, 61)] * p, indexing="ij")
    grid = np.stack([axis.ravel() for axis in axes], axis=1)
    phi = mode.phi + grid @ mode.factor.T
    residuals = [problem.residual(x) for x in phi]
    prior = np.array([log_prior(problem, x, mode.sigma) for x in phi])
    result = []
    for f, sigma in enumerate(leave_out(mode, fold).sigma):
        density = np.array(
            [problem.log_density(r, sigma, x) for r, x in zip(residuals, phi, strict=True)]
        )
        rest = density[:, fold != f].sum(axis=1) + prior
        rest -= logsumexp(rest)
        result.append(logsumexp(rest + density[:, fold == f].sum(axis=1)))
    return np.array(result)


def by_refits(mode: Mode, scene: Scene, fold: np.ndarray) -> np.ndarray:
    """The same by a fit without each trajectory, noise and all, and draws of its posterior."""
    rng = np.random.default_rng(5)
    history, coordinates = mode.problem.data.history, mode.problem.trajectory_noise.coordinates
    result = []
    for f in range(fold.max() + 1):
        rest = history.select([t for t in range(fold.max() + 1) if t != f])
        fitted = trajectory_mode(Problem.of(Physics.declare(scene), rest), mode.phi)
        held = fitted.problem.with_data(history=history.select([f]), states=None)
        held = along_trajectories(held, fitted.phi, fitted.sigma, coordinates)
        drawn = [
            held.log_density(held.residual(phi), fitted.sigma, phi).sum()
            for phi in fitted.draws(rng, 200)
        ]
        result.append(logsumexp(drawn) - np.log(200))
    return np.array(result)


@pytest.mark.parametrize("scene", [DISC, DRAGGED], ids=["mass", "mass-and-drag"])
def test_one_step_is_the_integral_over_all_parameters(scene) -> None:
    own = mode(scene)
    fold = folds(own)
    # of log densities of about 125 a fold
    np.testing.assert_allclose(leave_out(own, fold).density, by_quadrature(own, fold), atol=0.01)


def test_one_step_is_near_a_fit_without_each_trajectory() -> None:
    own = mode(DRAGGED)
    fold = folds(own)
    quick, slow = leave_out(own, fold).density, by_refits(own, DRAGGED, fold)
    # with the noise of all data, which knows the fold, it was 0.3 to 1.4 too high in the mean
    assert (np.abs(quick - slow) < 2.5).all()
    assert abs((quick - slow).mean()) < 0.3


def test_the_gain_of_an_effect_is_that_of_refits() -> None:
    without, with_drag = mode(DISC), mode(DRAGGED)
    fold = folds(with_drag)
    gain = leave_out(with_drag, fold).density - leave_out(without, fold).density
    refitted = by_refits(with_drag, DRAGGED, fold) - by_refits(without, DISC, fold)
    # 60 against 69 and a standard error of 15: without the drag, noise grows with the fold
    assert gain.sum() > 20
    assert abs(gain.sum() - refitted.sum()) < Change.of(gain).error


def test_trajectories_are_folds_and_few_of_them_are_cut() -> None:
    fold = folds(mode(DISC))
    np.testing.assert_array_equal(fold, mode(DISC).problem.segments.trajectory)
    short = mode(DISC, 3)
    runs, segments = folds(short), short.problem.segments
    assert len(np.unique(runs)) >= DEFAULT.selection.least_trajectories
    for run in np.unique(runs):  # of neighbours in one trajectory
        own = runs == run
        assert len(np.unique(segments.trajectory[own])) == 1
        assert (np.diff(segments.step[own]) == 1).all()


def test_where_a_climb_ended_near_the_top_changes_nothing() -> None:
    """A step of one standard deviation off: what one fold alone knew of was once charged for it."""
    own = mode(DRAGGED)
    fold = folds(own)
    expected = leave_out(own, fold).density
    for direction in own.factor.T:
        moved = replace(own, phi=own.phi + direction)
        peak = LocalMode(moved.phi, own.sigma, 0.0)
        moved = replace(moved, jacobian=finish(own.problem, peak).jacobian)
        # the noise of other folds is estimated where the climb ended: 0.13 was measured
        np.testing.assert_allclose(leave_out(moved, fold).density, expected, atol=0.2)


def test_a_parameter_at_its_bound_is_held_there() -> None:
    """A drag that data without one would make negative costs no more than none."""
    still = Disc(trajectories=8, intervals=6, drag=-0.1).frame(np.random.default_rng(6))
    modes = []
    for scene in (DISC, DRAGGED):
        problem = Problem.of(Physics.declare(scene), History.from_dataframe(still, scene))
        modes.append(trajectory_mode(problem, find_mode(problem, seed=1).phi))
    fold = folds(modes[0])
    gain = leave_out(modes[1], fold).density - leave_out(modes[0], fold).density
    assert abs(gain.sum()) < 3.0


def test_runs_of_a_trajectory_are_refitted_too() -> None:
    short = mode(DISC, 3)
    fold = folds(short)
    # without the drag the fit is bent: 0.03 was measured
    np.testing.assert_allclose(leave_out(short, fold).density, by_quadrature(short, fold), atol=0.1)


def test_folds_are_worth_less_than_the_fit_says() -> None:
    """What was left out is never foreseen better than what was fitted, on the whole."""
    own = mode(DRAGGED)
    fold = folds(own)
    density = own.problem.log_density(own.problem.residual(own.phi), own.sigma, own.phi)
    assert leave_out(own, fold).density.sum() < density.sum()


def test_standard_error_is_that_of_a_sum() -> None:
    gains = np.array([1.0, 2.0, 4.0, 5.0])
    assert Change.of(gains).total == 12.0
    assert Change.of(gains).error == pytest.approx(2 * gains.std(ddof=1))
    assert Change.of(gains[:1]).error == np.inf
