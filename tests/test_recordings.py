"""Benchmark of recordings: its laws against an integrator, its oracle and its scores; no loop."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk
from scipy.stats import binom, kstest

from tests.helpers.places import ROOT

pytestmark = pytest.mark.one_stack

G = 9.81


@pytest.fixture
def bench(monkeypatch):
    """Modules of analysis/recordings, imported as the script imports them."""
    monkeypatch.syspath_prepend(str(ROOT / "analysis"))
    import recordings.cases as cases
    import recordings.laws as laws
    import recordings.one_case as one_case
    import recordings.oracle as oracle
    import recordings.scores as scores
    import running

    return SimpleNamespace(
        cases=cases, laws=laws, one_case=one_case, oracle=oracle, scores=scores, running=running
    )


def path(rate, start, time):
    """States of one trajectory from a plain call of SciPy's integrator, shape (row, state)."""
    found = solve_ivp(rate, (time[0], time[-1]), start, "DOP853", time, rtol=1e-11, atol=1e-13)
    return found.y.T


# --- laws ---


@pytest.mark.parametrize("coefficient", [0.0, 1e-7, 1e-4, 0.05, 1.0])
def test_a_fall_with_linear_drag_solves_its_equation(bench, coefficient) -> None:
    ball, time = bench.laws.Body(0.1, (0.03,)), np.linspace(0.0, 2.0, 21)
    start = np.array([[0.1, 3.0, 0.5, 4.0], [0.0, 9.0, -0.2, -1.0]])
    places = bench.laws.linear_fall(ball, coefficient, start, time, np.zeros((2, 20)))

    def rate(t, s):
        return [s[2], s[3], -coefficient / 0.1 * s[2], -coefficient / 0.1 * s[3] - G]

    for one, expected in zip(places, start, strict=True):
        np.testing.assert_allclose(one, path(rate, expected, time)[:, :2], atol=1e-8)


def test_a_straight_fall_with_quadratic_drag_has_its_closed_form(bench) -> None:
    mass, coefficient, time = 0.02, 0.003, np.linspace(0.0, 2.0, 21)
    start = np.array([[0.0, 5.0, 0.0, 0.0]])
    ball = bench.laws.Body(mass, (0.03,))
    places = bench.laws.quadratic_fall(ball, coefficient, start, time, np.zeros((1, 20)))
    last = math.sqrt(mass * G / coefficient)
    np.testing.assert_allclose(places[0, :, 0], 0.0)
    depth = last**2 / G * np.log(np.cosh(G * time / last))
    np.testing.assert_allclose(places[0, :, 1], 5.0 - depth, atol=1e-8)


def test_a_pendulum_has_its_closed_forms(bench) -> None:
    """Without damping at any angle, by elliptic functions; with damping at small angles."""
    rod, time = bench.laws.Body(0.5, (0.03, 0.6), hinge=0.28), np.linspace(0.0, 3.0, 61)
    still = np.zeros((1, 60))
    own = math.sqrt(rod.mass * G * rod.hinge / rod.inertia)
    top = 1.3
    angle = bench.laws.pendulum(rod, 0.0, np.array([[top, 0.0]]), time, still)[0, :, 0]
    m = math.sin(top / 2) ** 2
    sn = ellipj(ellipk(m) - own * time, m)[0]
    np.testing.assert_allclose(angle, 2 * np.arcsin(math.sqrt(m) * sn), atol=1e-8)
    small, decay = 1e-4, 0.3
    found = bench.laws.pendulum(rod, 2 * decay * rod.inertia, np.array([[small, 0.0]]), time, still)
    damped = math.sqrt(own**2 - decay**2)
    expected = np.cos(damped * time) + decay / damped * np.sin(damped * time)
    np.testing.assert_allclose(found[0, :, 0], small * np.exp(-decay * time) * expected, atol=1e-11)


