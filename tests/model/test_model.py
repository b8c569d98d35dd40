"""physics_model: an ordinary pm.Model with the prior of Table 1 and the likelihood of Eq. 11."""

import gc
import math
import weakref
from collections.abc import Mapping

import numpy as np
import pandas as pd
import pymc as pm
import pytest
from scipy import stats

from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import EffectError, HistoryError, SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, along_trajectories
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Joint, Scene, Shape, units_of
from pbrl_ppl.state import STATE, WRENCH
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE
from tests.helpers.places import MODELS
from tests.helpers.plain import PlainSimulator

BY_NAME = {effect.name: effect for effect in catalogue}


@pytest.fixture(scope="module")
def cart() -> tuple[Scene, History]:
    scene = cart_scene()
    return scene, simulated_history(scene, CART, seed=1, trajectories=2, intervals=6)


@pytest.fixture(scope="module")
def pendulum() -> tuple[Scene, History]:
    """Theta and omega alone are measured; the hinge gives the rest."""
    scene = Scene.load(MODELS / "pendulum" / "scene.toml")
    path = MODELS / "pendulum" / "recorded" / "train.csv"
    return scene, History.load(path, scene).select([0, 1])


def expected_logp(model: pm.Model, point: Mapping[str, np.ndarray], priors) -> float:
    """Scipy's log-densities of the priors, and Eq. 11 on predictions of the plain reference.

    ``priors`` gives scipy's distribution of each parameter.
    """
    problem = problem_in(model)
    layout, segments = problem.layout, problem.segments
    simulator = PlainSimulator(
        Physics(problem.scene, problem.physics.effects, substeps=problem.physics.substeps)
    )
    predicted = simulator(layout.to_vector(point), segments.start, segments.actions)
    residual = segments.observed - predicted
    residual[..., 2] = np.angle(np.exp(1j * residual[..., 2]))
    measured = [d for d in range(6) if np.isfinite(segments.observed[..., d]).any()]
    sigma = np.broadcast_to(point["sigma"], len(measured))
    total = np.nansum(stats.norm(0.0, sigma).logpdf(residual[..., measured]))
    for name, law in priors.items():
        total += law.logpdf(point[name]).sum()
    # the weak prior of sigma: log-normal about a tenth of how much the state changes, spread 2
    change = segments.observed - segments.start[:, None]
    change[..., 2] = np.angle(np.exp(1j * change[..., 2]))
    median = 0.1 * np.sqrt(np.nanmean(change[..., measured] ** 2, axis=(0, 1, 2)))
    if problem.likelihood.scalar:
        median = np.exp(np.log(median).mean())
    return total + stats.lognorm(s=2.0, scale=median).logpdf(point["sigma"]).sum()


