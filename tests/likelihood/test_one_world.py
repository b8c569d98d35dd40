"""The likelihood takes bodies apart that were apart in the data; predictions are of one world."""

import json

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from calibration import draw_truths

from pbrl_ppl.criticism import prior_predictive_check
from pbrl_ppl.criticism.held_out import HeldOut, example_rollout
from pbrl_ppl.errors import MeetingWarning
from pbrl_ppl.history import from_segments
from pbrl_ppl.likelihood import ACCELERATION, Problem, TrajectoryLikelihood, along_trajectories
from pbrl_ppl.model import build_model, physics_model, problem_in
from pbrl_ppl.modes import Mode
from pbrl_ppl.modes.search import find_mode
from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.posterior import Fit, evaluate, from_groups, group, problem_of
from pbrl_ppl.sampling import fit, fitting
from pbrl_ppl.sampling.fitting import joined_at
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import STATE

A, B = 0, 1
APART, FORCE = 1.2, 20.0  # m, N


def scene_of(mass: dict[str, float], **known: float) -> Scene:
    """Two pucks, one before the other; that in front has 0.2 kg."""
    rest = {"r": 0.0, "mu_c": 0.0}
    first = Body("a", Shape.circle(0.2), known=rest | known, prior={"mass": mass})
    return Scene(
        time_step=0.2, bodies=(first, Body("b", Shape.circle(0.2), known=rest | {"mass": 0.2}))
    )


#: A prior under which most pucks are so light that the push takes them to the other: below
#: FORCE 0.2^2 / 2 / 0.8 = 0.5 kg. The recorded one has 5 kg and moves by 0.08 m.
LIGHT = scene_of({"mu": -2.0, "sigma": 1.0})
TRUE, TOO_LIGHT = 5.0, 0.1


def recorded(scene: Scene, mass: float, n: int = 20, sigma: float = 0.002):
    """A history of pushes on a, from one world's engine, with noise."""
    rng = np.random.default_rng(0)
    start, actions = np.zeros((n, 2, 6)), np.zeros((n, 1, 2, 3))
    start[:, B, 0] = APART
    actions[:, 0, A, 0] = FORCE * rng.uniform(0.5, 1.0, n)
    engine = Simulator(Physics(scene))
    ends = engine(engine.physics.layout.to_vector({"mass": mass}), start, actions)
    return from_segments(scene, start, actions, ends + sigma * rng.standard_normal(ends.shape))


@pytest.fixture(scope="module")
def model():
    model = physics_model(LIGHT, recorded(LIGHT, TRUE))
    assert problem_in(model).physics.parts == (("a",), ("b",))
    return model


def of_one_world(problem: Problem, phi) -> np.ndarray:
    engine = Simulator(Physics(problem.scene))
    return engine(phi, problem.segments.start, problem.segments.actions)


def within_the_noise(problem: Problem, mass, sigma, next_state) -> None:
    """Draws (draw, ...) are normal about one world's predictions: none is six sigma off.

    False-alarm rate: 2e-9 a cell, below 1e-3 in all.
    """
    expected = of_one_world(problem, mass.reshape(-1, 1))
    off = (next_state - expected) / sigma[:, None, None, None, :]
    assert abs(off).max() < 6.0


def posterior_of(model, phi):
    """Draws (n, 1) of the mass, each with the recorded noise."""
    variables = {"mass": (("chain", "draw", "mass_body"), phi.reshape(1, -1, 1))}
    dims = {"sigma": "state"}
    if isinstance(problem_in(model).likelihood, TrajectoryLikelihood):
        dims = {"sigma": "sensor", ACCELERATION: "velocity"}
    for name, dim in dims.items():
        of = len(problem_in(model).noise_variables[name])
        variables[name] = (("chain", "draw", dim), np.full((1, len(phi), of), 0.002))
    coords = {name: list(model.coords[name]) for name in ("mass_body", *dims.values())}
    return from_groups({"posterior": xr.Dataset(variables, coords)}, {})