def test_a_slider_solves_its_equation_until_and_after_it_stops(bench) -> None:
    """Against the integrator, which restarts where the block stops or the force changes."""
    mass, mu, dt, rows = 0.8, 0.2, 0.1, 31
    block, time = bench.laws.Body(mass, (0.2, 0.1)), 0.1 * np.arange(rows)
    rng = np.random.default_rng(1)
    force = np.stack([np.zeros(rows - 1), 3.0 * mu * mass * G * rng.uniform(-1, 1, rows - 1)])
    start = np.array([[0.3, 2.0], [0.0, 0.0]])
    found = bench.laws.slider(block, mu, start, time, force)[..., 0]
    for one, state, pushes in zip(found, start, force, strict=True):
        expected, (x, v), stops = [state[0]], state, 0
        for push in pushes:
            t = 0.0
            while t < dt:
                if v == 0.0 and abs(push) <= mu * mass * G:
                    break
                way = np.sign(v) if v else np.sign(push)
                a = push / mass - mu * G * way

                def stop(t, s):
                    return s[1]

                stop.terminal, stop.direction = True, -way
                path = solve_ivp(
                    lambda t, s, a=a: [s[1], a], (t, dt), [x, v], rtol=1e-10, atol=1e-12,
                    events=stop,
                )  # fmt: skip
                t, (x, v) = path.t[-1], path.y[:, -1]
                if path.status == 1:
                    v, stops = 0.0, stops + 1
            expected.append(x)
        assert stops > 0
        np.testing.assert_allclose(one, expected, atol=1e-8)
    np.testing.assert_allclose(found[0, -1], 0.3 + 2.0**2 / (2 * mu * G))  # where it stays


# --- cases ---


def test_cases_are_as_announced(bench) -> None:
    cases = bench.cases.all_cases()
    assert len({case.name for case in cases}) == len(cases) == 144
    assert sum(case.clean for case in cases) == 72
    assert {case.effect for case in cases} == set(bench.laws.LAWS)
    assert cases == bench.cases.all_cases(0)
    other = bench.cases.all_cases(1)
    assert not {case.sd for case in cases} & {case.sd for case in other}


@pytest.mark.parametrize("world", ["fall", "pendulum", "slider"])
@pytest.mark.parametrize("noise", ["white", "quantised", "outliers"])
def test_a_case_makes_histories_of_positions(bench, world, noise) -> None:
    case = bench.cases.drawn(world, 30, "twelve", noise, False, seed=2)
    train, test = case.recordings()
    assert train.measured.shape[:2] == (12, 30)
    assert test.measured.shape[:2] == (4, 30)
    history = case.history(train)
    assert history.bodies == (case.scene.bodies[0].name,)
    assert history.n_trajectories == 12
    observed = history.dataset["observed"].sel(state=["vx", "vy", "omega"])
    assert observed.isnull().all()
    again, _ = bench.cases.drawn(world, 30, "twelve", noise, False, seed=2).recordings()
    np.testing.assert_array_equal(train.measured, again.measured)
    law = bench.laws.LAWS[case.effect]
    places = law(case.body, case.truth, train.start, train.time, train.force)
    off = (train.measured - places) / case.sd
    assert np.abs(off[train.good]).max() < (1.8 if noise == "quantised" else 5.5)
    assert (~train.good).sum() == (7 if noise == "outliers" else 0)
    if noise == "outliers":
        assert np.linalg.norm(off[~train.good], axis=-1).min() > 24.0


def test_a_bare_log_has_what_was_measured_alone(bench) -> None:
    case = bench.cases.drawn("slider", 30, "one", "white", True, seed=0)
    frame = case.frame(case.recordings()[0], bare=True)
    assert frame["x"].notna().all()
    assert frame[["y", "theta", "vx", "vy", "omega"]].isna().all(axis=None)


# --- oracle ---


@pytest.mark.parametrize("world", ["fall", "slider"])
def test_the_oracle_is_calibrated(bench, world) -> None:
    """Over 40 recordings, one false alarm in 1e-3: sizes, their errors, and clean p-values.

    The coefficient is not negative, so that half of the clean statistics are 0 and the others
    chi-squared: p-values under 1/2 come half as often as the chi-squared distribution says.
    """
    scores, p_values = [], []
    for seed in range(40):
        case = bench.cases.drawn(world, 100, "twelve", "outliers", False, seed)
        found = bench.oracle.ask(case, case.recordings()[0])
        scores.append((found.estimate - case.truth) / found.sd)
        assert 0.7 < found.misfit < 1.3
        clean = bench.cases.drawn(world, 100, "one", "white", True, seed)
        p_values.append(bench.oracle.ask(clean, clean.recordings()[0]).p_value)
    assert kstest(scores, "norm").pvalue > 3e-4
    low = sum(p < 0.5 for p in p_values)
    assert binom.cdf(low, 40, 0.25) > 3e-4 and binom.sf(low - 1, 40, 0.25) > 3e-4


