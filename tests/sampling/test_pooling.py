"""Partial pooling: by simulation the truth is covered, and real posteriors give a next prior."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pbrl_ppl.effects import attach
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.physics import build_layout
from pbrl_ppl.sampling import pool
from pbrl_ppl.sampling.pooling import Population, population
from pbrl_ppl.scene import Scene
from tests.helpers.carts import cart_scene
from tests.helpers.made_up import idata as made_idata

ENDS = (0.03, 0.97)


def inside(low: float, truth: float, high: float) -> bool:
    return bool(low <= truth <= high)


def simulated(
    rng: np.random.Generator, robots: int, mean: float, spread: float, scale: float
) -> tuple[np.ndarray, Population]:
    """True values, and what is made of estimates whose errors are a third to three times 0.1."""
    true = rng.normal(mean, spread, robots)
    sd = 0.1 * 3 ** rng.uniform(-1, 1, robots)
    estimate = rng.normal(true, sd)
    return true, population(estimate, sd, centre=1.0, width=1.5, spread=scale)


def test_intervals_hold_the_truth_that_is_drawn_from_the_prior() -> None:
    """94 % of the mean, the spread, each robot and the next: exact, but for 2.5 standard errors."""
    rng = np.random.default_rng(1)
    held = []
    for _ in range(400):
        mean, spread = rng.normal(1.0, 1.5), abs(rng.normal(0.0, 0.75))
        true, found = simulated(rng, 4, mean, spread, 0.75)
        held.append(
            [
                inside(found.mean(ENDS[0]), mean, found.mean(ENDS[1])),
                inside(found.deviation(ENDS[0]), spread, found.deviation(ENDS[1])),
                inside(found.robot(2, ENDS[0]), true[2], found.robot(2, ENDS[1])),
                inside(found.next(ENDS[0]), rng.normal(mean, spread), found.next(ENDS[1])),
            ]
        )
    error = np.sqrt(0.94 * 0.06 / 400)
    np.testing.assert_allclose(np.mean(held, axis=0), 0.94, atol=2.5 * error)


@pytest.mark.parametrize(("robots", "spread"), [(3, 0.1), (8, 0.1), (8, 0.3), (8, 0.02)])
def test_intervals_of_one_population_hold_it_at_least_as_often(robots, spread) -> None:
    """A spread as of real robots of a kind, small beside its prior's scale: never far below."""
    rng = np.random.default_rng(2)
    held = []
    for _ in range(200):
        _, found = simulated(rng, robots, 1.9, spread, 0.75)
        held.append(
            [
                inside(found.mean(ENDS[0]), 1.9, found.mean(ENDS[1])),
                inside(found.deviation(ENDS[0]), spread, found.deviation(ENDS[1])),
            ]
        )
    assert (np.mean(held, axis=0) > 0.94 - 3 * np.sqrt(0.94 * 0.06 / 200)).all()


