"""The ensemble's moves on densities with closed forms."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from pbrl_ppl.likelihood import TransitionLikelihood
from pbrl_ppl.modes import systematic
from pbrl_ppl.modes.space import Independent
from pbrl_ppl.sampling.ensemble import Ensemble, Reference

pytestmark = pytest.mark.one_stack

MEAN = np.array([1.0, -2.0, 0.5])
SD = np.array([0.2, 3.0, 1.0])
CORRELATION = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, -0.3], [0.0, -0.3, 1.0]])
COVARIANCE = SD[:, None] * CORRELATION * SD
#: Mean and standard deviation of each of three coordinates, and share, of two modes that no random
#: walk connects.
NARROW, WIDE = (0.0, 0.3, 0.3), (8.0, 1.2, 0.7)
#: False-alarm rate of one comparison, and the z-score beyond which it fails.
ALARM = 1e-5
BOUND = float(stats.norm.isf(ALARM / 2))


def space_of(parts, noise=()) -> SimpleNamespace:
    """Return a space with these coordinates of its independent parts and its noise."""
    return SimpleNamespace(
        problem=SimpleNamespace(measured=np.zeros(1), likelihood=TransitionLikelihood()),
        parts=[Independent(np.array(own, dtype=int), np.array([i])) for i, own in enumerate(parts)],
        noise_blocks=[np.array(own) for own in noise],
        # the Laplace approximation about a mode is the mode itself here
        laplace=lambda mode: (mode.mean, mode.covariance),
        widened=lambda mean, covariance: covariance,
        prior_draws=lambda q, rng: q,
    )


def about(space, *modes) -> Reference:
    """Return Gaussians about modes, each a mean and a covariance."""
    first, *others = (SimpleNamespace(mean=np.array(m), covariance=np.array(c)) for m, c in modes)
    first.others = tuple(others)
    return Reference.about(space, first)


class Density:
    """Log-density of all coordinates, the first column; none of noise."""

    def __init__(self, function) -> None:
        self.function = function

    def evaluate(self, q):
        return q[:, None, None, None]

    def columns(self, q, values):
        np.testing.assert_array_equal(values[:, 0, 0, 0], q)  # it belongs to the particles
        return np.stack([self.function(q), np.zeros(len(q))], axis=1)


def gaussian(q, mean=MEAN, covariance=COVARIANCE):
    return stats.multivariate_normal(mean, covariance).logpdf(q)


def two_modes(q):
    each = [
        np.log(share) + stats.norm(mean, sd).logpdf(q).sum(axis=1)
        for mean, sd, share in (NARROW, WIDE)
    ]
    return logsumexp(each, axis=0)


def two_guesses(space, factor=1.3) -> Reference:
    """Return Gaussians about both modes, wider or narrower than these."""
    guess = [(np.full(3, m), factor**2 * s**2 * np.eye(3)) for m, s, _ in (NARROW, WIDE)]
    return about(space, *guess)


def independent(q, start) -> None:
    """Particles have forgotten where they were: no correlation beyond 5 of its errors."""
    for a, b in zip(q.T, start.T, strict=True):
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(len(a))


def is_gaussian(q, mean=MEAN, covariance=COVARIANCE) -> None:
    """Each margin and each pair's product, of independent particles: false alarm 9e-5."""
    z = (q - mean) @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    for i, own in enumerate(z.T):
        assert stats.kstest(own, stats.norm.cdf).pvalue > ALARM
        for other in z.T[:i]:
            product = own * other
            assert abs(product.mean()) < BOUND * product.std() / np.sqrt(len(z))


def settle(ensemble, target, rounds) -> None:
    """Move particles and learn from them in turn, as chains do while they tune."""
    for _ in range(rounds):
        ensemble.move(target, 3)
        ensemble.learn()