def test_the_oracle_detects_what_is_large(bench) -> None:
    for world in bench.cases.WORLDS:
        case = bench.cases.drawn(world, 30, "one", "quantised", False, seed=0)
        assert bench.oracle.ask(case, case.recordings()[0]).detects
    case = bench.cases.drawn("pendulum", 500, "one", "white", False, seed=0)  # 0.08 s
    assert not bench.oracle.ask(case, case.recordings()[0]).detects


# --- scores ---


def row(bench, verdict, *added, clean=False, p_value=1e-9, hdi=(0.0, 2.0)):
    """A made-up row of a fall with linear drag; an alternative after a slash."""
    findings = {
        "verdict": verdict,
        "added": [
            {
                "effect": name.split("/")[0],
                "not_separable_from": name.split("/")[1:],
                "parameters": {"coefficient": {"mean": 1.0, "hdi": list(hdi)}},
            }
            for name in added
        ],
    }
    return bench.one_case.Row(
        "made up", "fall", 30, "one", "white", "linear_drag", clean,
        {"linear_drag": ("coefficient", 1.5), "quadratic_drag": None},
        oracle=bench.oracle.Oracle(40.0, p_value, 1.0, 0.1, 1.0),
        findings=None if verdict == "failed" else findings,
        error="why" if verdict == "failed" else None,
        seconds=10.0,
    )  # fmt: skip


def test_scores_by_hand(bench) -> None:
    rows = [
        row(bench, "effects-added", "linear_drag"),  # named, inside
        row(bench, "unexplained", "linear_drag", hdi=(0.0, 1.0)),  # named, outside
        row(bench, "effects-added", "quadratic_drag"),  # named, no true coefficient
        row(bench, "effects-added", "spring/linear_drag"),  # named in a group
        row(bench, "effects-added", "linear_drag", "spring"),  # a wrong name beside it; inside
        row(bench, "effects-added", "spring"),  # a wrong name
        row(bench, "adequate"),  # missed
        row(bench, "failed"),  # missed
        row(bench, "adequate", p_value=0.3),  # not detectable
        row(bench, "effects-added", "spring", p_value=0.3),
        row(bench, "adequate", clean=True, p_value=0.3),
        row(bench, "unexplained", clean=True, p_value=0.3),  # not clean
        row(bench, "effects-added", "linear_drag", clean=True),  # the oracle's false alarm too
    ]
    assert bench.scores.score(rows) == {
        "naming": 4 / 8,
        "extra_names": 1,
        "overcautious": 1,
        "in_group": 1,
        "wrong_names": 1,
        "missed": 2,
        "clean": 1 / 3,
        "undetectable_named": 1,
        "coverage": 2 / 3,
        "oracle_false_alarms": 1,
        "detectable": 8,
        "cases": 13,
        "failed": 1,
        "seconds_median": 10.0,
        "seconds_max": 10.0,
    }
    lines = bench.scores.table(rows).splitlines()
    assert len(lines) == 2 + 12 + 1
    assert "| fall | 30 Hz | 4/8, 2/3 |" in lines[3]


def test_rows_are_kept(bench, tmp_path) -> None:
    case = bench.cases.drawn("fall", 30, "one", "white", True, seed=0)
    where = bench.one_case.cache_path(tmp_path, case, seed=0, bare=False)
    assert bench.one_case.load(where) is None
    made = row(bench, "adequate", clean=True)
    bench.running.save(made, where)
    kept = bench.one_case.load(where)
    assert (kept.name, kept.oracle, kept.verdict) == (made.name, made.oracle, "adequate")
    assert where != bench.one_case.cache_path(tmp_path, case, seed=0, bare=True)
