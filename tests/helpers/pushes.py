"""A block that a finger pushes, measured only before and after each push."""

import pandas as pd

from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene, Shape

SCENE = Scene(
    time_step=0.1,
    bodies=(
        Body("block", Shape.box(0.2, 0.2)),
        Body("finger", Shape.circle(0.01), kinematic=True),
    ),
)
STATE = ["x", "y", "theta", "vx", "vy", "omega"]
WRENCH = ["force_x", "force_y", "torque"]


def rows(steps=(4, 6)) -> pd.DataFrame:
    """Return a finger with known poses, and a block measured before and after each push."""
    table = []
    for trajectory, count in enumerate(steps):
        for step in range(count):
            common = {"trajectory": trajectory, "step": step, "time": 0.1 * step}
            ends = step in (0, count - 1)
            block = dict.fromkeys(STATE, float(trajectory)) if ends else {}
            push = dict.fromkeys(WRENCH, 0.0) if step < count - 1 else {}
            table.append(common | {"body": "block"} | block | push)
            pose = {"x": -0.3 + 0.01 * step**2, "y": 0.2 * step, "theta": 3.0 + 0.2 * step}
            table.append(common | {"body": "finger"} | pose)
    return pd.DataFrame(table)


def pushed(steps=(4, 6)) -> tuple[Scene, History]:
    return SCENE, History.from_dataframe(rows(steps), SCENE)
