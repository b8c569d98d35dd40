"""Laws named by simulation error: falls in closed form, a carriage by SciPy's integrator."""

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from pbrl_ppl.criticism import attribute, close_loop
from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import HistoryError, PriorWarning
from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.counted import of_work
from tests.helpers.falls import BALL, GRAVITY, MASS, fall

pytestmark = [pytest.mark.one_stack, pytest.mark.slow]
TERMINAL = 12.0


def some(*names: str):
    return [effect for effect in catalogue if effect.name in names]


def test_a_drag_is_named_among_the_whole_catalogue() -> None:
    """From four falls with AR(0.9) errors of 1 cm, with its size within 4 sd."""
    found = attribute(BALL, fall(3, terminal=TERMINAL, trajectories=4), seed=1)
    assert [law.effect for law in found.laws] == ["quadratic_drag"]
    (law,) = found.laws
    truth = MASS * GRAVITY / TERMINAL**2
    assert abs(law.estimate["coefficient"] - truth) < 4 * law.sd["coefficient"]
    assert found.after["y"] == pytest.approx(0.01, rel=0.5)
    assert found.before["y"] > 10 * found.after["y"]


@pytest.mark.parametrize("trajectories", [1, 4])
def test_clean_falls_have_no_law(trajectories) -> None:
    """Eight recordings with AR(0.9) errors of 1 cm: no name.

    Of 16 others with one trajectory 4 had a name at the share of a fifth, with four trajectories 0.
    """
    drags = some("linear_drag", "quadratic_drag", "constant_force", "spring")
    for seed in range(8):
        found = attribute(BALL, fall(seed, trajectories=trajectories), catalogue=drags)
        assert not found.laws, (seed, found.laws)


def test_one_fall_is_said_to_be_one() -> None:
    found = attribute(BALL, fall(1, terminal=TERMINAL), catalogue=some("quadratic_drag"))
    assert [law.effect for law in found.laws] == ["quadratic_drag"]
    assert any("record a second" in sentence for sentence in found.sentences)


def slowed(times: float) -> History:
    """Four falls whose clock runs so many times too slowly, with errors of 1 mm."""
    rng, time = np.random.default_rng(2), BALL.time_step * np.arange(40) / times
    states = np.zeros((4, 40, 1, 6))
    states[..., 3:] = np.nan
    for one, speed in zip(states, (1.0, 2.0, 3.0, 4.0), strict=True):
        one[:, 0, 1] = speed * time - 0.5 * GRAVITY * time**2 + rng.normal(0.0, 1e-3, 40)
    return History.of_arrays(states, BALL, np.zeros((4, 39, 1, 3)))


def test_a_force_of_the_size_of_the_weight_is_no_law() -> None:
    """Exported at a quarter of the frames: gravity seems 9.81 / 16."""
    found = attribute(BALL, slowed(4.0))
    assert not found.laws
    assert any("falls with 6.2 % of gravity" in why for why in found.rejected.values())
    with pytest.warns(PriorWarning, match="the clock runs 4 times too fast"):
        loop = close_loop(BALL, slowed(4.0), method="laplace", seed=1)
    assert loop.verdict == "unexplained" and not loop.added
    assert "a wrong unit of time or length" in loop.unexplained.sentence


def test_one_trajectory_shows_no_unusual_law() -> None:
    """However well it would fit: a drag is named, or nothing."""
    said: list[str] = []
    unusual = [one for one in catalogue if one.unusual]
    found = attribute(BALL, fall(1, terminal=TERMINAL), catalogue=unusual, progress=said.append)
    assert not found.laws and not any("unusual" in one for one in said)


def test_unusual_laws_wait_for_common_ones_that_leave_something() -> None:
    """Common laws explain four falls in air with white errors: none is tried beside the drag."""
    said: list[str] = []
    falls = fall(3, terminal=TERMINAL, trajectories=4, memory=0.0)
    found = attribute(BALL, falls, seed=1, progress=said.append)
    assert [law.effect for law in found.laws] == ["quadratic_drag"]
    assert not any("trying unusual ones" in one for one in said)
    totals = of_work(said)
    linearised = [one for one in totals if one.startswith("linearising")]
    assert linearised and all(totals[one] == int(one.split()[1]) for one in linearised)
    assert any(one.startswith("refitting models on pieces of") for one in totals)


def test_gaps_longer_than_the_shortest_pieces() -> None:
    """Every eleventh row measured, as of a block that is seen between pushes: the drag is named."""
    dataset = fall(5, terminal=TERMINAL, trajectories=8, sd=1e-3).dataset.copy()
    for name in ("observed", "start"):
        values = dataset[name].to_numpy().copy()
        hidden = np.arange(values.shape[1]) % 11 > 0
        values[:, hidden, :, 1] = np.nan
        dataset[name] = dataset[name].copy(data=values)
    found = attribute(BALL, History(dataset), catalogue=some("linear_drag", "quadratic_drag"))
    assert [law.effect for law in found.laws] == ["quadratic_drag"]


