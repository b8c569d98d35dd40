"""Whole trajectories of which a body is seen at the ends alone."""

import numpy as np
import pytest

from pbrl_ppl.history import History, from_segments
from pbrl_ppl.likelihood import Problem, along_trajectories, single_transitions
from pbrl_ppl.modes import find_mode, trajectory_mode
from pbrl_ppl.physics import Physics, Transition
from pbrl_ppl.scene import Body, Scene, Shape

FINGER = Body("finger", Shape.circle(0.02), kinematic=True, known={"r": 0.0, "mu_c": 1.0})
BLOCK = Body(
    "block", Shape.box(0.2, 0.1), known={"mass": 1.0, "r": 0.0, "mu_c": 0.3},
    effects=("sliding_friction",),
)  # fmt: skip
SCENE = Scene(time_step=0.1, bodies=(FINGER, BLOCK), normal_gravity=9.81)
TRUTH = {"sliding_friction_mu": 0.2, "sliding_friction_radius": 0.06}
INTERVALS, NOISE = 12, np.array([5e-4, 5e-4, 5e-3])
RNG = np.random.default_rng(4)


def recorded(trajectories: int = 16) -> History:
    """Pushes off the block's middle; the block is seen before them and when it is at rest again."""
    start = np.zeros((trajectories, 2, 6))
    start[:, 0, 0] = -0.13
    start[:, 0, 1] = RNG.uniform(-0.04, 0.04, trajectories)
    actions = np.zeros((trajectories, INTERVALS, 2, 3))
    actions[:, :8, 0, 0] = RNG.uniform(0.1, 0.2, (trajectories, 1))
    states = Transition(SCENE, TRUTH).predict(start, actions)
    seen = np.full_like(states, np.nan)
    seen[:, -1, :, :3] = states[:, -1, :, :3]
    start[:, 1, :3] += NOISE * RNG.normal(size=(trajectories, 3))
    seen[:, -1, 1, :3] += NOISE * RNG.normal(size=(trajectories, 3))
    return from_segments(SCENE, start, actions, seen)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem.of(Physics.declare(SCENE), recorded())


def test_between_the_rows_it_is_linearised_where_the_model_leads(problem) -> None:
    phi = problem.layout.to_vector(TRUTH)
    whole = along_trajectories(problem, phi)
    states, segments = whole.data.smoothed_states, single_transitions(problem).segments
    ends = problem.physics.one_world(phi, states[:, 0], segments.inputs)
    # an engine forgets its contacts where it restarts: not to the last digit
    way = states[:, 1:-1, 1, :3] - ends[:, :-1, 1, :3]
    assert (np.sqrt((way**2).mean(axis=(0, 1))) < NOISE).all()
    measured = whole.data.history.dataset["observed"].to_numpy()[:, -1, 1, :3]
    assert (np.abs(states[:, -1, 1, :3] - measured) < 6 * NOISE).all()


@pytest.mark.slow
def test_friction_is_recovered(problem) -> None:
    """Within 3.3 standard deviations: false alarms in 1 of 500."""
    begin = find_mode(single_transitions(problem), seed=1)
    mode = trajectory_mode(problem, begin.phi)
    spread = np.sqrt(np.diag(mode.covariance))
    truth = mode.problem.layout.to_vector(TRUTH)
    assert (np.abs(mode.phi - truth) < 3.3 * spread).all()
    assert (spread < 0.2 * truth).all()
