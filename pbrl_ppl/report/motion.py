"""Held-out motions, measured and predicted, for a report's animation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbrl_ppl.criticism import Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.posterior import best_draw, parameter_draws, problem_of
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats, wrapped

#: Motions in one page, and their rows in all, at most; the declared model's worst come first.
MOST, _MOST_ROWS = 6, 3000


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
        x, y, theta (m, m, rad), shape (time, body, 3); NaN where not measured. Predictions begin at
        the first measured state and see none after it.
    """

    name: str
    time: Floats
    measured: Floats
    before: Floats
    after: Floats


def best_vectors(problem: Problem, posterior: Any) -> tuple[Floats, Floats]:
    """Return the draw of highest likelihood: phi, shape (p,), and the noise parameters."""
    best = best_draw(posterior)
    phi, sigma = parameter_draws(problem, posterior)
    return phi[best], sigma[best]


def held_out_motions(loop: Loop) -> list[Motion]:
    """Return predictions of held-out trajectories, those worst predicted by the old model first.

    Each posterior predicts with its draw of highest likelihood.
    """
    if loop.held_out is None:
        return []
    before = after = _predicted(loop.posterior_before, loop.held_out, loop.catalogue)
    if loop.posterior_after is not loop.posterior_before:
        after = _predicted(loop.posterior_after, loop.held_out, loop.catalogue)
    dataset = loop.held_out.dataset
    known, rows = dataset["start"].to_numpy()[..., :3], dataset["n_rows"].to_numpy()
    labels = [str(label) for label in dataset["trajectory"].to_numpy()]
    motions = []
    for (trajectory, step), first in before.items():
        end = int(min(rows[trajectory], step + len(first)))
        length = end - step
        motions.append(
            Motion(
                labels[trajectory],
                np.arange(length, dtype=float) * loop.scene.time_step,
                known[trajectory, step:end],
                first[:length],
                after[trajectory, step][:length],
            )
        )
    shown: list[Motion] = []
    for motion in sorted(motions, key=lambda each: -distance(loop.scene, each, each.before)):
        if shown and sum(len(each.time) for each in [*shown, motion]) > _MOST_ROWS:
            break
        shown.append(motion)
    return shown[:MOST]


def distance(scene: Scene, motion: Motion, predicted: Floats) -> float:
    """Return the root mean square distance (m) of outlines from the measured ones."""
    reach = np.array([body.shape.bounding_radius for body in scene.moving])
    off = predicted - motion.measured
    square = off[..., 0] ** 2 + off[..., 1] ** 2 + (reach * wrapped(off[..., 2])) ** 2
    return float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else 0.0


def _predicted(
    posterior: Any, history: History, effects: Sequence[Effect]
) -> dict[tuple[int, int], Floats]:
    """Return the poses that a posterior predicts, by trajectory and starting step."""
    problem = problem_of(posterior, effects)
    phi, _ = best_vectors(problem, posterior)
    longest = int(history.dataset["n_rows"].max()) - 1
    problem = problem.with_data(history=history, states=None, horizon=longest)
    segments = problem.segments
    states = problem.predict(phi, problem.one_world)[..., :3]
    states = np.concatenate([segments.start[:, None, :, :3], states], axis=1)
    keys = zip(segments.trajectory.tolist(), segments.step.tolist(), strict=True)
    return dict(zip(keys, states, strict=True))


def animation(loop: Loop, motions: Sequence[Motion]) -> dict[str, Any] | None:
    """Return what the page's script draws, as JSON values; None where there is no motion.

    Lengths are in m, to 1e-5 of the view, and angles in rad, to five decimals.
    """
    if not motions:
        return None
    scene = loop.scene
    reach = max(body.shape.bounding_radius for body in scene.moving)
    return {
        "models": ["before", "after"] if loop.added else ["before"],
        "bodies": [
            {"name": body.name, "outline": _outline(body.shape), "radius": body.shape.radius}
            for body in scene.moving
        ],
        "static": [
            {"outline": _outline(body.shape), "radius": body.shape.radius, "pose": list(body.pose)}
            for body in scene.bodies
            if body.static and body.pose is not None
        ],
        "walls": [[list(wall.start), list(wall.end)] for wall in scene.walls],
        "motions": [_drawn(scene, motion, 1.2 * reach) for motion in motions],
    }


def _drawn(scene: Scene, motion: Motion, margin: float) -> dict[str, Any]:
    """Return a motion, and the corners of its view, as JSON values."""
    box = _box(motion, margin)
    places = _decimals(1e-5 * float((box[1] - box[0]).max()))

    def poses(given: Floats) -> Any:
        return _listed(np.concatenate([given[..., :2].round(places), given[..., 2:].round(5)], -1))

    return {
        "name": motion.name,
        "box": box.round(places).tolist(),
        "time": _listed(motion.time.round(_decimals(1e-4 * scene.time_step))),
        "measured": poses(motion.measured),
        "before": poses(motion.before),
        "after": poses(motion.after),
        "distance": [
            round(distance(scene, motion, predicted), places)
            for predicted in (motion.before, motion.after)
        ],
    }


def _box(motion: Motion, margin: float) -> Floats:
    """Return the corners of the view, (2, 2): measured positions, and a margin for predictions."""
    places = motion.measured[..., :2].reshape(-1, 2)
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    spare = 0.7 * float((high - low).max()) + margin
    every = np.concatenate([motion.before, motion.after])[..., :2].reshape(-1, 2)
    every = np.clip(every, low - spare, high + spare)
    low = np.minimum(low, np.nanmin(every, axis=0)) - margin
    high = np.maximum(high, np.nanmax(every, axis=0)) + margin
    return np.array([low, high])


def _outline(shape: Any) -> list[list[float]] | None:
    return None if shape.outline is None else [list(map(float, point)) for point in shape.outline]


def _decimals(size: float) -> int:
    """Return the decimals that show a size."""
    return int(np.ceil(-np.log10(size)))


def _listed(values: Floats) -> Any:
    """Return nested lists, with None for NaN."""
    return np.where(np.isfinite(values), values.astype(object), np.array(None)).tolist()
