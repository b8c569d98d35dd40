"""Bodies that have nothing to do with each other: found in the data, simulated apart."""

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.errors import SceneError, SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import Space
from pbrl_ppl.parameters import inside
from pbrl_ppl.physics import PartedSimulator, Physics, Simulator, build_layout, independent_parts
from pbrl_ppl.physics.parts import Memory
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.histories import COLUMNS
from tests.helpers.places import RECORDED

pytestmark = pytest.mark.one_stack

NAMES = ("a", "b", "c", "d")
JOINT = Joint("hinge", ("a", "b"), (0.3, 0.0), (-0.3, 0.0))


def scene_of(*joints: Joint, **options) -> Scene:
    bodies = tuple(Body(name, Shape.circle(0.1), wheel=name != "b") for name in NAMES)
    return Scene(
        time_step=0.1, bodies=bodies, joints=joints, normal_gravity=9.81, substeps=8, **options
    )


def history_of(scene: Scene, places: dict[str, list[tuple[float, float]]]) -> History:
    """One trajectory of bodies that pass through these places, a step each."""
    rows = []
    for name in NAMES:
        for step, (x, y) in enumerate(places[name]):
            row = dict.fromkeys(COLUMNS, 0.0)
            row |= {"step": step, "time": 0.1 * step, "body": name, "x": x, "y": y}
            rows.append(row)
    frame = pd.DataFrame(rows).sort_values(["time", "body"])
    return History.from_dataframe(frame, scene)


def still(**places) -> dict[str, list[tuple[float, float]]]:
    """Bodies 2 m apart that rest, but for these."""
    found = {name: [(2.0 * i, 0.0)] * 3 for i, name in enumerate(NAMES)}
    return found | places


def test_bodies_that_rest_apart() -> None:
    scene = scene_of()
    assert independent_parts(scene, history_of(scene, still())) == (("a",), ("b",), ("c",), ("d",))


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ([(0.0, 0.0), (1.7, 0.0), (0.0, 0.0)], (("a", "b"), ("c",), ("d",))),
        # straight through c between two samples, far from it at both
        ([(4.0, -3.0), (4.0, -1.2), (4.0, 1.2)], (("a", "c"), ("b",), ("d",))),
        ([(0.0, 0.0), (0.0, 5.0), (8.0, 5.0)], (("a",), ("b",), ("c",), ("d",))),
    ],
)
def test_a_body_that_comes_near_another(path, expected) -> None:
    scene = scene_of()
    assert independent_parts(scene, history_of(scene, still(a=path))) == expected


def test_a_body_that_was_lost_from_sight_may_have_been_anywhere() -> None:
    scene = scene_of()
    history = history_of(scene, still())
    frame = history.to_dataframe()
    frame.loc[(frame["body"] == "b") & (frame["time"] == 0.2), "x"] = np.nan
    assert independent_parts(scene, History.from_dataframe(frame, scene)) == (NAMES,)


def test_joints_couple() -> None:
    joined = scene_of(JOINT)
    parts = independent_parts(joined, history_of(joined, still()))
    assert parts == (("a", "b"), ("c",), ("d",))
    pinned = scene_of(Joint("hinge", ("a", "world"), (0.1, 0.0), (0.1, 0.0)))
    assert len(independent_parts(pinned, history_of(pinned, still()))) == 4
    anything = scene_of(Joint("hinge", known=False))
    assert independent_parts(anything, history_of(anything, still())) == (NAMES,)


def test_recorded_pairs_that_collide_stay_together() -> None:
    folder = RECORDED / "pair-null"
    if not folder.exists():
        pytest.skip(f"{folder} is not there")
    scene = Scene.load(folder / "scene.toml")
    assert len(independent_parts(scene, History.load(folder / "train.csv", scene))) == 1


# -- the engine in parts ---------------------------------------------------------------------------

WALLS = (Wall((-1, -3), (9, -3)), Wall((-1, 3), (9, 3)))


@pytest.fixture(scope="module")
def worlds():
    """A scene of three parts, two bodies hinged together, whole and apart; and inputs."""
    scene = scene_of(JOINT, walls=WALLS)
    layout = build_layout(scene)
    parts = (("a", "b"), ("d",), ("c",))
    rng = np.random.default_rng(1)
    start = rng.normal(0, 0.1, (12, 4, 6))
    start[..., 0] += 2.0 * np.arange(4)
    start[:, 1] = start[:, 0] + [0.6, 0, 0, 0, 0, 0]  # where the hinge holds it
    start[:, :2, 2] = start[:, :2, 5] = 0.0
    phi = np.array([prior.sample(rng, 1)[0] for prior in layout.priors])
    actions = rng.normal(0, 0.3, (12, 2, 4, 3))
    whole = Simulator(Physics(scene, substeps=320))
    parted = PartedSimulator(Physics(scene, parts=parts, substeps=320))
    return whole, parted, phi, start, actions