# -- moves -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1 / 7, 1.0, 3.0])
def test_a_correlated_gaussian_from_a_wrong_guess(factor) -> None:
    """The guess is off by one standard deviation in place, and by a factor in width."""
    space, rng = space_of([range(3)]), np.random.default_rng(1)
    reference = about(space, (MEAN + SD, factor**2 * COVARIANCE))
    ensemble = Ensemble(reference, reference.draw(3000, rng), rng)
    target = Density(gaussian)
    for _ in range(8):  # from far off, the largest correlation may be negative
        ensemble.move(target, 20)
        ensemble.learn()
    start = ensemble.q.copy()
    settle(ensemble, target, 9)
    is_gaussian(ensemble.q)
    independent(ensemble.q, start)


@pytest.mark.parametrize("adapt", [True, False])
def test_draws_of_a_gaussian_stay_draws_of_it(adapt) -> None:
    space, rng = space_of([range(3)]), np.random.default_rng(2)
    start = rng.multivariate_normal(MEAN, COVARIANCE, 3000)
    ensemble = Ensemble(Reference.of_draws(space, start), start, rng)
    accepted = ensemble.move(Density(gaussian), 10, adapt=adapt)
    assert 0.2 < accepted < 1.0
    assert (ensemble.q != start).all(axis=1).mean() > 0.9
    is_gaussian(ensemble.q)


def test_a_banana() -> None:
    """x ~ N(0, 1), y given x ~ N(x^2 / 2, 0.7^2): no Gaussian is close; false alarm 4e-5."""
    space, rng = space_of([range(2)]), np.random.default_rng(3)

    def banana(q):
        return stats.norm.logpdf(q[:, 0]) + stats.norm(q[:, 0] ** 2 / 2, 0.7).logpdf(q[:, 1])

    start = rng.standard_normal((3000, 2))
    start[:, 1] = start[:, 0] ** 2 / 2 + 0.7 * start[:, 1]
    ensemble = Ensemble(Reference.of_draws(space, start), start, rng)
    settle(ensemble, Density(banana), 15)
    independent(ensemble.q, start)
    x, y = ensemble.q.T
    for z in (x, (y - x**2 / 2) / 0.7):
        assert stats.kstest(z, stats.norm.cdf).pvalue > ALARM
    assert abs(np.corrcoef(x, y)[0, 1]) < BOUND * 1.5 / np.sqrt(3000)
    assert abs(y.mean() - 0.5) < BOUND * np.sqrt((0.49 + 0.5) / 3000)


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_jumps_weigh_modes_that_no_walk_connects(factor) -> None:
    """All begin in the narrow mode, which holds 0.3; the guess of both widths is a third off."""
    space, rng = space_of([range(3)]), np.random.default_rng(4)
    reference = two_guesses(space, factor)
    ensemble = Ensemble(reference, 0.3 * rng.standard_normal((2000, 3)), rng)
    for _ in range(10):
        ensemble.move(Density(two_modes), 20)
        ensemble.learn()
    wide = ensemble.q.mean(axis=1) > 4.0
    assert abs(wide.mean() - 0.7) < BOUND * np.sqrt(0.21 / 2000)
    for which, (mean, sd, _) in ((~wide, NARROW), (wide, WIDE)):
        for own in ensemble.q[which].T:
            assert stats.kstest(own, stats.norm(mean, sd).cdf).pvalue > ALARM


def test_parts_jump_by_themselves() -> None:
    """Two modes of each of two parts are four of both; none is more than its share: 5e-5."""
    space, rng = space_of([[0], [1]]), np.random.default_rng(22)

    class Both:
        def evaluate(self, q):
            return q[:, None, None, :, None]

        def columns(self, q, values):
            each = [
                np.log(share) + stats.norm(mean, sd).logpdf(values[:, 0, 0, :, 0])
                for mean, sd, share in (NARROW, WIDE)
            ]
            return np.column_stack([np.logaddexp(*each), np.zeros(len(q))])

    modes = [(np.full(2, mean), sd**2 * np.eye(2)) for mean, sd, _ in (NARROW, WIDE)]
    reference = about(space, *modes)
    ensemble = Ensemble(reference, reference.draw(4000, rng), rng)
    for _ in range(10):
        ensemble.move(Both(), 10)
    wide = ensemble.q > 4.0
    shares = [((wide == which).all(axis=1)).mean() for which in np.ndindex(2, 2)]
    expected = [0.09, 0.21, 0.21, 0.49]
    for share, own in zip(shares, expected, strict=True):
        assert abs(share - own) < BOUND * np.sqrt(own * (1 - own) / 4000), (shares, expected)


