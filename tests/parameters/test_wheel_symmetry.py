"""A wheel's equal descriptions: folded where the prior is the same for them, and nowhere else."""

import numpy as np
import pymc as pm
import pytest
from scipy import stats

from pbrl_ppl.effects import attach
from pbrl_ppl.effects.friction import wheel
from pbrl_ppl.model import physics_model
from pbrl_ppl.parameters import (
    Layout,
    by_prior,
    nearest,
    prior_draws,
    symmetrised,
    wheels,
)
from pbrl_ppl.physics import build_layout
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE

pytestmark = pytest.mark.one_stack

PRIORS = {
    "default": {},
    "frictions alike": {"mu_x": {"mu": 0.1}, "mu_y": {"mu": 0.1}},
    "frictions differ": {"mu_x": {"mu": 0.1, "sigma": 0.3}},
    "angle known roughly": {"w_theta": {"mu": 0.4, "kappa": 0.8}},
    "all different": {"w_theta": {"mu": 2.0, "kappa": 2.0}, "mu_y": {"mu": 0.9, "sigma": 0.4}},
}
PERIODS = dict(zip(PRIORS, (1, 1, 2, 4, 4), strict=True))
EVERY = pytest.mark.parametrize("name", PRIORS)


def layout_of(name: str) -> Layout:
    return build_layout(cart_scene(prior=PRIORS[name]))


def draws_of(layout: Layout, n: int = 4000, seed: int = 1) -> np.ndarray:
    return prior_draws(layout.priors, np.random.default_rng(seed), n)


def columns(layout: Layout, phi: np.ndarray) -> np.ndarray:
    return phi[:, list(wheels(layout)[0].places)]


@EVERY
def test_the_period_is_the_prior_s(name) -> None:
    """Turned by the period, a wheel is as probable as before; by less, it is not."""
    layout = layout_of(name)
    (wheel,) = wheels(layout)
    assert wheel.period == PERIODS[name]
    phi = draws_of(layout, 50)
    each = layout.log_prior(wheel.turned(phi, wheel.period)).sum(axis=1)
    np.testing.assert_allclose(each, layout.log_prior(phi).sum(axis=1))
    for turns in range(1, wheel.period):
        other = layout.log_prior(wheel.turned(phi, turns)).sum(axis=1)
        assert not np.allclose(other, layout.log_prior(phi).sum(axis=1))


def test_a_wheel_with_something_known_has_no_other_description() -> None:
    for known in ("w_theta", "mu_x", "mu_y"):
        assert not wheels(build_layout(cart_scene(known={known: 0.2})))


def test_a_wheel_that_an_effect_adds_is_folded_too() -> None:
    layout = build_layout(cart_scene(wheel=False), attach(cart_scene(wheel=False), (wheel,)))
    (own,) = wheels(layout)
    assert own.labels == ("wheel_w_theta[cart]", "wheel_mu_x[cart]", "wheel_mu_y[cart]")
    assert own.period == 1
    phi = draws_of(layout, 50)
    for turns in range(4):
        np.testing.assert_allclose(
            by_prior(layout, own.turned(phi, turns)), by_prior(layout, phi), atol=1e-12
        )


@OBJECT_MODE
def test_the_default_angle_is_uniform() -> None:
    """On the circle, in PyMC too. One false alarm in 1000."""
    history = simulated_history(cart_scene(), CART, seed=1, trajectories=1, intervals=3)
    model = physics_model(cart_scene(), history)
    angle = pm.draw(model["w_theta"], 300, random_seed=3, mode="FAST_COMPILE")
    assert stats.kstest(angle.ravel(), stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3
    at = np.linspace(-3.1, 3.1, 7)[:, None]
    density = pm.logp(model["w_theta"], at).eval(mode="FAST_COMPILE")
    np.testing.assert_allclose(density, -np.log(2 * np.pi), rtol=1e-9)


@EVERY
def test_folding_keeps_the_prior(name) -> None:
    """Draws of the prior, folded, are where it is as probable; a known angle is left alone."""
    layout = layout_of(name)
    phi = draws_of(layout)
    for each in (nearest(layout, phi), nearest(layout, phi, phi[:1])):
        before, after = layout.log_prior(phi).sum(axis=1), layout.log_prior(each).sum(axis=1)
        np.testing.assert_allclose(after, before)
        if PERIODS[name] == 4:
            np.testing.assert_array_equal(each, phi)
        if PERIODS[name] == 2:
            others = [i for i, label in enumerate(layout.labels) if label != "w_theta[cart]"]
            np.testing.assert_array_equal(each[:, others], phi[:, others])
    angle, x, y = columns(layout, by_prior(layout, phi)).T
    if PERIODS[name] < 4:
        assert (np.abs(angle) <= np.pi / 2 + 1e-12).all()
    if PERIODS[name] == 1:
        assert (x <= y).all()


@EVERY
def test_the_most_probable_description_is(name) -> None:
    layout = layout_of(name)
    (wheel,) = wheels(layout)
    phi = draws_of(layout, 100)
    best = layout.log_prior(by_prior(layout, phi)).sum(axis=1)
    for turns in range(4):
        assert (best >= layout.log_prior(wheel.turned(phi, turns)).sum(axis=1) - 1e-12).all()


@EVERY
def test_redrawn_descriptions_have_the_prior_s_distribution(name) -> None:
    """Whichever description the draws had: folded by the prior afterwards they are the prior's.

    Two-sample Kolmogorov-Smirnov tests of three parameters: one false alarm in 3000.
    """
    layout, rng = layout_of(name), np.random.default_rng(5)
    gone = nearest(layout, draws_of(layout), any_prior=True)  # by place, not by probability
    phi = by_prior(layout, gone, rng)
    if PERIODS[name] > 1:
        expected = draws_of(layout, seed=2)
        if PERIODS[name] == 2:  # the angle is known to half a turn, and no better
            at = np.array([layout.to_vector(CART)])  # any centre that is the same for both
            phi, expected = nearest(layout, phi, at), nearest(layout, expected, at)
        for found, right in zip(columns(layout, phi).T, columns(layout, expected).T, strict=True):
            assert stats.ks_2samp(found, right).pvalue > 1e-4
    else:
        np.testing.assert_array_equal(phi, gone)


@EVERY
def test_the_symmetrised_prior_is_the_descriptions_mean(name) -> None:
    """The same for each of the four; the prior itself where it is even."""
    layout = layout_of(name)
    (wheel,) = wheels(layout)
    phi = draws_of(layout, 5)
    own = layout.log_prior(phi).sum(axis=1)
    four = [np.exp(layout.log_prior(wheel.turned(phi, k)).sum(axis=1)) for k in range(4)]
    change = symmetrised(layout, phi).sum(axis=1)
    np.testing.assert_allclose(own + change, np.log(np.mean(four, axis=0)))
    turned = wheel.turned(phi, 1)
    after = layout.log_prior(turned).sum(axis=1) + symmetrised(layout, turned).sum(axis=1)
    np.testing.assert_allclose(after, own + change)
    if PERIODS[name] == 1:
        np.testing.assert_array_equal(change, 0.0)
    else:
        assert change.all()
