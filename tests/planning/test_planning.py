"""Searches for plans: closed forms, symmetry, limits, uncertainty, and acting on plans."""

from dataclasses import replace
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pbrl_ppl.agents import act
from pbrl_ppl.errors import GoalError
from pbrl_ppl.history import History
from pbrl_ppl.physics import Transition, overlap
from pbrl_ppl.planning import ActionSet, Dynamics, Goal, astar, plan, predicted_path, search
from pbrl_ppl.planning.astar import TimeToGo
from pbrl_ppl.scene import Actuator, Joint, Scene, Shape, Wall
from tests.helpers.pucks import ACROSS, FORCE, FREE, MASS, PUSHES, ROOM, known
from tests.helpers.worlds import body, state

pytestmark = pytest.mark.one_stack  # nothing is fitted here


# -- dynamics --------------------------------------------------------------------------------------


def test_each_draw_moves_its_own_states() -> None:
    """Newton: a force F for a time step adds F/m dt to the velocity, whatever the others do."""
    dynamics = known(FREE, 1.0, 2.0, 4.0)
    states = np.random.default_rng(0).normal(size=(3, 5, 1, 6))
    wrench = np.random.default_rng(1).normal(size=(5, 1, 3))
    after = dynamics.step(states, wrench)
    gain = wrench[None, ..., :2] * 0.1 / np.array([1.0, 2.0, 4.0])[:, None, None, None]
    np.testing.assert_allclose(after[..., 3:5], states[..., 3:5] + gain, atol=1e-12)


def test_threads_and_order_change_nothing() -> None:
    one, many = (Dynamics(ROOM, [[MASS]], threads=threads) for threads in (1, 3))
    states = np.random.default_rng(0).uniform(-2, 2, size=(1, 400, 1, 6))
    wrench = np.random.default_rng(1).normal(size=(400, 1, 3))
    order = np.random.default_rng(2).permutation(400)
    after = one.step(states, wrench)
    np.testing.assert_array_equal(after, many.step(states, wrench))
    np.testing.assert_array_equal(after[:, order], one.step(states[:, order], wrench[order]))


def test_what_diverged_stays_lost() -> None:
    states = np.zeros((1, 2, 1, 6))
    states[0, 1, 0, 0] = np.nan
    after = known().step(states, np.zeros((2, 1, 3)))
    assert np.isfinite(after[0, 0]).all()
    assert np.isnan(after[0, 1]).all()


# -- the bound -------------------------------------------------------------------------------------


def test_bound_is_the_double_integrators_least_time() -> None:
    """From rest over d: sqrt(2 d / a); at speed u towards it, less; away from it, more."""
    goal = Goal.of({"puck": (0.0, 0.0, None)}, tolerance=0.1)
    bound = TimeToGo(known(), goal, PUSHES, state(x=5.1)[None])
    a = np.hypot(FORCE, FORCE) / MASS
    at = np.array([state(x=5.1), state(x=5.1, vx=-1.0), state(x=5.1, vx=1.0), state(x=0.05)])
    root = np.sqrt(1 + 2 * a * 5.0)
    expected = [np.sqrt(10.0 / a), (root - 1) / a, (root + 1) / a, 0.0]
    np.testing.assert_allclose(bound(at[None, :, None])[0], expected, rtol=1e-12)


@pytest.mark.parametrize("at", [(-1.5, -1.0), (-1.5, 0.0), (-2.0, -2.0), (-1.0, -1.0), (-0.5, 0.5)])
def test_bound_goes_around_walls(at) -> None:
    """The shortest way of the puck's centre over the wall's end, to the grid's 1 %.

    Two tangents of the circle about the wall's end that the puck's rim leaves free, and its arc.
    """
    end, rim = np.array([0.0, 1.0]), 0.2
    arms = np.array([at, (1.5, -1.0)]) - end
    far = np.hypot(*arms.T)
    around = 2 * np.pi - np.arccos(arms[0] @ arms[1] / far.prod()) - np.arccos(rim / far).sum()
    shortest = np.sqrt(far**2 - rim**2).sum() + rim * around
    goal = Goal.of({"puck": (1.5, -1.0, None)}, tolerance=0.1)
    start = state(*at)[None]
    bound = TimeToGo(known(ROOM), goal, PUSHES, start)
    a = np.hypot(FORCE, FORCE) / MASS
    found = a / 2 * float(bound(start[None, None])[0, 0]) ** 2 + 0.1
    assert found == pytest.approx(shortest, rel=0.01)


