"""The pendulum's model written out in PyMC: what `pbrl_ppl.physics_model` declares for its scene.

Run from anywhere: `python models/pendulum/model.py`.
"""

from pathlib import Path

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pbrl_ppl as pp

FOLDER = Path(__file__).parent
MEASURED = [2, 5]  # theta and omega, of x, y, theta, vx, vy, omega
IS_ANGLE = np.array([1, 0])


def pendulum_model(scene: pp.Scene, history: pp.History) -> pm.Model:
    """Table 1 and Eq. 11 of Scholz et al. (2014) for an arm on a known hinge, of known mass."""
    transitions = history.segments(horizon=1)
    start, actions = transitions.start, transitions.actions
    measured = transitions.observed[..., MEASURED]  # (transition, 1, body, state)
    physics = pp.Physics.declare(scene)  # gives the order of phi
    simulate = pp.SimulatorOp(physics)
    with pm.Model() as model:
        # Table 1, restitution and contact friction: the arm touches nothing
        r = pm.LogNormal("r", mu=-1.5, sigma=1.0)
        mu_c = pm.TruncatedNormal("mu_c", mu=0.5, sigma=1.0, lower=0, upper=1)
        # the declared effect: moment of inertia over that of an even arm
        scale = pm.LogNormal("inertia_scale_scale", mu=0.0, sigma=0.5)
        # P(sigma): weak, about a tenth of how much each state dimension changes
        typical = np.sqrt(
            np.mean(short_way(measured - start[:, None][..., MEASURED]) ** 2, axis=(0, 1, 2))
        )
        sigma = pm.LogNormal("sigma", mu=np.log(0.1 * typical), sigma=2.0, shape=2)
        # Eq. 11: s' ~ Normal(f(s, a; Phi), sigma^2); angles a whole turn apart are the same
        phi = pt.stack([r, mu_c, scale])
        predicted = simulate(phi, start, actions)[..., MEASURED]
        turns = 2 * np.pi * pt.round((measured - predicted) / (2 * np.pi)) * IS_ANGLE
        pm.Normal("next_state", mu=predicted + turns, sigma=sigma, observed=measured)
    return model


def short_way(change: np.ndarray) -> np.ndarray:
    """Changes of measured states (..., 2) with angles the short way round."""
    return change - 2 * np.pi * np.round(change / (2 * np.pi)) * IS_ANGLE


if __name__ == "__main__":
    scene = pp.Scene.load(FOLDER / "scene.toml")
    history = pp.History.load(FOLDER / "recorded" / "train.csv", scene)
    print(pendulum_model(scene, history).point_logps())
