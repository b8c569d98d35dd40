"""Autocovariance of errors: what a fitted start position and speed take away is given back."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pbrl_ppl.likelihood import autocovariance

pytestmark = pytest.mark.one_stack


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_lines_that_were_fitted_do_not_shorten_it(memory, missing) -> None:
    """AR(1) errors of variance 1 in 200 pieces of 45 rows, beside the lines fitted to each.

    Of AR(0.9) errors the estimate has a standard deviation of 0.14 (12 seeds); the residual's own
    variance is under a half of the errors'.
    """
    rng, pieces, rows = np.random.default_rng(3), 200, 45
    white = np.sqrt(1 - memory**2) * rng.standard_normal((pieces, rows + 200))
    error = lfilter([1.0], [1.0, -memory], white)[:, 200:]
    seen = rng.random((pieces, rows)) >= missing
    lines = np.column_stack([np.ones(rows), np.arange(rows)]) * seen[:, :, None]
    error = np.where(seen, error, 0.0)
    left = np.array([e - x @ np.linalg.lstsq(x, e)[0] for e, x in zip(error, lines, strict=True)])
    found = autocovariance(
        left[..., None], seen[..., None], lines[:, :, None], np.zeros((pieces, rows, 1, 0))
    )
    assert memory < 0.9 or (left[seen] ** 2).mean() < 0.5
    assert found == pytest.approx(memory ** np.arange(rows), abs=0.3)


def test_too_few_measurements_count_as_white() -> None:
    residual = np.array([[[0.1], [-0.2], [0.1]]])
    line = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])[None, :, None]
    seen = np.ones((1, 3, 1), dtype=bool)
    found = autocovariance(residual, seen, line, np.zeros((1, 3, 1, 0)))
    assert found == pytest.approx([0.02, 0.0, 0.0])


def test_parameters_that_initial_states_follow_take_nothing() -> None:
    """Their derivatives are left as rounding; in any unit."""
    rng, pieces, rows = np.random.default_rng(4), 8, 12
    seen = np.ones((pieces, rows, 1), dtype=bool)
    lines = np.broadcast_to(np.column_stack([np.ones(rows), np.arange(rows)]), (pieces, rows, 2))
    left = rng.standard_normal((pieces, rows, 1))
    by_phi = lines @ np.array([[1.0, 0.0], [0.1, 1e9]])
    lines, by_phi = lines[:, :, None], by_phi[:, :, None]
    found = autocovariance(left, seen, lines, by_phi)
    assert found == pytest.approx(autocovariance(left, seen, lines, by_phi[..., :0]), rel=1e-9)
