"""What is left is tested: each test is calibrated on clean data, and sees what it is there for.

The clean data are of a law in closed form, made of recordings with noise on every state.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.innovations import (
    UnexplainedAcceleration,
    _kernels,
    noise_alone,
    unexplained_acceleration,
)
from pbrl_ppl.criticism.misfit import find_misfit
from pbrl_ppl.criticism.results import KindOfTest, ResidualTest
from tests.helpers.free_puck import BOX, DISC, Disc, box2d, fitted
from tests.helpers.histories import NOISE

pytestmark = pytest.mark.one_stack

#: Chance that each fails on clean data, as stated; the permutation test has a level of its own.
RATES = dict.fromkeys(
    (KindOfTest.ACCELERATION, KindOfTest.WHITENESS, KindOfTest.COMMANDS, KindOfTest.FORECASTS),
    DEFAULT.false_alarm,
)
RATES |= {KindOfTest.DEPENDENCE: 0.01}
#: Engine steps that leave nothing of an engine's error.
FINE = DISC.replace(substeps=40)


def misfit(mode, seed=0):
    return find_misfit(mode, unexplained_acceleration(mode), horizon=10, seed=seed)


def failed(mode):
    return {test.name for test in misfit(mode).tests if not test.passed}


@pytest.mark.long
@pytest.mark.parametrize(("trajectories", "intervals"), [(4, 12), (4, 5), (1, 10), (3, 2), (1, 4)])
def test_each_fails_on_clean_data_no_more_often_than_it_says(trajectories, intervals) -> None:
    rng = np.random.default_rng(5)
    failures = dict.fromkeys(RATES, 0)
    for i in range(100):
        if i % 20 == 0:  # five sets of commands, which are held for up to three intervals
            disc = Disc(trajectories, intervals, FINE, hold=1 + i // 20 % 3, seed=i)
        for test in misfit(disc.mode(rng), seed=i).tests:
            failures[test.name] += not test.passed
    for name, count in failures.items():
        # more failures than this come by chance in one of a thousand
        assert count <= binom.isf(0.001, 100, RATES[name]), (name, count)


def test_clean_data_of_another_engine_pass(make_history) -> None:
    found = misfit(fitted(BOX, box2d(make_history, 3)[0]))
    assert found.unexplained is None
    assert not found.predicts(DEFAULT)  # a test that is missing is not passed
    for kind in (KindOfTest.HELD_OUT, KindOfTest.SIMULATION):
        found = replace(
            found, tests=(*found.tests, ResidualTest(kind, 0.5, 0.0, True, "as expected"))
        )
    assert found.predicts(DEFAULT)
    far_off = ResidualTest(KindOfTest.SIMULATION, 0.5, 9.0, False, "far off")
    failed = replace(found, tests=(*found.tests, far_off))
    assert not failed.predicts(DEFAULT)
    assert {test.name for test in found.tests if test.tested} == {
        *RATES,
        KindOfTest.HELD_OUT,
        KindOfTest.SIMULATION,
    }


def test_trajectories_shorter_than_the_lags_are_tested() -> None:
    for intervals in range(1, 7):
        mode = Disc(1, intervals, FINE).mode(np.random.default_rng(1))
        tested = {test.name for test in misfit(mode).tests if test.tested}
        assert tested == {
            KindOfTest.ACCELERATION,
            KindOfTest.FORECASTS,
        }  # the data cannot fail the others


def test_forecasts_of_few_intervals_are_as_good_as_their_noise() -> None:
    """Six do not tell errors of measuring from what a step adds: a third of such data failed."""
    rng = np.random.default_rng(5)
    disc = Disc(2, 3, FINE)
    for _ in range(4):
        mode = disc.mode(rng)
        left = unexplained_acceleration(mode)
        assert KindOfTest.FORECASTS not in failed(mode)
        # and the floor of the report is one that the disc's sensors can have
        assert (noise_alone(mode, left)[:6] > 0.1 * np.array(NOISE)).all()


def test_a_disturbance_without_memory_is_an_acceleration() -> None:
    """It is independent of all there is: that it is there is all that can be said."""
    rng = np.random.default_rng(7)
    disc = Disc(8, 15, FINE)
    size = 0.3  # m/s^2
    mode = disc.mode(rng, size * rng.normal(size=disc.pushes.shape))
    left = unexplained_acceleration(mode)
    assert KindOfTest.ACCELERATION in failed(mode)
    assert KindOfTest.WHITENESS not in failed(mode)
    # 240 steps of each velocity, of which the noise of the speed hides little: 20 % is 4 sd
    np.testing.assert_allclose(left.size[:2], size, rtol=0.2)
    assert left.worst > 2 * DEFAULT.negligible


def disturbed(relative, p_value):
    """A misfit with a disturbance without memory, and these shares and p-values."""
    disc = Disc(8, 15, FINE)
    rng = np.random.default_rng(7)
    mode = disc.mode(rng, 0.3 * rng.normal(size=disc.pushes.shape))
    left = unexplained_acceleration(mode)
    left = replace(left, relative=np.array(relative), p_value=np.array(p_value))
    return find_misfit(mode, left, horizon=10), left


def test_body_dimension_and_size_of_what_remains_have_one_source() -> None:
    """The largest of those that are significant; a larger one that may be noise is not named."""
    found, left = disturbed([0.1, 0.2, 0.9], [1e-9, 1e-9, 0.5])
    test, remains = found.tests[0], found.unexplained
    assert (test.name, test.body, test.dimension) == (KindOfTest.ACCELERATION, "puck", "vy")
    assert (remains.body, remains.dimension, remains.share) == ("puck", "vy", 0.2)
    assert remains.sentence == test.sentence
    assert test.sentence == (
        f"an acceleration of {left.size[1]:.2g} m/s² in vy of puck is unexplained in each"
        " interval, 20 % of the bodies' acceleration"
    )


def test_bodies_that_hardly_accelerate_have_no_share_of_it() -> None:
    found, left = disturbed([300.6, 0.2, 0.1], [1e-9, 1e-9, 0.5])
    assert found.unexplained.sentence == (
        f"an acceleration of {left.size[0]:.2g} m/s² in vx of puck is unexplained in each interval,"
        " more than the bodies' acceleration itself"
    )


def test_what_engines_differ_by_is_no_misfit() -> None:
    """Half of the engine's error is certain in enough data, and left alone; ten times is not."""
    sizes = np.array([0.02, 0.02, 0.02])
    left = UnexplainedAcceleration(
        ("vx", "vy", "omega"), sizes, sizes / 2.0, np.full(3, 1e-9), 0.5 * sizes
    )
    assert left.certain.all()
    assert not left.matters.any()
    coarse = replace(left, numerical=np.array([0.5, 0.1, 0.5]) * sizes)
    np.testing.assert_array_equal(coarse.matters, [False, True, False])
    few = replace(coarse, p_value=np.full(3, 0.1))
    assert not few.matters.any()


