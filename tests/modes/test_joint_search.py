"""Joints of unknown bodies where there are more configurations than can be tried."""

import numpy as np
import pytest

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import configurations as module
from pbrl_ppl.modes import weigh
from pbrl_ppl.modes.configurations import MOST, configurations, number
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Joint, Scene, Shape
from tests.helpers.histories import simulated_history
from tests.helpers.joints import scene
from tests.helpers.worlds import body

pytestmark = pytest.mark.one_stack  # nothing is sampled here
NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)
#: In the bounds of discs that do not touch.
HINGES = {
    ("a", "b"): ((0.17, 0.17), (-0.17, -0.17)),
    ("c", "f"): ((-0.17, 0.17), (0.17, -0.17)),
}


def discs(*joints: Joint, names: str = "abcdefg") -> Scene:
    """Discs of which all but the joints is known."""
    made = tuple(body(name, Shape.circle(0.2), mass=1.0 + 0.2 * i) for i, name in enumerate(names))
    return Scene(time_step=0.1, bodies=made, joints=joints, substeps=4)


@pytest.mark.parametrize(
    ("names", "most", "all_of_them"),
    [
        pytest.param("abcf", 40, 66, marks=pytest.mark.slow),
        pytest.param("abcdefg", MOST, 435, marks=pytest.mark.long),
    ],
)
def test_two_hinges_are_found_among_more_than_can_be_tried(
    names, most, all_of_them, monkeypatch
) -> None:
    """Each hinge shows by itself."""
    monkeypatch.setattr(module, "MOST", most)
    free = discs(*(Joint("hinge", known=False) for _ in range(2)), names=names)
    assert number(free) == all_of_them > most
    truth = discs(*(Joint("hinge", pair, *at) for pair, at in HINGES.items()), names=names)
    poses = np.zeros((len(names), 3))
    poses[:, 0] = np.arange(float(len(names)))
    poses[1] = poses[0] + [0.34, 0.34, 0.0]
    poses[names.index("f")] = poses[2] + [-0.34, 0.34, 0.0]
    history = simulated_history(
        truth, {}, seed=2, trajectories=3, intervals=2, noise=NOISE, poses=poses, substeps=4,
        wrench_sd=(5.0, 5.0, 0.1),
    )  # fmt: skip
    found = weigh(Problem.of(Physics(free), history), seed=1)
    assert len(found) <= most
    best = max(found, key=lambda each: each.probability)
    assert {pair for _, pair in best.configuration.pairs} == set(HINGES)
    assert best.probability > 0.999
    assert sum(each.probability for each in found) == pytest.approx(1.0)
    assert found[0].configuration.empty


def test_few_configurations_are_all_tried(monkeypatch) -> None:
    """And where one more would be too many, the search begins with single joints."""
    free = scene(Joint("hinge", known=False), Joint("distance", known=False))
    tried = tried_of(free, monkeypatch, lambda pairs: 0.0)
    assert tried == set(configurations(free))
    monkeypatch.setattr(module, "MOST", 60)
    good = {("joint1", ("a", "b")), ("joint2", ("c", "world"))}
    some = tried_of(free, monkeypatch, lambda pairs: 50.0 * len(good & set(pairs)))
    assert len(some) <= 60
    assert good in [set(each.pairs) for each in some]
    singles = [each for each in some if [p for _, p in each.pairs].count(None) == 1]
    assert len(singles) == 20


def test_hopeless_joints_are_not_added_to(monkeypatch) -> None:
    """Where every joint makes it far worse, two of them are not tried."""
    free = scene(Joint("hinge", known=False), Joint("distance", known=False))
    monkeypatch.setattr(module, "MOST", 60)
    joined = lambda pairs: len([p for _, p in pairs if p])  # noqa: E731
    assert len(tried_of(free, monkeypatch, lambda pairs: -1e4 * joined(pairs))) == 21


def test_too_many_pairs_for_one_joint_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(module, "MOST", 10)
    free = scene(Joint("hinge", known=False))
    with pytest.raises(
        FitError, match=r"10 configurations .* \(a, b, c, d, world\), .* at most 10"
    ):
        tried_of(free, monkeypatch, lambda pairs: 0.0)


def tried_of(free: Scene, monkeypatch, height):
    """Which configurations are tried, if their evidence is this; no engine runs."""

    class Found:
        def __init__(self, log_posterior: float) -> None:
            self.log_posterior = log_posterior

    tried = set()

    def joint(problem, configuration, fewer, worth):
        tried.add(configuration)
        return Found(height(configuration.pairs))

    monkeypatch.setattr(module, "_apart", lambda problem, seed: Found(0.0))
    monkeypatch.setattr(module, "_joint", joint)
    monkeypatch.setattr(module, "laplace", lambda mode: module.Marginal(mode.log_posterior))
    history = simulated_history(scene(), {}, seed=1, trajectories=1, intervals=2)
    modes, _ = module._tried(Problem.of(Physics(free), history), 1, module.silent)
    first, *others = modes
    assert first.empty
    assert set(others) == tried
    return set(modes)
