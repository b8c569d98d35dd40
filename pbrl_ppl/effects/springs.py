"""What holds a body and the scene does not show: springs, stops and rods."""

from dataclasses import replace
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
    Structure,
    Values,
    With,
    body_points,
    is_unjoined,
    is_unpivoted,
    measured,
)
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
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


def _scan_anchors(scene: Scene, history: History, body: Body) -> Floats:
    """Return anchors among the measured positions; the derivative is taken by the stiffness."""
    places = _poses(history, body, 2)
    if not len(places):
        return np.empty((0, 3))
    x, y = np.quantile(places, (0.1, 0.5, 0.9), axis=0).T
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
    scan=With(_scan_range, (0.7, 0.9)),
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
    scan=With(_scan_range, (0.3, 0.1)),
)


def _rod(parameters: Values) -> Rod:
    return Rod(*(parameters[name] for name in Rod._fields))


def _scan_rods(scene: Scene, history: History, body: Body) -> Floats:
    """Return rods whose length is constant over the measured poses, by least squares."""
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
        # a shorter rod has no direction in the data, a longer one is no other than a straight line
        possible = 0.04 < length < 20.0 * spread and deviation(fitted).std() <= 0.03 * spread
        # ends nearer than this, in radii of the body, are the same
        if possible and all(np.abs(fitted - other[:4]).max() > 0.02 for other in rods):
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
        *EffectParameter.each("a_x", "a_y", unit="m", prior=SIGNED, scale="length"),
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
