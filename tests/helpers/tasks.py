"""Small tasks for agents: a cart without walls, and a puck behind a wall."""

from episodes import World

from pbrl_ppl.agents import Task
from pbrl_ppl.planning import ActionSet, Goal
from pbrl_ppl.scene import Body, Scene, Shape, Wall

#: Pushed sideways it slides: 15 N are more than mu_y m g.
CART_TRUTH = {
    "mass": 5.0, "r": 0.2, "mu_c": 0.3, "w_x": -0.2, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.05,
    "mu_y": 0.2,
}  # fmt: skip
CART = Task(
    Scene(
        time_step=0.25,
        substeps=20,
        normal_gravity=9.81,
        bodies=(Body("cart", Shape.box(0.9, 0.55), wheel=True, pose=(0.0, 0.0, 0.0)),),
    ),
    Goal.of({"cart": (2.0, 1.0, None)}, tolerance=0.2),
    ActionSet.box("cart", forces=(-15.0, 0.0, 15.0), lateral=(-15.0, 15.0), torques=(-4.0, 0, 4.0)),
)
PUCK_TRUTH = {"mass": 2.0}
PUCK = Task(
    Scene(
        time_step=0.2,
        bodies=(
            Body("puck", Shape.circle(0.2), pose=(-0.8, 0.0, 0.0), known={"r": 0.0, "mu_c": 0}),
        ),
        walls=(Wall((0.0, -1.2), (0.0, 1.2)),),
    ),
    Goal.of({"puck": (0.8, 0.0, None)}, tolerance=0.2),
    ActionSet.box("puck", forces=(-4.0, 0.0, 4.0), lateral=(-4.0, 0.0, 4.0), frame="world"),
)


def puck_world(sigma: float = 0.0) -> World:
    """Return the puck's true dynamics."""
    return World(PUCK, PUCK_TRUTH, sigma=sigma)
