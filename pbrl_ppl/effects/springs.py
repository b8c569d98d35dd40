"""Springs, springy stops, and rods that the scene does not show."""

from itertools import product
from math import floor, pi

import numpy as np
from scipy.optimize import least_squares

from pbrl_ppl.effects.effect import (
    ANY_ANGLE,
    SIGNED,
    SIZE,
    Effect,
    EffectParameter,
    Force,
    Rod,
    ScanWith,
    Structure,
    Values,
    body_points,
    is_unjoined,
    is_unpivoted,
)
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats, wrapped

_ANCHOR = (
    EffectParameter("anchor_x", "m", SIGNED, scale="range", origin="x"),
    EffectParameter("anchor_y", "m", SIGNED, scale="range", origin="y"),
)


def _poses(history: History, body: Body, width: int) -> Floats:
    """Return the first coordinates of a body where all are known, shape (n, width).

    None where no place of it was measured.
    """
    seen = history.dataset["observed"].sel(body=body.name, state=["x", "y"]).to_numpy()
    if not np.isfinite(seen).any():
        return np.empty((0, width))
    poses = history.dataset["start"].sel(body=body.name).to_numpy()[..., :width].reshape(-1, width)
    return np.asarray(poses[np.isfinite(poses).all(axis=1)])


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
        *_ANCHOR,
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
    theta = history.dataset["start"].sel(body=body.name, state="theta").to_numpy().ravel()
    off = np.abs(wrapped(theta[np.isfinite(theta), None] - angles))
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


def _cubic_spring(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    x, y = state[0] - parameters[1], state[1] - parameters[2]
    pull = parameters[0] * (x * x + y * y)
    wrench[0] -= pull * x
    wrench[1] -= pull * y


cubic_spring = Effect(
    "cubic_spring",
    (
        EffectParameter("stiffness", "N/m^3", SIGNED, scale="force/range^3"),
        *_ANCHOR,
    ),
    "a pull towards a place that grows with the cube of the distance: a spring that hardens",
    "Duffing's spring, F = -k r^3",
    Force(_cubic_spring),
    applies=is_unpivoted,
    scan=_scan_anchors,
    log_odds=-4.0,
    family="place and angle",
    unusual="springs that harden are rare, and it takes any misfit of a place",
    needs=("places",),
)


def _cubic_torsion(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    off = state[2] - parameters[1]
    off -= 2.0 * pi * floor((off + pi) / (2.0 * pi))
    wrench[2] -= parameters[0] * off * off * off


def _scan_range(scene: Scene, history: History, body: Body, shares: tuple[float, ...]) -> Floats:
    """Return angles at shares of the range that was measured; none if it turns all the way.

    The derivative is taken by the stiffness.
    """
    theta = history.dataset["start"].sel(body=body.name, state="theta").to_numpy().ravel()
    theta = theta[np.isfinite(theta)]
    if not len(theta) or not 0.0 < np.ptp(theta) < 2.0 * np.pi:
        return np.empty((0, 2))
    return np.array([(np.nan, theta.min() + share * np.ptp(theta)) for share in shares])


cubic_torsion_spring = Effect(
    "cubic_torsion_spring",
    (
        EffectParameter("stiffness", "N m/rad^3", SIGNED, scale="torque"),
        EffectParameter("angle", "rad", ANY_ANGLE),
    ),
    "a torque towards an angle that grows with the cube of the deflection: a spring that hardens",
    "Duffing's spring, tau = -k theta^3",
    Force(_cubic_torsion),
    scan=ScanWith(_scan_range, (0.1, 0.5, 0.9)),
    log_odds=-3.0,
    family="place and angle",
    unusual="springs that harden are rare, and it takes any misfit of an angle",
    needs=("places",),
)


def _upper_stop(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] -= parameters[0] * max(0.0, state[2] - parameters[1])


def _lower_stop(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] += parameters[0] * max(0.0, parameters[1] - state[2])


_STOP = (
    EffectParameter("stiffness", "N m/rad", Prior("half_normal", sigma=10.0), scale="torque"),
    EffectParameter("angle", "rad", ANY_ANGLE),
)

upper_stop = Effect(
    "upper_stop",
    _STOP,
    "a springy stop above an angle: a bumper, a cable that gets tight",
    "one-sided spring, tau = -k max(0, theta - theta0)",
    Force(_upper_stop),
    scan=ScanWith(_scan_range, (0.7, 0.9)),
    log_odds=-4.0,
    family="place and angle",
    unusual="stops are seen, and seldom reached",
    needs=("places",),
)

lower_stop = Effect(
    "lower_stop",
    _STOP,
    "a springy stop below an angle: a bumper, a cable that gets tight",
    "one-sided spring, tau = k max(0, theta0 - theta)",
    Force(_lower_stop),
    scan=ScanWith(_scan_range, (0.3, 0.1)),
    log_odds=-4.0,
    family="place and angle",
    unusual="stops are seen, and seldom reached",
    needs=("places",),
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
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, 0] + c * point[0] - s * point[1], poses[:, 1] + s * point[0] + c * point[1]


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