def test_bound_goes_around_walls_for_a_body_with_an_actuator() -> None:
    known_of = {"gain": 1.0, "direction": 0.0}
    jet = Actuator(name="jet", kind="thruster", body="puck", known=known_of)
    start = ACROSS[1], PUSHES, state(-1.5, -1.0)[None]
    driven = Dynamics.known(ROOM.replace(actuators=(jet,)), {"mass": MASS})
    at = state(-1.5, -1.0)[None, None, None]
    assert TimeToGo(driven, *start)(at) == pytest.approx(TimeToGo(known(ROOM), *start)(at))


def test_bound_is_below_what_plans_take() -> None:
    """Along plans that were found, at every step: no plan is quicker than the bound says."""
    rng = np.random.default_rng(0)
    dynamics, goal = known(ROOM), ACROSS[1]
    for _ in range(5):
        start = {"puck": (*rng.uniform([-2.5, -2.5], [-0.5, 2.5]), 0.0, *rng.normal(size=3))}
        found = plan(dynamics, start, goal, PUSHES)
        assert found.reached
        bound = TimeToGo(dynamics, goal, PUSHES, found.start)
        states = found.predicted["predicted"].values[:, :, :, :]
        left = 0.1 * np.arange(len(found.wrenches), -1, -1)
        # the grid knows ways around walls to 1 %, as the test above has it
        assert (bound(states)[0] <= 1.01 * left + 1e-9).all()


# -- A* --------------------------------------------------------------------------------------------


def test_a_straight_push_is_found_and_is_the_quickest() -> None:
    """Constant force over 3 m less the tolerance: sqrt(2 d / a), rounded up to the interval."""
    forward = ActionSet.box("puck", forces=(-FORCE, 0.0, FORCE), durations=(0.1, 0.2))
    found = plan(known(), {"puck": (0, 0, 0)}, {"puck": (3.0, 0.0, None)}, forward, weight=1.0)
    assert found.reached
    least = np.sqrt(2 * (3.0 - 0.2 * 0.2) * MASS / FORCE)
    assert found.duration == pytest.approx(0.1 * np.ceil(least / 0.1))


def test_plans_go_around_walls_and_are_what_the_engine_does() -> None:
    found = plan(known(ROOM), *ACROSS, PUSHES)
    assert found.reached
    assert found.stopped == "goal"
    states = found.predicted["predicted"].values[0]
    assert states[:, 0, 1].max() > 1.0  # over the wall's end
    transition, at = Transition(ROOM, {"mass": MASS}), states[:1]
    for wrench, after in zip(found.wrenches, states[1:], strict=True):
        at = transition.predict(at, wrench[None, None])[:, 0]
        np.testing.assert_allclose(at[0], after, atol=1e-12)
    assert found.distance == pytest.approx(float(np.hypot(*(states[-1, 0, :2] - [1.5, -1.0]))))


def test_the_mirrored_task_costs_the_same() -> None:
    mirrored = ROOM.replace(
        walls=tuple(Wall((-a.start[0], a.start[1]), (-a.end[0], a.end[1])) for a in ROOM.walls)
    )
    one = plan(known(ROOM), *ACROSS, PUSHES, weight=1.0)
    back = replace(ACROSS[1].targets[0], x=-1.5)
    other = plan(
        known(mirrored), {"puck": (1.5, -1.0, 0.0)}, Goal((back,)), PUSHES, weight=1.0
    )  # fmt: skip
    # cells are not mirrored: one plan may be a tenth longer than the other
    assert one.duration == pytest.approx(other.duration, rel=0.12)


