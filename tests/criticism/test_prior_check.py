"""Could the prior have made these data: yes for good ones; wrong units and masses are named."""

import dataclasses

import numpy as np
import pandas as pd
import pymc as pm
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism.prior_check import (
    QUANTILES,
    informative_horizon,
    prior_predictive_check,
)
from pbrl_ppl.errors import FitError
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.reporting import plot_prior_check, png
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import STATE
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.places import RECORDED, load


@pytest.fixture(scope="module")
def scene():
    return cart_scene()


@pytest.fixture(scope="module")
def history(scene):
    return simulated_history(scene, CART, seed=2, trajectories=6, intervals=12)


def scaled(history, scene, columns, factor) -> History:
    rows = history.to_dataframe()
    rows[columns] *= factor
    return History.from_dataframe(rows, scene)


def named(check) -> set[str]:
    return {sentence.split(" of ")[0] for sentence in check.sentences}


def test_good_data_pass(scene, history) -> None:
    check = pp.prior_predictive_check(physics_model(scene, history), seed=1)
    assert check.sentences == ()
    assert check.diverged == 0
    share = check.dataset["share_inside"]
    assert dict(share.sizes) == {"body": 1, "state": 6}
    assert float(share.min()) > 0.75
    assert dict(check.dataset["measured"].sizes) == {"body": 1, "state": 6, "quantile": 5}


@pytest.mark.skipif(not RECORDED.exists(), reason="no recorded data beside the project")
@pytest.mark.parametrize("name", ["cart-slope", "cart-thrust-bias"])
def test_no_seed_rejects_a_sound_prior(name) -> None:
    """Of 100 draws, two and six seeds of these eight reject; of 400, none."""
    scene, history, _ = load(RECORDED / name)
    problem = problem_in(physics_model(scene, history))
    for seed in range(8):
        assert prior_predictive_check(problem, seed=seed).sentences == ()


def test_the_measured_side_is_the_data_s(scene, history) -> None:
    check = prior_predictive_check(physics_model(scene, history, horizon=2), draws=50)
    assert check.seconds == pytest.approx(0.2)
    segments = history.segments(2)
    change = (segments.observed[:, -1] - segments.start)[:, 0, STATE.index("vx")]
    one = check.dataset.sel(body="cart", state="vx")
    np.testing.assert_allclose(one["measured"], np.quantile(change, QUANTILES))


def test_same_seed_same_answer(scene, history) -> None:
    model = physics_model(scene, history)
    first, again, other = (prior_predictive_check(model, draws=50, seed=s) for s in (1, 1, 2))
    assert first.dataset.identical(again.dataset)
    assert not first.dataset.identical(other.dataset)


def test_degrees_are_named(scene, history) -> None:
    degrees = scaled(history, scene, ["theta", "omega"], 180 / np.pi)
    check = prior_predictive_check(physics_model(scene, degrees))
    assert "omega" in named(check)
    sentence = next(each for each in check.sentences if each.startswith("omega of cart"))
    assert "draws from the prior in 0.1 s" in sentence
    beyond = float(check.dataset["share_beyond"].sel(state="omega").item())
    assert f"({100 * beyond:.0f} % of changes lie beyond all of" in sentence
    assert "check units" in sentence


def test_degrees_of_the_angle_alone(scene, history) -> None:
    """The angle no longer moves as its rate says."""
    check = prior_predictive_check(
        physics_model(scene, scaled(history, scene, ["theta"], 180 / np.pi))
    )
    assert named(check) == {"theta"}


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_mass_wrong_by_a_thousand_is_named(scene, history, factor) -> None:
    def check(mass):
        prior = {"mass": {"mu": float(np.log(mass)), "sigma": 0.5}}
        body = dataclasses.replace(scene.bodies[0], prior=prior)
        return prior_predictive_check(physics_model(scene.replace(bodies=(body,)), history))

    assert check(CART["mass"]).sentences == ()
    assert {"vx", "vy"} <= named(check(factor * CART["mass"]))


@pytest.mark.parametrize(
    ("columns", "factor", "near"),
    [
        (["x", "y", "vx", "vy"], 1000.0, "a factor near 1000: units?"),
        (["force_x", "force_y"], 1000.0, "a factor near 1/1000: units?"),
        (["force_x", "force_y", "torque"], 1 / 9.81, "a factor near 9.81: units?"),
        (["force_x", "force_y", "torque"], 9.81, "a factor near 1/9.81: units?"),
        (["theta", "omega"], 180 / np.pi, "a factor near 57.3: units?"),
    ],
)
def test_a_factor_of_units_is_named(columns, factor, near) -> None:
    """Of a puck whose mass is about known: noise's prior, scaled by the data, hides no factor."""
    prior = {"mass": {"mu": 0.0, "sigma": 0.3}}
    scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1), prior=prior),))
    truth = {"mass": 1.0, "r": 0.2, "mu_c": 0.3}
    history = simulated_history(
        scene, truth, seed=2, trajectories=6, intervals=12, wrench_sd=(2.0, 2.0, 0.02)
    )

    def said(history):
        model = physics_model(scene, history, horizon=informative_horizon(history))
        return prior_predictive_check(model, draws=100).sentences

    assert said(history) == ()
    named = [
        sentence for sentence in said(scaled(history, scene, columns, factor)) if "?" in sentence
    ]
    assert named
    assert all(near in sentence for sentence in named), named