@pytest.mark.filterwarnings("ignore:Numba will use object mode")
def test_prior_draws_collide(model) -> None:
    drawn = pm.sample_prior_predictive(50, model=model, random_seed=1)
    prior, values = group(drawn, "prior"), group(drawn, "prior_predictive")["next_state"].values[0]
    mass, sigma = prior["mass"].values[0], prior["sigma"].values[0]
    within_the_noise(problem_in(model), mass, sigma, values)
    pushed = of_one_world(problem_in(model), mass)[:, :, 0, B, 0].max(axis=1) > APART + 0.1
    assert 0.5 < pushed.mean() < 1.0  # P(mass < 0.5 kg) is 0.9


@pytest.mark.filterwarnings("ignore:Numba will use object mode")
def test_posterior_draws_collide(model) -> None:
    phi, sigma = np.array([[TRUE], [TOO_LIGHT]]), np.full((2, 6), 0.002)
    trace = posterior_of(model, phi)
    drawn = pm.sample_posterior_predictive(trace, model=model, random_seed=1, progressbar=False)
    values = group(drawn, "posterior_predictive")["next_state"].values[0]
    within_the_noise(problem_in(model), phi, sigma, values)
    likelihood, stored = evaluate(problem_in(model), phi, sigma, [0, 1], np.random.default_rng(1))
    within_the_noise(problem_in(model), phi, sigma, stored)
    # that of the likelihood is still cheap: part by part
    logp = model.compile_logp(vars=[model["next_state"]])
    point = {"mass_log__": np.log(phi[1]), "sigma_log__": np.log(sigma[1])}
    assert float(logp(point)) == pytest.approx(likelihood[1].sum())


def test_the_prior_check_s_draws_collide(model) -> None:
    check = prior_predictive_check(model, draws=50, seed=1)
    assert float(abs(check.dataset["predicted"].sel(body="b", state="x")).max()) > 0.1


def test_calibration_s_data_collide(model) -> None:
    truths, _ = draw_truths(problem_in(model), 20, seed=1)
    for truth in truths:
        within_the_noise(problem_in(model), truth.phi, truth.sigma[None], truth.values[None])
    assert max(truth.values[..., B, 0].max() for truth in truths) > APART + 0.1


def test_held_out_errors_are_of_one_world(model) -> None:
    phi = np.array([TOO_LIGHT])
    whole = along_trajectories(problem_in(model), np.array([TRUE]))
    sigma = np.full(len(whole.likelihood.noise.sigma), 0.002)
    mode = Mode(whole, phi, sigma, np.zeros((0, 1)), np.eye(1), log_posterior=0.0)
    held = HeldOut.of(mode, problem_in(model).data.history)
    expected = of_one_world(problem_in(model), phi)
    shown = example_rollout(held, held)
    assert shown.body == "a"  # which the other stops
    np.testing.assert_allclose(shown.before[1], expected[0, 0, A], atol=1e-9)
    off = problem_in(model).observations.residual(expected)[:, -1]
    fitted = Fit(whole, posterior_of(build_model(whole), phi))
    errors = held.errors(held, fitted, rollout=1, seed=1, noise=held.mode.sigma)
    for i, name in enumerate(STATE):
        found = errors.one_step_rmse[name]
        assert found == pytest.approx(np.sqrt((off[..., i] ** 2).mean()), rel=1e-6), name


def test_whole_trajectories_are_joined_where_they_collide(model) -> None:
    """At noise parameters of which there are more than state dimensions."""
    whole = along_trajectories(problem_in(model), np.array([TRUE]))
    sigma = np.full((1, len(whole.likelihood.noise.sigma)), 0.002)
    assert joined_at(whole, np.array([[TRUE]]), sigma) is whole
    assert joined_at(whole, np.array([[TOO_LIGHT]]), sigma).physics.together == ("a", "b")