def constrained(model: pm.Model, point: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The values of the model's variables at a point of the sampler's space."""
    values = {}
    for variable in model.free_RVs:
        value = model.rvs_to_values[variable]
        transform = model.rvs_to_transforms[variable]
        raw = np.asarray(point[value.name])
        back = raw if transform is None else transform.backward(raw, *variable.owner.inputs)
        values[variable.name] = (
            np.asarray(back) if transform is None else np.asarray(back.eval(mode="FAST_COMPILE"))
        )
    return values


def truncated(mu, sigma, lower, upper):
    return stats.truncnorm((lower - mu) / sigma, (upper - mu) / sigma, loc=mu, scale=sigma)


SHARE = truncated(0.5, 1.0, 0.0, 1.0)
PRIORS = {
    "mass": stats.lognorm(s=1.5, scale=math.e),
    "r": stats.lognorm(s=1.0, scale=math.exp(-1.5)),
    "mu_c": SHARE,
    "w_x": truncated(0.0, 0.9, -0.45, 0.45),
    "w_y": truncated(0.0, 0.55, -0.275, 0.275),
    "w_theta": stats.uniform(-np.pi, 2 * np.pi),
    "mu_x": SHARE,
    "mu_y": SHARE,
}
DRAG = {"linear_drag_coefficient": stats.halfnorm(scale=20.0)}


@pytest.mark.parametrize(
    ("body", "options", "priors"),
    [
        pytest.param({}, {}, PRIORS, id="paper"),
        pytest.param({}, {"sigma": "scalar"}, PRIORS, id="scalar sigma"),
        pytest.param({}, {"horizon": 2}, PRIORS, id="horizon 2"),
        pytest.param({}, {"substeps": 4}, PRIORS, id="substeps"),
        pytest.param({"effects": ("linear_drag",)}, {}, PRIORS | DRAG, id="declared effect"),
        pytest.param({}, {"effects": [BY_NAME["linear_drag"]]}, PRIORS | DRAG, id="added effect"),
        pytest.param(
            {"known": {"mass": 6.5}, "wheel": False},
            {},
            {name: PRIORS[name] for name in ("r", "mu_c")},
            id="known mass, no wheel",
        ),
    ],
)
def test_logp_is_the_sum_of_priors_and_eq_11(cart, body, options, priors) -> None:
    _, history = cart
    model = physics_model(cart_scene(**body), history, **options)
    assert {variable.name for variable in model.free_RVs} == {*priors, "sigma"}
    if "linear_drag_coefficient" in priors:  # in the recording's units: half-normal, force / speed
        units = units_of(problem_in(model).scene, "cart")
        scale = units.force / units.speed
        priors = priors | {"linear_drag_coefficient": stats.halfnorm(scale=scale)}
    point = model.initial_point()
    moved = {name: value + 0.1 for name, value in point.items()}
    logp = model.compile_logp(jacobian=False, mode="FAST_COMPILE")
    for at in (point, moved):
        expected = expected_logp(model, constrained(model, at), priors)
        assert np.isfinite(expected)
        # PyMC's truncated normal and scipy's agree to 1e-8
        assert float(logp(at)) == pytest.approx(expected, rel=1e-7)


def test_default_compilation_agrees(cart) -> None:
    """The backend that PyMC chooses gives what plain Python gives."""
    model = physics_model(*cart)
    point = model.initial_point()
    plain = model.compile_logp(mode="FAST_COMPILE")(point)
    assert float(model.compile_logp()(point)) == pytest.approx(float(plain))


def test_names_coordinates_and_dimensions(cart) -> None:
    model = physics_model(*cart)
    assert isinstance(model, pm.Model)
    coords = {name: list(values) for name, values in model.coords.items()}
    assert coords == {
        "body": ["cart"],
        "full_state": list(STATE),
        "state": list(STATE),
        "wrench": list(WRENCH),
        "transition": list(range(12)),
        "step": [1],
    }
    dims = model.named_vars_to_dims
    assert dims["next_state"] == ("transition", "step", "body", "state")
    assert dims["start"] == ("transition", "body", "full_state")
    assert dims["actions"] == ("transition", "step", "body", "wrench")
    assert dims["sigma"] == ("state",)
    for name in PRIORS:
        assert dims[name] == ("body",)
    assert [variable.name for variable in model.observed_RVs] == ["next_state"]
    assert isinstance(problem_in(model), Problem)


def test_bodies_with_different_parameters_have_dimensions_of_their_own() -> None:
    cart = Body("cart", Shape.box(0.9, 0.55), wheel=True)
    puck = Body("puck", Shape.circle(0.2), known={"mass": 1.5})
    scene = Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart, puck))
    history = simulated_history(scene, CART, seed=2, trajectories=1, intervals=4)
    model = physics_model(scene, history, [BY_NAME["linear_drag"].on("puck")])
    dims, coords = model.named_vars_to_dims, model.coords
    assert dims["r"] == ("body",)
    assert coords["body"] == ("cart", "puck")
    assert coords[dims["mass"][0]] == coords[dims["mu_y"][0]] == ("cart",)
    assert coords[dims["linear_drag_coefficient"][0]] == ("puck",)
    logp = model.compile_logp(mode="FAST_COMPILE")
    assert np.isfinite(logp(model.initial_point()))


@OBJECT_MODE
def test_prior_predictive(cart) -> None:
    model = physics_model(*cart)
    with model:
        idata = pm.sample_prior_predictive(draws=5, random_seed=1)
    prior = idata["prior"]
    assert dict(prior["mass"].sizes) == {"chain": 1, "draw": 5, "body": 1}
    predicted = idata["prior_predictive"]["next_state"]
    assert predicted.dims == ("chain", "draw", "transition", "step", "body", "state")
    assert predicted.sizes["transition"] == 12
    assert np.isfinite(predicted.values).all()
    # one draw: its noise about the engine's prediction, in units of its own sigma
    problem = problem_in(model)
    values = {name: prior[name].values[0, 0] for name in PRIORS}
    mean = problem.predict(problem.layout.to_vector(values))
    z = (predicted.values[0, 0] - mean) / prior["sigma"].values[0, 0]
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3  # one false alarm in 1000 seeds


def test_models_are_let_go_of(cart) -> None:
    """PyMC holds on to the functions of its custom distributions."""
    model = physics_model(*cart)
    held = weakref.ref(problem_in(model))
    del model
    gc.collect()
    assert held() is None


def test_measured_variable_can_be_rewritten(cart) -> None:
    """PyTensor makes a variable's Op anew from its properties, to draw in place."""
    op = physics_model(*cart)["next_state"].owner.op
    assert type(op)(**op._props_dict()) == op


def test_graphviz(cart) -> None:
    pytest.importorskip("graphviz", reason="graphviz draws models")
    source = pm.model_to_graphviz(physics_model(*cart)).source
    for name in (*PRIORS, "sigma", "next_state", "actions", "start"):
        assert name in source


def test_pendulum_with_missing_columns(pendulum) -> None:
    """x, y, vx and vy were never measured: the state dimensions are theta and omega."""
    scene, history = pendulum
    model = physics_model(scene, history, horizon=5)
    assert model.coords["state"] == ("theta", "omega")
    assert model.coords["step"] == (1, 2, 3, 4, 5)
    assert {variable.name for variable in model.free_RVs} == {
        "r",
        "mu_c",
        "inertia_scale_scale",
        "sigma",
    }
    point = model.initial_point()
    point["sigma_log__"] = np.log([0.01, 0.1])
    values = constrained(model, point)
    assert values["sigma"] == pytest.approx([0.01, 0.1])
    prior = BY_NAME["inertia_scale"].parameters[0].prior
    assert prior.family == "log_normal"
    priors = {name: PRIORS[name] for name in ("r", "mu_c")} | {
        "inertia_scale_scale": stats.lognorm(s=prior.sigma, scale=math.exp(prior.mu))
    }
    logp = float(model.compile_logp(jacobian=False, mode="FAST_COMPILE")(point))
    # the arm moves to the tolerance of its steps, in the whole recording and in pieces
    assert logp == pytest.approx(expected_logp(model, values, priors), rel=1e-6)


def test_a_missing_cell_takes_no_part(cart) -> None:
    """One unmeasured cell: the log-likelihood lacks that cell's term alone."""
    scene, history = cart
    frame = history.to_dataframe()
    frame.loc[6, "theta"] = np.nan  # last of trajectory 0: it starts no transition
    holed = History.from_dataframe(frame, scene)
    whole_model, model = physics_model(scene, history), physics_model(scene, holed)
    point = whole_model.initial_point()
    at = {"mode": "FAST_COMPILE", "sum": False}
    whole = whole_model.compile_logp(vars=whole_model["next_state"], **at)(point)[0]
    part = model.compile_logp(vars=model["next_state"], **at)(point)[0]
    values = constrained(whole_model, point)
    problem = problem_in(whole_model)
    residual = problem.residual(problem.layout.to_vector(values))[5, 0, 0, 2]
    missing = stats.norm(0.0, values["sigma"][2]).logpdf(residual)
    np.testing.assert_allclose(np.delete(part, 5), np.delete(whole, 5))
    assert part[5] == pytest.approx(whole[5] - missing)


def test_slopes_are_closed_forms() -> None:
    """A free body: x' = x + vx dt, theta' = theta + omega dt."""
    body = Body("puck", Shape.circle(0.2), known={"mass": 1.0, "r": 0.0})
    scene = Scene(time_step=0.1, bodies=(body,))
    history = simulated_history(scene, {"mu_c": 0.1}, seed=3, trajectories=1, intervals=4)
    problem = problem_in(physics_model(scene, history))
    found = along_trajectories(problem, np.array([0.1])).likelihood.noise.slope
    expected = np.eye(6)
    expected[:3, 3:] = 0.1 * np.eye(3)
    np.testing.assert_allclose(found, np.tile(expected, (4, 1, 1)), atol=1e-9)


def test_slopes_follow_the_hinge() -> None:
    """Small swings of a physical pendulum: the transition matrix of a harmonic oscillator."""
    arm = Body("arm", Shape.box(0.03, 0.4), known={"mass": 0.5, "r": 0.0})
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.18), (0.0, 0.0))
    scene = Scene(time_step=0.02, gravity=(0.0, -9.81), substeps=40, bodies=(arm,), joints=(hinge,))
    frame = pd.DataFrame(
        {
            "trajectory": 0,
            "time": [0.0, 0.02, 0.04],
            "body": "arm",
            "theta": [0.0, 1e-4, 0.0],
            "omega": [0.0, 0.0, 1e-3],
            "force_x": [0.0, 0.0, np.nan],
            "force_y": [0.0, 0.0, np.nan],
            "torque": [0.0, 0.0, np.nan],
        }
    )
    for column in ("x", "y", "vx", "vy"):
        frame[column] = np.nan
    problem = problem_in(physics_model(scene, History.from_dataframe(frame, scene)))
    assert problem.observations.names == ("theta", "omega")
    noise = np.array([1e-3, 1e-3, 1e-3])
    found = along_trajectories(problem, np.array([0.1]), noise).likelihood.noise.slope[0]
    moment = (0.03**2 + 0.4**2) / 12 + 0.18**2
    w = math.sqrt(9.81 * 0.18 / moment)
    t = 0.02
    expected = [
        [math.cos(w * t), math.sin(w * t) / w],
        [-w * math.sin(w * t), math.cos(w * t)],
    ]
    # the engine's error is first order in a substep of 2 ms
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-4)


