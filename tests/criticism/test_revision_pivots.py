"""The whole loop on pendulums: one that was measured, and one of another engine."""

import pytest

from pbrl_ppl.criticism import revise
from tests.helpers.places import ROOT, load

# a posterior of few draws is enough to test a verdict, and says that it is one
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
]


def test_friction_of_a_real_pivot(shared_data):
    found = revise(*load(shared_data / "real" / "pendulum-swing"), seed=1, draws=40)
    assert found.candidates[0].effect == "pivot_damping"
    assert {"pivot_damping", "pivot_friction"} & {one.effect for one in found.added}
    assert found.rollout_horizon == 50  # 1 s
    assert found.before.rollout_rmse["theta"] == pytest.approx(0.013, abs=0.001)
    assert found.after.rollout_rmse["theta"] <= 0.0045


def test_a_pivot_of_another_engine():
    folder = ROOT / "models" / "pendulum"
    found = revise(*load(folder, folder / "recorded"), seed=1, draws=100)
    assert [one.effect for one in found.added] == ["pivot_friction"]
    low, high = found.added[0].parameters["torque"].hdi
    assert low <= 0.015 <= high
