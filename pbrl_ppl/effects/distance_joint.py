"""A rod or taut tether that the scene does not show: it holds a point of the body at a distance."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.hinge import hangs_in_none
from pbrl_ppl.effects.scans import body_points
from pbrl_ppl.effects.stages import Rod, Structure
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

Array = NDArray[np.float64]

#: Distances that vary by less than this share of how far the body went are of a rod, and one that
#: is longer than so many times that cannot be told from a straight line.
_HELD, _LONGEST = 0.03, 20.0
#: Rods shorter than this (m) have no direction that data could tell.
_SHORTEST = 0.02
#: Ends closer than this (m) are the same.
_SAME = 0.01


def _rod(parameters: Any) -> Rod:
    return Rod(*(parameters[name] for name in ("a_x", "a_y", "b_x", "b_y", "length")))


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Rods that all measured poses agree on, by least squares of the distance's changes."""
    poses = history.dataset["start"].sel(body=body.name).to_numpy()[..., :3].reshape(-1, 3)
    poses = poses[np.isfinite(poses).all(axis=1)]
    if len(poses) < 6:
        return np.empty((0, 5))
    way = float(np.sqrt(poses[:, :2].var(axis=0).sum()))

    def off(ends: Array) -> Array:
        distance = _distance(ends, poses)
        return np.asarray(distance - distance.mean())

    found: list[Array] = []
    for begin in body_points(body):
        ends = np.array([*begin, *_middle(begin, poses)])
        fitted = least_squares(off, ends, x_scale="jac").x
        length = float(_distance(fitted, poses).mean())
        if off(fitted).std() > _HELD * way or not _SHORTEST < length < _LONGEST * way:
            continue
        if all(np.abs(fitted - other[:4]).max() > _SAME for other in found):
            found.append(np.array([*fitted, length]))
    return np.array(found).reshape(-1, 5)


def _distance(ends: Array, poses: Array) -> Array:
    """From a point of the body to a place, shape (n,), of ends (4,) and poses (n, 3)."""
    x, y = _point(ends[:2], poses)
    return np.asarray(np.hypot(x - ends[2], y - ends[3]))


def _point(place: Array, poses: Array) -> tuple[Array, Array]:
    """Where a point of the body is, shape (n,) each."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, 0] + c * place[0] - s * place[1], poses[:, 1] + s * place[0] + c * place[1]


def _middle(place: Array, poses: Array) -> Array:
    """Middle of the circle that a point of the body goes on (Kasa, 1976), shape (2,)."""
    x, y = _point(place, poses)
    table = np.column_stack([2 * x, 2 * y, np.ones(len(x))])
    return np.asarray(np.linalg.lstsq(table, x * x + y * y, rcond=None)[0][:2])


distance_joint = Effect(
    "distance_joint",
    (
        EffectParameter("a_x", "m", Prior("normal", sigma=0.5)),
        EffectParameter("a_y", "m", Prior("normal", sigma=0.5)),
        EffectParameter("b_x", "m", Prior("normal", sigma=10.0)),
        EffectParameter("b_y", "m", Prior("normal", sigma=10.0)),
        EffectParameter("length", "m", Prior("half_normal", sigma=3.0)),
    ),
    "a rod or a taut tether that the scene does not show: it holds a point of the body at a"
    " distance from a place",
    "J_d of Scholz et al., ICML 2014, section 3.2, to the world",
    Structure(rod=_rod),
    applies=hangs_in_none,
    scan=_scan,
)