def test_the_engines_error_falls_with_its_steps() -> None:
    """A drag's exponential, in steps whose error is of third order once extrapolated."""
    disc = Disc(8, 15, FINE.with_effects("puck", "linear_drag"), drag=0.3)
    mode = disc.mode(np.random.default_rng(7))

    def numerical(substeps: int) -> np.ndarray:
        problem = mode.problem.with_physics(substeps=substeps)
        return unexplained_acceleration(replace(mode, problem=problem)).numerical[:2]

    coarse, fine = numerical(4), numerical(8)
    assert (coarse > 0).all()
    assert (fine < coarse / 4).all()


def test_a_disturbance_that_lasts_is_correlated_with_itself() -> None:
    rng = np.random.default_rng(8)
    disc = Disc(8, 15, FINE)
    drawn = 0.3 * rng.normal(size=disc.pushes.shape)
    for k in range(1, disc.intervals):
        drawn[:, k] = 0.9 * drawn[:, k - 1] + np.sqrt(1 - 0.9**2) * drawn[:, k]
    found = misfit(disc.mode(rng, drawn))
    assert {KindOfTest.ACCELERATION, KindOfTest.WHITENESS} <= {
        test.name for test in found.tests if not test.passed
    }
    assert found.unexplained is not None


def test_a_late_command_is_an_error_that_follows_commands(make_history) -> None:
    mode = fitted(BOX, box2d(make_history, 3, actuator_delay=0.4)[0])
    found = misfit(mode)
    names = {test.name for test in found.tests if not test.passed}
    assert {KindOfTest.ACCELERATION, KindOfTest.COMMANDS, KindOfTest.DEPENDENCE} <= names
    assert "command" in found.unexplained.depends_on
    assert not found.predicts(DEFAULT)


def test_a_spring_that_is_not_in_the_scene_fails_all_that_look_at_states(make_history) -> None:
    train, _ = box2d(make_history, 3, trajectories=12, intervals=30, spring=(0.5, 1.0, -0.5))
    mode = fitted(BOX, train)
    found = misfit(mode)
    names = {test.name for test in found.tests if not test.passed}
    assert {
        KindOfTest.ACCELERATION,
        KindOfTest.WHITENESS,
        KindOfTest.FORECASTS,
        KindOfTest.DEPENDENCE,
    } <= names
    assert found.unexplained.body == "puck"
    assert found.unexplained.depends_on.startswith("position")


def test_a_force_that_takes_two_quantities_depends_on_their_product(make_history) -> None:
    """Magnus: neither the spin nor the speed says anything of it alone."""
    train, _ = box2d(make_history, 3, trajectories=20, intervals=10, magnus_force=0.15)
    found = misfit(fitted(BOX, train))
    assert KindOfTest.DEPENDENCE in {test.name for test in found.tests if not test.passed}
    assert found.unexplained.depends_on.startswith("angular speed × ")
    assert found.unexplained.dimension in ("forward speed", "sideways speed")


def test_equal_quantities_are_as_close_as_can_be() -> None:
    """A torque that is mostly zero says nothing of the order of the rows."""
    (kernel,) = _kernels(np.array([[0.0], [0.0], [2.0], [0.0]]))
    np.testing.assert_array_equal(kernel[0], kernel[3])
    assert kernel[0, 0] == kernel[0, 3] == 1.0 > kernel[0, 2]


def test_same_seed_same_tests(make_history) -> None:
    mode = fitted(BOX, box2d(make_history, 3)[0])
    assert misfit(mode, seed=2).tests == misfit(mode, seed=2).tests
