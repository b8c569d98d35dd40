"""Relations by name, conditions that depend on the action, models shared by class."""

from dataclasses import dataclass

import numpy as np
import pytest

from pbrl_ppl.errors import FitError
from pbrl_ppl.oomdp import OOLWR, Attributes, Pushed, Relation, SectorContacts
from pbrl_ppl.scene import Body, Scene, Shape, Wall

pytestmark = pytest.mark.one_stack

DISC = Shape.circle(0.2)
#: Two chairs, a locked one and a table, far from each other.
PLACES = np.array([[0.0, 0.0], [5.0, 0.0], [10.0, 0.0], [15.0, 0.0]])


def room(**options) -> Scene:
    chair = {"shape": DISC, "object_class": "chair"} | options
    return Scene(
        time_step=0.1,
        bodies=(
            Body("chair1", **chair),
            Body("chair2", **chair),
            Body("locked", **chair, attributes=("wheels_locked",)),
            Body("table", DISC),
        ),
    )


def pushes(acts: list[float], n: int = 60, seed: int = 1):
    """Transitions of bodies that a push of 1 N accelerates by so many m/s^2; None stands still."""
    rng = np.random.default_rng(seed)
    states = np.zeros((n, 4, 6))
    states[..., :2] = PLACES
    states[..., 3:5] = rng.normal(size=(n, 4, 2)) * (np.array(acts)[:, None] != 0)
    wrenches = np.zeros((n, 4, 3))
    wrenches[..., :2] = rng.normal(size=(n, 4, 2))
    after = states.copy()
    after[..., :2] += 0.1 * states[..., 3:5]
    after[..., 3:5] += 0.1 * np.array(acts)[:, None] * wrenches[..., :2]
    return states, wrenches, after


def gains(model: OOLWR) -> np.ndarray:
    """Acceleration of each body by a push of 1 N along x from rest (m/s^2)."""
    states = np.zeros((1, 1, 4, 6))
    states[..., :2] = PLACES
    wrenches = np.zeros((1, 4, 3))
    wrenches[..., 0] = 1.0
    return model.step(states, wrenches)[0, 0, :, 3] / 0.1


def test_relations_are_relations() -> None:
    for relation in (SectorContacts(), Pushed(), Attributes()):
        assert isinstance(relation, Relation)
        scene = room()
        flags = relation.of(scene, np.zeros((3, 4, 6)) + np.pad(PLACES, ((0, 0), (0, 4))),
                            np.zeros((3, 4, 3)))  # fmt: skip
        assert flags[0, 0].size == len(relation.labels(scene)) and flags.shape[:2] == (3, 4)


def test_the_condition_depends_on_the_action() -> None:
    """A body that sticks until it is pushed: two conditions, each with a model."""
    scene = Scene(time_step=0.1, bodies=(Body("crate", DISC),), walls=(Wall((0.3, -1), (0.3, 1)),))
    model = OOLWR(scene, relations=(SectorContacts(radius=0.2), Pushed()))
    assert model.labels == (*(f"contact_{i}" for i in range(4)), "pushed")
    at_wall, away = np.zeros((1, 6)), np.array([[-3.0, 0, 0, 0, 0, 0]])
    push = np.array([[0.0, 2.0, 0.0]])
    for state in (at_wall, away):
        model.observe(state, 0 * push, state)
    model.observe(away, push, away + np.array([0, 0.1, 0, 0, 1.0, 0]))
    assert model.conditions("crate") == {
        frozenset({"contact_0"}): 1, frozenset(): 1, frozenset({"pushed"}): 1,
    }  # fmt: skip
    states = np.stack([away, away, at_wall])[None]
    found = model.step(states, np.stack([push, 0 * push, push]))[0, :, 0, 4]
    np.testing.assert_allclose(found[:2], [1.0, 0.0], atol=1e-9)
    assert np.isnan(found[2])  # pushed at the wall was never seen
    assert OOLWR(scene, relations=()).labels == ()  # one condition alone


def test_chairs_share_their_models_and_the_table_has_its_own() -> None:
    """Each chair is predicted from 120 transitions of both, the heavier table from its own."""
    model = OOLWR(room())
    assert model.labels[-1] == "wheels_locked"  # by default where a body has an attribute
    model.observe(*pushes([2.0, 2.0, 0.5, 0.25]))
    np.testing.assert_allclose(gains(model), [2.0, 2.0, 0.5, 0.25], rtol=1e-6)
    assert model.conditions("chair1") == model.conditions("chair2") == {
        frozenset(): 120, frozenset({"wheels_locked"}): 60,
    }  # fmt: skip
    assert model.conditions("table") == {frozenset(): 60}
    assert model.experience("locked") is model.experience("chair1")
    assert model.experience("table") is not model.experience("chair1")


def test_what_one_chair_met_the_other_knows() -> None:
    """chair1 was at a wall, chair2 and the table never: a model for both chairs, not for it."""
    walls = (Wall((0.3, -1.0), (0.3, 1.0)), Wall((5.3, -1), (5.3, 1)), Wall((15.3, -1), (15.3, 1)))
    scene = room().replace(walls=walls)
    at = np.zeros((1, 4, 6))
    at[0, :, :2] = PLACES
    away = at.copy()
    away[0, 1:, 1] = 5.0
    asked = at[None]
    for shared in (True, False):
        model = OOLWR(scene, relations=(SectorContacts(radius=0.2),), share_classes=shared)
        model.observe(away, np.zeros((1, 4, 3)), away)
        known = np.isfinite(model.step(asked, np.zeros((1, 4, 3)))[0, 0, :, 0])
        assert known.tolist() == [True, shared, True, False]


def test_a_locked_chair_has_a_model_of_its_own() -> None:
    """Without the attribute among the relations, the class has one mixed model."""
    data = pushes([2.0, 2.0, 0.5, 0.25])
    apart, mixed = OOLWR(room()), OOLWR(room(), relations=(SectorContacts(),))
    for model in (apart, mixed):
        model.observe(*data)
    np.testing.assert_allclose(gains(apart)[[0, 2]], [2.0, 0.5], rtol=1e-6)
    together = gains(mixed)
    np.testing.assert_allclose(together[0], together[2])
    assert 0.5 < together[0] < 2.0
    alone = OOLWR(room(), relations=(SectorContacts(),), share_classes=False)
    alone.observe(*data)
    np.testing.assert_allclose(gains(alone), [2.0, 2.0, 0.5, 0.25], rtol=1e-6)


@dataclass(frozen=True)
class Fast:
    """A relation of one's own."""

    def labels(self, scene):
        return ("fast",)

    def of(self, scene, states, wrenches):
        return abs(states[..., 3:4]) > 1.0


def test_a_relation_of_ones_own() -> None:
    model = OOLWR(room(), relations=(Fast(),))
    model.observe(*pushes([2.0] * 4))
    assert {*model.conditions("table")} == {frozenset(), frozenset({"fast"})}


def test_bad_relations() -> None:
    with pytest.raises(FitError, match=r"relations has 'contacts', expected objects with labels"):
        OOLWR(room(), relations=("contacts",))
    with pytest.raises(FitError, match='2 predicates are called "pushed"'):
        OOLWR(room(), relations=(Pushed(), Pushed()))
