"""Verdicts that a reader can trust: nothing negligible alarms, and held-out errors agree.

The data are of closed forms: a disc that is pushed about, a fall through air seen by positions.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism import close_loop
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.innovations import find_dependence, unexplained_acceleration
from pbrl_ppl.criticism.misfit import find_misfit
from pbrl_ppl.criticism.refinement import with_enough_substeps
from pbrl_ppl.criticism.results import KindOfTest
from pbrl_ppl.effects import attach
from pbrl_ppl.likelihood import Problem, bodies_acceleration, smoothed
from pbrl_ppl.modes import Mode, find_mode, trajectory_mode
from pbrl_ppl.physics import Physics
from tests.helpers.free_puck import BOX, DISC, MASS, Disc, box2d, fitted, searched
from tests.helpers.histories import COLUMNS
from tests.helpers.places import MODELS, load

pytestmark = [
    pytest.mark.one_stack,
    # a posterior of few draws is enough to test a verdict, and says that it is one
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
    # a ball of which all is known but the drag cannot have fallen so
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.PriorWarning"),
]

FINE = DISC.replace(substeps=40)
#: Effects that are quickly ranked.
QUICK = tuple(effect for effect in pp.catalogue if effect.scan is None)


def quiet(stage: str) -> None:
    """Take no notice."""


# --- what is negligible ---


def missing(share: float, lasting: bool) -> Mode:
    """Mode of a disc pushed along x by this share of its acceleration beyond what is declared."""
    disc, rng = Disc(20, 30, FINE, hold=3), np.random.default_rng(3)
    size = share * float(np.sqrt((disc.pushes[..., :2] ** 2).sum(axis=-1).mean())) / MASS
    more = np.zeros(disc.pushes.shape)
    more[..., 0] = size if lasting else size * rng.standard_normal(more.shape[:2])
    return disc.mode(rng, more)


@pytest.mark.parametrize(("share", "lasting"), [(0.4, False), (0.2, True)])
def test_a_negligible_acceleration_passes_every_test(share, lasting) -> None:
    """One that lasts counts for more than one that is drawn again in each interval."""
    mode = missing(share * DEFAULT.negligible, lasting)
    left = unexplained_acceleration(mode)
    assert left.certain[0]
    assert find_misfit(mode, left, horizon=30, seed=1).unexplained is None


def test_one_that_is_not_negligible_fails() -> None:
    mode = missing(6.0 * DEFAULT.negligible, False)
    left = unexplained_acceleration(mode)
    assert left.worst == pytest.approx(6.0 * DEFAULT.negligible, rel=0.3)
    tests = find_misfit(mode, left, horizon=30, seed=1).tests
    assert KindOfTest.ACCELERATION in {test.name for test in tests if not test.passed}


def test_the_bodies_acceleration_does_not_depend_on_the_axes() -> None:
    """The same recording in a frame that is turned by 0.7 rad."""
    frame = Disc(4, 10, FINE).frame(np.random.default_rng(2))
    turned = frame.copy()
    c, s = np.cos(0.7), np.sin(0.7)
    for x, y in (("x", "y"), ("vx", "vy"), ("force_x", "force_y")):
        turned[x], turned[y] = c * frame[x] - s * frame[y], s * frame[x] + c * frame[y]
    sizes = [bodies_acceleration(fitted(FINE, each).problem) for each in (frame, turned)]
    np.testing.assert_allclose(*sizes, rtol=0.02)
    assert sizes[0][0] == sizes[0][1]


@pytest.mark.slow
def test_substeps_are_refined_until_the_acceleration_test_is_still() -> None:
    """Six trajectories of the demo: at 40 substeps the engine's own error alarmed, at 80 not."""
    scene, train, _ = load(MODELS / "shopping_cart", MODELS / "shopping_cart" / "recorded")
    few = train.select(range(6))
    effects = attach(scene, [e.on("cart") for e in pp.catalogue if e.name == "angular_drag"])
    problem = Problem.of(Physics(scene, effects, threads=2), few)
    mode = trajectory_mode(problem, find_mode(problem, seed=1).phi)
    found = with_enough_substeps(mode, quiet)
    assert not unexplained_acceleration(found).matters.any()