def test_two_rows_are_refused() -> None:
    with pytest.raises(HistoryError, match="at least 3"):
        attribute(BALL, fall(0, rows=2, trajectories=8))


def test_start_states_that_can_follow_everything_are_refused() -> None:
    """Positions before and after, as of a pushed block: a start velocity explains both."""
    dataset = fall(0, trajectories=6).dataset.copy()
    for name in ("observed", "start"):
        values = dataset[name].to_numpy().copy()
        values[:, 1:-1, :, 1] = np.nan
        dataset[name] = dataset[name].copy(data=values)
    with pytest.raises(HistoryError, match="record more rows of each"):
        attribute(BALL, History(dataset))


def carriage(seed: int, viscous: float, dry: float, push: float) -> tuple[Scene, History]:
    """A carriage of 95 kg that known forces drive along x, its position alone measured."""
    rng, mass, dt, rows = np.random.default_rng(seed), 95.0, 0.02, 51
    scene = Scene(
        time_step=dt, normal_gravity=9.81,
        bodies=(
            Body("carriage", Shape.box(0.3, 0.2), known={"mass": mass, "r": 0.2, "mu_c": 0.2}),
        ),
    )  # fmt: skip
    frames = []
    for number in range(6):
        size, phase, rate = rng.uniform(60, 120, 2), rng.uniform(0, 6, 2), rng.uniform(3, 9, 2)
        force = (size * np.sin(rate * dt * np.arange(rows)[:, None] + phase)).sum(axis=1)
        state, xs = np.array([0.0, 0.5]), [0.0]
        for k in range(rows - 1):

            def slope(_: float, s: np.ndarray, u: float = force[k]) -> list[float]:
                friction = viscous * s[1] + dry * np.tanh(s[1] / 1e-4)
                return [s[1], (u + push - friction) / mass]

            state = solve_ivp(slope, (0, dt), state, method="LSODA", rtol=1e-8, atol=1e-11).y[:, -1]
            xs.append(state[0])
        frame = pd.DataFrame({"trajectory": number, "step": range(rows)})
        frame["time"], frame["body"] = (frame["step"] * dt).round(6), "carriage"
        frame[["y", "theta", "vx", "vy", "omega"]] = np.nan
        frame["x"] = np.array(xs) + rng.normal(0, 2e-5, rows)
        frame["force_x"], frame[["force_y", "torque"]] = force, 0.0
        frame.loc[rows - 1, ["force_x", "force_y", "torque"]] = np.nan
        frames.append(frame)
    return scene, History.from_dataframe(pd.concat(frames), scene)


def test_laws_that_only_help_together() -> None:
    """Viscous and dry friction and a constant force: all three, each within a tenth.

    SciPy's friction is a steep smooth one, the engine's is Coulomb's.
    """
    scene, history = carriage(0, viscous=200.0, dry=20.0, push=-8.0)
    offered = some(
        "linear_drag", "quadratic_drag", "sliding_friction", "constant_force", "force_gain"
    )
    found = attribute(scene, history, catalogue=offered, seed=1)
    laws = {law.effect: law for law in found.laws}
    assert set(laws) == {"linear_drag", "sliding_friction", "constant_force"}
    assert laws["linear_drag"].estimate["coefficient"] == pytest.approx(200.0, rel=0.1)
    assert laws["sliding_friction"].estimate["mu"] * 95 * 9.81 == pytest.approx(20.0, rel=0.1)
    assert laws["constant_force"].estimate["force_x"] == pytest.approx(-8.0, rel=0.1)
    assert found.before["x"] > 20 * found.after["x"]


