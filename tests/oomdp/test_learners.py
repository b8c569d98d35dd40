"""LWR and OO-LWR as learners: invariance, conditions, collisions, bad input."""

import numpy as np
import pytest

from pbrl_ppl.errors import FitError, HistoryError, SimulationError
from pbrl_ppl.history import from_segments
from pbrl_ppl.oomdp import LWR, OOLWR, SectorContacts
from pbrl_ppl.planning import TransitionModel
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.pucks import FREE, known
from tests.helpers.transitions import transitions

pytestmark = pytest.mark.one_stack

#: A wall along y; what is near it comes from the left.
WALLED = FREE.replace(walls=(Wall((1.0, -50.0), (1.0, 50.0)),))
LOW, HIGH = (0.0, -1.0), (0.8, 1.0)
NO_PUSH = np.zeros((1, 1, 3))
#: As far as the puck comes in an interval.
NEAR = (SectorContacts(radius=0.2),)


def taught(model, *data):
    model.observe(*data)
    return model


def predicted(model, states, wrenches) -> np.ndarray:
    return model.step(states[None], wrenches)[0]


def rmse(model, states, wrenches, after) -> np.ndarray:
    return np.sqrt(((predicted(model, states, wrenches) - after) ** 2).mean(axis=(0, 1)))


@pytest.fixture(scope="module")
def free():
    return transitions(FREE, 300, 1, low=(-1, -1), high=(1, 1))


@pytest.fixture(scope="module")
def near_wall():
    return transitions(WALLED, 3000, 2, low=LOW, high=HIGH)


@pytest.mark.parametrize("kind", [LWR, OOLWR])
def test_free_motion_of_a_puck_elsewhere(kind, free) -> None:
    """From another place and heading, to rounding: the puck's transition is linear."""
    model = taught(kind(FREE), *free)
    assert isinstance(model, TransitionModel)
    states, wrenches, after = transitions(FREE, 200, 3, low=(50, -90), high=(60, -80))
    np.testing.assert_allclose(predicted(model, states, wrenches), after, atol=1e-9)


def test_with_the_pose_a_wall_is_known_by_its_place(near_wall) -> None:
    """Eq. 3 with the pose among the inputs; without, the same push does the same everywhere."""
    heads_on = np.array([[[x, 0.0, 0.4, 2.0, 0.0, 0.0]] for x in (0.1, 0.78)])
    found = {
        invariant: predicted(
            taught(LWR(WALLED, pose_invariant=invariant), *near_wall), heads_on, np.zeros((2, 1, 3))
        )
        for invariant in (True, False)
    }
    added = found[True] - heads_on
    np.testing.assert_allclose(added[0], added[1], atol=1e-12)
    assert found[False][0, 0, 3] > found[False][1, 0, 3] + 1.0


def test_pose_invariance(near_wall) -> None:
    """The whole scene moved and turned: predictions move and turn with it, contacts too."""
    turn, shift = 2.3, np.array([4.0, -7.0])
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(states):
        new = states.copy()
        new[..., :2] = states[..., :2] @ matrix.T + shift
        new[..., 2] += turn
        new[..., 3:5] = states[..., 3:5] @ matrix.T
        return new

    walls = tuple(
        Wall(tuple(matrix @ w.start + shift), tuple(matrix @ w.end + shift)) for w in WALLED.walls
    )
    model, elsewhere = OOLWR(WALLED), OOLWR(WALLED.replace(walls=walls))
    states, wrenches, after = (part[:500] for part in near_wall)
    turned = wrenches.copy()
    turned[..., :2] = wrenches[..., :2] @ matrix.T
    model.observe(states, wrenches, after)
    elsewhere.observe(moved(states), turned, moved(after))
    assert dict(model.conditions("puck")) == dict(elsewhere.conditions("puck"))
    held, pushes, _ = transitions(WALLED, 100, 5, low=LOW, high=HIGH)
    pushed = pushes.copy()
    pushed[..., :2] = pushes[..., :2] @ matrix.T
    here, there = predicted(model, held, pushes), predicted(elsewhere, moved(held), pushed)
    np.testing.assert_allclose(moved(here), there, atol=1e-6)


