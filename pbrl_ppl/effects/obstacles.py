"""Obstacles that the scene does not show: discs that a body ran into."""

from itertools import combinations, product

import numpy as np

from pbrl_ppl.effects.effect import (
    SIGNED,
    SIZE,
    Disc,
    Effect,
    EffectParameter,
    Structure,
    Values,
    is_pivoted,
)
from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import Floats, turned


def _discs(parameters: Values) -> tuple[Disc, ...]:
    return (Disc(parameters["x"], parameters["y"], parameters["radius"]),)


def _scan_discs(scene: Scene, history: History, body: Body, *, most_discs: int = 60) -> Floats:
    """Return discs that several hits agree on, then discs of single hits.

    Where the velocity changed by ``dv``, the obstacle lies along ``-dv``. The change of the angular
    velocity gives the distance of the impulse's line from the centre, and with it the point of the
    outline that was hit; the disc's centre is one radius beyond.

    ``most_discs``: discs tried at most.
    """
    start = history.dataset["start"].sel(body=body.name).to_numpy()
    begin, end = start[:, :-1].reshape(-1, 6), start[:, 1:].reshape(-1, 6)
    seen = np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)
    begin, end = begin[seen], end[seen]
    change = np.linalg.norm(end[:, 3:5] - begin[:, 3:5], axis=1)
    order = np.argsort(-change)[:16]  # intervals that are taken for hits, at most
    least = 1e-9 * np.abs(begin[:, 3:5]).max(initial=0.0)
    if is_pivoted(scene, body) and len(change):
        # a hinge changes velocities all the time
        least = max(least, 3.0 * float(np.median(change)))
    order = order[change[order] > least]
    point, inward = _hits(body.shape, begin[order], end[order], scene.time_step)
    reach = body.shape.bounding_radius
    scored = []
    for i, j in combinations(range(len(point)), 2):  # point + radius * inward is the same for both
        apart, turn = point[j] - point[i], inward[i] - inward[j]
        if turn @ turn < 0.05:
            continue
        radius = float(apart @ turn / (turn @ turn))
        if not 0.0 < radius < 4.0 * reach:
            continue
        centre = 0.5 * (point[i] + point[j] + radius * (inward[i] + inward[j]))
        off = np.linalg.norm(point + radius * inward - centre, axis=1)
        # hits agree with a disc within a tenth of the body's radius
        scored.append((int((off < 0.1 * reach).sum()), (*centre, radius)))
    scored.sort(key=lambda agreed: -agreed[0])
    discs = [disc for count, disc in scored[: most_discs // 4] if count > 1]
    for at, way in zip(point, inward, strict=True):
        # friction may turn an impulse off the outline's normal
        for radius, turn in product(reach * np.array([0.25, 0.75, 2.0]), (0.0, 0.3, -0.3)):
            discs.append((*(at + radius * turned(way, turn)), radius))
    return np.array(discs[:most_discs]).reshape(-1, 3)


def _hits(shape: Shape, begin: Floats, end: Floats, time_step: float) -> tuple[Floats, Floats]:
    """Return the points of the outline that were hit, and the directions into the obstacle.

    Shape (hit, 2) each, in the world; points in m.
    """
    dv = end[:, 3:5] - begin[:, 3:5]
    size = np.linalg.norm(dv, axis=1)
    inward = -dv / size[:, None]
    # between two rows the body moves at its old velocity until the hit, then at its new one
    early = (end[:, :2] - begin[:, :2]) / time_step - end[:, 3:5]
    when = np.clip(-(early * dv).sum(axis=1) / size**2, 0.0, 1.0) * time_step
    place = begin[:, :2] + when[:, None] * begin[:, 3:5]
    theta = begin[:, 2] + when * begin[:, 5]
    # r x J = I d(omega): distance of the impulse's line from the centre, positive to its left
    offset = shape.unit_moment * (end[:, 5] - begin[:, 5]) / size
    ways = zip(turned(inward, -theta), offset.tolist(), strict=True)
    local = np.array([_exit(shape, way, off) for way, off in ways]).reshape(-1, 2)
    return place + turned(local, theta), inward


def _exit(shape: Shape, direction: Floats, offset: float) -> Floats:
    """Return where a line, at an offset from the body's centre, leaves the outline."""
    side = np.array([-direction[1], direction[0]])
    if shape.outline is None:
        radius = shape.bounding_radius
        offset = min(max(offset, -radius), radius)
        return np.asarray(offset * side + np.sqrt(radius**2 - offset**2) * direction)
    corners = np.array(shape.outline)
    across, along = corners @ side, corners @ direction
    offset = min(max(offset, across.min()), across.max())
    best = -np.inf
    for i in range(len(corners)):
        low, high = sorted((i - 1, i), key=lambda k: across[k])
        if across[low] <= offset <= across[high]:
            width = across[high] - across[low]
            share = (offset - across[low]) / width if width > 0 else 0.0
            ends = along[low] + share * (along[high] - along[low])
            best = max(best, ends, along[high] if width == 0 else -np.inf)
    return np.asarray(offset * side + best * direction)


hidden_obstacle = Effect(
    "hidden_obstacle",
    (
        EffectParameter("x", "m", SIGNED, scale="range", origin="x"),
        EffectParameter("y", "m", SIGNED, scale="range", origin="y"),
        EffectParameter("radius", "m", SIZE, scale="length"),
    ),
    "the body ran into something that the scene does not show",
    "contact with a static disc",
    Structure(_discs),
    scan=_scan_discs,
    log_odds=-8.0,
    unusual="obstacles are seen; three numbers that take any misfit of a place",
    needs=("places",),
)
