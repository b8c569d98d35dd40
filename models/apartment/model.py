"""The apartment's model written out in PyMC: what `pbrl_ppl.physics_model` declares for its scene.

Run from anywhere, on a recording of the eleven bodies: `python models/apartment/model.py FILE`.
"""

import sys
from pathlib import Path

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pbrl_ppl as pp

FOLDER = Path(__file__).parent
IS_ANGLE = np.array([0, 0, 1, 0, 0, 0])  # x, y, theta, vx, vy, omega
#: Medians of the masses' prior (logarithms of kg), and what has no wheel.
LOG_MASS = {
    "sofa": 4.1, "tea_table": 2.3, "round_table": 2.7, "plant_stand": 2.5, "wheelchair": 2.9,
    "shopping_cart": 2.7, "dining_table": 3.5, "kitchen_table": 2.9, "bed": 4.2, "desk": 3.4,
    "office_chair": 2.6,
}  # fmt: skip
NO_WHEEL = ("round_table", "plant_stand", "kitchen_table")


def apartment_model(scene: pp.Scene, history: pp.History) -> pm.Model:
    """Table 1 and Eq. 11 of Scholz et al. (2014) for eleven bodies, one on a known hinge."""
    transitions = history.segments(horizon=1)
    start, actions = transitions.start, transitions.actions
    measured = transitions.observed  # (transition, 1, body, state)
    wheels = [name for name in LOG_MASS if name not in NO_WHEEL]
    bounds = np.array([scene.body(name).shape.bounds for name in wheels])
    x_min, x_max, y_min, y_max = bounds.T
    physics = pp.Physics.declare(scene)  # gives the order of phi
    # bodies that were apart in this history are simulated apart
    simulate = pp.SimulatorOp(physics.in_parts(history))
    with pm.Model(coords={"body": list(LOG_MASS), "wheel": wheels}) as model:
        # Table 1, m and r
        mass = pm.LogNormal("mass", mu=list(LOG_MASS.values()), sigma=0.5, dims="body")
        r = pm.LogNormal("r", mu=-1.5, sigma=1.0, dims="body")
        # Table 1, friction coefficients
        share = {"mu": 0.5, "sigma": 1.0, "lower": 0, "upper": 1}
        mu_c = pm.TruncatedNormal("mu_c", **share, dims="body")
        mu_x = pm.TruncatedNormal("mu_x", **share, dims="wheel")
        mu_y = pm.TruncatedNormal("mu_y", **share, dims="wheel")
        # Table 1, the wheels' poses within the bounds of the bodies
        w_x = pm.TruncatedNormal(
            "w_x", mu=0, sigma=x_max - x_min, lower=x_min, upper=x_max, dims="wheel"
        )
        w_y = pm.TruncatedNormal(
            "w_y", mu=0, sigma=y_max - y_min, lower=y_min, upper=y_max, dims="wheel"
        )
        w_theta = pm.VonMises("w_theta", mu=0, kappa=1e-12, dims="wheel")  # uniform
        # P(sigma): weak, about a tenth of how much each state dimension changes
        typical = np.sqrt(np.mean(short_way(measured - start[:, None]) ** 2, axis=(0, 1, 2)))
        sigma = pm.LogNormal("sigma", mu=np.log(0.1 * typical), sigma=2.0, shape=6)
        # Eq. 11: s' ~ Normal(f(s, a; Phi), sigma^2); angles a whole turn apart are the same
        phi = pt.concatenate([mass, r, mu_c, w_x, w_y, w_theta, mu_x, mu_y])
        predicted = simulate(phi, start, actions)
        turns = 2 * np.pi * pt.round((measured - predicted) / (2 * np.pi)) * IS_ANGLE
        pm.Normal("next_state", mu=predicted + turns, sigma=sigma, observed=measured)
    return model


def short_way(change: np.ndarray) -> np.ndarray:
    """Changes of states (..., 6) with angles the short way round."""
    return change - 2 * np.pi * np.round(change / (2 * np.pi)) * IS_ANGLE


if __name__ == "__main__":
    scene = pp.Scene.load(FOLDER / "scene.toml")
    print(apartment_model(scene, pp.History.load(sys.argv[1], scene)).point_logps())