def test_modes_that_are_one_are_no_modes() -> None:
    """Without jumps particles stay in their mode; a mode within the other's width is the same."""
    space, rng = space_of([range(3)]), np.random.default_rng(5)
    one = about(space, (np.zeros(3), 0.09 * np.eye(3)), (np.full(3, 0.1), 0.09 * np.eye(3)))
    assert len(one.parts[0].modes) == 1
    ensemble = Ensemble(one, 0.3 * rng.standard_normal((500, 3)), rng)
    ensemble.move(Density(two_modes), 50)
    assert ensemble.q.max() < 4.0


def test_impossible_points_are_rejected() -> None:
    """A log-density of minus infinity or NaN is never moved to: a half-normal by hand."""
    space, rng = space_of([range(1)]), np.random.default_rng(6)

    def positive(q):
        x = q[:, 0]
        return np.where(x > 0, np.where(x < 50, -0.5 * x**2, np.nan), -np.inf)

    start = np.abs(rng.standard_normal((3000, 1)))
    ensemble = Ensemble(Reference.of_draws(space, start), start, rng)
    settle(ensemble, Density(positive), 12)
    assert (ensemble.q > 0).all()
    assert stats.kstest(ensemble.q[:, 0], stats.halfnorm.cdf).pvalue > ALARM


def test_particles_whose_density_is_zero_find_their_way() -> None:
    space, rng = space_of([range(1)]), np.random.default_rng(7)

    def positive(q):
        return np.where(q[:, 0] > 0, -0.5 * q[:, 0] ** 2, -np.inf)

    start = rng.standard_normal((500, 1))
    ensemble = Ensemble(Reference.of_draws(space, start), start, rng)
    ensemble.move(Density(positive), 50)
    assert (ensemble.q > 0).all()


# -- independent parts -----------------------------------------------------------------------------


class Parts:
    """Two bodies' residuals x - 1 and x + 1, each N(0, s^2); log s ~ N(0, 0.3^2).

    What is evaluated is each body's residual alone; if parts' residuals were mixed up or out of
    date, so were the density.
    """

    def __init__(self) -> None:
        self.shapes = []

    def evaluate(self, q):
        self.shapes.append(len(q))
        return (q[:, :2] + np.array([-1.0, 1.0]))[:, None, None, :, None]

    def columns(self, q, values):
        residual = values[:, 0, 0, :, 0]
        np.testing.assert_allclose(residual, q[:, :2] + np.array([-1.0, 1.0]), atol=1e-12)
        each = stats.norm.logpdf(residual, scale=np.exp(q[:, 2:]))
        return np.concatenate([each, stats.norm.logpdf(q[:, 2:] / 0.3)], axis=1)


def test_parts_are_accepted_by_themselves() -> None:
    """Given the noise bodies are independent: false alarm 5e-5."""
    space, rng = space_of([[0], [1]], [[2]]), np.random.default_rng(8)
    noise = 0.3 * rng.standard_normal(3000)
    x = np.array([1.0, -1.0]) + np.exp(noise)[:, None] * rng.standard_normal((3000, 2))
    start, target = np.column_stack([x, noise]), Parts()
    ensemble = Ensemble(Reference.of_draws(space, start), start, rng)
    ensemble.move(target, 1)
    moved = ensemble.q != start
    # some moved the one, some the other, some both
    assert 0.05 < (moved[:, 0] & ~moved[:, 1]).mean() < 0.95
    assert 0.05 < (moved[:, 1] & ~moved[:, 0]).mean() < 0.95
    settle(ensemble, target, 15)
    independent(ensemble.q, start)
    z = (ensemble.q[:, :2] - np.array([1.0, -1.0])) / np.exp(ensemble.q[:, 2:])
    for own in (*z.T, ensemble.q[:, 2] / 0.3):
        assert stats.kstest(own, stats.norm.cdf).pvalue > ALARM
    for a, b in ((0, 1), (0, 2), (1, 2)):
        own = np.column_stack([z, ensemble.q[:, 2]])
        assert abs(np.corrcoef(own[:, a], own[:, b])[0, 1]) < BOUND / np.sqrt(3000)


