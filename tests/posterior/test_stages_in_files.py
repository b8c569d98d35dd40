"""Effects of every stage in a posterior file: what they look at comes back with it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.effects import catalogue
from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.planning import Dynamics, plan
from pbrl_ppl.posterior import load_posterior, problem_of, save_posterior
from pbrl_ppl.sampling import fit, fitting, update
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

EFFECTS = {effect.name: effect for effect in catalogue}
STAGES = ("mass_change", "actuator_delay", "sensor_bias", "linear_drag", "heavy_tails")
TRUTH = {
    "mass": 2.0,
    "mass_change_factor": 1.5,
    "mass_change_trajectory": 4.0,
    "mass_change_time": 0.0,
    "actuator_delay_share": 0.3,
    "sensor_bias_x": 0.0,
    "sensor_bias_y": 0.0,
    "sensor_bias_theta": 0.0,
    "sensor_bias_vx": 0.1,
    "sensor_bias_vy": 0.0,
    "sensor_bias_omega": 0.05,
    "linear_drag_coefficient": 1.5,
    "heavy_tails_inverse_nu": 0.2,
}


def scene(*names: str) -> Scene:
    puck = Body("puck", Shape.circle(0.2), known={"r": 0.0, "mu_c": 0.0}, effects=names)
    return Scene(time_step=0.1, substeps=10, bodies=(puck,))


def recorded(names, seed=1, trajectories=8, **options) -> History:
    bare = Scene(time_step=0.1, substeps=10, bodies=(scene().bodies[0],))
    truth = {k: v for k, v in TRUTH.items() if k == "mass" or k.startswith(names)}
    return simulated_history(
        bare, truth, seed=seed, trajectories=trajectories, effects=[EFFECTS[n] for n in names],
        **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def history() -> History:
    return recorded(STAGES)


@pytest.fixture(scope="module")
def idata(history):
    declared = scene(*STAGES)
    model = physics_model(declared, history)
    start = problem_in(model).layout.to_vector(TRUTH)
    with pytest.warns(UserWarning):  # so few draws have not converged
        return fit(model, seed=1, draws=60, tune=20, chains=2, progress=False,
                   start=find_mode(problem_in(model), initial=start, rounds=1))  # fmt: skip


def test_a_loaded_file_predicts_as_the_fit(history, idata, tmp_path) -> None:
    """The command before, the trajectory and the clock are in it."""
    save_posterior(idata, tmp_path / "puck.nc")
    loaded = problem_of(load_posterior(tmp_path / "puck.nc"))
    fitted = problem_in(physics_model(scene(*STAGES), history))
    phi = fitted.layout.to_vector(TRUTH)
    np.testing.assert_array_equal(loaded.inputs, fitted.inputs)
    np.testing.assert_array_equal(loaded.predict(phi), fitted.predict(phi))
    moved = fitted.layout.to_vector(TRUTH | {"mass_change_trajectory": 6.0})
    assert np.abs(loaded.predict(moved) - loaded.predict(phi)).max() > 1e-3


@pytest.mark.one_stack
def test_an_update_numbers_its_trajectories_on(idata, monkeypatch) -> None:
    """A load taken up in the fifth trajectory is still there in what is recorded since."""
    since = recorded(STAGES, seed=2, trajectories=1)
    problem = problem_of(idata, history=since)
    assert problem.inputs[..., 6].min() == 8.0
    # few draws, also where the update refits
    few = replace(fitting.METHODS["importance"], draws=60)
    monkeypatch.setattr(fitting, "METHODS", {**fitting.METHODS, "importance": few})
    with pytest.warns(UserWarning):
        result = update(idata, since, seed=1)
    assert json.loads(result.attrs["updates"])[-1]["transitions"] == since.n_transitions


@pytest.mark.one_stack
def test_a_trajectory_that_its_end_cuts_short_has_a_number_too() -> None:
    """After its end it has none, which is not the largest there is."""
    rows = recorded(("mass_change",), trajectories=3, intervals=4).to_dataframe()
    last = (rows["trajectory"] == 1) & (rows["step"] == 2)
    rows.loc[last, ["force_x", "force_y", "torque"]] = np.nan
    rows = rows[(rows["trajectory"] != 1) | (rows["step"] <= 2)]
    declared = scene("mass_change")
    model = physics_model(declared, History.from_dataframe(rows, declared), horizon=4)
    fitted = fit(model, method="map", seed=1, progress=False)
    since = recorded(("mass_change",), seed=2, trajectories=1, intervals=4)
    assert problem_of(fitted, history=since).inputs[0, 0, 0, 6] == 3.0


def test_a_plan_from_the_file_knows_the_load_and_the_delay(idata, tmp_path) -> None:
    save_posterior(idata, tmp_path / "puck.nc")
    loaded = load_posterior(tmp_path / "puck.nc")
    goal = {"puck": (0.5, 0.0, None)}
    in_memory = plan(idata, {"puck": (0, 0, 0)}, goal, nodes=5000)
    from_file = plan(loaded, {"puck": (0, 0, 0)}, goal, nodes=5000)
    np.testing.assert_array_equal(in_memory.wrenches, from_file.wrenches)
    dynamics = Dynamics.of(loaded)
    push = np.array([[[3.0, 0.0, 0.0]]])
    values = dict(zip(dynamics.layout.labels, dynamics.phi[0], strict=True))
    mass = values["mass[puck]"] * values["mass_change_factor[puck]"]
    share = values["actuator_delay_share[puck]"]
    bias = values["sensor_bias_vx[puck]"]
    change = dynamics.step(np.zeros((1, 1, 1, 6)), push)[0, 0, 0, 3]
    drag = values["linear_drag_coefficient[puck]"]
    expected = (3.0 * (1 - share) + drag * bias) * 0.1 / mass  # it moves at minus the bias
    assert change == pytest.approx(expected, rel=0.1)


# -- recovery --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "known", "wrong"),
    [
        ("actuator_delay", {"share": 0.3}, {"share": 0.8}),
        ("sensor_bias", {"vx": 0.1, "omega": 0.05}, {"vx": -0.3}),
        ("mass_change", {"factor": 1.5}, {"factor": 0.7, "trajectory": 4.0}),
    ],
)
def test_a_declared_effect_is_recovered_from_a_wrong_start(name, known, wrong) -> None:
    """The truth within four Laplace sd of each parameter: a false alarm in 0.03 % of recordings."""
    history = noisy(recorded((name,), trajectories=40, intervals=5, noise=0.0))
    problem = problem_in(physics_model(scene(name), history, horizon=5))
    start = {k: v for k, v in TRUTH.items() if k == "mass" or k.startswith(name)}
    start |= {"mass": 3.0} | {f"{name}_{key}": value for key, value in wrong.items()}
    mode = find_mode(problem, initial=problem.layout.to_vector(start))
    for key, value in known.items():
        place = problem.layout.index(f"{name}_{key}", "puck")
        sd = np.sqrt(mode.covariance[place, place])
        assert mode.phi[place] == pytest.approx(value, abs=4 * sd)
        assert sd < 0.1


def noisy(history: History) -> History:
    """Noise on all but the first state of each trajectory: the start is exact, as in Eq. 11."""
    frame = history.to_dataframe()
    rng = np.random.default_rng(3)
    later = (frame["step"] > 0).to_numpy()
    sd = np.array([0.001, 0.001, 0.002, 0.005, 0.005, 0.01])
    columns = ["x", "y", "theta", "vx", "vy", "omega"]
    frame.loc[later, columns] += rng.standard_normal((later.sum(), 6)) * sd
    return History.from_dataframe(frame, scene())