def test_without_a_weight_no_plan_is_cheaper() -> None:
    """A* ends where its queue cannot hold a cheaper plan, not at the first that it meets."""
    weighted, without = (plan(known(ROOM), *ACROSS, PUSHES, weight=weight) for weight in (3, 1))
    assert without.reached
    assert without.duration <= weighted.duration
    exhaustive = plan(known(ROOM), *ACROSS, PUSHES, weight=1, improve=True)
    assert without.duration == exhaustive.duration
    assert weighted.nodes < without.nodes <= exhaustive.nodes


def test_the_same_seed_gives_the_same_plan() -> None:
    one, two = (plan(known(ROOM), *ACROSS, PUSHES, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.wrenches, two.wrenches)
    assert one.nodes == two.nodes


def test_going_on_never_makes_it_worse() -> None:
    first = plan(known(ROOM), *ACROSS, PUSHES, weight=5.0)
    better = plan(known(ROOM), *ACROSS, PUSHES, weight=5.0, improve=True, nodes=60_000)
    assert better.reached
    assert better.duration <= first.duration
    assert better.nodes > first.nodes


def test_forbidden_contact_is_avoided() -> None:
    """The wall stops a puck for nothing; a goal that forbids contact is reached without it."""
    goal = {"puck": (2.75, 2.75, None)}
    free = plan(known(ROOM), {"puck": (1.0, 2.0, 0.0)}, goal, PUSHES)
    assert free.reached
    careful = plan(
        known(ROOM), {"puck": (1.0, 2.0, 0.0)},
        Goal.of(goal, contact_penalty=np.inf), PUSHES,
    )  # fmt: skip
    assert careful.reached
    poses = careful.predicted["predicted"].values[0, :, :, :3]
    assert overlap(ROOM, poses).max() < 0


def test_a_goal_that_cannot_be_reached_is_said_with_the_best_found() -> None:
    closed = ROOM.replace(walls=(*ROOM.walls, Wall((0.0, 1.0), (0.0, 3.0))))
    found = plan(known(closed), *ACROSS, PUSHES, nodes=20_000)
    assert not found.reached
    assert found.stopped == "nodes"
    assert "limit of nodes" in found.in_words()
    # at the wall, as near as the puck's rim lets it
    assert found.distance == pytest.approx(1.5 + 0.2, abs=0.2)
    still = ActionSet.box("puck")
    nothing = plan(known(), {"puck": (0, 0, 0)}, {"puck": (3.0, 0, None)}, still)
    assert (nothing.reached, nothing.stopped, len(nothing.wrenches)) == (False, "exhausted", 0)
    assert "do not lead there" in nothing.in_words()


def test_time_is_a_limit_too() -> None:
    found = plan(known(ROOM), *ACROSS, PUSHES, seconds=1e-3)
    assert not found.reached
    assert found.stopped == "time"
    assert "limit of time" in found.in_words()


@pytest.mark.parametrize(
    ("module", "options"),
    [
        (astar, {}),
        (astar, {"draws": 3, "nodes": 20_000}),
        (search, {"method": "mppi", "intervals": 10, "samples": 20}),
    ],
)
def test_a_busy_machine_gives_the_same_plan(module, options, monkeypatch) -> None:
    """The clock goes on by an hour between two looks at it."""
    masses = (1.9, MASS, 2.1)[: options.pop("draws", 1)]
    idle = plan(known(ROOM, *masses), *ACROSS, PUSHES, seed=3, **options)
    hours = SimpleNamespace(monotonic=count(step=3600.0).__next__)
    monkeypatch.setattr(module, "time", hours)
    busy = plan(known(ROOM, *masses), *ACROSS, PUSHES, seed=3, **options)
    assert (busy.nodes, busy.stopped) == (idle.nodes, idle.stopped)
    np.testing.assert_array_equal(busy.wrenches, idle.wrenches)


def test_nodes_are_counted_under_each_draw() -> None:
    """The limit bounds the engine's work: eight draws may have as much as one."""
    closed = ROOM.replace(walls=(*ROOM.walls, Wall((0.0, 1.0), (0.0, 3.0))))
    for masses in ((MASS,), (MASS,) * 8):
        found = plan(known(closed, *masses), *ACROSS, PUSHES, nodes=20_000)
        assert found.stopped == "nodes"
        assert 20_000 <= found.nodes < 24_000
    shown = plan(known(closed), *ACROSS, PUSHES, method="mppi", nodes=20_000)
    assert shown.stopped == "nodes"


def test_an_interrupt_keeps_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(100))
    step = Dynamics.step

    def interrupted(self: Dynamics, *arguments: Any) -> Any:
        if next(calls) == 12:
            raise KeyboardInterrupt
        return step(self, *arguments)

    monkeypatch.setattr(Dynamics, "step", interrupted)
    found = plan(known(ROOM), *ACROSS, PUSHES)
    assert found.stopped == "interrupted"
    assert len(found.wrenches)


