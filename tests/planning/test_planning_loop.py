"""The gain of closing the loop, for a planner, in a world that another engine makes."""

import numpy as np
import pytest

pytestmark = pytest.mark.one_stack

pytest.importorskip("Box2D", reason="Box2D is the world; install the extra `test`")


@pytest.fixture
def benchmark(benchmarks):
    import planning_loop

    return planning_loop


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the chains have not converged")  # the mode is planned with
def test_revised_model_ends_nearer_the_goal(benchmark) -> None:
    """Six starts, seed 0: the median final distance is at most half of the declared model's."""
    loop = benchmark.closed(trajectories=2, draws=100)
    assert [one.effect for one in loop.added] == ["linear_drag"]
    before, after = benchmark.before_and_after(loop, 6)
    assert np.median(after) <= 0.5 * np.median(before)
