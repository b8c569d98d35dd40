"""A puck of known mass for planning, without walls and in a room with a wall."""

import numpy as np

from pbrl_ppl.planning import ActionSet, Dynamics, Goal
from pbrl_ppl.scene import Body, Scene, Shape, Wall

MASS, FORCE = 2.0, 4.0
FREE = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2), known={"r": 0.0, "mu_c": 0}),))
ROOM = FREE.replace(
    walls=tuple(
        Wall(a, b)
        for a, b in [
            ((-3.0, -3.0), (3.0, -3.0)), ((3.0, -3.0), (3.0, 3.0)), ((3.0, 3.0), (-3.0, 3.0)),
            ((-3.0, 3.0), (-3.0, -3.0)), ((0.0, -3.0), (0.0, 1.0)),
        ]
    )
)  # fmt: skip
PUSHES = ActionSet.box(
    "puck", forces=(-FORCE, 0.0, FORCE), lateral=(-FORCE, 0.0, FORCE), frame="world",
    durations=(0.1, 0.3),
)  # fmt: skip
ACROSS = {"puck": (-1.5, -1.0, 0.0)}, Goal.of({"puck": (1.5, -1.0, None)}, tolerance=0.1)


def known(scene: Scene = FREE, *masses: float) -> Dynamics:
    """Return the posterior of a puck with one mass, or one per draw."""
    return Dynamics(scene, np.array(masses or (MASS,))[:, None])
