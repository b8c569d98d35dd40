"""The place of what a body runs into is found from hits, whatever the guess to begin with."""

import numpy as np
import pytest

from pbrl_ppl.criticism.refinement import structure_mode
from pbrl_ppl.effects import attach, candidates
from tests.helpers.free_puck import BOX, box2d, fitted

pytest.importorskip("Box2D", reason="Box2D makes the histories; install the extra `test`")

pytestmark = pytest.mark.one_stack


@pytest.mark.slow
# in which several hits from different sides pin it down
@pytest.mark.parametrize("seed", [pytest.param(5, marks=pytest.mark.long), 6])
def test_a_disc_is_found_from_a_guess_on_the_other_side_of_the_room(make_history, seed) -> None:
    """Box2D's disc, to 5 mm, and what a step adds beyond the model all but gone."""
    disc = (1.2, 0.1, 0.2)
    rows, _ = box2d(
        make_history, seed, near=True, trajectories=12, intervals=20, hidden_obstacle=disc
    )
    without = fitted(BOX, rows)
    every = candidates(BOX, attach(BOX))
    (obstacle,) = (each for each in every if each.effect.name == "hidden_obstacle")
    found = structure_mode(without, obstacle, np.array([-8.0, 8.0, 0.3]))
    own = [found.problem.layout.labels.index(label) for label in obstacle.labels]
    np.testing.assert_allclose(found.phi[own], disc, atol=0.005)
    steps = len(found.problem.trajectory_noise.coordinates.sensors)
    assert np.all(found.sigma[steps:] < 0.05 * without.sigma[steps:])
