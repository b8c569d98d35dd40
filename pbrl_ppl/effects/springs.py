"""What holds or stops a body and the scene does not show: springs, stops, rods and obstacles."""

from dataclasses import replace
from itertools import combinations, product
from math import floor, pi

import numpy as np
from scipy.optimize import least_squares

from pbrl_ppl.effects.effect import (
    ANY_ANGLE,
    SIGNED,
    SIZE,
    Disc,
    Effect,
    EffectParameter,
    Force,
    Rod,
    ScanWith,
    Structure,
    Values,
    body_points,
    is_pivoted,
    is_unjoined,
    is_unpivoted,
    measured,
)
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import POSE, Floats, turned, wrapped


def _poses(history: History, body: Body, width: int) -> Floats:
    """Return the first coordinates of a body where all are known, shape (n, width).

    None where no place of it was measured.
    """
    seen = history.dataset["observed"].sel(body=body.name, state=["x", "y"]).to_numpy()
    if not np.isfinite(seen).any():
        return np.empty((0, width))
    return measured(history, body, *POSE[:width])


def _spring(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] -= parameters[0] * (state[0] - parameters[1])
    wrench[1] -= parameters[0] * (state[1] - parameters[2])


def _scan_anchors(
    scene: Scene, history: History, body: Body, *, quantiles: tuple[float, ...] = (0.1, 0.5, 0.9)
) -> Floats:
    """Return anchors among the measured positions; the derivative is taken by the stiffness.

    ``quantiles``: anchors of a spring along each axis, as quantiles of the measured positions.
    """
    places = _poses(history, body, 2)
    if not len(places):
        return np.empty((0, 3))
    x, y = np.quantile(places, quantiles, axis=0).T
    return np.array([(np.nan, *anchor) for anchor in product(np.unique(x), np.unique(y))])


spring = Effect(
    "spring",
    (
        EffectParameter("stiffness", "N/m", SIZE, scale="force/length"),
        EffectParameter("anchor_x", "m", SIGNED, scale="range", origin="x"),
        EffectParameter("anchor_y", "m", SIGNED, scale="range", origin="y"),
    ),
    "a pull towards a place that grows with the distance: a cable or a hose drags at the body",
    "Hooke's law",
    Force(_spring),
    applies=is_unpivoted,
    scan=_scan_anchors,
    log_odds=-3.0,
    family="place and angle",
    unusual="cables and springs are seen; three numbers that take any misfit of a place",
    needs=("places",),
)


