"""A kinematic body in models, posteriors and plans: its path is given, it is never observed."""

import numpy as np
import pytest

from pbrl_ppl.errors import GoalError, HistoryError
from pbrl_ppl.history import History, from_segments
from pbrl_ppl.likelihood import along_trajectories
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.physics import Transition
from pbrl_ppl.planning import Action, ActionSet, Dynamics, Goal, plan
from pbrl_ppl.posterior import load_posterior, problem_of, save_posterior
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape

NOISE = np.array([1e-3, 1e-3, 2e-3, 5e-3, 5e-3, 1e-2])
FINGER = Body("finger", Shape.circle(0.02), kinematic=True, known={"r": 1.0, "mu_c": 1.0})
BLOCK = Body("block", Shape.box(0.2, 0.1), known={"mass": 1.0, "mu_c": 0.2})
SCENE = Scene(time_step=0.1, bodies=(FINGER, BLOCK))
R = 0.3


@pytest.fixture(scope="module")
def hits() -> History:
    """A finger that hits a block off its middle."""
    rng = np.random.default_rng(0)
    start = np.zeros((20, 2, 6))
    start[:, 0, 0] = -0.2
    start[:, 0, 1] = rng.uniform(-0.04, 0.04, 20)
    actions = np.zeros((20, 4, 2, 3))
    actions[:, :, 0, 0] = rng.uniform(0.5, 1.5, (20, 1))
    states = Transition(SCENE, {"r": R}).predict(start, actions)
    return from_segments(SCENE, start, actions, states + NOISE * rng.normal(size=states.shape))


@pytest.fixture(scope="module")
def problem(hits):
    return problem_in(physics_model(SCENE, hits, horizon=4))


def test_only_the_block_is_observed(problem) -> None:
    assert not problem.observations.measured[:, :, 0].any()
    assert problem.observations.measured[:, :, 1].all()
    assert (problem.residual(np.array([R]))[:, :, 0] == 0.0).all()


def test_restitution_is_recovered(problem) -> None:
    """Within 3.3 standard deviations: false alarms in 1 of 1000."""
    mode = find_mode(problem, initial=np.array([0.9]))
    sd = float(np.sqrt(mode.covariance[0, 0]))
    assert abs(mode.phi[0] - R) < 3.3 * sd
    assert sd < 0.02


def test_its_path_has_no_noise(problem) -> None:
    whole = along_trajectories(problem, np.array([R]))
    coordinates = whole.likelihood.noise.coordinates
    assert (coordinates.places // 6 == 1).all()  # the block's
    own = whole.data.history.dataset["start"].to_numpy()[:, :, 0, :3]
    np.testing.assert_array_equal(whole.data.states[:, :, 0, :3], own)
    density = whole.log_density(whole.residual(np.array([R])), whole.likelihood.noise.sigma)
    assert np.isfinite(density).all()


def test_a_posterior_file_holds_its_path(problem, hits, tmp_path) -> None:
    idata = fit(physics_model(SCENE, hits, horizon=4), method="map", seed=1)
    save_posterior(idata, tmp_path / "hits.nc")
    again = problem_of(load_posterior(tmp_path / "hits.nc"))
    phi, sigma = np.array([R]), NOISE
    np.testing.assert_allclose(
        again.log_density(again.residual(phi), sigma),
        problem.log_density(problem.residual(phi), sigma),
        rtol=1e-6,
    )


def test_a_horizon_that_reaches_no_measurement_is_refused(hits) -> None:
    rows = hits.to_dataframe()
    block = (rows["body"] == "block") & (rows["step"] > 0)
    rows.loc[block & (rows["step"] < 4), ["x", "y", "theta", "vx", "vy", "omega"]] = np.nan
    ends = History.from_dataframe(rows, SCENE)
    with pytest.raises(HistoryError, match=r"no measured next state within 2 intervals.* longer"):
        physics_model(SCENE, ends, horizon=2)
    assert problem_in(physics_model(SCENE, ends, horizon=4)).observations.measured.sum() == 20 * 6


def test_a_plan_leaves_it_where_it_is() -> None:
    dynamics = Dynamics.known(SCENE, {"r": R})
    start = {"finger": (-1.0, 0, 0), "block": (0, 0, 0)}
    pushes = ActionSet((Action("block", (2.0, 0.0)), Action("block", (-2.0, 0.0))))
    goal = Goal.of({"block": (0.3, 0.0, None)}, tolerance=0.1)
    found = plan(dynamics, start, goal, pushes)
    assert found.reached
    finger = found.predicted["predicted"].sel(body="finger", state=["x", "y", "theta"])
    np.testing.assert_array_equal(finger, np.broadcast_to([-1.0, 0, 0], finger.shape))
    History.from_dataframe(found.to_dataframe(), SCENE)  # a history without measurements


def test_a_plan_cannot_move_it() -> None:
    dynamics = Dynamics.known(SCENE, {"r": R})
    start = {"finger": (-1.0, 0, 0), "block": (0, 0, 0)}
    push = ActionSet((Action("finger", (1.0, 0.0)),))
    with pytest.raises(GoalError, match=r'"finger" that can be pushed.* stays where it starts'):
        plan(dynamics, start, {"block": (1, 0, None)}, push)
    pushes = ActionSet((Action("block", (2.0, 0.0)),))
    with pytest.raises(GoalError, match='"finger" that can be pushed'):
        plan(dynamics, start, {"finger": (1, 0, None)}, pushes)
    with pytest.raises(GoalError, match="nothing says where finger is"):
        plan(dynamics, {"block": (0, 0, 0)}, {"block": (1, 0, None)}, pushes)
