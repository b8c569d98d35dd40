"""The whole loop: verdicts on histories of other engines and on measured ones."""

import json

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism import revise
from tests.helpers.histories import COLUMNS
from tests.helpers.places import ROOT, load

#: Effect in the truth file -> name in the catalogue, and its parameters' names.
NAMES = {
    "linear_drag": ("linear_drag", ("coefficient",)),
    "slope": ("constant_force", ("force_x", "force_y")),
    "thrust_bias": ("body_force", ("force_x", "force_y")),
    "offset_push": ("push_offset", ("offset_x", "offset_y")),
}
CASES = ("cart-linear-drag", "cart-slope", "cart-thrust-bias", "cart-offset-push")

# a posterior of few draws is enough to test a verdict, and says that it is one
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
]


def test_clean_cart_is_adequate(shared_data):
    found = revise(*load(shared_data / "cart-null"), seed=1, draws=150)
    assert found.verdict == "adequate"
    assert found.added == ()
    assert found.unexplained is None
    # the wheel of the truth lies within its 99.9 % intervals
    truth = json.loads((shared_data / "cart-null" / "truth.json").read_text())["truth"]
    body = truth["bodies"][0]
    expected = {"mass": body["mass"]} | {
        name: body["wheel"][key]
        for name, key in (
            ("w_x", "x"), ("w_y", "y"), ("w_theta", "theta"), ("mu_x", "mu_x"), ("mu_y", "mu_y")
        )
    }  # fmt: skip
    draws = found.posterior_after["posterior"]
    for name, value in expected.items():
        low, high = np.quantile(draws[name].values, [0.0005, 0.9995])
        assert low <= value <= high, (name, low, value, high)


@pytest.mark.parametrize("case", CASES)
def test_the_undeclared_effect_is_added_and_nothing_else(case, shared_data):
    scene, train, test = load(shared_data / case)
    found = revise(scene, train, test, seed=1, draws=150)
    truth = json.loads((shared_data / case / "truth.json").read_text())["undeclared"]
    ((key, value),) = truth.items()
    name, parameters = NAMES[key]
    assert found.candidates[0].effect == name
    assert found.verdict == "effects-added"
    assert [one.effect for one in found.added] == [name]
    for parameter, true in zip(parameters, np.atleast_1d(value), strict=True):
        low, high = found.added[0].parameters[parameter].hdi
        assert low <= true <= high, (parameter, low, true, high)
    assert found.added[0].elpd_difference > 2 * found.added[0].elpd_difference_se
    # leave-one-out on the training data says so too, of every transition
    assert found.loo.elpd_difference > 2 * found.loo.elpd_difference_se
    assert found.loo.transitions == train.n_transitions
    # as good as if the effect had been declared from the start
    declared = revise(scene.with_effects("cart", name), train, test, seed=1, draws=50)
    assert declared.verdict == "adequate"
    ratio = found.after.normalised_rmse / declared.after.normalised_rmse
    assert ratio == pytest.approx(1.0, abs=0.02)
    for dimension, error in found.after.rollout_rmse.items():
        assert error < found.before.rollout_rmse[dimension]


def test_an_effect_outside_the_catalogue_gets_no_wrong_name(make_history):
    scene = pp.Scene.load(ROOT / "models" / "shopping_cart" / "scene.toml")
    histories = make_history.simulate(seed=31, stiction_patch=0.3)
    train, test = (pp.History.from_dataframe(frame, scene) for frame in histories)
    found = revise(scene, train, test, seed=1, draws=50)
    assert found.verdict == "unexplained"
    assert found.unexplained is not None
    assert found.unexplained.body == "cart"


def _tether(state, command, parameters, wrench):
    wrench[0] -= parameters[0] * state[0]
    wrench[1] -= parameters[0] * state[1]


TETHER = pp.Effect(
    "tether",
    (pp.EffectParameter("stiffness", "N/m", pp.Prior("half_normal", sigma=20.0)),),
    "a pull towards the middle of the room that grows with the distance",
    "Hooke's law, F = -k x",
    force=_tether,
)


def tethered_history(stiffness, seed):
    """A free puck on a spring: the closed form of a harmonic oscillator, with noise."""
    rng = np.random.default_rng(seed)
    mass, dt = 2.0, 0.1
    w = np.sqrt(stiffness / mass)
    c, s = np.cos(w * dt), np.sin(w * dt)
    rows = []
    for trajectory in range(8):
        position, velocity = rng.normal(size=2), rng.normal(size=2)
        theta, omega = 0.0, rng.normal()
        for step in range(16):
            force = rng.normal(size=2) * 3.0
            state = np.array([*position, theta, *velocity, omega])
            noisy = state + np.array([2e-3, 2e-3, 4e-3, 1e-2, 1e-2, 2e-2]) * rng.normal(size=6)
            action = [*force, 0.0] if step < 15 else [np.nan] * 3
            rows.append([trajectory, step, step * dt, "puck", *noisy, *action])
            rest = force / stiffness
            offset = position - rest
            position = rest + offset * c + velocity / w * s
            velocity = velocity * c - offset * w * s
            theta += omega * dt
    return pd.DataFrame(rows, columns=COLUMNS)


def test_an_effect_of_the_users_own_is_found():
    puck = pp.Body("puck", pp.Shape.circle(0.2), known={"r": 0.1, "mu_c": 0.3})
    scene = pp.Scene(time_step=0.1, bodies=(puck,), normal_gravity=9.81, substeps=10)
    train, test = (pp.History.from_dataframe(tethered_history(3.0, seed), scene) for seed in (1, 2))
    found = revise(scene, train, test, catalogue=(*pp.catalogue, TETHER), seed=1, draws=200)
    assert [one.effect for one in found.added] == ["tether"]
    low, high = found.added[0].parameters["stiffness"].hdi
    assert low <= 3.0 <= high
    # without it in the catalogue, nothing else takes its name and its place
    blind = revise(scene, train, test, seed=1, draws=50)
    assert blind.verdict == "unexplained"


def test_same_seed_same_findings():
    puck = pp.Body("puck", pp.Shape.circle(0.2), known={"r": 0.1, "mu_c": 0.3})
    scene = pp.Scene(time_step=0.1, bodies=(puck,), normal_gravity=9.81, substeps=10)
    history = pp.History.from_dataframe(tethered_history(3.0, 4), scene)
    first, second = (revise(scene, history, seed=5, draws=20).to_dict() for _ in range(2))
    assert first == second


def test_the_demo_finds_what_is_hidden(tmp_path):
    folder = ROOT / "models" / "shopping_cart"
    loop = pp.close_loop(*load(folder, folder / "recorded"), seed=1, draws=150)
    loop.save(tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "effects-added"
    assert [one["effect"] for one in report["added"]] == ["angular_drag"]
    low, high = report["added"][0]["parameters"]["coefficient"]["hdi"]
    assert low <= 1.2 <= high
    assert pp.load_posterior(tmp_path / "out" / "after.nc")["posterior"]["mass"].size


def test_a_model_without_unknowns_can_be_criticised():
    puck = pp.Body("puck", pp.Shape.circle(0.2), known={"mass": 2.0, "r": 0.1, "mu_c": 0.3})
    scene = pp.Scene(time_step=0.1, bodies=(puck,), normal_gravity=9.81, substeps=10)
    history = pp.History.from_dataframe(tethered_history(3.0, 6), scene)
    found = revise(scene, history, catalogue=(TETHER,), seed=1, draws=50)
    assert [one.effect for one in found.added] == ["tether"]