def test_errors(cart) -> None:
    scene, history = cart
    with pytest.raises(ValueError, match="sigma is 'full', expected 'per_dimension' or 'scalar'"):
        physics_model(scene, history, sigma="full")
    with pytest.raises(ValueError, match="horizon is 0, expected at least 1"):
        physics_model(scene, history, horizon=0)
    with pytest.raises(HistoryError, match=r"horizon is 7 intervals, and the longest .* 6"):
        physics_model(scene, history, horizon=7)
    with pytest.raises(EffectError, match=r"'linear_dragg'.* did you mean \"linear_drag\""):
        physics_model(cart_scene(effects=("linear_dragg",)), history)
    with pytest.raises(EffectError, match="pivot_friction applies to no body"):
        physics_model(scene, history, [BY_NAME["pivot_friction"]])


@pytest.mark.parametrize("mass", [1e-300, 1e300, 0.0, np.inf])
def test_an_impossible_proposal_has_no_likelihood(cart, mass) -> None:
    """Minus infinity, never NaN: a body that a push would throw to the stars, or that is none."""
    model = physics_model(*cart)
    likelihood = model.compile_logp(vars=model.observed_RVs)
    point = model.initial_point()
    assert np.isfinite(likelihood(point))
    with np.errstate(divide="ignore"):
        point["mass_log__"] = np.log(np.array([mass]))
    value = float(likelihood(point))
    assert value == -np.inf or (mass == 1e300 and np.isfinite(value))