def test_false_alarms_of_difference_are_one_in_twenty() -> None:
    rng = np.random.default_rng(3)
    p = np.array([simulated(rng, 5, 1.9, 0.0, 0.75)[1].p_same for _ in range(1000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=2.5 * np.sqrt(0.05 * 0.95 / 1000))
    assert stats.kstest(p, "uniform").pvalue > 0.01
    p = np.array([simulated(rng, 5, 1.9, 0.4, 0.75)[1].p_same for _ in range(200)])
    assert np.mean(p < 0.05) > 0.9


def test_shrinkage_helps() -> None:
    rng = np.random.default_rng(4)
    single, shrunken = [], []
    for _ in range(200):
        true, sd = rng.normal(1.9, 0.1, 6), np.full(6, 0.15)
        estimate = rng.normal(true, sd)
        found = population(estimate, sd, centre=1.0, width=1.5, spread=0.75)
        single.append(np.square(estimate - true).mean())
        shrunken.append(np.square([found.robot(i, 0.5) for i in range(6)] - true).mean())
    assert np.mean(shrunken) < 0.6 * np.mean(single)


def test_robots_that_say_nothing() -> None:
    sd = np.array([0.1, np.inf, 0.1])
    found = population(np.array([1.0, 99.0, 1.1]), sd, centre=0.0, width=2.0, spread=0.5)
    without = population(np.array([1.0, 1.1]), sd[[0, 2]], centre=0.0, width=2.0, spread=0.5)
    assert found.mean(0.5) == pytest.approx(without.mean(0.5))
    assert found.robot(1, 0.97) == pytest.approx(found.next(0.97))
    none = population(np.zeros(2), np.full(2, np.inf), centre=1.0, width=2.0, spread=0.5)
    assert none.mean(0.97) == pytest.approx(stats.norm(1, 2).ppf(0.97))
    assert np.isnan(none.p_same)


def robot(scene: Scene, seed: int, **where: Any) -> Any:
    """A made-up posterior: normal draws on the prior's own scale, or the prior where none is given.

    ``where`` has a mean and a standard deviation of each parameter's data, which the prior joins.
    """
    rng, layout = np.random.default_rng(seed), build_layout(scene, attach(scene))
    draws, dims = {}, {}
    for block in layout.blocks:
        prior = block.priors[0]
        if block.name in where and prior.family != "von_mises":
            mean, sd = where[block.name]
            total = sd**-2 + prior.sigma**-2
            centre = (mean * sd**-2 + prior.mu * prior.sigma**-2) / total
            x = centre + total**-0.5 * rng.normal(size=(2, 1000, 1))
            x = np.exp(x) if prior.family == "log_normal" else x
        elif block.name in where:
            x = rng.vonmises(where[block.name][0], where[block.name][1] ** -2, (2, 1000, 1))
        else:
            x = prior.sample(rng, 2000).reshape(2, 1000, 1)
        draws[block.name], dims[block.name] = x, ["body"]
    made = made_idata(draws, dims)
    made.attrs["scene"] = scene.to_toml()
    return made


def test_pool_gives_the_next_robots_prior() -> None:
    masses, scene = [1.7, 1.9, 2.0, 2.1], cart_scene(effects=("inertia_scale",))
    scene = scene.replace(bodies=(replace(scene.bodies[0], prior=()),))
    cart = {"w_x": (-0.25, 0.01), "w_theta": (3.1, 0.05), "mu_x": (0.1, 0.02), "mu_y": (0.45, 0.02)}
    posteriors = {
        f"cart{i}": robot(scene, i, mass=(mass, 0.02), **cart) for i, mass in enumerate(masses)
    }
    pooled = pool(posteriors)
    table = pooled.table().set_index("parameter")
    mass = table.loc["mass[cart]"]
    assert mass["mean"] == pytest.approx(np.exp(np.mean(masses)), rel=0.02)
    assert mass["mean_low"] < mass["mean"] < mass["mean_high"]
    assert mass["spread_low"] < np.std(masses, ddof=1) < mass["spread_high"]
    assert mass["p_same"] < 1e-6 < 0.001 < table.loc["w_x[cart]", "p_same"]
    # the prior is not counted once a robot
    assert table.loc["w_x[cart]", "mean"] == pytest.approx(-0.25, abs=0.01)
    assert table.loc["mu_c[cart]", "informed"] == 0
    body = pooled.scene.body("cart")
    prior = {name: dict(hyper) for name, hyper in body.prior}
    assert "mu_c" not in prior and "mass" in prior and body.effects == ("inertia_scale",)
    assert prior["mass"]["mu"] == pytest.approx(np.mean(masses), abs=0.02)
    assert 0.1 < prior["mass"]["sigma"] < 0.5
    # half a turn on is the same wheel, and 3.1 beside -3.1
    assert abs(np.sin(prior["w_theta"]["mu"] - 3.1)) < 0.05
    kept = Scene.from_toml(pooled.scene.to_toml())
    assert build_layout(kept, attach(kept)).labels == tuple(table.index)
    robots = pooled.robots().set_index(["parameter", "robot"])
    first = robots.loc[("mass[cart]", "cart0")]
    assert first["low"] < np.exp(1.7) < first["high"]
    assert np.exp(1.7) < first["median"] < np.exp(1.75)  # drawn to the others, by little
    assert pooled.to_dict()["parameters"][0]["parameter"] == "mass[cart]"


def test_effects_that_some_lack_are_left_out() -> None:
    plain = cart_scene()
    drag = plain.replace(bodies=(replace(plain.bodies[0], effects=("linear_drag",)),))
    pooled = pool({"a": robot(plain, 1, mass=(1.8, 0.1)), "b": robot(drag, 2, mass=(1.9, 0.1))})
    assert pooled.left_out == ("linear_drag_coefficient[cart]",)
    assert pooled.scene.body("cart").effects == ()
    other = pool({"b": robot(drag, 2, mass=(1.9, 0.1)), "a": robot(plain, 1, mass=(1.8, 0.1))})
    assert other.scene.body("cart").effects == ()
    mass = [each.table()["mean"][0] for each in (pooled, other)]
    assert mass[0] == pytest.approx(mass[1])
    # which of equal wheels is described is no information
    assert set(pooled.table()["informed"][1:]) == {0}


def test_what_cannot_be_pooled() -> None:
    with pytest.raises(PosteriorError, match="expected at least 2 robots"):
        pool({"a": robot(cart_scene(), 1)})
    known = cart_scene(known={"mass": 5.0})
    with pytest.raises(PosteriorError, match="expected the same scene"):
        pool({"a": robot(cart_scene(), 1), "b": robot(known, 2)})
    still = robot(cart_scene(), 1)
    still["posterior"]["mass"][:] = 2.0
    with pytest.raises(PosteriorError, match=r"the draws of mass\[cart\] of b do not vary"):
        pool({"a": robot(cart_scene(), 1), "b": still})
    with pytest.raises(ValueError, match="spread is 0"):
        pool({"a": still, "b": still}, spread=0.0)