def _colliding(seed: int, drag: float, e: float = 0.5, sd: float = 1e-3) -> tuple[Scene, History]:
    """Two pucks of 1 kg on a line that meet half-way, in closed form, with errors of 1 mm."""
    rng, dt, radius, rows = np.random.default_rng(seed), 0.05, 0.1, 40
    known = {"mass": 1.0, "mu_c": 0.0}
    pucks = tuple(Body(name, Shape.circle(radius), known=known) for name in ("a", "b"))
    scene = Scene(time_step=dt, bodies=pucks, noise={"x": sd, "y": sd})
    states = np.zeros((6, rows, 2, 6))
    states[..., 3:] = np.nan

    def way(v: np.ndarray, t: np.ndarray) -> np.ndarray:
        gone = -np.expm1(-drag * t) / drag if drag else t
        return np.multiply.outer(gone, v)

    for one in states:
        x, v = np.array([0.0, rng.uniform(0.8, 1.2)]), rng.uniform((0.6, -0.6), (1.2, -0.2))
        gap = (x[1] - x[0] - 2 * radius) / (v[0] - v[1])
        met = -np.log1p(-drag * gap) / drag if drag else gap
        left = v * np.exp(-drag * met)
        after = np.array([
            0.5 * (1 - e) * left[0] + 0.5 * (1 + e) * left[1],
            0.5 * (1 + e) * left[0] + 0.5 * (1 - e) * left[1],
        ])  # fmt: skip
        t = dt * np.arange(rows)
        at_met = x + way(v, np.array([met]))[0]
        places = np.where((t < met)[:, None], x + way(v, t), at_met + way(after, t - met))
        one[..., 0] = places
        one[..., :2] += sd * rng.standard_normal((rows, 2, 2))
    return scene, History.of_arrays(states, scene, np.zeros((6, rows - 1, 2, 3)))


def test_laws_are_found_between_collisions() -> None:
    """A drag on both with its size within 4 sd, and none in clean recordings of the same."""
    laws = some("linear_drag", "constant_force", "spring")
    scene, history = _colliding(0, drag=0.4)
    found = attribute(scene, history, catalogue=laws)
    assert sorted((law.effect, law.body) for law in found.laws) == [
        ("linear_drag", "a"), ("linear_drag", "b"),
    ]  # fmt: skip
    for law in found.laws:
        assert abs(law.estimate["coefficient"] - 0.4) < 4 * law.sd["coefficient"]
    assert not attribute(*_colliding(1, drag=0.0), catalogue=laws).laws


def test_a_puck_that_touches_all_the_time_is_simulated_through_its_contacts() -> None:
    """It rattles between two walls, with one or two intervals of free motion between."""
    walls = tuple(Wall((x, -1.0), (x, 1.0)) for x in (-0.25, 0.25))
    known = {"mass": 1.0, "mu_c": 0.0, "r": 1.0}
    puck = Body("puck", Shape.circle(0.1), known=known)
    scene = Scene(time_step=0.1, bodies=(puck,), walls=walls, substeps=80)
    speed = np.array([1.5, 1.7, 1.9])
    start, push = np.zeros((3, 1, 6)), np.zeros((3, 30, 1, 3))
    start[:, 0, 3] = speed
    after = Physics(scene).predict(np.zeros(0), start, push)
    states = np.concatenate([start[:, None], after], axis=1)
    states += np.random.default_rng(0).normal(0.0, 1e-3, states.shape)
    history = History.of_arrays(states, scene, push)
    found = attribute(scene, history, catalogue=some("linear_drag"))
    assert not found.laws


def test_a_spring_stands_for_the_torque_of_its_anchor() -> None:
    """An arm of 0.4 kg and 0.5 m by SciPy, a spring of 0.13 N m/rad with its rest at 0.15 rad.

    A constant torque is found first, and leaves a part; the spring has it in it.
    """
    rng, dt, rows, moment = np.random.default_rng(4), 0.12, 19, 0.4 * 0.5**2 / 3
    arm = Body("arm", Shape.box(0.02, 0.5), known={"mass": 0.4}, effects=("inertia_scale",))
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.25), (0.0, 0.0))
    scene = Scene(time_step=dt, gravity=(0.0, -9.81), bodies=(arm,), joints=(hinge,))
    states = np.full((9, rows, 1, 6), np.nan)
    for one, start in zip(states, np.linspace(-1.4, 1.2, 9), strict=True):

        def slope(_: float, s: np.ndarray) -> list[float]:
            torque = -0.4 * 9.81 * 0.25 * np.sin(s[0]) - 0.13 * (s[0] - 0.15)
            return [s[1], torque / moment]

        times = dt * np.arange(rows)
        path = solve_ivp(slope, (0, times[-1]), [start, 0.0], t_eval=times, rtol=1e-9, atol=1e-9)
        one[:, 0, [2, 5]] = path.y.T + rng.normal(0.0, [6e-3, 1.2e-2], (rows, 2))
    history = History.of_arrays(states, scene, np.zeros((9, rows - 1, 1, 3)))
    offered = some(
        "constant_torque", "torsion_spring", "sensor_scale", "gravity_tilt", "inertia_scale"
    )
    (law,) = attribute(scene, history, catalogue=offered, seed=1).laws
    assert law.effect == "torsion_spring"
    assert law.estimate["stiffness"] == pytest.approx(0.13, rel=0.03)
    assert law.estimate["angle"] == pytest.approx(0.15, abs=0.02)
