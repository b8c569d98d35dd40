"""The cart's model written out in PyMC: what `pbrl_ppl.physics_model` declares for its scene.

Run from anywhere: `python models/shopping_cart/model.py`.
"""

from pathlib import Path

import pymc as pm
import pytensor.tensor as pt

import pbrl_ppl as pp

FOLDER = Path(__file__).parent


def cart_model(scene: pp.Scene, history: pp.History) -> pm.Model:
    """Table 1 and Eq. 11 of Scholz et al. (2014) for one cart with a wheel."""
    transitions = history.segments(horizon=1)
    x_min, x_max, y_min, y_max = scene.body("cart").shape.bounds
    reference = pp.physics_model(scene, history).problem  # gives the order of phi
    simulate = pp.SimulatorOp(scene, reference.layout)
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
        # Eq. 11: s' ~ Normal(f(s, a; Phi), sigma^2), with one sigma for all dimensions
        sigma = pm.HalfNormal("sigma", sigma=1.0)
        phi = pt.stack([mass, r, mu_c, w_x, w_y, w_theta, mu_x, mu_y])
        predicted = simulate(phi, transitions.start, transitions.actions)
        pm.Normal("next_state", mu=predicted, sigma=sigma, observed=transitions.observed)
    return model


if __name__ == "__main__":
    scene = pp.Scene.load(FOLDER / "scene.toml")
    history = pp.History.load(FOLDER / "recorded" / "train.csv", scene)
    print(cart_model(scene, history).point_logps())
