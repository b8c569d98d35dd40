"""Phi: layouts there and back, and priors against scipy's densities."""

import subprocess
import sys

import numpy as np
import pymc as pm
import pytest
import scipy.stats as stats
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.effects import attach
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.model.declaration import random_variable
from pbrl_ppl.parameters import (
    BODY_PARAMETERS,
    WHEEL_PARAMETERS,
    Block,
    Layout,
    Prior,
    stepped,
)
from pbrl_ppl.physics import build_layout
from pbrl_ppl.physics.settings import table1
from pbrl_ppl.scene import Body, Scene, Shape

pytestmark = pytest.mark.one_stack

BOX = Shape.box(1.0, 0.6)
BODIES = ("one", "two", "three")
NORMAL = Prior("normal")


@st.composite
def layouts(draw) -> Layout:
    names = draw(st.lists(st.sampled_from(list(BODY_PARAMETERS)), unique=True, max_size=5))
    blocks = []
    for name in names:
        on = tuple(draw(st.lists(st.sampled_from(BODIES), unique=True, min_size=1)))
        blocks.append(Block(name, on, "1", (NORMAL,) * len(on)))
    return Layout(tuple(blocks))


def test_a_step_takes_a_mass_no_further_than_ten_times() -> None:
    """A linear step beyond zero would end at the support's end, where drag is too stiff."""
    priors = (Prior("log_normal", mu=0.0, sigma=1.5), Prior("normal"), Prior("half_normal"))
    phi = np.array([2.0, 2.0, 2.0])
    end = stepped(priors, phi, np.array([-100.0, -100.0, -100.0]))
    assert end[0] == pytest.approx(0.2) and end[1] == -98.0 and 0.0 <= end[2] < 1e-5
    far, near = (stepped(priors, phi, np.full(3, size)) for size in (100.0, 0.5))
    np.testing.assert_allclose(far, (20.0, 102.0, 102.0))
    np.testing.assert_allclose(near, 2.5)


# -- layouts ---------------------------------------------------------------------------------------


@given(layouts(), st.integers(0, 3), st.randoms(use_true_random=False))
def test_vector_to_dict_and_back(layout, n, random) -> None:
    vector = np.array([random.gauss(0, 1) for _ in range(layout.size)])
    named = layout.to_dict(vector)
    assert list(named) == [block.name for block in layout.blocks]
    np.testing.assert_array_equal(layout.to_vector(named), vector)
    for position, label in enumerate(layout.labels):
        name, body = label.removesuffix("]").split("[")
        assert layout.index(name, body) == position
    batch = np.stack([vector] * n) if n else np.empty((0, layout.size))
    for block in layout.blocks:
        assert layout.to_dict(batch)[block.name].shape == (n, len(block.owners))


def test_scalars_stand_for_every_body() -> None:
    layout = Layout((Block("mass", ("one", "two"), "kg", (NORMAL, NORMAL)),))
    np.testing.assert_array_equal(layout.to_vector({"mass": 2.0, "other": 1}), [2.0, 2.0])
    np.testing.assert_array_equal(layout.to_vector({"mass": [1.0, 3.0]}), [1.0, 3.0])


def test_layout_says_what_is_wrong() -> None:
    layout = Layout((Block("mass", ("one", "two"), "kg", (NORMAL, NORMAL)),))
    with pytest.raises(ParameterError, match="parameter mass is missing"):
        layout.to_vector({})
    with pytest.raises(ParameterError, match=r"mass has 3 values, expected 2.*one, two"):
        layout.to_vector({"mass": [1, 2, 3]})
    with pytest.raises(ParameterError, match=r"mass\[six\] is not .*mass\[one\], mass\[two\]"):
        layout.index("mass", "six")


def test_empty_layout() -> None:
    layout = Layout(())
    assert (layout.size, layout.labels, layout.to_dict(np.zeros(0))) == (0, (), {})
    assert [bound.shape for bound in layout.bounds] == [(0,), (0,)]


def test_layout_of_a_scene() -> None:
    bodies = (
        Body("cart", BOX, wheel=True, known={"mass": 2.0, "w_y": 0.0}, effects=("linear_drag",)),
        Body("puck", Shape.circle(0.1), known={"r": 0.5}),
        Body("post", BOX, static=True, pose=(3.0, 0.0, 0.0)),
    )
    scene = Scene(time_step=0.1, normal_gravity=9.81, bodies=bodies)
    layout = build_layout(scene, attach(scene))
    assert layout.labels == (
        "mass[puck]",
        "r[cart]",
        "mu_c[cart]",
        "mu_c[puck]",
        "w_x[cart]",
        "w_theta[cart]",
        "mu_x[cart]",
        "mu_y[cart]",
        "linear_drag_coefficient[cart]",
    )
    lower, upper = layout.bounds
    w_x = layout.index("w_x", "cart")
    assert (lower[w_x], upper[w_x]) == (-0.5, 0.5)
    assert {block.name: block.effect for block in layout.blocks}["linear_drag_coefficient"] == (
        "linear_drag"
    )
    assert hash(layout) == hash(build_layout(scene, attach(scene)))


# -- priors ----------------------------------------------------------------------------------------


def scipy_prior(prior: Prior) -> stats.rv_continuous:
    mu, sigma = prior.mu, prior.sigma
    if prior.family == "log_normal":
        return stats.lognorm(sigma, scale=np.exp(mu))
    if prior.family == "truncated_normal":
        ends = (prior.lower - mu) / sigma, (prior.upper - mu) / sigma
        return stats.truncnorm(*ends, loc=mu, scale=sigma)
    if prior.family == "half_normal":
        return stats.halfnorm(scale=sigma)
    if prior.family == "von_mises":
        return stats.vonmises(prior.kappa, loc=mu)
    return stats.norm(mu, sigma)


