"""The rearrangement task of section 5.2 of Scholz et al. (2014): what agents are told, the truth.

The paper prints neither its apartment nor its goal; these are ours. The shopping cart stands before
the kitchen's door and is wanted behind it, the kitchen table has swung into the way and is wanted
at the outer wall. On either side of the cart, the door's posts are about the collision radius away.
"""

from pathlib import Path

import pbrl_ppl as pp

FOLDER = Path(__file__).parent
#: The apartment, with one action of half a second as the sampling interval.
SCENE = pp.Scene.load(FOLDER / "scene.toml").replace(time_step=0.5, substeps=40)
GOAL = pp.Goal(
    (
        pp.Target("shopping_cart", 1.9, -1.2, tolerance=0.3),
        pp.Target("kitchen_table", theta=0.4, angle_tolerance=0.4),
    )
)
_CART = pp.ActionSet.box("shopping_cart", forces=(-30.0, 0.0, 30.0), torques=(-5.0, 0.0, 5.0))
_TURNS = tuple(pp.Action("kitchen_table", torque=torque) for torque in (-4.0, 4.0))
#: Pushes of the cart by its handle, turns of it and of the table (N, N m).
ACTIONS = pp.ActionSet((*_CART.actions, *_TURNS))
TASK = pp.Task(SCENE, GOAL, ACTIONS)

#: True parameters: mass (kg); wheel's x (m), mu_x and mu_y, where there is one. Sofa and bed are
#: heavy, chairs light, dining table and desk have fixed wheels.
_TRUTH = {
    "sofa": (70.0, 0.0, 0.35, 0.35),
    "tea_table": (8.0, 0.0, 0.25, 0.25),
    "round_table": (18.0,),
    "plant_stand": (10.0,),
    "wheelchair": (22.0, -0.2, 0.03, 0.4),
    "shopping_cart": (12.0, -0.2, 0.04, 0.35),
    "dining_table": (40.0, 0.3, 0.05, 0.4),
    "kitchen_table": (15.0,),
    "bed": (80.0, 0.0, 0.4, 0.4),
    "desk": (35.0, -0.3, 0.05, 0.4),
    "office_chair": (9.0, 0.0, 0.04, 0.05),
}
_WHEELS = [_TRUTH[body.name][1:] for body in SCENE.dynamic if body.wheel]
#: By name, in the order of the scene's bodies and of its wheels.
TRUTH = {
    "mass": [_TRUTH[body.name][0] for body in SCENE.dynamic],
    "r": 0.2,
    "mu_c": 0.3,
    "w_x": [x for x, _, _ in _WHEELS],
    "w_y": 0.0,
    "w_theta": 0.0,
    "mu_x": [mu for _, mu, _ in _WHEELS],
    "mu_y": [mu for _, _, mu in _WHEELS],
}
#: Modes that were learned of each piece of furniture by itself; `make_library.py` makes it.
LIBRARY_FILE = FOLDER / "library.json"


def library() -> pp.ParameterLibrary:
    """The categorical prior: any body may be as any piece of furniture that was tried before."""
    return pp.ParameterLibrary.from_json(LIBRARY_FILE.read_text(encoding="utf-8"))
