"""The cart's model written out in PyMC: what `pbrl_ppl.physics_model` declares for its scene.

Run from anywhere: `python models/shopping_cart/model.py`.
"""

from pathlib import Path

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pbrl_ppl as pp

FOLDER = Path(__file__).parent
IS_ANGLE = np.array([0, 0, 1, 0, 0, 0])  # x, y, theta, vx, vy, omega


def cart_model(scene: pp.Scene, history: pp.History) -> pm.Model:
    """Table 1 and Eq. 11 of Scholz et al. (2014) for one cart with a wheel."""
    transitions = history.segments(horizon=1)
    start, actions = transitions.start, transitions.actions
    measured = transitions.observed  # (transition, 1, body, state)
    x_min, x_max, y_min, y_max = scene.body("cart").shape.bounds
    physics = pp.Physics.declare(scene)  # gives the order of phi
    simulate = pp.SimulatorOp(physics)
    with pm.Model() as model:
        # Table 1, m and r
        mass = pm.LogNormal("mass", mu=1.0, sigma=1.5)
        r = pm.LogNormal("r", mu=-1.5, sigma=1.0)
        # Table 1, friction coefficients
        mu_c = pm.TruncatedNormal("mu_c", mu=0.5, sigma=1.0, lower=0, upper=1)
        mu_x = pm.TruncatedNormal("mu_x", mu=0.5, sigma=1.0, lower=0, upper=1)
        mu_y = pm.TruncatedNormal("mu_y", mu=0.5, sigma=1.0, lower=0, upper=1)
        # Table 1, the wheel's pose within the bounds of the body
        w_x = pm.TruncatedNormal("w_x", mu=0, sigma=x_max - x_min, lower=x_min, upper=x_max)
        w_y = pm.TruncatedNormal("w_y", mu=0, sigma=y_max - y_min, lower=y_min, upper=y_max)
        w_theta = pm.VonMises("w_theta", mu=0, kappa=1e-12)  # uniform
        # P(sigma): weak, about a tenth of how much each state dimension changes
        typical = np.sqrt(np.mean(short_way(measured - start[:, None]) ** 2, axis=(0, 1, 2)))
        sigma = pm.LogNormal("sigma", mu=np.log(0.1 * typical), sigma=2.0, shape=6)
        # Eq. 11: s' ~ Normal(f(s, a; Phi), sigma^2); angles a whole turn apart are the same
        phi = pt.stack([mass, r, mu_c, w_x, w_y, w_theta, mu_x, mu_y])
        predicted = simulate(phi, start, actions)
        turns = 2 * np.pi * pt.round((measured - predicted) / (2 * np.pi)) * IS_ANGLE
        pm.Normal("next_state", mu=predicted + turns, sigma=sigma, observed=measured)
    return model


def short_way(change: np.ndarray) -> np.ndarray:
    """Changes of states (..., 6) with angles the short way round."""
    return change - 2 * np.pi * np.round(change / (2 * np.pi)) * IS_ANGLE


if __name__ == "__main__":
    scene = pp.Scene.load(FOLDER / "scene.toml")
    history = pp.History.load(FOLDER / "recorded" / "train.csv", scene)
    print(cart_model(scene, history).point_logps())
