"""Recordings and scenes that are allowed, on which the loop must end with a verdict."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism import close_loop
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.held_out import forecast
from pbrl_ppl.criticism.misfit import forecast_test
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.effects import candidates, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene
from tests.helpers.free_puck import DISC, Disc, fitted
from tests.helpers.places import MODELS

# a posterior of few draws is enough to test that there is one
pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")

COM_OFFSET = tuple(effect for effect in catalogue if effect.name == "com_offset")
DRAG = tuple(effect for effect in catalogue if effect.name == "linear_drag")


def test_a_prior_of_a_declared_effect_is_used() -> None:
    puck = replace(
        DISC.bodies[0],
        effects=("com_offset",),
        prior={f"com_offset_{axis}": {"mu": 0.0, "sigma": 0.01} for axis in "xy"},
    )
    scene = DISC.replace(bodies=(puck,))
    train, test = (
        History.from_dataframe(Disc(4, 8, seed=seed).frame(np.random.default_rng(seed)), scene)
        for seed in (1, 2)
    )
    found = close_loop(scene, train, test, catalogue=COM_OFFSET, seed=1, method="laplace")
    assert "com_offset_x" in found.posterior_after.posterior


@pytest.fixture(scope="module", params=["every row", "gaps"])
def unknown_pivot(request, make_history):
    """Mode and ranking of a pendulum on a hinge of unknown anchors, from its angle alone."""
    arm = Scene.load(MODELS / "pendulum" / "scene.toml")
    hinge = replace(arm.joints[0], known=False)
    scene = arm.replace(time_step=0.05, substeps=102, joints=(hinge,))
    setup = replace(
        make_history.PENDULUM, time_step=0.05, step=1e-3, n_intervals=40, n_train=4, n_test=1
    )
    frame, _ = make_history.simulate(9, setup, pivot_damping=0.02)
    frame = frame.assign(**dict.fromkeys(("x", "y", "vx", "vy", "omega"), np.nan))
    if request.param == "gaps":
        lost = (np.random.default_rng(4).random(len(frame)) < 0.2) & (frame["step"] > 0)
        frame = frame.assign(theta=frame["theta"].mask(lost))
    mode = fitted(scene, History.from_dataframe(frame, scene, estimate_velocities=True))
    return mode, rank_candidates(mode, candidates(scene, mode.problem.physics.effects, catalogue))


@pytest.mark.one_stack
def test_a_pivot_is_inferred_from_an_angle_alone(unknown_pivot) -> None:
    """Smoothed positions of the arm's centre diverged, and every score was NaN."""
    mode, ranked = unknown_pivot
    assert np.isfinite(mode.log_posterior)
    assert np.isfinite(mode.whitened_residual).all()
    assert all(np.isfinite(one.candidate.statistic) for one in ranked)


@pytest.fixture(scope="module")
def diverging():
    """A disc whose drag is so strong that the engine's steps overflow."""
    mode = fitted(DISC, Disc(4, 8).frame(np.random.default_rng(1)), DRAG)
    return replace(mode, phi=np.array([mode.phi[0], 1e80]))


@pytest.mark.one_stack
def test_errors_of_diverging_forecasts_are_infinite(diverging) -> None:
    made = forecast(diverging.problem, diverging.phi, diverging.sigma, 3)
    assert np.isposinf(made.error[:, made.dimension == 0]).all()
    assert made.rmse()["x"] == np.inf
    assert np.isfinite(made.floor()["x"])


@pytest.mark.one_stack
def test_diverging_forecasts_fail_their_test(diverging) -> None:
    assert not forecast_test(diverging, diverging.sigma, 3, DEFAULT).passed