def test_start_states_that_cannot_be() -> None:
    """The history's row and the bodies are named."""
    two = tuple(Body(name, Shape.circle(0.2)) for name in ("left", "right"))
    scene = Scene(time_step=0.1, bodies=two)
    rows = [
        {"trajectory": t, "time": 0.1 * i, "body": name, "x": x, "y": 0.0, "theta": 0.0}
        | {"vx": 0.0, "vy": 0.0, "omega": 0.0, "force_x": 0.0, "force_y": 0.0, "torque": 0.0}
        for t in (3, 7)
        for i in range(3)
        for name, x in (("left", 0.0), ("right", 0.1 if (t, i) == (7, 1) else 1.0))
    ]
    history = History.from_dataframe(pd.DataFrame(rows), scene)
    where = 'history trajectory 7, step 1: bodies "left" and "right" overlap by 0.3 m'
    with pytest.raises(SimulationError, match=where):
        physics_model(scene, history)


def test_everything_known_but_the_noise() -> None:
    """No physical parameter is left to infer: sigma is, and the model says so or works."""
    body = Body("puck", Shape.circle(0.2), known={"mass": 1.0, "r": 0.0, "mu_c": 0.0})
    scene = Scene(time_step=0.1, bodies=(body,))
    history = simulated_history(scene, {}, seed=3, trajectories=1, intervals=4)
    model = physics_model(scene, history)
    assert [variable.name for variable in model.free_RVs] == ["sigma"]
    assert np.isfinite(model.compile_logp(mode="FAST_COMPILE")(model.initial_point()))