def test_conditions_are_kept_apart() -> None:
    """A wall in front stops the puck; what is learned of that does not slow free motion."""
    free_start, at_wall = np.zeros((2, 200, 1, 6))
    speed = np.random.default_rng(6).uniform(0.5, 2.0, 200)
    free_start[:, 0, 3] = at_wall[:, 0, 3] = speed
    at_wall[:, 0, 0] = 0.75  # 0.05 m before it touches
    starts = np.concatenate([free_start, at_wall])
    ends = starts.copy()
    ends[:200, 0, 0] += 0.1 * speed
    ends[200:, 0, 0], ends[200:, 0, 3] = 0.8, 0.0
    still = np.zeros((400, 1, 3))
    ahead = np.array([[[0.3, 0, 0, 1.5, 0, 0]], [[0.75, 0, 0, 1.5, 0, 0]]])
    apart = predicted(taught(OOLWR(WALLED), starts, still, ends), ahead, still[:2])
    np.testing.assert_allclose(apart[:, 0, [0, 3]], [[0.45, 1.5], [0.8, 0.0]], atol=0.02)
    mixed = predicted(taught(LWR(WALLED), starts, still, ends), ahead, still[:2])
    np.testing.assert_allclose(mixed[:, 0, 3], 0.75, atol=0.1)  # half of both, in either place


def test_oolwr_beats_lwr_near_a_wall(near_wall) -> None:
    """Held-out transitions that begin within reach of the wall and head for it.

    Measured: vx is off by 0.72 m/s with OO-LWR, by 1.59 m/s with LWR.
    """
    states, wrenches, after = transitions(WALLED, 2000, 7, low=(0.6, -1), high=HIGH)
    hits = (states[:, 0, 3] > 0.5) & (states[:, 0, 0] + 0.1 * states[:, 0, 3] > 0.8)
    held = states[hits], wrenches[hits], after[hits]
    assert hits.sum() > 300
    across = rmse(taught(OOLWR(WALLED, relations=NEAR), *near_wall), *held)[3]
    alone = rmse(taught(LWR(WALLED), *near_wall), *held)[3]
    assert across < 0.6 * alone


def test_unknown_condition_has_no_model(free) -> None:
    model = taught(OOLWR(WALLED), *(part[free[0][:, 0, 0] < 0.5] for part in free))
    assert set(model.conditions("puck")) == {frozenset()}
    ahead = np.array([[[0.0, 0, 0, 1, 0, 0]], [[0.75, 0, 0, 1, 0, 0]]])
    found = predicted(model, ahead, np.zeros((2, 1, 3)))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()
    lost = predicted(model, found, np.zeros((2, 1, 3)))  # and it stays so
    assert np.isfinite(lost[0]).all() and np.isnan(lost[1]).all()
    assert np.isnan(predicted(model, found[1:], NO_PUSH)).all()
    assert predicted(model, ahead[:0], NO_PUSH[:0]).shape == (0, 1, 6)


def test_learning_is_incremental(near_wall) -> None:
    """One by one, in batches or at once, with predictions in between: the same answer."""
    data = tuple(part[:120] for part in near_wall)
    at_once, piecewise = taught(OOLWR(WALLED), *data), OOLWR(WALLED)
    for i in range(60):
        piecewise.observe(*(part[i] for part in data))
        piecewise.step(data[0][None, :3], data[1][:3])
    piecewise.observe(*(part[60:] for part in data))
    states, wrenches, _ = transitions(WALLED, 100, 8, low=LOW, high=HIGH)
    np.testing.assert_allclose(
        predicted(piecewise, states, wrenches), predicted(at_once, states, wrenches), rtol=1e-9
    )
    assert piecewise.transitions == at_once.transitions == 120


