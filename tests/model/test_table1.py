"""Table 1: families, hyper-parameters and supports, as PyMC variables, against scipy."""

import numpy as np
import pymc as pm
import pytensor
import pytest
from scipy import stats

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.model.declaration import random_variable
from pbrl_ppl.parameters import BODY_PARAMETERS, WHEEL_PARAMETERS, Prior
from pbrl_ppl.physics import build_layout
from pbrl_ppl.physics.settings import table1
from pbrl_ppl.scene import Body, Scene, Shape

# The paper's Table 1 with a triangle's bounds: x in [-1, 1], y in [-1, 2].
TRIANGLE = Shape.polygon([(-1.0, -1.0), (1.0, -1.0), (0.0, 2.0)])


def truncated(mu, sigma, lower, upper):
    return stats.truncnorm((lower - mu) / sigma, (upper - mu) / sigma, loc=mu, scale=sigma)


TABLE_1 = {
    "mass": stats.lognorm(s=1.5, scale=np.exp(1.0)),
    "r": stats.lognorm(s=1.0, scale=np.exp(-1.5)),
    "mu_c": truncated(0.5, 1.0, 0.0, 1.0),
    "w_x": truncated(0.0, 2.0, -1.0, 1.0),
    "w_y": truncated(0.0, 3.0, -1.0, 2.0),
    "w_theta": stats.uniform(-np.pi, 2 * np.pi),
    "mu_x": truncated(0.5, 1.0, 0.0, 1.0),
    "mu_y": truncated(0.5, 1.0, 0.0, 1.0),
}
SUPPORT = {
    "mass": (0.0, np.inf),
    "r": (0.0, np.inf),
    "mu_c": (0.0, 1.0),
    "w_x": (-1.0, 1.0),
    "w_y": (-1.0, 2.0),
    "mu_x": (0.0, 1.0),
    "mu_y": (0.0, 1.0),
}


def scene_of(*bodies: Body) -> Scene:
    return Scene(time_step=0.1, normal_gravity=9.81, bodies=bodies)


def log_densities(priors: dict[str, tuple[Prior, np.ndarray]]) -> dict[str, np.ndarray]:
    """Log-density of each prior's PyMC variable at some values, compiled together."""
    with pm.Model(coords={"body": ["one"]}):
        outputs = {
            name: pm.logp(random_variable(name, (prior,), dims="body"), values[:, None])
            for name, (prior, values) in priors.items()
        }
    found = pytensor.function([], list(outputs.values()), mode="FAST_COMPILE")()
    return {name: value[:, 0] for name, value in zip(outputs, found, strict=True)}