# --- the prior of an unexplained acceleration ---


def fall(seed: int, drag: float, trajectories: int = 1) -> pd.DataFrame:
    """A ball of 58 g that falls 2.7 s through air, its place seen to 4 mm at 15 Hz."""
    rng, dt, mass, g = np.random.default_rng(seed), 1 / 15, 0.0577, 9.81
    rate, time = drag / mass, dt * np.arange(42)
    gone = -np.expm1(-rate * time) / rate if rate else time
    rows = []
    for k in range(trajectories):
        vx, vy = 0.3 * rng.standard_normal(2)
        x = vx * gone
        y = 20.0 + vy * gone - g * ((time - gone) / rate if rate else time**2 / 2)
        places = np.stack([x, y], axis=1) + 0.004 * rng.standard_normal((42, 2))
        for i, (at, place) in enumerate(zip(time, places, strict=True)):
            wrench = [np.nan] * 3 if i == 41 else [0.0] * 3
            rows.append([k, i, at, "ball", *place, 0.0, *[np.nan] * 3, *wrench])
    return pd.DataFrame(rows, columns=COLUMNS)


AIR = pp.Scene(
    time_step=1 / 15,
    gravity=(0.0, -9.81),
    bodies=(
        pp.Body("ball", pp.Shape.circle(0.033), known={"mass": 0.0577, "r": 0.5, "mu_c": 0.3}),
    ),
)


def falls(seed: int, drag: float, trajectories: int = 1) -> pp.History:
    return pp.History.from_dataframe(fall(seed, drag, trajectories), AIR, estimate_velocities=True)


@pytest.mark.slow
@pytest.mark.parametrize("trajectories", [1, 4])
def test_drag_of_a_fall_that_positions_show_is_named(trajectories) -> None:
    """A random force could follow the drag, which is smooth; its prior says that it does not."""
    train, test = falls(1, 0.0209, trajectories), falls(2, 0.0209)
    found = close_loop(AIR, train, test, seed=1, method="laplace")
    assert found.verdict == "effects-added"
    assert [one.effect for one in found.added] == ["linear_drag"]
    estimate = found.added[0].parameters["coefficient"]
    assert abs(estimate.mean - 0.0209) < 4 * estimate.sd  # a false alarm in 1e-4
    assert found.after.rollout_rmse["y"] < 0.01 * found.before.rollout_rmse["y"]


@pytest.mark.slow
def test_a_fall_in_a_vacuum_is_adequate() -> None:
    found = close_loop(AIR, falls(1, 0.0), falls(2, 0.0), seed=1, method="laplace")
    assert found.verdict == "adequate"


def test_a_fit_leaves_the_hill_of_large_accelerations() -> None:
    """Drag is in the model, and the fit begins with a random force of 14 m/s^2."""
    drag = next(effect for effect in pp.catalogue if effect.name == "linear_drag")
    problem = Problem.of(Physics.declare(AIR, [drag.on("ball")]), falls(1, 0.0209))
    mode = trajectory_mode(problem, find_mode(problem, seed=1).phi)
    noisy = mode.sigma.copy()
    noisy[2:] = 14.0
    again = trajectory_mode(smoothed(mode.problem, mode.phi, noisy), 0.3 * mode.phi, noisy)
    assert (again.sigma[2:] < 0.01).all()
    assert again.log_posterior == pytest.approx(mode.log_posterior, abs=1.0)


# --- what an effect needs ---


def test_a_size_many_prior_scales_out_is_not_accepted(make_history) -> None:
    """A drag of 3 kg/s where its prior's scale is 10: accepted at 6 scales, not at 0.1."""
    mode = fitted(BOX, box2d(make_history, 5, linear_drag=3.0)[0])
    drags = tuple(effect for effect in pp.catalogue if effect.name == "linear_drag")

    assert searched(mode, drags).laws
    assert not searched(mode, drags, replace(DEFAULT, far_out=0.1)).laws


