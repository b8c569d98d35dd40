"""The rooms' model written out in PyMC: what `pbrl_ppl.physics_model` declares for its scene.

Run from anywhere: `python models/namo/model.py`, on the robot's first round in `world.py`.
"""

import sys
from pathlib import Path

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pbrl_ppl as pp

FOLDER = Path(__file__).parent
IS_ANGLE = np.array([0, 0, 1, 0, 0, 0])  # x, y, theta, vx, vy, omega


def rooms_model(scene: pp.Scene, history: pp.History) -> pm.Model:
    """Table 1 and Eq. 11 of Scholz et al. (2014) for a robot, a table and a couch."""
    transitions = history.segments(horizon=1)
    start, actions = transitions.start, transitions.actions
    measured = transitions.observed  # (transition, 1, body, state)
    physics = pp.Physics.declare(scene)  # gives the order of phi
    # bodies that were apart in this history are simulated apart
    simulate = pp.SimulatorOp(physics.in_parts(history))
    with pm.Model(
        coords={"body": ["robot", "table", "couch"], "feet": ["table", "couch"]}
    ) as model:
        # Table 1, m: the table may be as light as a chair or bolted to the floor
        mass = pm.LogNormal("mass", mu=[3.0, 3.0, 3.0], sigma=[0.5, 1.5, 0.5], dims="body")
        # Table 1, friction of feet, which are a wheel in the middle
        mu_x = pm.TruncatedNormal("mu_x", mu=0.3, sigma=0.2, lower=0, upper=1, dims="feet")
        mu_y = pm.TruncatedNormal("mu_y", mu=0.3, sigma=0.2, lower=0, upper=1, dims="feet")
        # the declared effect: the robot's motors push less the faster they turn
        drag = pm.HalfNormal("linear_drag_coefficient", sigma=100.0)
        # P(sigma): weak, about a tenth of how much each state dimension changes
        typical = np.sqrt(np.mean(short_way(measured - start[:, None]) ** 2, axis=(0, 1, 2)))
        sigma = pm.LogNormal("sigma", mu=np.log(0.1 * typical), sigma=2.0, shape=6)
        # Eq. 11: s' ~ Normal(f(s, a; Phi), sigma^2); angles a whole turn apart are the same
        phi = pt.concatenate([mass, mu_x, mu_y, drag[None]])
        predicted = simulate(phi, start, actions)
        turns = 2 * np.pi * pt.round((measured - predicted) / (2 * np.pi)) * IS_ANGLE
        pm.Normal("next_state", mu=predicted + turns, sigma=sigma, observed=measured)
    return model


def short_way(change: np.ndarray) -> np.ndarray:
    """Changes of states (..., 6) with angles the short way round."""
    return change - 2 * np.pi * np.round(change / (2 * np.pi)) * IS_ANGLE


if __name__ == "__main__":
    sys.path.insert(0, str(FOLDER))
    from world import SCENE, World, go_round

    print(rooms_model(SCENE, go_round(World(1)).history()).point_logps())