def test_already_there_is_a_plan_of_nothing() -> None:
    found = plan(known(), {"puck": (0, 0, 0)}, {"puck": (0.03, 0.0, None)}, PUSHES)
    assert found.reached
    assert found.wrenches.shape == (0, 1, 3)


# -- many draws ------------------------------------------------------------------------------------


def test_draws_that_agree_are_one() -> None:
    """The search goes in other batches, but is bound by the same weight; all predict the same."""
    one, many = plan(known(ROOM), *ACROSS, PUSHES), plan(known(ROOM, *[MASS] * 4), *ACROSS, PUSHES)
    assert one.reached
    assert many.reached
    assert many.duration <= 3.0 * one.duration
    states = many.predicted["predicted"].values
    np.testing.assert_array_equal(states, np.repeat(states[:1], 4, axis=0))


def test_caution_reaches_under_the_worst_draw() -> None:
    """A puck goes as far as it is light: 1.25 to 1.65 m must be right for masses of 1.8 to 2.2 kg.

    With the worst draw alone counting, it is; a plan for the middle one stops at the near edge.
    """
    goal = Goal.of({"puck": (1.45, 0.0, None)}, tolerance=0.2)
    found = plan(known(FREE, 1.8, 2.0, 2.2), {"puck": (0, 0, 0)}, goal, PUSHES, tail=0.01)
    assert found.reached
    ends = found.predicted["predicted"].values[:, -1]
    assert (goal.shortfall(FREE, ends) <= 1.0).all()
    sure = plan(known(), {"puck": (0, 0, 0)}, goal, PUSHES)
    others = predicted_path(known(FREE, 1.8, 2.2), sure.start, sure.wrenches)[:, -1]
    assert sure.reached
    assert goal.shortfall(FREE, others).max() > 1.0


# -- the receding horizon --------------------------------------------------------------------------


def test_mppi_reaches_a_place() -> None:
    goal = Goal.of({"puck": (1.0, 0.5, None)}, speed=0.5)
    found = plan(known(), {"puck": (0, 0, 0)}, goal, PUSHES, method="mppi", seed=1)
    assert found.reached
    again = plan(known(), {"puck": (0, 0, 0)}, goal, PUSHES, method="mppi", seed=1)
    np.testing.assert_array_equal(found.wrenches, again.wrenches)
    assert (abs(found.wrenches[..., :2]) <= np.hypot(FORCE, FORCE) + 1e-12).all()


@pytest.mark.long
def test_mppi_swings_a_pendulum_up() -> None:
    """Torque below what would lift it straight: 0.6 of m g l; it must swing."""
    rod = body("rod", Shape.box(0.8, 0.05), mass=1.0)
    hinge = Joint("hinge", ("world", "rod"), (0.0, 0.0), (-0.4, 0.0))
    scene = Scene(time_step=0.05, gravity=(0.0, -9.81), bodies=(rod,), joints=(hinge,))
    torque = 0.6 * 9.81 * 0.4
    start = {"rod": (0.0, -0.4, -np.pi / 2)}
    goal = Goal.of({"rod": (None, None, np.pi / 2)}, angle_tolerance=0.2)
    swing = ActionSet.box("rod", torques=(-torque, torque))
    found = plan(
        Dynamics(scene, np.zeros((1, 0))), start, goal, swing, method="mppi", horizon=40,
        samples=200, seed=2,
    )  # fmt: skip
    assert found.reached
    assert (abs(found.wrenches[..., 2]) <= torque + 1e-12).all()


# -- acting ----------------------------------------------------------------------------------------