def test_the_noise_moves_without_the_engine() -> None:
    """Engine batches: one where particles are, and one a sweep."""
    space, rng = space_of([[0], [1]], [[2]]), np.random.default_rng(9)
    start = rng.standard_normal((50, 3))
    target = Parts()
    Ensemble(Reference.of_draws(space, start), start, rng).move(target, 7)
    assert target.shapes == [50] * 8


def test_a_part_without_coordinates_and_arguments_stay_as_they_are() -> None:
    """The data may inform no parameter of a body; and nothing is changed that was passed in."""
    space, rng = space_of([[0], []], [[1]]), np.random.default_rng(10)

    class One:
        def evaluate(self, q):
            return np.zeros((len(q), 1, 1, 2, 1))

        def columns(self, q, values):
            each = stats.norm.logpdf(q)
            return np.stack([each[:, 0], np.zeros(len(q)), each[:, 1]], axis=1)

    start = rng.standard_normal((2000, 2))
    given = start.copy()
    reference = Reference.of_draws(space, start)
    before = reference.parts[0].modes[0].mean.copy()
    ensemble = Ensemble(reference, start, rng)
    settle(ensemble, One(), 6)
    np.testing.assert_array_equal(start, given)
    np.testing.assert_array_equal(reference.parts[0].modes[0].mean, before)
    for own in ensemble.q.T:
        assert stats.kstest(own, stats.norm.cdf).pvalue > ALARM


# -- the reference ---------------------------------------------------------------------------------


def test_a_reference_draws_from_its_density() -> None:
    """Two modes of a part, and of the noise whichever the part's is; it integrates to one.

    Its draws' mean of q / p for a known density q has the expectation 1: false alarm 1e-5.
    """
    space, rng = space_of([[0, 1]], [[2]]), np.random.default_rng(20)
    modes = [(np.full(3, mean), sd**2 * np.eye(3)) for mean, sd, _ in (NARROW, WIDE)]
    reference = about(space, *modes)
    q = reference.draw(5000, rng)
    assert abs((q[:, 0] > 4.0).mean() - 0.5) < BOUND * np.sqrt(0.25 / 5000)
    own = reference.log_density(q)
    other = np.column_stack([
        stats.norm(mean, 0.8 * sd).logpdf(q[:, :2]).sum(axis=1) for mean, sd, _ in (NARROW, WIDE)
    ])  # fmt: skip
    noise = np.logaddexp(
        *(stats.norm(mean, 0.8 * sd).logpdf(q[:, 2]) for mean, sd, _ in (NARROW, WIDE))
    )
    ratio = np.exp(np.logaddexp(*other.T) - np.log(2) + noise - np.log(2) - own)
    assert abs(ratio.mean() - 1.0) < BOUND * ratio.std() / np.sqrt(5000)


# -- resampling ------------------------------------------------------------------------------------


def test_systematic_resampling() -> None:
    """Counts are the expected ones rounded up or down, in order, and right on average."""
    weights = np.random.default_rng(21).dirichlet(np.ones(30))
    weights[4] = 0.0
    weights /= weights.sum()
    counts = np.zeros(30)
    for seed in range(400):
        chosen = systematic(weights, 50, np.random.default_rng(seed))
        assert (np.diff(chosen) >= 0).all()
        own = np.bincount(chosen, minlength=30)
        assert own.sum() == 50
        assert (np.abs(own - 50 * weights) < 1.0).all()
        counts += own / 400
    assert counts[4] == 0
    # a count has a standard deviation of at most 0.5, the mean of 400 one of 0.025
    assert np.abs(counts - 50 * weights).max() < 5 * 0.025
