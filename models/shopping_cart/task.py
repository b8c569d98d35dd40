"""The shopping-cart task of section 5.1 of Scholz et al. (2014): what an agent is told, the truth.

The paper gives no numbers; these are a cart's that someone pushes by its handle.
"""

from pathlib import Path

import pbrl_ppl as pp

SCENE = pp.Scene.load(Path(__file__).parent / "task.toml")
#: Any heading will do.
GOAL = pp.Goal.of({"cart": (2.0, 0.0, None)}, tolerance=0.2)
#: Forwards, backwards or not at all, and turning either way or not at all (N, N m).
ACTIONS = pp.ActionSet.box("cart", forces=(-20.0, 0.0, 20.0), torques=(-5.0, 0.0, 5.0))
TASK = pp.Task(SCENE, GOAL, ACTIONS)
#: The wheel, near the back, rolls along the cart and resists sideways (kg, m, rad).
TRUTH = {
    "mass": 8.0, "r": 0.2, "mu_c": 0.3, "w_x": -0.25, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.04,
    "mu_y": 0.45,
}  # fmt: skip

#: How far a start may be from the scene's (m, m, rad): episodes differ by it.
SPREAD = 0.2
