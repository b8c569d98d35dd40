"""Priors from posteriors: the same families and moments, and data in two parts as in one."""

import dataclasses
import warnings

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import pbrl_ppl as pp
from pbrl_ppl.effects import attach
from pbrl_ppl.errors import ConvergenceWarning, ParameterError, PosteriorError, SceneError
from pbrl_ppl.model import physics_model
from pbrl_ppl.model.declaration import random_variable
from pbrl_ppl.parameters import Prior, nearest
from pbrl_ppl.physics import build_layout
from pbrl_ppl.posterior import draws, from_groups, group, groups
from pbrl_ppl.posterior.updated_prior import moment_matched, updated_scene
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE

CONTACT = {"r": 0.2, "mu_c": 0.3}
DRAG = {"linear_drag_coefficient": 3.0}
QUICK = {"draws": 700, "tune": 300, "chains": 2, "cores": 1, "progress": False}


def truncated(mu, sigma, lower, upper):
    return stats.truncnorm((lower - mu) / sigma, (upper - mu) / sigma, mu, sigma)


def moments(prior: Prior) -> tuple[float, float]:
    law = truncated(prior.mu, prior.sigma, *prior.support)
    return law.mean(), law.std()


@pytest.mark.parametrize(
    ("mu", "sigma", "lower", "upper"),
    [
        (0.5, 1.0, 0.0, 1.0),
        (0.3, 0.02, 0.0, 1.0),
        (0.02, 0.03, 0.0, 1.0),
        (-0.2, 0.1, 0.0, 1.0),
        (1.2, 0.2, 0.0, 1.0),
        (0.1, 0.3, -0.45, 0.45),
    ],
)
def test_truncated_normals_are_recovered(mu, sigma, lower, upper) -> None:
    rng = np.random.default_rng(1)
    law = truncated(mu, sigma, lower, upper)
    values = law.rvs(4000, random_state=rng)
    prior = Prior("truncated_normal", lower=lower, upper=upper)
    found = moment_matched(prior, values)
    assert (found.family, found.support) == (prior.family, prior.support)
    assert moments(found) == pytest.approx((values.mean(), values.std()), rel=2e-3, abs=1e-4)
    # the same density: the probability of each tenth of the law within what 4000 draws allow
    share = truncated(found.mu, found.sigma, lower, upper).cdf(law.ppf(np.arange(1, 10) / 10))
    np.testing.assert_allclose(share, np.arange(1, 10) / 10, atol=0.03)


@pytest.mark.parametrize(
    ("values", "support"),
    [
        (stats.uniform(0, 1), (0.0, 1.0)),
        (stats.beta(0.3, 0.3), (0.0, 1.0)),  # piled on both bounds: no normal is
        (stats.expon(0, 0.01), (0.0, 1.0)),  # piled on one
        (stats.uniform(-0.45, 0.9), (-0.45, 0.45)),
    ],
)
def test_level_and_piled_up_posteriors_give_a_proper_prior(values, support) -> None:
    x = np.clip(values.rvs(2000, random_state=np.random.default_rng(2)), *support)
    found = moment_matched(Prior("truncated_normal", lower=support[0], upper=support[1]), x)
    mean, sd = moments(found)
    width = support[1] - support[0]
    assert mean == pytest.approx(x.mean(), abs=0.02 * width)
    # the widest truncated normal is the uniform
    assert sd == pytest.approx(min(x.std(), width / np.sqrt(12)), rel=0.1)