def world(scene: Scene, mass: float, start: Any) -> Any:
    """A world that is not as the model thinks: another mass."""
    truth, at = known(scene, mass), np.array(start)[None, None]

    def play(wrench: np.ndarray) -> np.ndarray:
        nonlocal at
        at = truth.step(at, wrench[None])
        return at[0, 0]

    return play


def test_planning_again_makes_up_for_a_wrong_mass() -> None:
    start, goal = ACROSS
    first = state(*start["puck"])[None]
    blind = act(world(ROOM, 3.0, first), known(ROOM), start, goal, PUSHES)
    assert not blind.reached
    assert blind.plans == 1
    looking = act(world(ROOM, 3.0, first), known(ROOM), start, goal, PUSHES, every=3)
    assert looking.reached
    assert looking.plans > 1
    assert looking.history().n_transitions == len(looking.wrenches)


def test_who_flies_past_the_goal_comes_back() -> None:
    """The start is nearest to the goal of all that is found, but no place to stay at: it moves."""
    unsure = known(FREE, 1.2, MASS, 3.0)
    start, goal = state(x=0.3, vx=4.0)[None], Goal.of({"puck": (0.0, 0.0, None)}, speed=0.5)
    for method, options in (("astar", {"nodes": 2_000}), ("mppi", {"intervals": 5, "samples": 50})):
        one = plan(unsure, start, goal, PUSHES, method=method, **options)
        assert not one.reached
        assert len(one.wrenches)
        still = plan(unsure, state(x=0.3)[None], goal, PUSHES, method=method, **options)
        assert still.distance <= 0.3 + 1e-9
    done = act(world(FREE, 2.2, start), unsure, start, goal, PUSHES, every=6, nodes=5_000)
    assert done.reached


def test_acting_stops_at_its_limit_and_refuses_nonsense() -> None:
    start, goal = ACROSS
    first = state(*start["puck"])[None]
    short = act(world(ROOM, 3.0, first), known(ROOM), start, goal, PUSHES, every=3, intervals=4)
    assert len(short.wrenches) == 4
    with pytest.raises(GoalError, match="every is 0"):
        act(world(ROOM, 3.0, first), known(ROOM), start, goal, PUSHES, every=0)
    with pytest.raises(GoalError, match="the world returned"):
        act(lambda wrench: np.zeros(6), known(ROOM), start, goal, PUSHES)


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": {"pluck": (0, 0, 0)}}, 'did you mean "puck"'),
        ({"start": {}}, "nothing says where puck is"),
        ({"start": {"puck": (0, 0)}}, "got 2 values"),
        ({"start": {"puck": (0, 0, np.nan)}}, "not a finite number"),
        ({"start": np.zeros((2, 6))}, r"expected \(1, 6\)"),
        ({"goal": {"puck": (0.0, 0.0, 0.0)}}, "inside a wall"),
        ({"goal": {"pluck": (0.0, 0.0, 0.0)}}, 'did you mean "puck"'),
        ({"actions": None}, "give actions"),
        ({"method": "a*"}, 'did you mean "astar"'),
        ({"tail": 0.0}, "tail is 0.0"),
        ({"seconds": 0.0}, "seconds is 0.0"),
        ({"nodes": 0}, "nodes 0"),
        ({"weight": 0.5}, "weight is 0.5"),
        ({"method": "mppi", "horizon": 0}, "at least 1"),
    ],
)
def test_a_task_that_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    task = {"start": ACROSS[0], "goal": ACROSS[1], "actions": PUSHES} | changes
    with pytest.raises(GoalError, match=message):
        plan(known(ROOM), **task)


def test_a_plan_is_a_history_without_measurements(tmp_path) -> None:
    found = plan(known(ROOM), *ACROSS, PUSHES)
    found.save(tmp_path / "plan.csv")
    history = History.load(tmp_path / "plan.csv", ROOM)
    assert history.n_transitions == len(found.wrenches)
    (trajectory,) = history.dataset["action"].values
    np.testing.assert_allclose(trajectory[: len(found.wrenches)], found.wrenches)
    assert np.isnan(history.dataset["observed"].values[0, 1:]).all()
