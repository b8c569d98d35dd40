"""Pendulums: one that was measured, and one of another engine."""

import pytest

from pbrl_ppl.criticism import close_loop
from pbrl_ppl.effects import catalogue
from tests.helpers.free_puck import fitted, searched
from tests.helpers.places import MODELS, load

# a posterior of few draws is enough to test a verdict, and says that it is one
pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")

FOLDER = MODELS / "pendulum"


@pytest.mark.long
def test_friction_of_a_pivot_of_another_engine_is_chosen() -> None:
    """Without draws: the mode and its covariance say what the posterior will."""
    scene, train, _ = load(FOLDER, FOLDER / "recorded")
    (law,) = searched(fitted(scene, train), catalogue).laws.values()
    assert law.effect == "pivot_friction"
    size, spread = law.estimate["torque"], law.sd["torque"]
    assert abs(size - 0.015) < 4 * spread  # a false alarm in 1e-4
    assert spread < 0.001


@pytest.mark.long
def test_the_loop_names_it() -> None:
    found = close_loop(*load(FOLDER, FOLDER / "recorded"), seed=1, draws=100)
    assert [one.effect for one in found.added] == ["pivot_friction"]
    low, high = found.added[0].parameters["torque"].hdi
    assert low <= 0.015 <= high


@pytest.mark.long
def test_a_real_pivot_rubs(shared_data) -> None:
    """It is not all of what is missing; what is added is known, and predicts."""
    found = close_loop(*load(shared_data / "real" / "pendulum-swing"), seed=1)
    assert {"pivot_damping", "pivot_friction"} & {one.effect for one in found.added}
    assert found.verdict in ("effects-added", "unexplained")
    assert found.posterior_after.attrs["max_rhat"] <= 1.02
    assert found.forecasts.horizon == 50  # 1 s
    assert found.after.rollout_rmse["theta"] <= 0.0020