def test_other_families() -> None:
    rng = np.random.default_rng(3)
    normal = rng.normal(0.3, 0.2, 5000)
    found = moment_matched(Prior("normal", sigma=5.0), normal)
    assert (found.mu, found.sigma) == pytest.approx((normal.mean(), normal.std()))
    found = moment_matched(Prior("log_normal"), np.exp(normal))
    assert (found.mu, found.sigma) == pytest.approx((normal.mean(), normal.std()))
    found = moment_matched(Prior("half_normal", sigma=20.0), 3.0 + 0.5 * normal)
    assert (found.family, found.mu, found.sigma) == (
        "half_normal",
        pytest.approx(3.15, abs=0.01),
        pytest.approx(0.1, rel=0.05),
    )
    # still a half-normal where the posterior is the prior's
    found = moment_matched(Prior("half_normal", sigma=20.0), np.abs(20 * rng.normal(size=5000)))
    law = truncated(found.mu, found.sigma, 0.0, np.inf)
    assert law.ppf([0.1, 0.5, 0.9]) == pytest.approx(
        20 * stats.halfnorm.ppf([0.1, 0.5, 0.9]), rel=0.1
    )


@pytest.mark.parametrize("kappa", [0.5, 8.0, 2e4])
def test_von_mises_about_the_seam(kappa) -> None:
    """At +-pi an ordinary mean would be near 0."""
    angles = np.random.default_rng(4).vonmises(3.1, kappa, 6000)
    found = moment_matched(Prior("von_mises"), angles)
    assert np.cos(found.mu - 3.1) > np.cos(0.1)
    assert found.kappa == pytest.approx(kappa, rel=0.1)


def folded_draws(layout, draws):
    return dict(zip(layout.labels, nearest(layout, layout.columns(draws)).T, strict=True))


def test_draws_of_one_wheel_in_four_descriptions() -> None:
    rng = np.random.default_rng(5)
    n = 400
    angle = 0.3 + 0.02 * rng.normal(size=n)
    low, high = 0.1 + 0.01 * rng.normal(size=n), 0.4 + 0.01 * rng.normal(size=n)
    turns = rng.integers(0, 4, n)
    odd = turns % 2 == 1
    mixed = {
        "w_theta[cart]": angle + turns * np.pi / 2,
        "mu_x[cart]": np.where(odd, high, low),
        "mu_y[cart]": np.where(odd, low, high),
        "mass[cart]": angle,
    }
    folded = folded_draws(build_layout(cart_scene()), mixed)
    np.testing.assert_allclose(folded["w_theta[cart]"], angle, atol=1e-12)
    np.testing.assert_array_equal(folded["mu_x[cart]"], low)
    np.testing.assert_array_equal(folded["mu_y[cart]"], high)
    np.testing.assert_array_equal(folded["mass[cart]"], angle)
    # with mu_x known, a swap is another wheel
    layout = build_layout(cart_scene(known={"mu_x": 0.1}))
    alone = folded_draws(layout, mixed)["w_theta[cart]"]
    np.testing.assert_array_equal(alone, mixed["w_theta[cart]"])


def test_a_wheel_with_nearly_equal_frictions_stays_in_one_piece() -> None:
    """Where mu_x and mu_y overlap, sorting them would tear the angle apart by pi/2."""
    rng = np.random.default_rng(6)
    angle = 0.2 + 0.03 * rng.normal(size=300)
    mus = 0.30 + 0.05 * rng.normal(size=300), 0.33 + 0.05 * rng.normal(size=300)
    names = ("w_theta[cart]", "mu_x[cart]", "mu_y[cart]")
    folded = folded_draws(build_layout(cart_scene()), dict(zip(names, (angle, *mus), strict=True)))
    np.testing.assert_allclose(folded["w_theta[cart]"], angle, atol=1e-12)


# ---- scenes: effects' priors, refusals


def with_prior(prior, effects=("linear_drag",)) -> Scene:
    cart = Body("cart", Shape.box(0.9, 0.55), effects=effects, prior=prior)
    return Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart,))


def layout_of(scene: Scene):
    return build_layout(scene, attach(scene))


