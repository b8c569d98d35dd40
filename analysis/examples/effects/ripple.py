"""A force along a line that repeats with the place: a linear motor's magnets, a belt's teeth.

F = cosine cos(2 pi s / wavelength) + sine sin(2 pi s / wavelength), s the place along the line.
"""

import math

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.effects import is_unpivoted


def law(state, command, parameters, wrench):
    """Add the force; the parameters are cosine, sine, wavelength and direction."""
    c, s = math.cos(parameters[3]), math.sin(parameters[3])
    phase = 2.0 * math.pi * (c * state[0] + s * state[1]) / parameters[2]
    force = parameters[0] * math.cos(phase) + parameters[1] * math.sin(phase)
    wrench[0] += c * force
    wrench[1] += s * force


def scan(scene, history, body):
    """Return wavelengths along each axis of motion; the derivative is taken by the forces."""
    places = history.dataset["start"].sel(body=body.name, state=["x", "y"]).to_numpy()
    high = np.nanmax(places, axis=(0, 1), initial=-np.inf)
    reach = high - np.nanmin(places, axis=(0, 1), initial=np.inf)
    rows = [
        (np.nan, np.nan, reach[axis] / n, 0.5 * np.pi * axis)
        for axis in (0, 1)
        for n in 1.5 * 1.35 ** np.arange(8)
        if 0.2 * reach.max() < reach[axis] < np.inf
    ]
    return np.array(rows).reshape(-1, 4)


SIZE = pp.Prior("normal", sigma=1.0)

ripple = pp.Effect(
    "ripple",
    (
        pp.EffectParameter("cosine", "N", SIZE, scale="force"),
        pp.EffectParameter("sine", "N", SIZE, scale="force"),
        pp.EffectParameter(
            "wavelength", "m", pp.Prior("log_normal", mu=-1.0, sigma=1.0), null=0.4, scale="range"
        ),
        pp.EffectParameter("direction", "rad", pp.Prior("von_mises", mu=0.0, kappa=0.0)),
    ),
    "a force along a line that repeats with the place: a linear motor's magnets, a belt's teeth",
    "force ripple, a cos(2 pi x / l) + b sin(2 pi x / l)",
    pp.Force(law),
    applies=is_unpivoted,
    scan=scan,
    log_odds=-5.0,
    family="place and angle",
    unusual="floors with waves are rare; it takes any misfit of a place",
    needs=("places",),
)
