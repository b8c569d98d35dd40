"""Rays against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.oomdp.rays import spans

pytestmark = pytest.mark.one_stack

BOX = (np.array([[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]]), 0.0)
CIRCLE = (np.zeros((1, 2)), 0.7)
WALL = (np.array([[2.0, -1.0], [2.0, 1.0]]), 0.0)
MISS = [np.inf, -np.inf]


def one(part, origin, direction) -> np.ndarray:
    direction = np.array(direction, dtype=float) / np.hypot(*direction)
    return spans(part, np.array([origin], dtype=float), direction[None, None])[0, 0]


@pytest.mark.parametrize(
    ("part", "origin", "direction", "expected"),
    [
        (CIRCLE, (-3, 0), (1, 0), [2.3, 3.7]),
        (CIRCLE, (0, 0), (3, 4), [0.0, 0.7]),
        (CIRCLE, (-3, 0), (-1, 0), MISS),
        (CIRCLE, (-3, 0.8), (1, 0), MISS),
        # a chord at half the radius
        (CIRCLE, (-3, 0.35), (1, 0), [3 - 0.7 * np.sqrt(0.75), 3 + 0.7 * np.sqrt(0.75)]),
        (BOX, (-3, 0.4), (1, 0), [2.0, 4.0]),
        (BOX, (0, 0), (0, -1), [0.0, 0.5]),
        (BOX, (0, 0), (1, 1), [0.0, 0.5 * np.sqrt(2)]),
        (BOX, (-2, -1.5), (1, 1), [np.sqrt(2), 2 * np.sqrt(2)]),
        (BOX, (-3, 0.6), (1, 0), MISS),
        (BOX, (3, 0), (1, 0), MISS),
        (WALL, (0, 0.9), (1, 0), [2.0, 2.0]),
        (WALL, (1, 0), (1, 1), [np.sqrt(2)] * 2),
        (WALL, (0, 1.1), (1, 0), MISS),
        (WALL, (3, 0), (1, 0), MISS),
        (WALL, (2, -3), (0, 1), MISS),  # along it: it has no width
    ],
)
def test_closed_forms(part, origin, direction, expected) -> None:
    np.testing.assert_allclose(one(part, origin, direction), expected, atol=1e-14)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-np.pi, np.pi), st.sampled_from([BOX, CIRCLE]))
def test_span_is_where_the_ray_is_inside(x, y, angle, part) -> None:
    """Points of a fine grid along the ray, by the shape's own inequality."""
    ray = np.array([np.cos(angle), np.sin(angle)])
    enter, leave = one(part, (x, y), ray)
    at = np.linspace(0.0, 8.0, 400)
    px, py = np.array([[x], [y]]) + ray[:, None] * at
    depth = 0.7 - np.hypot(px, py) if part is CIRCLE else np.minimum(1 - abs(px), 0.5 - abs(py))
    sure = abs(depth) > 1e-9
    inside = (enter <= at) & (at <= leave)
    assert (inside == (depth > 0))[sure].all()


def test_rows_are_independent() -> None:
    rng = np.random.default_rng(3)
    origins, angles = rng.normal(0, 2, (50, 2)), rng.uniform(-np.pi, np.pi, (50, 7))
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for part in (BOX, CIRCLE, WALL):
        together = spans(part, origins, directions)
        alone = [spans(part, origins[i : i + 1], directions[i : i + 1])[0] for i in range(50)]
        np.testing.assert_array_equal(together, alone)