def test_an_effect_s_parameter_takes_hyper_parameters() -> None:
    scene = with_prior({"linear_drag_coefficient": {"sigma": 0.2, "mu": 3.0}})
    assert Scene.from_toml(scene.to_toml()) == scene
    layout = layout_of(scene)
    prior = layout.priors[layout.index("linear_drag_coefficient", "cart")]
    assert (prior.family, prior.mu, prior.sigma) == ("half_normal", 3.0, 0.2)
    values = prior.sample(np.random.default_rng(0), 2000)
    assert (values.mean(), values.std()) == pytest.approx((3.0, 0.2), rel=0.05)
    assert prior.centre == 3.0


def test_the_order_of_hyper_parameters_means_nothing() -> None:
    some = {"linear_drag_coefficient": {"sigma": 0.2}, "mass": {"mu": 1.0}}
    assert with_prior(some) == with_prior(dict(reversed(some.items())))


@pytest.mark.parametrize(
    ("prior", "effects", "error", "message"),
    [
        ({"lineardrag_coefficient": {"mu": 1.0}}, ("linear_drag",), SceneError, "unknown param"),
        ({"linear_drag_coefficient": {"mu": 1.0}}, (), SceneError, "needs the effect among"),
        (
            {"linear_drag_coeficient": {"mu": 1.0}},
            ("linear_drag",),
            ParameterError,
            "body 'cart': prior has 'linear_drag_coeficient'.*mean \"linear_drag_coefficient\"",
        ),
        (
            {"linear_drag_coefficient": {"kappa": 1.0}},
            ("linear_drag",),
            ParameterError,
            "body 'cart': prior of linear_drag_coefficient has 'kappa', expected mu and sigma",
        ),
        ({"mass": {"sigma": 0.0}}, (), SceneError, 'body "cart": mass: sigma is 0.0'),
        ({"mass": {"mu": np.nan}}, (), SceneError, "mass: mu is nan, expected a finite"),
        (
            {"mu_c": {"mu": -5.0, "sigma": 0.01}},
            (),
            ParameterError,
            r"body 'cart': prior of mu_c: .* mu is -5, 500 sigma outside the support \[0, 1\]",
        ),
    ],
)
def test_refused_hyper_parameters(prior, effects, error, message) -> None:
    with pytest.raises(error, match=message):
        layout_of(with_prior(prior, effects))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sigma": 0.0}, "sigma is 0.0, expected more than 0"),
        ({"sigma": -1.0}, "sigma is -1.0"),
        ({"sigma": np.inf}, "sigma is inf, expected a finite"),
        ({"mu": np.nan}, "mu is nan"),
        ({"kappa": -1.0}, "kappa is -1.0"),
        ({"lower": 1.0, "upper": 1.0}, "lower is 1.0 and upper 1.0, expected lower below upper"),
        ({"mu": 9.0, "sigma": 0.2, "lower": 0.0, "upper": 1.0}, "40 sigma outside"),
    ],
)
def test_improper_priors(values, message) -> None:
    with pytest.raises(ParameterError, match=f"truncated_normal: .*{message}"):
        Prior("truncated_normal", **values)


def test_densities_of_updated_families_are_scipy_s() -> None:
    """A sharp von Mises and a shifted half-normal in PyMC, beside owners with vague ones."""
    angles = (Prior("von_mises", mu=0.1, kappa=0.5), Prior("von_mises", mu=0.2, kappa=4e4))
    drags = (Prior("half_normal", sigma=20.0), Prior("half_normal", mu=3.0, sigma=0.1))
    x, c = np.array([0.3, 0.21]), np.array([5.0, 3.1])
    with pm.Model(coords={"body": ["a", "b"]}):
        found = [
            pm.logp(random_variable("angle", angles, "body"), x).eval(mode="FAST_COMPILE"),
            pm.logp(random_variable("drag", drags, "body"), c).eval(mode="FAST_COMPILE"),
        ]
    np.testing.assert_allclose(found[0], stats.vonmises.logpdf(x, [0.5, 4e4], [0.1, 0.2]))
    expected = [stats.halfnorm.logpdf(5.0, 0, 20.0), truncated(3.0, 0.1, 0, np.inf).logpdf(3.1)]
    np.testing.assert_allclose(found[1], expected, rtol=1e-6)


