"""Springs that harden: a pull or a torque that grows with the cube of the deflection.

F = -k r^3 towards a place, tau = -k theta^3 towards an angle, by the shorter way round.
"""

from itertools import product
from math import floor, pi

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.effects import is_unpivoted


def force(state, command, parameters, wrench):
    """Add the pull; the parameters are stiffness, x and y."""
    x, y = state[0] - parameters[1], state[1] - parameters[2]
    pull = parameters[0] * (x * x + y * y)
    wrench[0] -= pull * x
    wrench[1] -= pull * y


def torque(state, command, parameters, wrench):
    """Add the torque; the parameters are stiffness and angle."""
    off = state[2] - parameters[1]
    off -= 2.0 * pi * floor((off + pi) / (2.0 * pi))
    wrench[2] -= parameters[0] * off * off * off


def scan_places(scene, history, body):
    """Return anchors among the measured positions; the derivative is taken by the stiffness."""
    places = history.dataset["start"].sel(body=body.name, state=["x", "y"]).to_numpy()
    places = places[np.isfinite(places).all(axis=-1)]
    if not len(places):
        return np.empty((0, 3))
    x, y = np.quantile(places, (0.1, 0.5, 0.9), axis=0).T
    return np.array([(np.nan, *anchor) for anchor in product(np.unique(x), np.unique(y))])


def scan_angles(scene, history, body):
    """Return angles of the range that was measured; none if the body turns all the way."""
    theta = history.dataset["start"].sel(body=body.name, state="theta").to_numpy().ravel()
    theta = theta[np.isfinite(theta)]
    if not len(theta) or not 0.0 < np.ptp(theta) < 2.0 * np.pi:
        return np.empty((0, 2))
    return np.array([(np.nan, theta.min() + share * np.ptp(theta)) for share in (0.1, 0.5, 0.9)])


SIGNED = pp.Prior("normal", sigma=1.0)

cubic_spring = pp.Effect(
    "cubic_spring",
    (
        pp.EffectParameter("stiffness", "N/m^3", SIGNED, scale="force/range^3"),
        pp.EffectParameter("anchor_x", "m", SIGNED, scale="range", origin="x"),
        pp.EffectParameter("anchor_y", "m", SIGNED, scale="range", origin="y"),
    ),
    "a pull towards a place that grows with the cube of the distance: a spring that hardens",
    "Duffing's spring, F = -k r^3",
    pp.Force(force),
    applies=is_unpivoted,
    scan=scan_places,
    log_odds=-4.0,
    family="place and angle",
    unusual="springs that harden are rare, and it takes any misfit of a place",
    needs=("places",),
)

cubic_torsion_spring = pp.Effect(
    "cubic_torsion_spring",
    (
        pp.EffectParameter("stiffness", "N m/rad^3", SIGNED, scale="torque"),
        pp.EffectParameter("angle", "rad", pp.Prior("von_mises", mu=0.0, kappa=0.0)),
    ),
    "a torque towards an angle that grows with the cube of the deflection: a spring that hardens",
    "Duffing's spring, tau = -k theta^3",
    pp.Force(torque),
    scan=scan_angles,
    log_odds=-3.0,
    family="place and angle",
    unusual="springs that harden are rare, and it takes any misfit of an angle",
    needs=("places",),
)
