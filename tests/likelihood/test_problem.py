"""Problem: a change of data, physics or noise keeps the others with all that they have made."""

import pickle

import numpy as np
import pytest

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.likelihood import (
    Problem,
    TrajectoryLikelihood,
    TransitionLikelihood,
    along_trajectories,
    single_transitions,
)
from pbrl_ppl.likelihood import data as data_module
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

pytestmark = pytest.mark.one_stack  # plain numpy
PUCKS = Scene(time_step=0.1, bodies=tuple(Body(name, Shape.circle(0.2)) for name in "ab"))
TRUTH = {"mass": [2.0, 3.0], "r": [0.2, 0.2], "mu_c": [0.3, 0.3]}


@pytest.fixture
def checks(monkeypatch) -> list[int]:
    """One entry for each time that initial states are checked."""
    seen: list[int] = []
    check = data_module.check_history

    def counted(scene, history, segments) -> None:
        seen.append(segments.n)
        check(scene, history, segments)

    monkeypatch.setattr(data_module, "check_history", counted)
    return seen


@pytest.fixture
def problem() -> Problem:
    return Problem.of(Physics(PUCKS, substeps=5), simulated_history(PUCKS, TRUTH, seed=1))


def test_other_noise_keeps_the_engine_and_the_checked_data(problem, checks) -> None:
    engine, coarse, segments = (
        problem.physics.simulator,
        problem.coarse.physics.simulator,
        problem.segments,
    )
    for other in (
        problem.with_likelihood(prior=((1.0,) * 6, 2.0)),
        problem.with_likelihood(nu=4.0),
    ):
        assert other.physics.simulator is engine
        assert other.coarse.physics.simulator is coarse
        assert other.segments is segments
        assert other.observations is problem.observations
    assert checks == [segments.n]


def test_other_physics_keep_the_checked_data(problem, checks) -> None:
    drag = next(effect for effect in catalogue if effect.name == "linear_drag")
    segments, engine = problem.segments, problem.physics.simulator
    fewer = PUCKS.replace(bodies=tuple(Body(n, Shape.circle(0.2), known={"r": 0.1}) for n in "ab"))
    for other in (
        problem.with_physics(effects=attach(PUCKS, [drag])),
        problem.with_physics(scene=fewer),
        problem.with_physics(substeps=10),
    ):
        assert other.segments is segments
        assert other.likelihood is problem.likelihood
        assert other.physics.simulator is not engine
    assert problem.with_physics(substeps=5, threads=1).physics.simulator is engine
    assert checks == [segments.n]


def test_other_data_keep_the_engine_where_its_parts_are_the_same(problem) -> None:
    longer = problem.with_data(horizon=2)
    assert longer.physics.simulator is problem.physics.simulator
    assert longer.segments.actions.shape[1] == 2
    apart = problem.with_data(history=simulated_history(PUCKS, TRUTH, seed=2))
    assert apart.physics.simulator is problem.physics.simulator
    poses = np.array([[0.0, 0.0, 0.0], [0.45, 0.0, 0.0]])
    meeting = problem.with_data(history=simulated_history(PUCKS, TRUTH, seed=3, poses=poses))
    assert [len(each.bodies) for each in problem.physics.simulator.parts] == [1, 1]
    assert [len(each.bodies) for each in meeting.physics.simulator.parts] == [2]


def test_noise_along_trajectories_is_of_its_own_data(problem) -> None:
    phi = problem.layout.to_vector(TRUTH)
    whole = along_trajectories(problem.with_likelihood(nu=4.0), phi)
    assert isinstance(whole.likelihood, TrajectoryLikelihood)
    assert whole.physics.simulator is problem.physics.simulator
    for other in (whole.with_data(states=None), whole.with_data(history=problem.data.history)):
        assert isinstance(other.likelihood, TransitionLikelihood)
        assert other.likelihood.nu == 4.0
    # other noise and other physics keep it, with the smoothed states that it is about
    for other in (whole.with_likelihood(nu=None), whole.with_physics(substeps=10)):
        assert other.likelihood.noise is whole.likelihood.noise
        assert other.segments is whole.segments
    assert isinstance(single_transitions(whole).likelihood, TransitionLikelihood)
    np.testing.assert_array_equal(single_transitions(whole).segments.start, problem.segments.start)


def test_what_was_computed_does_not_travel(problem) -> None:
    small = len(pickle.dumps(problem))
    phi = problem.layout.to_vector(TRUTH)
    here = problem.predict(phi)
    assert len(pickle.dumps(problem)) == small
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(problem)).predict(phi), here)
