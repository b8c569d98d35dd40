"""A pull towards a place, or a push away, that is strong near it and weak far off: a magnet.

F = strength d / (d^2 + depth^2)^1.5, d the way to the place.
"""

from itertools import product

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.effects import is_unpivoted


def law(state, command, parameters, wrench):
    """Add the pull; the parameters are strength, x, y and depth."""
    x, y = parameters[1] - state[0], parameters[2] - state[1]
    strength = parameters[0] * (x * x + y * y + parameters[3] * parameters[3]) ** -1.5
    wrench[0] += strength * x
    wrench[1] += strength * y


def scan(scene, history, body):
    """Return places about the measured positions; the derivative is taken by the strength."""
    places = history.dataset["start"].sel(body=body.name, state=["x", "y"]).to_numpy()
    places = places[np.isfinite(places).all(axis=-1)]
    if not len(places):
        return np.empty((0, 4))
    low, high = places.min(axis=0), places.max(axis=0)
    wider = 0.15 * (high - low)
    x, y = np.linspace(low - wider, high + wider, 9).T
    depths = [share * body.shape.bounding_radius for share in (0.15, 0.45)]
    return np.array([(np.nan, *at) for at in product(np.unique(x), np.unique(y), depths)])


SIGNED = pp.Prior("normal", sigma=1.0)

point_attractor = pp.Effect(
    "point_attractor",
    (
        pp.EffectParameter("strength", "N m^2", SIGNED, scale="force length^2"),
        pp.EffectParameter("x", "m", SIGNED, scale="range", origin="x"),
        pp.EffectParameter("y", "m", SIGNED, scale="range", origin="y"),
        pp.EffectParameter(
            "depth", "m", pp.Prior("log_normal", mu=-1.0, sigma=0.7), null=0.4, scale="length"
        ),
    ),
    "a pull towards a place, or a push away, that is strong near it and weak far off: a magnet",
    "inverse-square law, of a source below or above the plane",
    pp.Force(law),
    applies=is_unpivoted,
    scan=scan,
    log_odds=-8.0,
    family="place and angle",
    unusual="few rigs have magnets",
    needs=("places",),
)