def test_a_prior_wrong_by_a_factor_of_no_unit_is_none_of_units(scene, history) -> None:
    prior = {"mass": {"mu": float(np.log(CART["mass"] / 150.0)), "sigma": 0.1}}
    body = dataclasses.replace(scene.bodies[0], prior=prior)
    check = prior_predictive_check(physics_model(scene.replace(bodies=(body,)), history))
    assert check.sentences
    assert not any("factor" in sentence for sentence in check.sentences)


def test_one_of_few_changes_may_lie_beyond_all_draws(scene, history) -> None:
    """By chance one of six does in every ninth recording; three do if the units are wrong."""
    check = prior_predictive_check(physics_model(scene, history), draws=100)

    def told(share: float, cells: int) -> bool:
        few = check.dataset.assign(
            share_beyond=check.dataset["share_beyond"] * 0 + share,
            cells=check.dataset["cells"] * 0 + cells,
        )
        return bool(dataclasses.replace(check, dataset=few).sentences)

    assert not told(1 / 6, 6)
    assert told(3 / 6, 6)
    assert not told(1.0, 1)
    assert told(0.12, 100)


def test_missing_cells_count_on_neither_side(scene, history) -> None:
    rows = history.to_dataframe()
    rows.loc[rows.index % 3 == 1, "x"] = np.nan
    rows.loc[0, "omega"] = np.nan
    holed = History.from_dataframe(rows, scene)
    check = prior_predictive_check(physics_model(scene, holed))
    assert check.sentences == ()
    segments = holed.segments(1)
    change = (segments.observed[:, -1] - segments.start)[:, 0, 0]
    assert np.isnan(change).any()
    one = check.dataset.sel(body="cart", state="x")
    np.testing.assert_allclose(one["measured"], np.nanquantile(change, QUANTILES))
    assert float(one["share_inside"]) > 0.75


def test_draws_that_diverge_are_left_out_and_counted(scene, history, monkeypatch) -> None:
    model = physics_model(scene, history)
    honest = type(problem_in(model)).predict

    def sometimes(problem, phi, engine=None):
        states = honest(problem, phi, engine)
        states[phi[:, 0] > np.exp(1.0)] = np.nan  # the upper half of the masses
        return states

    monkeypatch.setattr(type(problem_in(model)), "predict", sometimes)
    check = prior_predictive_check(model, draws=60)
    assert 10 < check.diverged < 50
    assert any(f"diverged on {check.diverged} of 60 draws" in each for each in check.sentences)
    assert np.isfinite(check.dataset["predicted"]).all()
    monkeypatch.setattr(
        type(problem_in(model)),
        "predict",
        lambda p, phi, engine=None: np.nan * honest(p, phi),
    )
    with pytest.raises(FitError, match="diverged on 60 of 60 draws"):
        prior_predictive_check(model, draws=60)


def test_everything_known(history) -> None:
    scene = cart_scene(known=CART)
    check = prior_predictive_check(physics_model(scene, history), draws=50)
    assert check.sentences == ()


def test_refusals(scene, history) -> None:
    with pytest.raises(FitError, match="was not made by physics_model"):
        prior_predictive_check(pm.Model())
    with pytest.raises(ValueError, match="draws is 1, expected at least 50"):
        prior_predictive_check(physics_model(scene, history), draws=1)


def test_picture(scene, history) -> None:
    check = prior_predictive_check(physics_model(scene, history), draws=50)
    figure = plot_prior_check(check)
    titles = [axes.get_title() for axes in figure.axes if axes.get_visible()]
    assert [title.split(":")[0] for title in titles] == [f"{name} of cart" for name in STATE]
    share = float(check.dataset["share_inside"].sel(state="vx").item())
    assert f"{100 * share:.0f} % as expected" in titles[STATE.index("vx")]
    assert len(png(figure)) > 10_000


def wave(dt: float, noise: float, turns: float = 0.0) -> History:
    """A free puck that goes 1 m/s along x for 40 rows, and does not move along y."""
    rng = np.random.default_rng(3)
    scene = Scene(time_step=dt, bodies=(Body("puck", Shape.circle(0.1)),))
    time = dt * np.arange(40)
    x = time + 0.1 * time**2 + noise * rng.standard_normal(40)
    theta = np.angle(np.exp(1j * (turns * time + noise * rng.standard_normal(40))))
    rows = {"trajectory": 0, "time": time, "body": "puck", "x": x, "y": 0.0, "theta": theta}
    speeds = {"vx": 1.0, "vy": 0.0, "omega": turns}
    wrench = dict.fromkeys(("force_x", "force_y", "torque"), 0.0)
    return History.from_dataframe(pd.DataFrame(rows | speeds | wrench), scene)