def test_what_has_not_met_is_predicted_as_the_likelihood_has_it(model) -> None:
    problem = problem_in(model)
    data = problem.segments.start, problem.segments.actions
    physics = Physics(LIGHT, parts=problem.physics.parts)
    apart, one = physics.simulator, physics.one_world
    phi = np.array([[TRUE], [0.7 * TRUE]])
    np.testing.assert_array_equal(one(phi, *data), apart(phi, *data))
    np.testing.assert_array_equal(one(phi[0], *data), apart(phi[0], *data))
    light = np.array([TOO_LIGHT])
    np.testing.assert_allclose(one(light, *data), of_one_world(problem, light), atol=1e-9)
    assert abs(one(light, *data) - apart(light, *data)).max() > 0.1


def test_bodies_that_meet_are_joined(model) -> None:
    problem, sigma = problem_in(model), np.full((1, 6), 0.002)
    assert joined_at(problem, np.array([[TRUE]]), sigma) is problem
    joined = joined_at(problem, np.array([[TOO_LIGHT]]), sigma)
    assert joined.physics.parts == (("a", "b"),)
    assert joined.with_data(history=recorded(LIGHT, TRUE, n=5)).physics.parts == (("a", "b"),)
    assert joined_at(joined, np.array([[TOO_LIGHT]]), sigma) is joined


def test_a_body_too_heavy_to_be_moved_is_joined_with_what_meets_it() -> None:
    """One world and the parts say the same of it, to a hundredth of the noise."""
    wall = Body("b", Shape.circle(0.2), known={"r": 0.0, "mu_c": 0.0, "mass": 1e4})
    scene = LIGHT.replace(bodies=(LIGHT.bodies[0], wall))
    problem = Problem.of(Physics(scene), recorded(scene, TRUE))
    joined = joined_at(problem, np.array([[TOO_LIGHT]]), np.full((1, 6), 0.05))
    assert joined.physics.parts == (("a", "b"),)


@pytest.mark.one_stack
@pytest.mark.filterwarnings("ignore:the draws are too few")
@pytest.mark.parametrize("given", [False, True], ids=["searched", "given a mode"])
def test_a_fit_finds_out_that_they_have_met(given, monkeypatch) -> None:
    """A puck that bounces off a heavy one is back before it is seen again."""
    rest = {"r": 0.9, "mu_c": 0.0, "mass": 1e4}
    first = Body("a", Shape.circle(0.2), known={"r": 0.9, "mu_c": 0.0})
    scene = Scene(time_step=0.2, bodies=(first, Body("b", Shape.circle(0.2), known=rest)))
    rng, n = np.random.default_rng(2), 20
    start, actions = np.zeros((n, 2, 6)), np.zeros((n, 1, 2, 3))
    start[:, A, 3], start[:, B, 0] = rng.uniform(10.0, 12.0, n), APART  # back at -0.2 m or so
    actions[:, 0, A, 0] = FORCE * rng.uniform(-1.0, 1.0, n)
    engine = Simulator(Physics(scene))
    ends = engine(engine.physics.layout.to_vector({"mass": 2.0}), start, actions)
    history = from_segments(scene, start, actions, ends + 0.002 * rng.standard_normal(ends.shape))
    model = physics_model(scene, history)
    assert problem_in(model).physics.parts == (("a",), ("b",))
    start = find_mode(problem_in(model), seed=1) if given else None
    if given:  # all is fitted again from there
        monkeypatch.setattr(fitting, "_SEARCHES", {})
    sampler = {"draws": 100, "tune": 100, "chains": 2, "cores": 1, "progress": False}
    with pytest.warns(MeetingWarning, match="a, b meet"):
        idata = fit(model, seed=1, start=start, **sampler)
    mass = group(idata, "posterior")["mass"].values
    assert abs(mass.mean() - 2.0) < 4 * mass.std()
    assert mass.std() < 0.05
    assert json.loads(idata.attrs["together"])
    assert problem_of(idata).physics.parts == (("a", "b"),)