def test_learns_from_a_history(near_wall) -> None:
    """Rows that were not measured whole are left out."""
    states, wrenches, after = (part[:50] for part in near_wall)
    lost = after.copy()
    lost[7, 0, 4] = np.nan
    history = from_segments(WALLED, states, wrenches[:, None], lost[:, None])
    model = OOLWR(WALLED)
    model.learn(history)
    kept = np.arange(50) != 7
    other = taught(OOLWR(WALLED), states[kept], wrenches[kept], after[kept])
    assert model.transitions == 49
    assert dict(model.conditions("puck")) == dict(other.conditions("puck"))
    np.testing.assert_allclose(
        predicted(model, states, wrenches), predicted(other, states, wrenches), rtol=1e-9
    )


def test_several_bodies() -> None:
    """Each has its own models; a kinematic one goes where its velocity leads it."""
    scene = Scene(
        time_step=0.1,
        bodies=(
            Body("a", Shape.circle(0.2)),
            Body("finger", Shape.circle(0.1), kinematic=True),
            Body("b", Shape.box(0.4, 0.4)),
        ),
    )
    rng = np.random.default_rng(9)
    states = rng.normal(size=(100, 3, 6))
    states[:, 1, :2], states[:, 2, 0] = (0, 20), 10.0
    actions = rng.normal(size=(100, 3, 3))
    after = states.copy()
    after[..., :3] += 0.1 * states[..., 3:]
    after[:, 0, 3:5] += 0.1 * actions[:, 0, :2]
    after[:, 2, 3:5] += 0.2 * actions[:, 2, :2]
    after[:, 1] = np.nan  # nothing has to explain it
    model = taught(OOLWR(scene), states, actions, after)
    found = predicted(model, states, actions)
    np.testing.assert_allclose(found[:, [0, 2]], after[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(found[:, 1, :3], states[:, 1, :3] + 0.1 * actions[:, 1])
    np.testing.assert_allclose(found[:, 1, 3:], actions[:, 1])
    # the strongest a push of 3 N can do: 1/10 and 2/10 m/s in 0.1 s a newton
    for body, gain in (("a", 1.0), ("b", 2.0)):
        linear, angular = model.acceleration(body, 3.0, 0.5)
        np.testing.assert_allclose([linear[0], angular[0]], [3 * gain, 0.0], atol=1e-9)
    # b comes to a: what touches it is told apart from what touched nothing
    states[:1, 2, :2] = states[:1, 0, :2] + (0.45, 0.0)
    found = predicted(model, states[:1], actions[:1])
    assert np.isnan(found[0, [0, 2]]).all() and np.isfinite(found[0, 1]).all()


def test_angles_take_the_short_way() -> None:
    """A heading that was measured as -3.1 after 3.1 has turned by 0.08, not by -6.2."""
    state, after = np.zeros((2, 1, 6))
    state[0, 2], state[0, 5], after[0, 2], after[0, 5] = 3.1, 0.8, -3.1, 0.8
    for invariant in (True, False):
        model = taught(LWR(FREE, pose_invariant=invariant), state, NO_PUSH[0], after)
        found = predicted(model, state[None], NO_PUSH)
        np.testing.assert_allclose(found[0, 0, 2], 2 * np.pi - 3.1, atol=0.01)


def test_what_runs_away_is_lost() -> None:
    """One transition in which a body doubled its speed: after 30 such steps nothing is known."""
    model = taught(LWR(FREE), [[0, 0, 0, 1.0, 0, 0]], NO_PUSH[0], [[0.1, 0, 0, 2.0, 0, 0]])
    states = np.array([[[[0, 0, 0, 1.0, 0, 0]]]])
    for _ in range(30):
        states = model.step(states, NO_PUSH)
        assert not (abs(states) > 2e6).any()  # a million times the largest
    assert np.isnan(states).all()


def test_nothing_observed() -> None:
    for model in (LWR(FREE), OOLWR(FREE)):
        with pytest.raises(FitError, match=r"nothing was observed yet; observe\(\)"):
            model.step(np.zeros((1, 1, 1, 6)), NO_PUSH)
        with pytest.raises(FitError, match="nothing was observed"):
            model.acceleration("puck", 1.0, 0.0)


def test_bad_transitions() -> None:
    model = OOLWR(FREE)
    good = np.zeros((4, 1, 6)), np.zeros((4, 1, 3)), np.zeros((4, 1, 6))
    bad = [np.array(part) for part in good]
    bad[2][3, 0, 1] = np.nan
    with pytest.raises(HistoryError, match="next_state of puck in transition 3 is not finite"):
        model.observe(*bad)
    with pytest.raises(HistoryError, match=r"action has shape \(4, 1, 2\), expected \(1, 3\)"):
        model.observe(good[0], good[1][..., :2], good[2])
    with pytest.raises(HistoryError, match="got 4, 4, 3 states"):
        model.observe(good[0], good[1], good[2][:3])
    assert model.transitions == 0
    missing = from_segments(FREE, good[0], good[1][:, None], np.full((4, 1, 1, 6), np.nan))
    with pytest.raises(HistoryError, match="none of 4 transitions was measured whole"):
        model.learn(missing)
    with pytest.raises(HistoryError, match="is of puck, expected other"):
        OOLWR(Scene(time_step=0.1, bodies=(Body("other", Shape.circle(0.2)),))).learn(missing)
    model.observe(*good)
    with pytest.raises(SimulationError, match=r"states have shape \(4, 1, 6\)"):
        model.step(good[0], good[1])
    with pytest.raises(FitError, match=r'no moving body "puk".*did you mean "puck"'):
        model.conditions("puk")


def test_rounding_errors_are_no_input() -> None:
    """Pushed along its own x alone; what is left across it is rounding, after two turns."""
    rng = np.random.default_rng(1)
    states, _, _ = transitions(FREE, 40, 1, low=(-2, -2), high=(2, 2))

    def pushed(heading: np.ndarray, force: np.ndarray) -> np.ndarray:
        along = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
        return (force[:, None] * along)[:, None]

    force = rng.choice([-4.0, 0.0, 4.0], 40)
    wrenches, after = pushed(states[:, 0, 2], force), states.copy()
    after[:, :, 3:5] += abs(wrenches[..., :2])  # not linear: distances matter
    states[..., 2] += 4 * np.pi
    after[..., 2] += 4 * np.pi
    model = taught(LWR(FREE), states, wrenches, after)
    heading = np.linspace(-3.0, 3.0, 25)
    same = np.zeros((25, 1, 6))
    same[:, 0, 2] = heading + 4 * np.pi
    speeds = predicted(model, same, pushed(heading, np.full(25, 4.0)))[:, 0, 3:5]
    np.testing.assert_allclose(np.hypot(*speeds.T), np.hypot(*speeds[0]), rtol=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"neighbours": 0}, {"neighbours": 2.5}, {"bandwidth": 0.0}, {"ridge": np.nan}]
)
def test_bad_settings(wrong) -> None:
    with pytest.raises(FitError, match=next(iter(wrong))):
        OOLWR(FREE, **wrong)


def test_paper_s_settings() -> None:
    """Table 2."""
    (contacts,) = OOLWR(FREE).relations
    assert contacts == SectorContacts(sectors=4, rays=10, radius=None, by_object=False)


def test_true_dynamics_are_a_transition_model() -> None:
    assert isinstance(known(FREE), TransitionModel)
    linear, angular = known(FREE).acceleration("puck", 4.0, 0.0)
    np.testing.assert_allclose(linear, 2.0)
    np.testing.assert_allclose(angular, 4.0 * 0.2 / (2.0 * 0.02))