# ---- two parts


@pytest.fixture(scope="module")
def parts():
    """Data A, data B and both; drag on the cart is declared."""
    scene = cart_scene(known=CONTACT, effects=("linear_drag",)).replace(substeps=5)
    both = simulated_history(scene, CART | DRAG, seed=9, trajectories=10, intervals=10)
    return scene, both.select(range(4)), both.select(range(4, 10)), both


def quick_fit(scene, history):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # few draws, on purpose
        return fit(physics_model(scene, history), seed=1, **QUICK)


@pytest.fixture(scope="module")
def first(parts):
    scene, a, _, _ = parts
    return quick_fit(scene, a)


def test_the_updated_scene_holds_the_posterior_s_moments(parts, first) -> None:
    scene = updated_scene(first)
    assert Scene.from_toml(scene.to_toml()) == scene
    kept = dataclasses.replace(scene.bodies[0], prior=(), typical=())
    assert kept == parts[0].bodies[0] and scene.bodies[0].typical
    prior = {name: dict(hyper) for name, hyper in scene.bodies[0].prior}
    layout = layout_of(parts[0])
    assert set(prior) == {block.name for block in layout.blocks}
    assert [p.family for p in layout_of(scene).priors] == [p.family for p in layout.priors]
    found = draws(first)
    mass = np.log(found["mass"])
    assert (prior["mass"]["mu"], prior["mass"]["sigma"]) == pytest.approx((mass.mean(), mass.std()))
    drag = found["linear_drag_coefficient"]
    assert prior["linear_drag_coefficient"]["mu"] == pytest.approx(drag.mean(), rel=0.02)


@pytest.mark.long
def test_two_parts_are_as_good_as_one(parts, first) -> None:
    """Posterior of A as the prior of B against the fit to A and B at once.

    What is lost is how parameters depend on each other. With 3000 draws of each fit, the means were
    within 0.5 posterior sd and the widths within 10 %; part A alone was off by 2.1 sd in mu_x and
    its widths by 1.25 to 1.7. The posterior of w_y is left out: friction's kinks make it no normal,
    and the widths of its two fits were 0.0031 and 0.0045 m.
    """
    scene, _, b, both = parts
    two, one = quick_fit(updated_scene(first), b), quick_fit(scene, both)
    for name in ("mass", "w_x", "w_theta", "mu_x", "mu_y", "linear_drag_coefficient"):
        x, y, part = (draws(each)[name][:, 0] for each in (two, one, first))
        assert abs(x.mean() - y.mean()) < 0.8 * y.std(), name
        assert 1 / 1.25 < x.std() / y.std() < 1.25, name
        assert part.std() > 1.1 * x.std(), name


@OBJECT_MODE
def test_the_model_s_prior_is_the_posterior(first) -> None:
    """Drawn by PyMC from the updated scene: the posterior's own means and widths."""
    scene = updated_scene(first)
    history = simulated_history(scene, CART | DRAG, seed=3, trajectories=2, intervals=3)
    names = [name for name, _ in scene.bodies[0].prior]
    model = physics_model(scene, history)
    prior = group(pm.sample_prior_predictive(2000, model, names, random_seed=1), "prior")
    for name in names:
        x, y = prior[name].to_numpy().ravel(), draws(first)[name][:, 0]
        assert abs(x.mean() - y.mean()) < 0.15 * y.std(), name
        assert x.std() == pytest.approx(y.std(), rel=0.1), name


def test_refused_posteriors(first) -> None:
    assert pp.updated_scene is updated_scene
    data = groups(first)
    data["posterior"] = data["posterior"].assign(mass=data["posterior"]["mass"] * 0 + 2.0)
    stuck = from_groups(data, first.attrs)
    with pytest.raises(PosteriorError, match=r"draws of mass\[cart\] are all 2, .*fit again"):
        updated_scene(stuck)
    assert group(first, "posterior")["mass"].std() > 0
