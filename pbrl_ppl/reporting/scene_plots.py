"""Plots of scenes from above: bodies, motions, goals."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon

from pbrl_ppl.planning import Goal
from pbrl_ppl.reporting.style import blank_figure, legend
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

#: Okabe and Ito's colours, one a moving body, in turn; what is static is grey.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
_STATIC = "#777777"


def draw_scene(
    axes: Axes, scene: Scene, states: Floats, *, names: bool = False, faded: bool = False
) -> None:
    """Draw walls, and bodies at one state each.

    Parameters
    ----------
    axes : Axes
        Axes to draw on; their aspect becomes equal.
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
            axes.add_patch(_outline(body, np.array(body.pose))).set(color=_STATIC)
    for i, (body, state) in enumerate(zip(scene.moving, states, strict=True)):
        patch = axes.add_patch(_outline(body, state[:3]))
        patch.set(facecolor=_colour(i), edgecolor="black", linewidth=0.8, zorder=2)
        if faded:
            patch.set(facecolor="none", edgecolor=_colour(i), linestyle="--", zorder=1)
        if names:
            axes.annotate(
                body.name, state[:2], ha="center", va="center", fontsize=8, zorder=4,
                bbox={"boxstyle": "round,pad=0.15", "color": "white", "alpha": 0.8},
            )  # fmt: skip
    axes.set_aspect("equal")
    axes.set(xlabel="x (m)", ylabel="y (m)")


def draw_motion(axes: Axes, scene: Scene, states: Floats) -> None:
    """Draw bodies where they end, dashed where they began, and the tracks of those that moved.

    A track is drawn if it is longer than a tenth of the body's bounding radius.

    Parameters
    ----------
    axes, scene
        As of :func:`draw_scene`.
    states : ndarray
        Shape (time, body, 6), SI units: what a plan predicts, or what happened.
    """
    draw_scene(axes, scene, states[0], faded=True)
    draw_scene(axes, scene, states[-1])
    for i, body in enumerate(scene.moving):
        x, y = states[:, i, :2].T
        if np.hypot(x - x[0], y - y[0]).max() > 0.1 * body.shape.bounding_radius:
            axes.plot(x, y, color=_colour(i), linewidth=1.5, zorder=3)


def plot_recording(scene: Scene, poses: Floats, held_out: Floats | None) -> Figure:
    """Draw a scene from above, with the bodies' recorded paths.

    Parameters
    ----------
    scene : Scene
        Shapes and walls.
    poses : ndarray
        x, y, theta (m, m, rad) of the fitted recording, shape (trajectory, time, body, 3 or more);
        NaN where not measured.
    held_out : ndarray, optional
        The same of the held-out recording.
    """
    figure, (axes,) = blank_figure(5.0)
    for paths, style, alpha in ((poses, "-", 0.8), (held_out, ":", 1.0)):
        for states in () if paths is None else paths:
            for i in range(states.shape[1]):
                axes.plot(*states[:, i, :2].T, style, color=_colour(i), linewidth=1.4, alpha=alpha)
    shown = np.isfinite(poses[..., :3]).all(axis=(2, 3))
    if shown.any():  # the first moment at which all bodies were seen
        trajectory, time = np.argwhere(shown)[0]
        draw_scene(axes, scene, poses[trajectory, time], names=True)
    places = poses[..., :2].reshape(-1, 2)
    margin = 1.5 * max(body.shape.bounding_radius for body in scene.moving)
    low, high = np.nanmin(places, axis=0) - margin, np.nanmax(places, axis=0) + margin
    panel, middle, span = axes.get_window_extent(), (low + high) / 2, high - low
    half = max(span[0] / panel.width, span[1] / panel.height) / 2  # the panel is filled
    (left, bottom), (right, top) = (middle + i * half * np.array(panel.size) for i in (-1, 1))
    axes.set(xlim=(left, right), ylim=(bottom, top))
    handles = [Line2D([], [], color="black", label="fitted")]
    if held_out is not None:
        handles.append(Line2D([], [], color="black", linestyle=":", label="held out"))
    legend(figure, handles)
    return figure


def draw_goal(axes: Axes, scene: Scene, goal: Goal) -> None:
    """Draw a circle of the tolerance where each target with a place is, in its body's colour.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    scene : Scene
        Orders the bodies.
    goal : Goal
        Targets.
    """
    every = zip(goal.places(scene), goal.targets, goal.tolerances(scene), strict=True)
    for place, target, tolerance in every:
        if target.x is None or target.y is None:
            continue
        circle = axes.add_patch(Circle((target.x, target.y), tolerance))
        circle.set(fill=False, color=_colour(place), hatch="////")


def _colour(index: int) -> str:
    return _COLOURS[index % len(_COLOURS)]


def _outline(body: Body, pose: Floats) -> Patch:
    """Return a body's outline at a pose (x, y, theta)."""
    corners = body.shape.outline
    if corners is None:
        return Circle((pose[0], pose[1]), float(body.shape.radius or 0.0))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return Polygon(np.array(corners) @ np.array([[c, s], [-s, c]]) + pose[:2])