def test_table_1_families_and_supports() -> None:
    """The variable's density is scipy's, and vanishes outside the paper's support."""
    priors = table1(Body("cart", TRIANGLE, wheel=True))
    assert tuple(priors) == tuple(TABLE_1) == tuple(BODY_PARAMETERS)
    levels = np.array([0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
    points = {name: law.ppf(levels) for name, law in TABLE_1.items()}
    inside = log_densities({name: (priors[name], points[name]) for name in TABLE_1})
    for name, law in TABLE_1.items():
        # the two libraries' normal probabilities agree to 1e-8
        np.testing.assert_allclose(
            inside[name], law.logpdf(points[name]), rtol=1e-6, atol=1e-7, err_msg=name
        )

    beyond = {
        name: np.array([low - 0.01, high + 0.01 if np.isfinite(high) else low - 3.0])
        for name, (low, high) in SUPPORT.items()
    }
    outside = log_densities({name: (priors[name], beyond[name]) for name in SUPPORT})
    for name, values in outside.items():
        assert (values == -np.inf).all(), name
        assert priors[name].support == SUPPORT[name]


FAMILIES = {
    "log_normal": Prior("log_normal", mu=0.7, sigma=0.4),
    "truncated_normal": Prior("truncated_normal", mu=0.2, sigma=0.7, lower=-0.5, upper=1.0),
    "von_mises": Prior("von_mises", mu=0.4, kappa=2.0),
    "normal": Prior("normal", mu=-1.0, sigma=2.0),
    "half_normal": Prior("half_normal", sigma=3.0),
}


def test_least_squares_residual_is_the_variable_s_density() -> None:
    """Half the residual's square is minus the log-density, up to one constant."""
    points = {}
    for name, prior in FAMILIES.items():
        low, high = np.maximum(prior.support[0], -2.5), np.minimum(prior.support[1], 2.5)
        points[name] = np.linspace(low + 0.01, high - 0.01, 9)
    found = log_densities({name: (FAMILIES[name], points[name]) for name in FAMILIES})
    for name, prior in FAMILIES.items():
        constant = found[name] + 0.5 * prior.residual(points[name]) ** 2
        np.testing.assert_allclose(constant, constant[0], err_msg=name)


def test_draws_of_the_variables_stay_in_their_supports() -> None:
    layout = build_layout(scene_of(Body("cart", TRIANGLE, wheel=True)))
    with pm.Model(coords={"body": ["cart"]}) as model:
        for block in layout.blocks:
            random_variable(block.name, block.priors, dims="body")
    named = {variable.name: variable for variable in model.free_RVs}
    assert set(named) == set(BODY_PARAMETERS)
    drawn = pm.draw(list(named.values()), draws=200, random_seed=1, mode="FAST_COMPILE")
    values = dict(zip(named, drawn, strict=True))
    for name, (low, high) in SUPPORT.items():
        assert values[name].shape == (200, 1)
        assert ((values[name] >= low) & (values[name] <= high)).all(), name


def test_known_parameters_are_absent() -> None:
    layout = build_layout(scene_of(Body("cart", TRIANGLE, known={"mass": 2.0, "mu_c": 0.1})))
    assert [block.name for block in layout.blocks] == ["r"]


def test_wheel_parameters_only_where_there_is_a_wheel() -> None:
    cart = Body("cart", TRIANGLE, wheel=True, known={"mu_x": 0.0})
    puck = Body("puck", Shape.circle(0.1), known={"mass": 1.0})
    layout = build_layout(scene_of(cart, puck))
    bodies = {block.name: block.owners for block in layout.blocks}
    assert bodies["mass"] == ("cart",)
    assert bodies["r"] == bodies["mu_c"] == ("cart", "puck")
    assert "mu_x" not in bodies
    for name in set(WHEEL_PARAMETERS) - {"mu_x"}:
        assert bodies[name] == ("cart",)


def test_static_bodies_have_no_parameters() -> None:
    block = Body("block", TRIANGLE, static=True, pose=(0.0, 0.0, 0.0))
    puck = Body("puck", Shape.circle(0.1))
    assert all(one.owners == ("puck",) for one in build_layout(scene_of(block, puck)).blocks)


def test_two_bodies_each_have_their_own_bounds() -> None:
    big = Body("big", Shape.box(4.0, 2.0), wheel=True)
    small = Body("small", Shape.box(1.0, 0.5), wheel=True)
    layout = build_layout(scene_of(big, small))
    (block,) = (block for block in layout.blocks if block.name == "w_x")
    assert [prior.support for prior in block.priors] == [(-2.0, 2.0), (-0.5, 0.5)]
    with pm.Model(coords={"body": ["big", "small"]}):
        variable = random_variable("w_x", block.priors, dims="body")
        low = pm.logp(variable, np.array([1.5, 1.5])).eval(mode="FAST_COMPILE")
    assert np.isfinite(low[0])
    assert low[1] == -np.inf


def test_the_scene_s_prior_replaces_hyper_parameters() -> None:
    body = Body(
        "cart",
        TRIANGLE,
        wheel=True,
        prior={
            "mass": {"mu": 2.0, "sigma": 0.5},
            "w_theta": {"kappa": 9.0},
            "w_x": {"sigma": 0.1},
        },
    )
    found, default = table1(body), table1(Body("cart", TRIANGLE, wheel=True))
    assert (found["mass"].mu, found["mass"].sigma) == (2.0, 0.5)
    assert (found["w_theta"].mu, found["w_theta"].kappa) == (0.0, 9.0)
    assert (found["w_x"].mu, found["w_x"].sigma, found["w_x"].support) == (0.0, 0.1, (-1.0, 1.0))
    assert found["r"] == default["r"]
    values = np.array([0.5, 2.0, 9.0])
    logp = log_densities({"mass": (found["mass"], values)})["mass"]
    np.testing.assert_allclose(logp, stats.lognorm(s=0.5, scale=np.exp(2.0)).logpdf(values))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"mass": {"kappa": 1.0}}, "prior of mass has 'kappa', expected mu and sigma"),
        ({"w_theta": {"sigma": 1.0}}, "prior of w_theta has 'sigma', expected mu and kappa"),
    ],
)
def test_a_hyper_parameter_of_another_family(prior, message) -> None:
    with pytest.raises(ParameterError, match=message):
        table1(Body("cart", TRIANGLE, wheel=True, prior=prior))


def test_unknown_family() -> None:
    known = r"'normall' is unknown; did you mean 'normal'\? \(known: log_normal, .*, categorical\)"
    with pytest.raises(ParameterError, match=known):
        Prior("normall")


def test_effects_follow_table_1_in_the_layout() -> None:
    cart = Body("cart", TRIANGLE)
    puck = Body("puck", Shape.circle(0.1))
    scene = scene_of(cart, puck)
    by_name = {effect.name: effect for effect in catalogue}
    drag, force = by_name["linear_drag"], by_name["constant_force"]
    layout = build_layout(scene, attach(scene, [force.on("puck"), drag]))
    assert layout.labels == (
        "mass[cart]",
        "mass[puck]",
        "r[cart]",
        "r[puck]",
        "mu_c[cart]",
        "mu_c[puck]",
        "constant_force_force_x[puck]",
        "constant_force_force_y[puck]",
        "linear_drag_coefficient[cart]",
        "linear_drag_coefficient[puck]",
    )
    units = {block.name: block.unit for block in layout.blocks}
    assert units["mass"] == "kg"
    assert units["linear_drag_coefficient"] == "kg/s"
