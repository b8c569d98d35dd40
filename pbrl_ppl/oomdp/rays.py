"""Ray casting: where rays are inside convex solids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: A convex part of a solid: corners (k, 2) counter-clockwise, and a radius about them; one corner
#: is a circle, two are a wall.
Part = tuple[Array, float]


def spans(part: Part, origins: Array, directions: Array) -> Array:
    """Where rays enter a convex part and where they leave it.

    Parameters
    ----------
    part : tuple of ndarray and float
        Of a solid as :func:`pbrl_ppl.physics.scenery` describes it, in its frame (m).
    origins : ndarray
        Where rays begin, shape (n, 2), m.
    directions : ndarray
        Unit vectors, shape (n, ray, 2).

    Returns
    -------
    ndarray
        Distances along the rays, shape (n, ray, 2), m; 0 is the first where the origin is inside,
        and a ray that misses has (inf, -inf). A wall is left where it is entered, and a ray along
        it misses: it has no width.

    Examples
    --------
    >>> box = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    >>> spans((box, 0.0), np.array([[-3.0, 0.0]]), np.array([[[1.0, 0.0]]]))
    array([[[2., 4.]]])
    """
    corners, radius = part
    with np.errstate(over="ignore"):  # of a ray almost along an edge, which it meets at infinity
        if len(corners) == 1:
            enter, leave = _circle(origins - corners[0], directions, radius)
        elif len(corners) == 2:
            enter, leave = _segment(corners, origins, directions)
        else:
            enter, leave = _polygon(corners, origins, directions)
    enter = np.maximum(enter, 0.0)
    hit = enter <= leave
    return np.stack([np.where(hit, enter, np.inf), np.where(hit, leave, -np.inf)], axis=-1)


def _circle(arm: Array, directions: Array, radius: float) -> tuple[Array, Array]:
    ahead = np.einsum("nrc,nc->nr", directions, arm)
    square = ahead**2 - ((arm**2).sum(axis=-1) - radius**2)[:, None]
    half = np.sqrt(np.where(square < 0, np.nan, square))
    return -ahead - half, -ahead + half


def _segment(ends: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    edge, arm = ends[1] - ends[0], ends[0] - origins
    across = directions[..., 0] * edge[1] - directions[..., 1] * edge[0]
    across = np.where(across == 0, np.nan, across)
    at = (arm[:, 0] * edge[1] - arm[:, 1] * edge[0])[:, None] / across
    share = arm[:, None, 0] * directions[..., 1] - arm[:, None, 1] * directions[..., 0]
    at = np.where((share / across >= 0) & (share / across <= 1), at, np.nan)
    return at, at


def _polygon(corners: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Cyrus and Beck's clipping: a ray is inside between the last entry and the first exit."""
    enter = np.full(directions.shape[:2], -np.inf)
    leave = -enter
    for corner, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        outward = np.array([after[1] - corner[1], corner[0] - after[0]])
        depth = ((corner - origins) @ outward)[:, None]
        rate = directions @ outward
        at = depth / np.where(rate == 0, np.nan, rate)
        enter = np.where(rate < 0, np.maximum(enter, at), enter)
        leave = np.where(rate > 0, np.minimum(leave, at), leave)
        # along the edge, and outside of it
        leave = np.where((rate == 0) & (depth < 0), -np.inf, leave)
    return enter, leave