scale = st.floats(0.1, 3.0)
location = st.floats(-1.5, 1.5)
priors = st.one_of(
    st.builds(Prior, st.just("log_normal"), location, scale),
    st.builds(Prior, st.just("normal"), location, scale),
    st.builds(Prior, st.just("half_normal"), sigma=scale),
    st.builds(Prior, st.just("von_mises"), location, kappa=st.floats(0.0, 20.0)),
    st.builds(
        Prior,
        st.just("truncated_normal"),
        st.floats(-0.5, 0.5),
        scale,
        lower=st.floats(-2.0, -0.5),
        upper=st.floats(0.5, 2.0),
    ),
)


@given(priors, st.integers(0, 2**32 - 1))
def test_half_the_squared_residual_is_the_log_density(prior, seed) -> None:
    """Up to a constant: their sum has no spread over the support."""
    x = prior.sample(np.random.default_rng(seed), 50)
    density = scipy_prior(prior).logpdf(x)
    total = density + prior.residual(x) ** 2 / 2
    assert np.ptp(total) < 1e-8 * (1 + np.abs(density).max())


@given(priors, st.integers(0, 2**32 - 1))
def test_draws_lie_in_the_support(prior, seed) -> None:
    draws = prior.sample(np.random.default_rng(seed), 200)
    lower, upper = prior.support
    assert draws.shape == (200,)
    assert ((lower <= draws) & (draws <= upper)).all()
    assert lower <= prior.centre <= upper
    np.testing.assert_array_equal(draws, prior.sample(np.random.default_rng(seed), 200))


FAMILIES = (
    Prior("log_normal", 1.0, 1.5),
    Prior("normal", 0.3, 2.0),
    Prior("half_normal", sigma=2.0),
    Prior("von_mises", 0.4, kappa=2.0),
    Prior("truncated_normal", 0.5, 1.0, lower=0.0, upper=1.0),
)


@pytest.mark.parametrize("prior", FAMILIES, ids=lambda prior: prior.family)
def test_draws_have_the_density(prior) -> None:
    draws = prior.sample(np.random.default_rng(9), 2000)
    # fixed seed; a right sampler fails one seed in ten thousand
    assert stats.kstest(draws, scipy_prior(prior).cdf).pvalue > 1e-4


@pytest.mark.parametrize("prior", FAMILIES, ids=lambda prior: prior.family)
def test_model_has_the_same_prior(prior) -> None:
    """The PyMC variable's log-density is the scipy one."""
    with pm.Model(coords={"body": ["one", "two"]}) as model:
        variable = random_variable("phi", (prior, prior), "body")
    x = prior.sample(np.random.default_rng(10), 2)
    got = pm.logp(variable, x).eval()
    np.testing.assert_allclose(got, scipy_prior(prior).logpdf(x), rtol=1e-6, atol=1e-6)
    assert model.named_vars_to_dims["phi"] == ("body",)


def test_truncated_prior_far_from_its_support_can_be_sampled() -> None:
    """A belief that a scene file may state, 30 sigma outside, must not hang the sampler."""
    code = (
        "import numpy as np; from pbrl_ppl.parameters import Prior;"
        "prior = Prior('truncated_normal', mu=4.0, sigma=0.1, lower=0.0, upper=1.0);"
        "draws = prior.sample(np.random.default_rng(0), 5);"
        "raise SystemExit(not ((draws >= 0.9) & (draws <= 1)).all())"
    )
    # in a process of its own, for a loop without end could not be stopped here
    subprocess.run([sys.executable, "-c", code], timeout=10, check=True)


# -- Table 1 ---------------------------------------------------------------------------------------


def test_table1_families_and_supports() -> None:
    shape = Shape.polygon(((-1.0, -1.0), (1.0, -1.0), (0.0, 2.0)))
    table = table1(Body("cart", shape))
    assert tuple(table) == tuple(BODY_PARAMETERS)
    for name, family in {"mass": "log_normal", "r": "log_normal", "w_theta": "von_mises"}.items():
        assert table[name].family == family
    for name in ("mu_c", "mu_x", "mu_y"):
        assert (table[name].family, table[name].support) == ("truncated_normal", (0.0, 1.0))
    assert table["w_x"].support == (-1.0, 1.0)
    assert table["w_y"].support == (-1.0, 2.0)
    assert set(WHEEL_PARAMETERS) <= set(table)


def test_scene_replaces_hyper_parameters() -> None:
    prior = {"mass": {"mu": 2.0, "sigma": 0.5}, "w_theta": {"kappa": 3.0}, "mu_x": {"mu": 0.1}}
    default, table = table1(Body("cart", BOX)), table1(Body("cart", BOX, prior=prior))
    assert (table["mass"].mu, table["mass"].sigma) == (2.0, 0.5)
    assert (table["w_theta"].mu, table["w_theta"].kappa) == (default["w_theta"].mu, 3.0)
    assert (table["mu_x"].mu, table["mu_x"].sigma) == (0.1, default["mu_x"].sigma)
    assert table["mu_x"].support == (0.0, 1.0)
    assert {name: table[name] for name in ("r", "mu_y")} == {
        name: default[name] for name in ("r", "mu_y")
    }


@pytest.mark.parametrize(
    ("name", "key", "allowed"), [("mass", "kappa", "mu and sigma"), ("w_theta", "sigma", "kappa")]
)
def test_wrong_hyper_parameter_is_named(name, key, allowed) -> None:
    body = Body("cart", BOX, prior={name: {key: 1.0}})
    with pytest.raises(ParameterError, match=rf"'cart': prior of {name} has '{key}'.*{allowed}"):
        table1(body)