def test_parts_are_the_whole(worlds) -> None:
    whole, parted, phi, start, actions = worlds
    expected = whole(phi, start, actions)
    # a wheel that is not joined has steps of its own, and in the whole those of the joined bodies
    got = parted(phi, start, actions)
    np.testing.assert_allclose(got[:, :, :2], expected[:, :, :2], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-3)
    assert np.median(np.abs(got - expected)) < 1e-6
    np.testing.assert_array_equal(parted.recall(phi, start, actions), parted(phi, start, actions))


def test_proposals_and_derivative_are_the_whole_s(worlds) -> None:
    whole, parted, phi, start, actions = worlds
    proposals = np.tile(phi, (5, 1))
    proposals[1, 0] *= 1.1
    proposals[2, -1] *= 0.9
    proposals[3] = phi * 1.01
    np.testing.assert_allclose(
        parted(proposals, start, actions), whole(proposals, start, actions), rtol=1e-3, atol=1e-3
    )
    slopes, expected = (one.jacobian(phi, start, actions) for one in (parted, whole))
    np.testing.assert_allclose(slopes[:, :, :2], expected[:, :, :2], atol=1e-3)
    assert np.median(np.abs(slopes - expected)) < 1e-6


def test_threads_share_a_memory() -> None:
    """Each gets its own argument's value, also while others push it out."""
    memory, arguments = Memory(1), np.tile(np.arange(4.0), 5000)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            got = list(pool.map(lambda x: memory.recall((x,), np.exp), arguments[:, None]))
    finally:
        sys.setswitchinterval(interval)
    np.testing.assert_array_equal(np.ravel(got), np.exp(arguments))
    copy = pickle.loads(pickle.dumps(memory))
    assert copy.recall((np.ones(1),), np.exp) == np.exp(1)


def test_only_what_moved_is_simulated_again(worlds, monkeypatch) -> None:
    _, parted, phi, start, actions = worlds
    runs = []
    for part in parted.parts:

        def counted(own, *rest, original=part.simulator, names=tuple(part.bodies)):
            runs.append((names, len(np.atleast_2d(own))))
            return original(own, *rest)

        monkeypatch.setattr(part, "simulator", counted)
    parted.recall(phi, start, actions)
    runs.clear()
    moved = phi.copy()
    moved[parted.parts[1].places[0]] *= 1.1
    parted.recall(moved, start, actions)
    assert runs == [((3,), 1)]
    parted.recall(phi, start, actions)
    assert len(runs) == 1
    parted.recall(phi, start + 1e-9, actions)  # other data
    assert len(runs) == 4
    runs.clear()
    parted(np.stack([phi, moved, phi]), start, actions)
    assert sorted(runs) == [((0, 1), 1), ((2,), 1), ((3,), 2)]


def test_each_parameter_is_in_one_block_of_the_sampler() -> None:
    """Also where a part without joints stands beside one whose joint is inferred."""
    scene = scene_of(Joint("hinge", ("a", "b"), (0.3, 0.0), (-0.3, 0.0), known=False))
    places = {name: [(0.6 if name == "b" else 2.0 * i, 0.0)] * 3 for i, name in enumerate(NAMES)}
    model = physics_model(scene, history_of(scene, places))
    layout = problem_in(model).layout
    phi = inside(layout.priors, np.array([prior.centre for prior in layout.priors]))
    blocks = Space(problem_in(model), phi).blocks
    assert len(blocks) == 4  # a and b, c, d, the noise
    assert sorted(np.concatenate(blocks)) == list(range(len(phi) + 6))


def test_labels_of_joints_survive() -> None:
    """The second joint of the scene is the only one of its part, and keeps its name."""
    scene = scene_of(
        Joint("hinge", ("a", "world"), (0.0, 0.0), (0.0, 0.0)),
        Joint("hinge", ("c", "d"), (1.0, 0.0), (-1.0, 0.0), known=False),
    )
    assert scene.subset(["c", "d"]).joint_names == ("joint2",)
    assert scene.subset(["a"]).joint_names == ("joint1",)
    layout = build_layout(scene)
    own = layout.subset(("c", "d", "joint2"))
    assert set(own.labels) <= set(layout.labels)
    assert own.labels == build_layout(scene.subset(["c", "d"])).labels
    assert own.priors == build_layout(scene.subset(["c", "d"])).priors


def test_named_joints() -> None:
    joint = Joint("hinge", ("a", "b"), (0, 0), (0, 0), name="elbow")
    scene = scene_of(joint)
    assert scene.joint_names == ("elbow",)
    assert Scene.from_toml(scene.to_toml()) == scene
    with pytest.raises(SceneError, match='two joints are called "joint1"'):
        scene_of(JOINT, Joint("hinge", ("c", "d"), (0, 0), (0, 0), name="joint1"))


def test_parts_must_be_a_partition() -> None:
    scene = scene_of()
    with pytest.raises(SimulationError, match="each moving body once: a, b, c, d"):
        PartedSimulator(Physics(scene, parts=(("a",), ("b", "c"))))
    parted = PartedSimulator(Physics(scene, parts=(("a", "b"), ("c", "d"))))
    with pytest.raises(SimulationError, match="phi has shape"):
        parted.recall(np.zeros(3), np.zeros((1, 4, 6)), np.zeros((1, 1, 4, 3)))
