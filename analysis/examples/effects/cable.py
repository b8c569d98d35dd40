"""A pull towards a place that begins beyond a distance: a springy cable that gets taut.

F = -stiffness max(0, r - length), r the distance from the anchor.
"""

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.effects import is_unpivoted


def law(state, command, parameters, wrench):
    """Add the pull; the parameters are stiffness, anchor_x, anchor_y and length."""
    x, y = state[0] - parameters[1], state[1] - parameters[2]
    distance = (x * x + y * y) ** 0.5
    if distance > parameters[3]:
        pull = parameters[0] * (1.0 - parameters[3] / distance)
        wrench[0] -= pull * x
        wrench[1] -= pull * y


def scan(scene, history, body):
    """Return cables from beyond each side, taut in a third of the poses; only stiffness is free."""
    places = history.dataset["start"].sel(body=body.name, state=["x", "y"]).to_numpy()
    places = places[np.isfinite(places).all(axis=-1)]
    if not len(places):
        return np.empty((0, 4))
    middle, reach = places.mean(axis=0), np.ptp(places, axis=0)
    rows = []
    for side in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        if reach @ np.abs(side) > 0.0:
            anchor = middle + reach * side
            length = np.quantile(np.linalg.norm(places - anchor, axis=1), 0.67)
            rows.append((np.nan, *anchor, length))
    return np.array(rows).reshape(-1, 4)


PLACE = pp.Prior("normal", sigma=1.0)

cable = pp.Effect(
    "cable",
    (
        pp.EffectParameter(
            "stiffness", "N/m", pp.Prior("half_normal", sigma=3.0), scale="force/length"
        ),
        pp.EffectParameter("anchor_x", "m", PLACE, scale="range", origin="x"),
        pp.EffectParameter("anchor_y", "m", PLACE, scale="range", origin="y"),
        pp.EffectParameter("length", "m", pp.Prior("half_normal", sigma=1.0), scale="range"),
    ),
    "a pull towards a place that begins beyond a distance: a springy cable that gets taut",
    "one-sided spring, F = -k max(0, r - l)",
    pp.Force(law),
    applies=is_unpivoted,
    scan=scan,
    log_odds=-5.0,
    family="place and angle",
    unusual="cables are seen, and mostly slack",
    needs=("places",),
)
