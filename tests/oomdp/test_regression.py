"""Locally weighted regression against closed forms and weighted least squares by hand."""

import numpy as np
import pytest

from pbrl_ppl.oomdp import LocalRegression

pytestmark = pytest.mark.one_stack


def linear(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x, beta = rng.normal(size=(n, 6)), rng.normal(size=(6, 6))
    return x, x @ beta, beta


@pytest.mark.parametrize("neighbours", [30, 1000])
def test_reproduces_a_linear_system(neighbours) -> None:
    """To rounding, whatever weights and ridge: near the data and away from them."""
    x, y, beta = linear(300)
    regression = LocalRegression(x, y, neighbours=neighbours)
    queries = np.random.default_rng(2).normal(size=(40, 6)) * np.linspace(0.2, 2, 40)[:, None]
    np.testing.assert_allclose(regression(queries), queries @ beta, atol=1e-12)


def by_hand(x, y, at, k, bandwidth, scale) -> np.ndarray:
    """Eqs. 4 and 5 for one query: brute-force neighbours, square roots of weights, lstsq."""
    square = (((x - at) / scale) ** 2).sum(axis=1)
    near = np.argsort(square)[:k]
    root = np.sqrt(np.exp(-square[near] / bandwidth))[:, None]
    return at @ np.linalg.lstsq(root * x[near], root * y[near], rcond=None)[0]


@pytest.mark.parametrize("neighbours", [25, 150, 200, 1000])
def test_is_weighted_least_squares(neighbours) -> None:
    """Of a function that is not linear; the nearest come from a tree, or are all."""
    rng = np.random.default_rng(4)
    scale = np.array([0.5, 1.0, 2.0, 1.0])
    x = rng.normal(size=(200, 4)) * scale
    y = np.stack([np.sin(x[:, 0]) * x[:, 1], abs(x[:, 2]), x.sum(axis=1)], axis=1)
    queries = rng.normal(size=(30, 4)) * scale
    regression = LocalRegression(x, y, neighbours=neighbours, scale=scale, ridge=1e-12)
    expected = [by_hand(x, y, at, neighbours, 1.5, scale) for at in queries]
    np.testing.assert_allclose(regression(queries), expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("neighbours", [60, 1000])
def test_no_ridge_is_eq_4(neighbours) -> None:
    """Within 1e-9 of NumPy's weighted least squares, on well-conditioned data."""
    rng = np.random.default_rng(10)
    x = rng.normal(size=(200, 4))
    y = np.stack([np.sin(x[:, 0]) * x[:, 1], abs(x[:, 2])], axis=1)
    queries = rng.normal(size=(30, 4))
    regression = LocalRegression(x, y, neighbours=neighbours, ridge=0)
    expected = [by_hand(x, y, at, neighbours, 1.5, np.ones(4)) for at in queries]
    np.testing.assert_allclose(regression(queries), expected, rtol=0, atol=1e-9)


def test_no_ridge_is_the_least_norm_solution_of_a_singular_system() -> None:
    """Columns that are the same share their coefficient; one that is zero has none."""
    rng = np.random.default_rng(11)
    one = rng.normal(size=(30, 1))
    x = np.concatenate([one, one, np.zeros((30, 1))], axis=1)
    regression = LocalRegression(x, 4.0 * one, ridge=0)
    queries = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, -1.0, 5.0]])
    np.testing.assert_allclose(regression(queries)[:, 0], [4.0, 2.0, 0.0, 0.0], atol=1e-9)
    few = LocalRegression(x[:1], 4.0 * one[:1], ridge=0)
    np.testing.assert_allclose(few(x[:1]), 4.0 * one[:1], atol=1e-9)


def test_bandwidth_is_local() -> None:
    """A kink is followed with a narrow kernel, and cut off with a wide one."""
    x = np.random.default_rng(5).uniform(-2, 2, (400, 1))
    narrow, wide = (
        LocalRegression(x, abs(x), bandwidth=b)(np.array([[1.0], [-1.0]])) for b in (0.1, 1e6)
    )
    np.testing.assert_allclose(narrow[:, 0], [1, 1], atol=2e-3)
    assert abs(wide).max() < 0.2


@pytest.mark.parametrize("n", [1, 2, 5])
def test_singular_queries_stay_bounded(n) -> None:
    """Fewer data than columns: what they say holds, the rest is nought, and nothing is NaN."""
    x, y, _ = linear(n)
    regression = LocalRegression(x, y)
    np.testing.assert_allclose(regression(x), y, atol=1e-9)
    queries = np.random.default_rng(7).normal(size=(200, 6))
    found = regression(queries)
    assert np.isfinite(found).all()
    assert abs(found).max() < 20 * abs(y).max()


def test_degenerate_data() -> None:
    same = np.repeat([[1.0, 2.0, 0.0]], 20, axis=0)
    found = LocalRegression(same, np.full((20, 1), 3.0))(
        np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 5.0]])
    )
    np.testing.assert_allclose(found, [[3.0], [0.0]], atol=0.01)
    nothing = LocalRegression(np.zeros((20, 3)), np.zeros((20, 2)))
    np.testing.assert_array_equal(nothing(np.ones((4, 3))), 0.0)
    x, y, beta = linear(50)
    far = np.full((1, 6), 1e3)  # every weight would vanish
    np.testing.assert_allclose(LocalRegression(x, y)(far), far @ beta, rtol=1e-9)
    assert LocalRegression(x, y)(np.zeros((0, 6))).shape == (0, 6)


def test_few_noisy_data_do_not_blow_up() -> None:
    """Nearly collinear inputs: without the ridge the noise is blown up by a thousand."""
    rng = np.random.default_rng(8)
    x = rng.normal(size=(10, 1)) * [1.0, 1.0] + 1e-3 * rng.normal(size=(10, 2))
    y = x[:, :1] + 0.1 * rng.normal(size=(10, 1))
    queries = rng.normal(size=(100, 2))
    assert abs(LocalRegression(x, y)(queries)).max() < 10
    assert abs(LocalRegression(x, y, ridge=1e-12)(queries)).max() > 50


def test_many_queries_are_as_one_by_one() -> None:
    x, _, _ = linear(2500)
    regression = LocalRegression(x, np.sin(x), neighbours=100)
    queries = np.random.default_rng(9).normal(size=(3000, 6))
    some = [regression(queries[i : i + 1])[0] for i in range(0, 3000, 300)]
    np.testing.assert_allclose(regression(queries)[::300], some, rtol=1e-9, atol=1e-12)
