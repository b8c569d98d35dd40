"""Held-out motions, measured and predicted, for a report's animation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.criticism import ComparedModel, HeldOut, Loop, diverged_after
from pbrl_ppl.reporting.words import number
from pbrl_ppl.scene import Scene, Shape
from pbrl_ppl.state import Bools, Floats, wrapped
from pbrl_ppl.system.files import json_values


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of all moving bodies in one held-out trajectory.

    Parameters
    ----------
    name : str
        Which trajectory.
    time : ndarray
        Seconds since the first pose, shape (time,).
    measured, before, after : ndarray
        x, y, theta (m, m, rad), shape (time, body, 3); NaN where not measured, or from where a
        prediction diverges. Predictions begin at the first state, which is as measured, or fitted
        to the first rows where velocities were not measured.
    unmeasured : ndarray of bool
        Coordinates that were not measured and follow from none that was, shape (body, 3).
    """

    name: str
    time: Floats
    measured: Floats
    before: Floats
    after: Floats
    unmeasured: Bools


def held_out_motions(loop: Loop, most: int = 6, most_rows: int = 3000) -> list[Motion]:
    """Return predictions of held-out trajectories, those worst predicted by the old model first.

    Those of which the new model's prediction diverges come before them. At most ``most``
    trajectories, with at most ``most_rows`` rows together.

    Each model predicts with the parameters of its mode.
    """
    history = loop.held_out
    if history is None:
        return []

    def poses(model: ComparedModel) -> dict[int, Floats]:
        whole = HeldOut.of(model.innovations, history).rollouts()
        return {trajectory: states[..., :3] for trajectory, states in whole.items()}

    before = poses(loop.declared)
    after = before if loop.revised is loop.declared else poses(loop.revised)
    dataset = history.dataset
    known = dataset["start"].to_numpy()[..., :3]
    unmeasured = dataset["assumed"].to_numpy()[:, :3]
    paths = [states for predicted in (before, after) for states in predicted.values()]
    moves = np.nanmax([np.ptp(states, axis=0) for states in paths], axis=0)[:, :2]
    if (moves[unmeasured[:, :2]] > 1e-6).any():
        return []  # a place that moves, and that nobody measured
    labels = dataset["trajectory"].to_numpy().astype(str)
    motions = []
    for i, first in before.items():
        time = np.arange(len(first), dtype=float) * loop.scene.time_step
        seen = known[i, : len(first)]
        motions.append(Motion(str(labels[i]), time, seen, first, after[i], unmeasured))

    def worst(motion: Motion) -> tuple[bool, float]:
        first, last = (distance(loop.scene, motion, p) for p in (motion.before, motion.after))
        return not np.isposinf(last), -float(np.nan_to_num(first))

    motions = sorted(motions, key=worst)[:most]
    rows = np.cumsum([len(motion.time) for motion in motions])
    return motions[: max(1, int((rows <= most_rows).sum()))]


def distance(scene: Scene, motion: Motion, predicted: Floats) -> float:
    """Return the root mean square distance (m) of outlines from the measured ones.

    Infinite if the prediction diverges, NaN if nothing was measured.
    """
    if diverged_after(motion.time, predicted) is not None:
        return float("inf")
    reach = np.array([body.shape.bounding_radius for body in scene.moving])
    off = np.where(motion.unmeasured, 0.0, predicted - motion.measured)
    square = off[..., 0] ** 2 + off[..., 1] ** 2 + (reach * wrapped(off[..., 2])) ** 2
    return float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else float("nan")


def divergence_in_words(motions: Sequence[Motion]) -> str:
    """Return which model's predictions of how many motions diverge, and after how long."""
    parts = []
    for which, name in (("before", "declared"), ("after", "revised")):
        ends = [diverged_after(motion.time, getattr(motion, which)) for motion in motions]
        seconds = [end for end in ends if end is not None]
        if seconds:
            first = "" if len(seconds) == 1 else "at the earliest "
            parts.append(
                f"the {name} model's prediction of {len(seconds)} of the {len(motions)} held-out"
                f" recordings below diverges, {first}after {number(min(seconds))} s"
            )
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def animation(loop: Loop, motions: Sequence[Motion]) -> dict[str, object] | None:
    """Return what the page's script draws, as JSON values; None where there is no motion.

    Lengths are in m, to 1e-5 of the view at least, and angles in rad.
    """
    if not motions:
        return None
    scene = loop.scene
    reach = max(body.shape.bounding_radius for body in scene.moving)
    static = (body for body in scene.bodies if body.static and body.pose is not None)
    drawn: dict[str, object] = json_values({
        "models": ["before", "after"] if loop.added else ["before"],
        "bodies": [{"name": body.name} | _outline(body.shape) for body in scene.moving],
        "static": [{"pose": body.pose} | _outline(body.shape) for body in static],
        "walls": [(wall.start, wall.end) for wall in scene.walls],
        "motions": [_drawn(scene, motion, 1.2 * reach) for motion in motions],
    })  # fmt: skip
    return drawn


def _outline(shape: Shape) -> dict[str, object]:
    return {"outline": shape.outline, "radius": shape.radius}


def _drawn(scene: Scene, motion: Motion, margin: float) -> dict[str, object]:
    """Return a motion, and the corners of its view."""
    box = _box(motion, margin)
    size = float((box[1] - box[0]).max())
    places = max(5, 5 - int(np.floor(np.log10(size))))
    both = (motion.before, motion.after)
    return {
        "name": motion.name,
        "box": box.round(places),
        "time": motion.time.round(9),
        "measured": motion.measured.round(places),
        "before": motion.before.round(places),
        "after": motion.after.round(places),
        "distance": [distance(scene, motion, predicted) for predicted in both],
        "diverged": [diverged_after(motion.time, predicted) for predicted in both],
    }


def _box(motion: Motion, margin: float) -> Floats:
    """Return the corners of the view, (2, 2): measured positions, and a margin for predictions."""
    measured = motion.measured[..., :2].reshape(-1, 2)
    low, high = np.nanmin(measured, axis=0), np.nanmax(measured, axis=0)
    spare = 0.7 * float((high - low).max()) + margin
    predicted = np.concatenate([motion.before, motion.after])[..., :2].reshape(-1, 2)
    seen = np.concatenate([measured, np.clip(predicted, low - spare, high + spare)])
    return np.array([np.nanmin(seen, axis=0) - margin, np.nanmax(seen, axis=0) + margin])
