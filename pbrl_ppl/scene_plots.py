"""Pictures of scenes from above: where bodies are, how they moved, where they should be."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Patch, Polygon
from numpy.typing import NDArray

from pbrl_ppl.planning.goals import Goal
from pbrl_ppl.scene import Body, Scene

Array = NDArray[np.float64]

#: Okabe and Ito's colours, one a moving body, in turn; what is static is grey.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
_STATIC = "#777777"
#: A body that moved less than this (m) has no track.
_STILL = 0.05


def draw_scene(
    axes: Axes, scene: Scene, states: Array, *, names: bool = False, faded: bool = False
) -> None:
    """Draw walls, and bodies at one state each.

    Parameters
    ----------
    axes : Axes
        Drawn on; its aspect becomes equal.
    scene : Scene
        Shapes and walls.
    states : ndarray
        Shape (body, 6), moving bodies in the scene's order, SI units.
    names : bool
        Whether each moving body's name is written on it.
    faded : bool
        Whether the moving bodies are drawn as outlines: where they were.
    """
    for wall in scene.walls:
        axes.plot(*zip(wall.start, wall.end, strict=True), color="black", linewidth=2.0, zorder=3)
    for body in scene.bodies:
        if body.static and body.pose is not None:
            axes.add_patch(_outline(body, np.array(body.pose), color=_STATIC))
    for i, (body, state) in enumerate(zip(scene.dynamic, states, strict=True)):
        how: dict[str, Any] = {
            "facecolor": _colour(i),
            "edgecolor": "black",
            "linewidth": 0.8,
            "zorder": 2,
        }
        if faded:
            how |= {"facecolor": "none", "edgecolor": _colour(i), "linestyle": "--", "zorder": 1}
        axes.add_patch(_outline(body, state[:3], **how))
        if names:
            axes.annotate(
                body.name, state[:2], ha="center", va="center", fontsize=8, zorder=4,
                bbox={"boxstyle": "round,pad=0.15", "color": "white", "alpha": 0.8},
            )  # fmt: skip
    axes.set_aspect("equal")
    axes.set(xlabel="x (m)", ylabel="y (m)")


def draw_motion(axes: Axes, scene: Scene, states: Array) -> None:
    """Draw bodies where they end, dashed where they began, and the tracks of those that moved.

    Parameters
    ----------
    axes, scene
        As of :func:`draw_scene`.
    states : ndarray
        Shape (time, body, 6), SI units: what a plan predicts, or what happened.
    """
    draw_scene(axes, scene, states[0], faded=True)
    draw_scene(axes, scene, states[-1])
    for i in range(states.shape[1]):
        x, y = states[:, i, :2].T
        if np.hypot(x - x[0], y - y[0]).max() > _STILL:
            axes.plot(x, y, color=_colour(i), linewidth=1.5, zorder=3)


def draw_goal(axes: Axes, scene: Scene, goal: Goal) -> None:
    """Draw a circle of the tolerance where each target with a place is, in its body's colour.

    Parameters
    ----------
    axes : Axes
        Drawn on.
    scene : Scene
        Orders the bodies.
    goal : Goal
        Targets.
    """
    moving = [body.name for body in scene.dynamic]
    for target in goal.targets:
        if target.x is None or target.y is None:
            continue
        colour = _colour(moving.index(target.body))
        circle = Circle(
            (target.x, target.y), target.tolerance, fill=False, color=colour, hatch="////"
        )
        axes.add_patch(circle)


def _colour(index: int) -> str:
    return _COLOURS[index % len(_COLOURS)]


def _outline(body: Body, pose: Array, **how: Any) -> Patch:
    """A body's outline at a pose (x, y, theta)."""
    corners = body.shape.outline
    if corners is None:
        return Circle((pose[0], pose[1]), float(body.shape.radius or 0.0), **how)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return Polygon(np.array(corners) @ np.array([[c, s], [-s, c]]) + pose[:2], **how)
