"""Each effect is named from data of another engine; clean data yields no name."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kstest

from pbrl_ppl.criticism.score import inseparable, rank_candidates, twins
from pbrl_ppl.effects import attach, candidates, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import find_mode, with_start_noise
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import COLUMNS
from tests.helpers.places import ROOT

EFFECTS = {effect.name: effect for effect in catalogue}

#: What the Box2D generator hides in a cart's history, and how the catalogue describes it.
HIDDEN = {
    "linear_drag": ({"linear_drag": 2.0}, {"coefficient": 2.0}),
    "quadratic_drag": ({"quadratic_drag": 1.5}, {"coefficient": 1.5}),
    "angular_drag": ({"angular_drag": 0.8}, {"coefficient": 0.8}),
    "constant_force": ({"constant_force": (1.0, -1.5)}, {"force_x": 1.0, "force_y": -1.5}),
    "body_force": ({"body_force": (1.2, 0.8)}, {"force_x": 1.2, "force_y": 0.8}),
    "constant_torque": ({"constant_torque": 0.4}, {"torque": 0.4}),
    "push_offset": ({"push_offset": (0.05, -0.06)}, {"offset_x": 0.05, "offset_y": -0.06}),
    "actuator_rotation": ({"actuator_rotation": 0.12}, {"angle": 0.12}),
    "inertia_scale": ({"inertia_scale": 1.3}, {"scale": 1.3}),
}
QUICK = {"angular_drag", "push_offset"}


def mode_of(scene, history, horizon=1, initial=None):
    problem = Problem.of(scene, history, attach(scene), horizon=horizon, threads=2)
    mode = find_mode(problem, seed=3, initial=initial)
    for _ in range(2):
        mode = find_mode(with_start_noise(mode.problem, mode), initial=mode.phi)
    return mode


def ranked(scene, history, **options):
    mode = mode_of(scene, history, **options)
    return rank_candidates(mode, candidates(scene, mode.problem.physics.effects))


@pytest.fixture(scope="module")
def cart():
    return Scene.load(ROOT / "models" / "shopping_cart" / "scene.toml")


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in HIDDEN]
)
def test_the_hidden_effect_comes_first_with_its_size(name, cart, make_history):
    hidden, truth = HIDDEN[name]
    train, _ = make_history.simulate(seed=21, **hidden)
    best = ranked(cart, History.from_dataframe(train, cart))[0].candidate
    assert best.effect == name
    assert best.p_value < 1e-6
    # One linear step from the null value, at the kinked mode of a model that lacks the effect: over
    # seeds 21 to 24 the size was off by 1 to 37 %. The refit's estimate is tested in test_revision.
    size = np.linalg.norm(list(truth.values()))
    error = np.linalg.norm([best.estimate[key] - value for key, value in truth.items()])
    assert error < 0.5 * size


def test_clean_data_of_another_engine_yields_no_name(cart, make_history):
    train, _ = make_history.simulate(seed=22)
    # corrected p-values: a false alarm in one clean history of a hundred, at a fixed seed
    assert ranked(cart, History.from_dataframe(train, cart))[0].candidate.p_value > 0.01


@pytest.fixture(scope="module")
def puck():
    body = Body("puck", Shape.circle(0.2), known={"r": 0.1, "mu_c": 0.3})
    return Scene(time_step=0.1, bodies=(body,), normal_gravity=9.81, substeps=4)


def frictionless_history(scene, rng, n=60, mass=2.0, drag=0.0, push=True):
    """Independent transitions of a free body in closed form, every state measured with noise."""
    dt, noise = scene.time_step, np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])
    rows = []
    for i in range(n):
        start = rng.normal(size=6)
        force = rng.normal(size=2) * (5.0 if push else 0.0)
        rate = drag / mass
        velocity = start[3:5]
        if drag:
            limit = force / drag
            after = limit + (velocity - limit) * np.exp(-rate * dt)
            moved = limit * dt + (velocity - limit) * (1 - np.exp(-rate * dt)) / rate
        else:
            after = velocity + force / mass * dt
            moved = velocity * dt + 0.5 * force / mass * dt**2
        end = np.array([*(start[:2] + moved), start[2] + dt * start[5], *after, start[5]])
        for step, state in enumerate((start, end)):
            measured = state + noise * rng.normal(size=6)
            action = [*force, 0.0] if step == 0 else [np.nan] * 3
            rows.append([i, step, step * dt, "puck", *measured, *action])
    return History.from_dataframe(pd.DataFrame(rows, columns=COLUMNS), scene)


def test_statistic_is_chi_squared_if_nothing_is_missing(puck):
    rng = np.random.default_rng(5)
    uncorrected = []
    for _ in range(40):
        mode = mode_of(puck, frictionless_history(puck, rng), initial=np.array([2.0]))
        (signature,) = rank_candidates(mode, [EFFECTS["constant_force"].on("puck")])
        uncorrected.append(np.exp(signature.log_p))
    # a Kolmogorov-Smirnov test at 0.1 %, at a fixed seed
    assert kstest(uncorrected, "uniform").pvalue > 0.001


def test_drag_cannot_have_the_wrong_sign(puck):
    # a body that is pushed along by its own motion: no drag explains that
    history = frictionless_history(puck, np.random.default_rng(6), drag=-1.0)
    (signature,) = rank_candidates(
        mode_of(puck, history, initial=np.array([2.0])), [EFFECTS["linear_drag"].on("puck")]
    )
    assert signature.candidate.statistic == 0.0
    assert signature.candidate.p_value == 1.0


def test_an_effect_without_a_trace_is_not_identifiable(puck):
    history = frictionless_history(puck, np.random.default_rng(7), push=False)
    mode = mode_of(puck, history, initial=np.array([2.0]))
    (signature,) = rank_candidates(mode, [EFFECTS["push_offset"].on("puck")])
    assert signature.candidate.identifiable == 0.0
    assert signature.candidate.statistic == 0.0
    assert signature.candidate.p_value == 1.0


def test_drags_of_a_single_pendulum_are_twins(make_history):
    scene = Scene.load(ROOT / "models" / "pendulum" / "scene.toml")
    train, _ = make_history.simulate(seed=9, setup=make_history.PENDULUM, pivot_damping=0.02)
    found = ranked(scene, History.from_dataframe(train, scene), horizon=10)
    by_name = {each.attached.effect.name: each for each in found}
    assert twins(by_name["pivot_damping"], by_name["angular_drag"])
    assert twins(by_name["pivot_damping"], by_name["linear_drag"])
    assert not twins(by_name["pivot_damping"], by_name["constant_torque"])
    assert "angular_drag" in inseparable(by_name["pivot_damping"], found)
    assert found[0].attached.effect.name in ("pivot_damping", "angular_drag", "linear_drag")


def test_no_candidates_no_ranking(puck):
    history = frictionless_history(puck, np.random.default_rng(8), n=10)
    assert rank_candidates(mode_of(puck, history, initial=np.array([2.0])), []) == []


def test_a_declared_effect_is_no_candidate(cart):
    declared = replace(cart.bodies[0], effects=("linear_drag",))
    scene = cart.replace(bodies=(declared,))
    names = [one.effect.name for one in candidates(scene, attach(scene))]
    assert "linear_drag" not in names
    assert "quadratic_drag" in names