def _torsion_spring(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    # the shorter way round: a logged angle has no number of turns
    off = state[2] - parameters[1]
    off -= 2.0 * pi * floor((off + pi) / (2.0 * pi))
    wrench[2] -= parameters[0] * off


def _scan_angles(scene: Scene, history: History, body: Body, *, n_angles: int = 8) -> Floats:
    """Return angles of rest whose opposite the body never reaches; all if it reaches each.

    The torque jumps at the opposite angle, and such a saw-tooth fits any residual. The derivative
    is taken by the stiffness.

    ``n_angles``: angles of rest.
    """
    angles = np.linspace(-np.pi, np.pi, n_angles, endpoint=False)
    off = np.abs(wrapped(measured(history, body, "theta") - angles))
    smooth = off.max(axis=0, initial=0.0) < np.pi - np.pi / n_angles
    return np.array([(np.nan, angle) for angle in (angles[smooth] if smooth.any() else angles)])


torsion_spring = Effect(
    "torsion_spring",
    (
        EffectParameter("stiffness", "N m/rad", Prior("half_normal", sigma=0.5), scale="torque"),
        EffectParameter("angle", "rad", ANY_ANGLE),
    ),
    "a torque towards an angle that grows with the deflection: a twisted cable or a bent hinge",
    "Hooke's law of torsion",
    Force(_torsion_spring),
    scan=_scan_angles,
    log_odds=-3.0,
    family="place and angle",
    unusual="cables and springs are seen; a turned hinge or a constant torque is commoner",
    needs=("places",),
)


def _scan_range(scene: Scene, history: History, body: Body, shares: tuple[float, ...]) -> Floats:
    """Return angles at shares of the range that was measured; none if it turns all the way.

    The derivative is taken by the stiffness.
    """
    theta = measured(history, body, "theta")
    if not len(theta) or not 0.0 < np.ptp(theta) < 2.0 * np.pi:
        return np.empty((0, 2))
    return np.array([(np.nan, theta.min() + share * np.ptp(theta)) for share in shares])


def _upper_stop(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] -= parameters[0] * max(0.0, state[2] - parameters[1])


def _lower_stop(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] += parameters[0] * max(0.0, parameters[1] - state[2])


upper_stop = Effect(
    "upper_stop",
    (
        EffectParameter("stiffness", "N m/rad", Prior("half_normal", sigma=10.0), scale="torque"),
        EffectParameter("angle", "rad", ANY_ANGLE),
    ),
    "a springy stop above an angle: a bumper, a cable that gets tight",
    "one-sided spring, tau = -k max(0, theta - theta0)",
    Force(_upper_stop),
    scan=ScanWith(_scan_range, (0.7, 0.9)),
    log_odds=-4.0,
    family="place and angle",
    unusual="stops are seen, and seldom reached",
    needs=("places",),
)

lower_stop = replace(
    upper_stop,
    name="lower_stop",
    sentence="a springy stop below an angle: a bumper, a cable that gets tight",
    reference="one-sided spring, tau = k max(0, theta0 - theta)",
    stage=Force(_lower_stop),
    scan=ScanWith(_scan_range, (0.3, 0.1)),
)


def _rod(parameters: Values) -> Rod:
    return Rod(*(parameters[name] for name in Rod._fields))


def _scan_rods(
    scene: Scene,
    history: History,
    body: Body,
    *,
    most_deviation: float = 0.03,
    longest: float = 20.0,
    shortest: float = 0.04,
    same: float = 0.02,
) -> Floats:
    """Return rods whose length is constant over the measured poses, by least squares.

    ``most_deviation``: largest standard deviation of a rod's length, as a share of that of the
    positions.

    ``longest``: largest length as a multiple of the positions' standard deviation: a longer rod
    cannot be told from a straight line.

    ``shortest``: length of a rod below which the data do not inform its direction.
    ``same``: distance of ends that are the same, in radii of the body.
    """
    radius = body.shape.bounding_radius
    poses = _poses(history, body, 3) / [radius, radius, 1.0]  # in radii of the body
    if len(poses) < 6:
        return np.empty((0, 5))
    spread = float(np.sqrt(poses[:, :2].var(axis=0).sum()))

    def deviation(ends: Floats) -> Floats:
        length = _length(ends, poses)
        return np.asarray(length - length.mean())

    rods: list[Floats] = []
    for begin in body_points(body) / radius:
        ends = np.array([*begin, *_centre(begin, poses)])
        fitted = least_squares(deviation, ends, x_scale="jac").x
        length = float(_length(fitted, poses).mean())
        if (
            deviation(fitted).std() > most_deviation * spread
            or not shortest < length < longest * spread
        ):
            continue
        if all(np.abs(fitted - other[:4]).max() > same for other in rods):
            rods.append(np.array([*fitted, length]))
    return radius * np.array(rods).reshape(-1, 5)


def _length(ends: Floats, poses: Floats) -> Floats:
    """Return the distances (n,) from a point of the body to a place: ends (4,), poses (n, 3)."""
    x, y = _positions(ends[:2], poses)
    return np.asarray(np.hypot(x - ends[2], y - ends[3]))


def _positions(point: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Return where a point of the body is in the world, shape (n,) each."""
    x, y = (poses[:, :2] + turned(point, poses[:, 2])).T
    return x, y


def _centre(point: Floats, poses: Floats) -> Floats:
    """Return the centre of the circle on which a point of the body moves (Kasa, 1976)."""
    x, y = _positions(point, poses)
    table = np.column_stack([2 * x, 2 * y, np.ones(len(x))])
    return np.asarray(np.linalg.lstsq(table, x * x + y * y, rcond=None)[0][:2])


distance_joint = Effect(
    "distance_joint",
    (
        EffectParameter("a_x", "m", SIGNED, scale="length"),
        EffectParameter("a_y", "m", SIGNED, scale="length"),
        EffectParameter("b_x", "m", SIGNED, scale="range", origin="x"),
        EffectParameter("b_y", "m", SIGNED, scale="range", origin="y"),
        EffectParameter("length", "m", SIZE, scale="range"),
    ),
    "a rod or a taut tether that the scene does not show: it holds a point of the body at a"
    " distance from a place",
    "J_d of Scholz et al., ICML 2014, section 3.2, to the world",
    Structure(rod=_rod),
    applies=is_unjoined,
    scan=_scan_rods,
    log_odds=-8.0,
    unusual="rods are seen",
    needs=("places",),
)


def _discs(parameters: Values) -> tuple[Disc, ...]:
    return (Disc(parameters["x"], parameters["y"], parameters["radius"]),)


def _scan_discs(
    scene: Scene,
    history: History,
    body: Body,
    *,
    hits: int = 16,
    most_discs: int = 60,
    stands_out: float = 3.0,
    sizes: tuple[float, ...] = (0.25, 0.75, 2.0),
    near: float = 0.1,
    turns: tuple[float, ...] = (0.0, 0.3, -0.3),
) -> Floats:
    """Return discs that several hits agree on, then discs of single hits.

    Where the velocity changed by ``dv``, the obstacle lies along ``-dv``. The change of the angular
    velocity gives the distance of the impulse's line from the centre, and with it the point of the
    outline that was hit; the disc's centre is one radius beyond.

    ``hits``: intervals with the largest velocity changes that are taken for hits.
    ``most_discs``: discs tried at most.
    ``stands_out``: a hinge changes velocities all the time: there a hit exceeds this multiple of
    the median change.

    ``sizes``: radii of discs tried for a single hit, as shares of the body's radius.
    ``near``: distance from a disc within which a hit agrees with it, as a share of the body's
    radius.
    ``turns``: angles by which friction may turn an impulse off the outline's normal (rad).
    """
    start = history.dataset["start"].sel(body=body.name).to_numpy()
    begin, end = start[:, :-1].reshape(-1, 6), start[:, 1:].reshape(-1, 6)
    seen = np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)
    begin, end = begin[seen], end[seen]
    change = np.linalg.norm(end[:, 3:5] - begin[:, 3:5], axis=1)
    order = np.argsort(-change)[:hits]
    least = 1e-9 * np.abs(begin[:, 3:5]).max(initial=0.0)
    if is_pivoted(scene, body) and len(change):
        least = max(least, stands_out * float(np.median(change)))
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
        scored.append((int((off < near * reach).sum()), (*centre, radius)))
    scored.sort(key=lambda agreed: -agreed[0])
    discs = [disc for count, disc in scored[: most_discs // 4] if count > 1]
    for at, way in zip(point, inward, strict=True):
        for radius, turn in product(reach * np.array(sizes), turns):
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
