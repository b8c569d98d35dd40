"""`joints = "any"`: any two bodies, or a body and the world, may be joined by a rod (Eq. 8)."""

import pytest

from pbrl_ppl.errors import SceneError
from pbrl_ppl.model import physics_model
from pbrl_ppl.posterior import joint_probabilities
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from tests.helpers.histories import simulated_history

POSES = ((0.0, 0.0, 0.0), (1.2, 0.1, 0.4), (0.3, 1.6, -0.3))
NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)
ROD = Joint("distance", ("a", "b"), (0.1, 0.05), (-0.1, 0.0))
pytestmark = [
    pytest.mark.one_stack,
    pytest.mark.filterwarnings("ignore:which bodies are joined is uncertain"),
]


def pucks(names: str, *joints: Joint) -> Scene:
    """Pucks of which everything is known, and joints."""
    known, shape = {"mass": 1.5, "r": 0.1, "mu_c": 0.3}, Shape.circle(0.2)
    bodies = tuple(
        Body(name, shape, pose=pose, known=known) for name, pose in zip(names, POSES, strict=False)
    )
    return Scene(time_step=0.1, substeps=5, bodies=bodies, joints=joints)


def found(names: str, *joints: Joint) -> list[str]:
    """The most probable answer of each of the scene's possible joints, if of more than 0.99."""
    truth = pucks(names, *joints)
    history = simulated_history(
        truth, {}, seed=2, trajectories=6, intervals=2, noise=NOISE, poses=POSES[: len(names)],
        substeps=20, wrench_sd=(4.0, 4.0, 0.3),
    )  # fmt: skip
    model = physics_model(pucks(names).with_any_joints(), history)
    table = joint_probabilities(fit(model, seed=1, method="map", progress=False))
    assert len(table) == len(names)
    return [pair for own in table.values() for pair, p in own.items() if p > 0.99]


@pytest.mark.parametrize(("joints", "expected"), [((ROD,), "a-b"), ((), "none")])
def test_of_two_bodies(joints, expected) -> None:
    assert found("ab", *joints) == [expected, "none"]


@pytest.mark.slow
@pytest.mark.parametrize(("joints", "expected"), [((ROD,), "a-b"), ((), "none")])
def test_of_three_bodies(joints, expected) -> None:
    """The pair that a rod joins is named, and no other; where nothing is joined, none is."""
    assert found("abc", *joints) == [expected, "none", "none"]


def test_a_file_says_it_in_one_word() -> None:
    scene = pucks("abc", ROD)
    text = scene.to_toml().replace("[world]\n", '[world]\njoints = "any"\n')
    read = Scene.from_toml(text)
    assert read == scene.with_any_joints()
    assert [joint.bodies for joint in read.joints] == [("a", "b"), None, None, None]
    assert Scene.from_toml(read.to_toml()) == read
    with pytest.raises(SceneError, match=r'\[world\]: joints is "?\'?all.*expected "any"'):
        Scene.from_toml(text.replace('"any"', '"all"'))
    nowhere = Scene(time_step=0.1, bodies=(Body("a", Shape.circle(0.1)),))
    with pytest.raises(SceneError, match='body "a" has no pose'):
        nowhere.with_any_joints()
