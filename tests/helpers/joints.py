"""Four boxes with known parameters, and joints between them."""

from dataclasses import replace

import numpy as np

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.sampling.methods import METHODS, SamplerRun
from pbrl_ppl.scene import Joint, Scene, Shape, Wall
from pbrl_ppl.system.threads import silent
from tests.helpers.worlds import G, body

POSES = ((0.0, 0.0, 0.0), (1.2, 0.1, 0.4), (2.5, -0.2, -0.3), (0.3, 2.0, 0.0))
#: Boxes a and b overlap, as hinged bodies do, and the hinge lies in both.
HINGED = (POSES[0], (0.75, 0.05, 0.4), *POSES[2:])
PIN = (0.35, 0.05)
NAMES = ("a", "b", "c", "d")


def scene(*joints: Joint, walls: bool = False, poses=POSES) -> Scene:
    """Return four wheeled boxes with known parameters, and joints."""
    wheel = {"mu_x": 0.02, "mu_y": 0.2, "w_x": 0.1}
    shape = Shape.box(0.8, 0.5)
    bodies = (
        body(name, shape, wheel=True, mass=mass, **wheel)
        for name, mass in zip(NAMES, (1.0, 2.0, 1.5, 3.0), strict=True)
    )
    placed = tuple(replace(each, pose=pose) for each, pose in zip(bodies, poses, strict=True))
    edge = (Wall((-9.0, -9.0), (9.0, -9.0)),) if walls else ()
    return Scene(
        time_step=0.1, normal_gravity=G, bodies=placed, joints=joints, walls=edge, substeps=10
    )


def reference_anchors(first: int, second: int, point=PIN, poses=HINGED) -> list[float]:
    """Return the world point in both bodies' frames, in their reference poses."""
    anchors = []
    for i in (first, second):
        x, y, theta = poses[i]
        c, s = np.cos(theta), np.sin(theta)
        dx, dy = point[0] - x, point[1] - y
        anchors += [c * dx + s * dy, -s * dx + c * dy]
    return anchors


def run_of(problem: Problem, draws: int, seed: int = 1) -> SamplerRun:
    """Return a sampler's run of two chains on a problem."""
    method = replace(METHODS["laplace"], draws=draws, chains=2)
    return SamplerRun(problem, method, None, None, seed, 1, silent)