@pytest.mark.slow
def test_a_revision_that_forecasts_worse_is_unexplained() -> None:
    """Drag in the training recording alone: the law that was found does not hold later."""
    train = Disc(8, 15, FINE, drag=0.3).frame(np.random.default_rng(1))
    test = Disc(4, 15, FINE, seed=12).frame(np.random.default_rng(2))
    histories = (pp.History.from_dataframe(frame, FINE) for frame in (train, test))
    found = close_loop(FINE, *histories, catalogue=QUICK, seed=1, method="laplace")
    assert [one.effect for one in found.added] == ["linear_drag"]
    assert found.after.normalised_rmse > found.before.normalised_rmse
    assert found.verdict == "unexplained"
    assert "worse than the declared one" in found.unexplained.sentence


def loaded(trajectories: int, first: int, rng: np.random.Generator) -> pd.DataFrame:
    """A disc that carries half of its mass again from some trajectory on."""
    disc = Disc(trajectories, 15, FINE)
    share = np.where(np.arange(trajectories) >= first, 1 / 1.5, 1.0)[:, None, None]
    inertia = MASS * 0.2**2 / 2
    return disc.frame(rng, pushed=disc.pushes / (MASS, MASS, inertia) * (share - 1.0))


@pytest.mark.slow
def test_a_load_that_lasts_holds_in_a_later_recording() -> None:
    rng = np.random.default_rng(4)
    frames = loaded(12, 6, rng), loaded(4, 0, rng)
    load_alone = tuple(effect for effect in pp.catalogue if effect.name == "mass_change")

    def loop(scene: pp.Scene):
        train, test = (pp.History.from_dataframe(frame, scene) for frame in frames)
        return close_loop(scene, train, test, catalogue=load_alone, seed=1, method="laplace")

    later = loop(FINE)
    assert later.verdict == "effects-added"
    assert later.added[0].parameters["factor"].mean == pytest.approx(1.5, rel=0.02)
    assert later.after.normalised_rmse < 1.2
    # counted from 0 as the training recording, its trajectories carry nothing
    beside = loop(FINE.replace(test_is_later=False))
    assert beside.after.normalised_rmse > 2.0


# --- tests that can fail ---


def test_dependence_of_many_bodies_can_be_significant() -> None:
    """Eight discs, of which one is pushed twice as hard along x as was logged."""
    names = [f"puck{i}" for i in range(8)]
    body = FINE.bodies[0]
    scene = FINE.replace(bodies=tuple(replace(body, name=name) for name in names))
    frames = []
    for i, name in enumerate(names):
        disc = Disc(8, 10, FINE, seed=20 + i)
        frame = disc.frame(np.random.default_rng(i)).assign(body=name)
        frame["x"] += 10.0 * i  # apart
        if i == 3:
            frame["force_x"] *= 0.5
        frames.append(frame)
    mode = fitted(scene, pd.concat(frames).sort_values(["trajectory", "step"], kind="stable"))
    _, found = find_dependence(mode, DEFAULT, seed=1)
    assert found is not None
    assert found.body == "puck3"
    assert found.p_value <= 0.01


def test_dependence_within_a_single_trajectory_is_tested() -> None:
    frame = Disc(1, 120, FINE).frame(np.random.default_rng(1))
    test, found = find_dependence(fitted(FINE, frame), DEFAULT, seed=1)
    assert test.tested and found is None
    frame["force_x"] *= 0.5
    assert find_dependence(fitted(FINE, frame), DEFAULT, seed=1)[1] is not None


def test_dependence_in_few_transitions_is_not_tested() -> None:
    mode = Disc(2, 5, FINE).mode(np.random.default_rng(1))
    assert not find_dependence(mode, DEFAULT)[0].tested
