"""The Gaussians about the modes, on densities with closed forms; resampling."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from pbrl_ppl.modes import systematic
from pbrl_ppl.sampling.importance import Reference

pytestmark = pytest.mark.one_stack

#: Mean and standard deviation of each of three coordinates of two modes.
NARROW, WIDE = (0.0, 0.3), (8.0, 1.2)
#: The z-score beyond which a comparison fails: false alarm 1e-5.
BOUND = float(stats.norm.isf(0.5e-5))


def space_of(*blocks) -> SimpleNamespace:
    """Return a space with these coordinates of its independent parts and its noise."""
    return SimpleNamespace(
        blocks=[np.array(own) for own in blocks],
        prior_draws=lambda q, rng: q,
        log_density=lambda q: stats.norm.logpdf(q).sum(axis=1),
    )


def test_a_reference_draws_from_its_density() -> None:
    """Two modes of a part, and of the noise whichever the part's is; it integrates to one.

    Its draws' mean of q / p for a known density q has the expectation 1: false alarm 1e-5.
    """
    space, rng = space_of([0, 1], [2]), np.random.default_rng(20)
    modes = [(np.full(3, mean), sd**2 * np.eye(3)) for mean, sd in (NARROW, WIDE)]
    reference = Reference.of(space, modes)
    q = reference.draw(5000, rng)
    assert abs((q[:, 0] > 4.0).mean() - 0.5) < BOUND * np.sqrt(0.25 / 5000)
    own = reference.log_density(q)
    other = np.column_stack([
        stats.norm(mean, 0.8 * sd).logpdf(q[:, :2]).sum(axis=1) for mean, sd in (NARROW, WIDE)
    ])  # fmt: skip
    noise = np.logaddexp(
        *(stats.norm(mean, 0.8 * sd).logpdf(q[:, 2]) for mean, sd in (NARROW, WIDE))
    )
    ratio = np.exp(np.logaddexp(*other.T) - np.log(2) + noise - np.log(2) - own)
    assert abs(ratio.mean() - 1.0) < BOUND * ratio.std() / np.sqrt(5000)


def test_gaussians_within_each_other_s_width_are_one() -> None:
    """Of each part by itself; and several modes learn nothing, for points may be of any."""
    near, far = np.array([0.1, 0.0]), np.array([0.1, 9.0])
    gaussians = [(mean, np.eye(2)) for mean in (np.zeros(2), near, far)]
    reference = Reference.of(space_of([0], [1]), gaussians)
    assert [len(mixture.modes) for mixture in reference.mixtures] == [1, 2]
    learned = reference.learned(np.random.default_rng(1).normal(5.0, 1.0, (100, 2)))
    assert learned.mixtures[0].modes[0].mean > 4.0
    assert learned.mixtures[1] is reference.mixtures[1]


def test_what_is_learned_keeps_a_share_of_the_covariance() -> None:
    """And nothing is changed that was passed in."""
    q = np.random.default_rng(10).normal([1.0, -2.0], [0.5, 3.0], (2000, 2))
    reference = Reference.of_draws(space_of([0], [1]), q[:3])
    before = [mixture.modes[0].mean.copy() for mixture in reference.mixtures]
    learned = reference.learned(q, retained=0.25)
    for mixture, mean, x in zip(reference.mixtures, before, q.T, strict=True):
        np.testing.assert_array_equal(mixture.modes[0].mean, mean)
        (found,) = learned.mixtures[mixture.places[0]].modes
        assert found.mean == pytest.approx(x.mean())
        kept = 0.25 * mixture.modes[0].cov + 0.75 * reference.wider * x.var(ddof=1)
        assert found.cov == pytest.approx(kept)


def test_weights_are_those_of_the_informed_coordinates() -> None:
    """A coordinate in the middle is not informed, and stays where the origin is."""
    space, rng = space_of([0], [2]), np.random.default_rng(11)
    reference = Reference.of(space, [(np.array([0.5, 7.0, -0.5]), np.eye(3))])
    q = reference.draw(50, rng)
    assert (q[:, 1] == 7.0).all()
    z = rng.standard_normal((50, reference.normals))
    q = reference.at(z)
    np.testing.assert_allclose(q[:, [0, 2]], [0.5, -0.5] + np.sqrt(reference.wider) * z)
    expected = space.log_density(q) - reference.log_density(q)
    np.testing.assert_allclose(reference.log_weight(z), expected)


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