@pytest.mark.parametrize(
    ("dt", "noise", "turns", "low", "high"),
    [
        (0.1, 1e-3, 3.0, 1, 1),  # an interval is 100 times the noise
        (0.001, 1e-3, 3.0, 4, 16),  # it is as large as the noise
        (0.1, 0.0, 60.0, 1, 1),  # nothing is beyond no noise, turned often or not
        (1e-6, 1.0, 3.0, 39, 39),  # nothing shows, whatever the length
    ],
)
def test_prior_is_asked_where_motion_shows(dt, noise, turns, low, high) -> None:
    assert low <= informative_horizon(wave(dt, noise, turns)) <= high


def test_a_recording_of_three_rows_is_asked_as_it_is() -> None:
    history = wave(0.1, 1e-3)
    rows = history.to_dataframe()
    rows = rows[rows["step"] < 3].assign(torque=[0.0, 0.0, np.nan])
    scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))
    rows.loc[rows["step"] == 2, ["force_x", "force_y"]] = np.nan
    assert informative_horizon(History.from_dataframe(rows, scene)) == 1


def test_worse_sensors_than_the_noise_prior_has_are_no_wrong_prior(history, scene) -> None:
    """A clean recording at a high rate, of which a change shows hardly more than noise."""
    rng = np.random.default_rng(4)
    observed = history.dataset["observed"]
    spread = observed.std(("trajectory", "time", "body")).to_numpy()
    noisy = observed + (0, 0, 0, 0.3, 0.3, 0.3) * spread * rng.standard_normal(observed.shape)
    start = history.dataset["start"] + (noisy - observed).fillna(0.0)
    noisier = History(history.dataset.assign(observed=noisy, start=start))
    assert prior_predictive_check(physics_model(scene, noisier), draws=100).sentences == ()


def pushed_straight(dt, velocities, seed=1) -> pd.DataFrame:
    """A body of 2 kg that is pushed along x and never turns; all errors are 0.01."""
    rng = np.random.default_rng(seed)
    rows = []
    for trajectory in range(6):
        force, speed, turn = rng.normal(0.0, 4.0), rng.normal(), 0.3 * rng.normal()
        time = dt * np.arange(30)
        x = speed * time + 0.25 * force * time**2
        states = np.zeros((30, 6))
        states[:, 0], states[:, 2], states[:, 3] = x, turn, speed + 0.5 * force * time
        frame = pd.DataFrame(states + 0.01 * rng.standard_normal((30, 6)), columns=list(STATE))
        frame = frame.assign(trajectory=trajectory, time=time, body="cart", force_x=force)
        frame = frame.assign(step=range(30), force_y=0.0, torque=0.0)
        frame.loc[29, ["force_x", "force_y", "torque"]] = np.nan
        rows.append(frame)
    table = pd.concat(rows, ignore_index=True)
    if velocities == "computed":
        for rate, place in (("vx", "x"), ("vy", "y"), ("omega", "theta")):
            table[rate] = table.groupby("trajectory")[place].transform(
                lambda values: np.gradient(values, dt)
            )
    return table


@pytest.mark.one_stack
@pytest.mark.parametrize("velocities", ["measured", "computed"])
@pytest.mark.parametrize("dt", [0.1, 0.02])
@pytest.mark.parametrize("stated", [{}, {"x": 0.01, "theta": 0.01, "omega": 0.01}])
@pytest.mark.parametrize("whole", [False, True])
def test_a_body_that_never_turns_is_no_wrong_prior(dt, velocities, stated, whole) -> None:
    scene = Scene(time_step=dt, bodies=(Body("cart", Shape.box(0.4, 0.3)),), noise=stated)
    history = History.from_dataframe(pushed_straight(dt, velocities), scene)
    horizon = 29 if whole else informative_horizon(history)
    assert whole or horizon <= 8  # what never turns does not make it longer
    check = prior_predictive_check(physics_model(scene, history, horizon=horizon), draws=100)
    assert check.sentences == ()
    cells = check.dataset["cells"].sel(body="cart")
    rates = cells.sel(state=["vx", "vy", "omega"]).to_numpy()
    assert (rates == 0).all() if velocities == "computed" else (rates > 0).all()
    assert (cells.sel(state=["x", "y", "theta"]) > 0).all()


@pytest.mark.one_stack
def test_stated_noise_is_that_of_the_predictions(scene, history) -> None:
    """Errors as large as the angles explain an angle in degrees."""
    degrees = scaled(history, scene, ["theta"], 180 / np.pi)
    assert named(prior_predictive_check(physics_model(scene, degrees))) == {"theta"}
    noisy_scene = scene.replace(noise={"theta": 3.0})
    assert prior_predictive_check(physics_model(noisy_scene, degrees)).sentences == ()
