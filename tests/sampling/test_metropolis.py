"""AdaptiveMetropolis on targets with closed forms, in an ordinary pm.Model."""

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

from pbrl_ppl.posterior.store import group
from pbrl_ppl.sampling.metropolis import AdaptiveMetropolis, Gaussian, Jumps, Schedule

# Python 3.12 and later warn of a fork in a process with threads; PyMC's chains start by fork
FORK = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
# PyTensor's wheels come without BLAS; nothing here multiplies large matrices
pytestmark = [
    pytest.mark.first(2),
    pytest.mark.filterwarnings("ignore:PyTensor could not link to a BLAS:UserWarning"),
]
MEAN = np.array([1.0, -2.0, 0.5])
SD = np.array([0.2, 3.0, 1.0])
CORRELATION = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, -0.3], [0.0, -0.3, 1.0]])
COVARIANCE = SD[:, None] * CORRELATION * SD


def block(mean, covariance, first: int = 0) -> Gaussian:
    """A block of neighbours in the sampler's vector."""
    mean = np.asarray(mean)
    return Gaussian(first + np.arange(len(mean)), mean, np.asarray(covariance))


def sample(
    model: pm.Model,
    *,
    mean=None,
    covariance=None,
    blocks=None,
    rough=None,
    jumps=None,
    chains=4,
    **options,
) -> dict[str, np.ndarray]:
    """Draws by name, shape (chain, draw, ...)."""
    with model:
        step = AdaptiveMetropolis(
            model.free_RVs,
            blocks=blocks or [block(mean, covariance)],
            rough=rough,
            jumps=jumps,
            schedule=Schedule(thin=2),
        )
        trace = pm.sample(
            **({"draws": 600, "tune": 500, "cores": 1, "random_seed": 4} | options),
            chains=chains,
            step=step,
            progressbar=False,
            compute_convergence_checks=False,
        )
    posterior = group(trace, "posterior")
    return {str(name): posterior[name].values for name in posterior.data_vars}


def check(draws: np.ndarray, expected: float) -> None:
    """The mean of (chain, draw) is the expected one within 4 Monte Carlo errors.

    A false alarm 6e-5 of the time.
    """
    ess = float(az.ess(draws, method="mean"))
    error = draws.std() / np.sqrt(ess)
    assert ess > 100
    assert abs(draws.mean() - expected) < 4 * error, (draws.mean(), expected, error)


def gaussian() -> pm.Model:
    with pm.Model() as model:
        pm.MvNormal("x", MEAN, COVARIANCE)
    return model


@pytest.mark.one_stack
@pytest.mark.parametrize("factor", [1 / 7, 1.0, 3.0])
def test_correlated_gaussian_from_a_wrong_guess(factor: float) -> None:
    """Moments to second order, from a guess off by one sd in place and by a factor in width.

    At kinks of friction, a Laplace covariance was seen seven times too narrow.
    """
    draws = sample(gaussian(), mean=MEAN + SD, covariance=factor**2 * COVARIANCE)["x"]
    for i in range(3):
        check(draws[..., i], MEAN[i])
        for j in range(i + 1):
            product = (draws[..., i] - MEAN[i]) * (draws[..., j] - MEAN[j])
            check(product, COVARIANCE[i, j])


@pytest.mark.one_stack
def test_learned_proposal_makes_large_moves() -> None:
    """On a Gaussian the adapted sampler beats a random walk's best by far."""
    found = sample(gaussian(), mean=MEAN, covariance=COVARIANCE)["x"]
    # a random walk at its best gives about 0.33 / dimension effective draws a step
    assert float(az.ess(found[..., 1], method="bulk")) > 0.2 * found[..., 1].size


def rough_gaussian(q: np.ndarray) -> float:
    """The target off by half a standard deviation, half as wide again, and uncorrelated."""
    return -0.5 * float((((q - MEAN - 0.5 * SD) / (1.5 * SD)) ** 2).sum())


@pytest.mark.one_stack
def test_a_bad_look_ahead_is_put_right() -> None:
    """The draws are exact whatever the cheap posterior is."""
    guess = {"mean": MEAN, "covariance": COVARIANCE}
    found = sample(gaussian(), **guess, rough=rough_gaussian, draws=1200)["x"]
    for i in range(3):
        check(found[..., i], MEAN[i])
        check((found[..., i] - MEAN[i]) ** 2, COVARIANCE[i, i])


@pytest.mark.one_stack
def test_a_good_look_ahead_gives_nearly_independent_draws() -> None:
    precision = np.linalg.inv(COVARIANCE)

    def exact(q: np.ndarray) -> float:
        return -0.5 * float((q - MEAN) @ precision @ (q - MEAN))

    found = sample(gaussian(), mean=MEAN, covariance=COVARIANCE, rough=exact)["x"]
    assert float(az.ess(found[..., 1], method="bulk")) > 0.8 * found[..., 1].size


@pytest.mark.one_stack
@pytest.mark.one_stack
def test_blocks_that_depend_on_each_other() -> None:
    """Correlated variables in blocks of their own: slower, and still exact."""
    blocks = [block(MEAN[:1], COVARIANCE[:1, :1]), block(MEAN[1:], COVARIANCE[1:, 1:], first=1)]
    found = sample(gaussian(), blocks=blocks, draws=1200)["x"]
    for i in range(3):
        check(found[..., i], MEAN[i])
    check((found[..., 0] - MEAN[0]) * (found[..., 1] - MEAN[1]), COVARIANCE[0, 1])


