"""Degrees of freedom of simulated pieces: measurements less what initial states can follow."""

import numpy as np
import pytest

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, in_pieces
from pbrl_ppl.modes import find_mode, fit_pieces, trajectory_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE

pytestmark = pytest.mark.one_stack

WHEEL = Scene(
    time_step=0.02,
    bodies=(Body("wheel", Shape.circle(0.1)),),
    joints=(Joint("hinge", ("wheel", "world"), (0.0, 0.0), (0.0, 0.0)),),
)
MOMENT = 2.0 * 0.1**2 / 2


def turning(*measured: str) -> History:
    """A wheel of 2 kg that random torques turn: three runs of 60 intervals, errors of 1e-3."""
    rng = np.random.default_rng(0)
    torque = np.repeat(rng.normal(0.0, 0.02, (3, 12)), 5, axis=1)
    omega = np.cumsum(np.pad(torque * 0.02 / MOMENT, ((0, 0), (1, 0))), axis=1)
    steps = 0.01 * (omega[:, 1:] + omega[:, :-1])
    theta = np.cumsum(np.pad(steps, ((0, 0), (1, 0))), axis=1)
    states, wrenches = np.full((3, 61, 1, 6), np.nan), np.zeros((3, 60, 1, 3))
    for name, values in (("theta", theta), ("omega", omega)):
        if name in measured:
            states[:, :, 0, STATE.index(name)] = values + 1e-3 * rng.standard_normal(values.shape)
    wrenches[:, :, 0, 2] = torque
    return History.of_arrays(states, WHEEL, wrenches)


@pytest.mark.parametrize(
    ("measured", "followed"), [(("omega",), 1), (("theta",), 2), (("theta", "omega"), 2)]
)
def test_only_what_initial_states_can_follow_is_taken_off(measured, followed) -> None:
    """A speed alone tells nothing of an angle: one coordinate of each piece moves it, not two."""
    problem = Problem.of(Physics(WHEEL), turning(*measured))
    whole = trajectory_mode(problem, find_mode(problem).phi)
    pieces = in_pieces(whole.problem, 4, whole.problem.data.smoothed_states)
    mode = fit_pieces(pieces, whole.phi)
    initial = mode.problem.likelihood.initial_states
    total, n = initial.measured.sum(), len(initial.begin)
    assert n == 45
    assert initial.counts.sum() == pytest.approx(total - followed * n)
    # the noise comes out right, to four standard errors
    assert mode.sigma == pytest.approx(1e-3, rel=4 / np.sqrt(2 * initial.counts.min()))