def test_log_normal_and_beta() -> None:
    """Supports with bounds, sampled through PyMC's transforms."""
    with pm.Model() as model:
        pm.LogNormal("m", mu=0.5, sigma=0.8)
        pm.Beta("share", alpha=2.0, beta=5.0)
    draws = sample(model, mean=[0.0, 0.0], covariance=np.eye(2))
    mean = np.exp(0.5 + 0.8**2 / 2)
    check(draws["m"], mean)
    check(np.log(draws["m"]), 0.5)
    check((np.log(draws["m"]) - 0.5) ** 2, 0.8**2)
    check(draws["share"], 2 / 7)
    check((draws["share"] - 2 / 7) ** 2, 2 * 5 / (7**2 * 8))
    assert ((draws["share"] > 0) & (draws["share"] < 1)).all()


@pytest.mark.one_stack
@pytest.mark.one_stack
def test_banana() -> None:
    """x ~ N(0, 1), y | x ~ N(x^2 / 2, 0.7^2): no Gaussian is close to it."""
    with pm.Model() as model:
        x = pm.Normal("x")
        pm.Normal("y", x**2 / 2, 0.7)
    draws = sample(model, mean=[0.0, 0.0], covariance=np.eye(2), draws=2000)
    check(draws["x"], 0.0)
    check(draws["x"] ** 2, 1.0)
    check(draws["y"], 0.5)
    check((draws["y"] - 0.5) ** 2, 0.7**2 + 0.5)
    check((draws["y"] - draws["x"] ** 2 / 2) ** 2, 0.7**2)


@pytest.mark.one_stack
def test_jumps_weigh_hills_that_no_walk_connects() -> None:
    """A narrow hill with 0.3 of the mass and a wide one 20 of its widths away; all start on one.

    The jumps' Gaussians are a third off in width, as a guess may be.
    """
    narrow, wide = (0.0, 0.3, 0.3), (8.0, 1.2, 0.7)  # mean, sd, share
    with pm.Model() as model:
        x = pm.Flat("x", shape=3)
        parts = [
            np.log(share) + pm.logp(pm.Normal.dist(mean, sd), x).sum()
            for mean, sd, share in (narrow, wide)
        ]
        pm.Potential("mixture", pm.math.logaddexp(*parts))
    hills = tuple(
        block(np.full(3, mean), 1.3**2 * sd**2 * np.eye(3)) for mean, sd, _ in (narrow, wide)
    )
    options = {"mean": np.zeros(3), "covariance": 0.09 * np.eye(3)}
    start = {"x": np.zeros(3)}
    draws = sample(model, **options, jumps=Jumps(hills), draws=1200, initvals=start)["x"]
    check((draws.mean(axis=-1) > 4.0).astype(float), 0.7)
    stuck = sample(model, **options, chains=1, initvals=start)["x"]
    assert stuck.max() < 4.0


def test_impossible_points_are_rejected() -> None:
    """A log-density of minus infinity or NaN is never moved to: a half-normal by hand."""
    with pm.Model() as model:
        x = pm.Normal("x", initval=1.0)
        pm.Potential("positive", pt.switch(x > 0, 0.0, -np.inf))
        pm.Potential("finite", pt.switch(x < 50, 0.0, np.nan))
    draws = sample(model, mean=[0.0], covariance=np.eye(1))["x"]
    assert (draws > 0).all()
    check(draws, np.sqrt(2 / np.pi))
    check(draws**2, 1.0)


@FORK
def test_same_seed_same_draws_in_one_process_or_two() -> None:
    """Also: no chain inherits what the one before it learned."""
    options = {"mean": np.zeros(3), "covariance": np.eye(3), "draws": 100, "tune": 150, "chains": 2}
    first = sample(gaussian(), **options)["x"]
    again = sample(gaussian(), **options)["x"]
    np.testing.assert_array_equal(again, first)
    parallel = sample(gaussian(), cores=2, **options)["x"]
    np.testing.assert_array_equal(parallel, first)
    other = sample(gaussian(), random_seed=5, **options)["x"]
    assert not np.array_equal(other, first)
    assert not np.array_equal(first[0], first[1])


def test_state_is_restored() -> None:
    """What PyMC does between chains: put the state back, and the same chain comes again."""
    model = gaussian()
    with model:
        step = AdaptiveMetropolis(
            model.free_RVs,
            blocks=[block(np.zeros(3), np.eye(3))],
            schedule=Schedule(inner=1),
            rng=np.random.default_rng(1),
        )
    initial = step.sampling_state
    start = model.initial_point()

    def chain() -> np.ndarray:
        point, found = start, []
        for _ in range(120):
            point, _ = step.step(point)
            found.append(point["x"])
        return np.array(found)

    first = chain()
    assert step.blocks[0].seen == 120
    assert not np.array_equal(step.blocks[0].factor, np.eye(3))
    step.sampling_state = initial
    assert step.blocks[0].seen == 0
    np.testing.assert_array_equal(step.blocks[0].factor, np.eye(3))
    np.testing.assert_array_equal(step.blocks[0].mean, np.zeros(3))
    np.testing.assert_array_equal(chain(), first)


def test_nothing_is_learned_after_tuning() -> None:
    model = gaussian()
    with model:
        step = AdaptiveMetropolis(model.free_RVs, blocks=[block(MEAN, COVARIANCE)])
    step.stop_tuning()
    point = model.initial_point()
    for _ in range(60):
        point, (stats,) = step.step(point)
    assert step.blocks[0].seen == 0
    np.testing.assert_array_equal(step.blocks[0].mean, MEAN)
    assert not stats["tune"]
    assert 0.0 <= stats["accept"] <= 1.0


def test_arguments_are_not_changed() -> None:
    mean, covariance = np.zeros(3), np.eye(3)
    sample(gaussian(), mean=mean, covariance=covariance, draws=20, tune=60, chains=1)
    np.testing.assert_array_equal(mean, np.zeros(3))
    np.testing.assert_array_equal(covariance, np.eye(3))
