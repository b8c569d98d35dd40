"""Recordings as commands read them: with warnings, and with options in place of the scene's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Unpack

import numpy as np

from pbrl_ppl.errors import warn
from pbrl_ppl.history.bad_frames import trimmed, unmodelled_ends
from pbrl_ppl.history.conversion import Reading
from pbrl_ppl.history.falls import wrong_clock
from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import hung_bodies
from pbrl_ppl.history.logs import Paths, in_words
from pbrl_ppl.history.measures import unit_size, zero_angle
from pbrl_ppl.history.units import rate_factor, unit_mismatch, unit_mismatches
from pbrl_ppl.history.velocities import unused_velocities
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import THETA, VELOCITY, Floats, wrapped

#: Whole numbers that range over more are no angles in rad or degrees, but counts.
_COUNTS = 1440.0


def read_scene(
    path: Path,
    *,
    noise: Mapping[str, float] | None = None,
    substeps: int | None = None,
    time_step: float | None = None,
) -> Scene:
    """Return the scene of a file, with other settings where they are given."""
    scene = Scene.load(path)
    return scene.replace(
        noise=dict(scene.noise) | dict(noise or {}),
        substeps=scene.substeps if substeps is None else substeps,
        time_step=scene.time_step if time_step is None else time_step,
    )


def read_recording(
    path: Paths,
    scene: Scene,
    *,
    trim: bool = False,
    estimate_velocities: bool = False,
    most_ends: int = 4,
    **reading: Unpack[Reading],
) -> History:
    """Return the history of files as `History.load` does, and warn of what looks wrong.

    Warns where velocities and changes of positions differ by the factor of a unit, and of rows at
    trajectory ends that belong to no model. With ``trim``, here or in the scene's ``[recording]``,
    these are left out. A warning names ``most_ends`` of them.
    """
    history = History.load(path, scene, estimate_velocities=estimate_velocities, **reading)
    path = in_words(path)
    for sentence in (*unit_mismatches(history), *angle_warnings(history, scene)):
        warn(f"history {path}: {sentence}", UserWarning)
    ends = unmodelled_ends(history, scene)
    if not ends:
        return history
    trim = trim or (scene.recording is not None and scene.recording.trim)
    named = "; ".join(map(str, ends[:most_ends]))
    more = f"; and {len(ends) - most_ends} more" if len(ends) > most_ends else ""
    cure = "left out" if trim else "no command or contact explains it: --trim leaves the rows out"
    warn(f"history {path}: {named}{more}: {cure}", UserWarning)
    return trimmed(history, ends) if trim else history


def layout_cures(
    history: History, scene: Scene, present: Mapping[str, str]
) -> tuple[list[str], dict[str, str], bool]:
    """Return what is wrong with a recording's units and velocities, and the entries that cure it.

    Parameters
    ----------
    history, scene : History, Scene
        What was measured; the scene's gravity and free bodies tell a wrong clock.
    present : mapping of str to str
        Units in which columns were read, if not SI units.

    Returns
    -------
    said : list of str
        A sentence on each finding.
    units : dict of str to str
        Those that cure it.
    computed : bool
        Whether velocities are best left out.
    """
    said, units, computed = angle_warnings(history, scene), dict[str, str](), False
    if clock := wrong_clock(history, scene):
        return [clock.sentence(scene)], {"time": clock.unit(present.get("time", "s"))}, False
    alone = len(history.bodies) == 1
    for i, body in enumerate(history.bodies):
        for d in range(VELOCITY):
            sentence, cures = unit_mismatch(history, i, d)
            keys = {column: column if alone else f"{body}.{column}" for column in cures}
            if sentence:
                said.append(sentence)
                units |= {keys[name]: cures[name] for name in cures if keys[name] not in present}
    unused = unused_velocities(history)
    rates = history.dataset["observed"].isel(state=slice(VELOCITY, None))
    measured = int(rates.notnull().any(("trajectory", "time")).sum())
    for velocity in unused:
        said.append(velocity.sentence)
        if velocity.fault and velocity.fault.factor:
            key = velocity.state if alone else f"{velocity.body}.{velocity.state}"
            size = unit_size(velocity.state, present[key]) if key in present else 1.0
            units[key] = velocity.unit(size or 1.0)
        else:  # of computed and late ones others may be good
            computed |= velocity.fault is not None or len(unused) == measured
    return said, units, computed


def angle_warnings(history: History, scene: Scene) -> list[str]:
    """Return a sentence on each body whose angle looks like one of another convention.

    Parameters
    ----------
    history : History
        What was measured.
    scene : Scene
        Has gravity and the hinges.

    Examples
    --------
    ::

        angle_warnings(history, scene)
        ["theta of arm swings to both sides by 23 rad: looks like deg: units = { theta = "deg" }"]
    """
    sentences = []
    hung = hung_bodies(scene)
    for i, body in enumerate(scene.moving):
        states = history.dataset["observed"].to_numpy()[:, :, i]
        action = np.nan_to_num(history.dataset["action"].to_numpy()[:, :, i])
        angles = [run[np.isfinite(run)] for run in states[..., THETA]]
        angles = [run for run in angles if len(run) > 8]
        if not angles:
            continue
        if sentence := _degrees(angles, hinged=body.name in hung and bool(any(scene.gravity))):
            sentences.append(f"theta of {body.name} {sentence}")
        elif (rate_factor(states, THETA, scene.time_step) or 0.0) < 0:
            sentences.append(
                f"theta of {body.name} falls where omega is positive, and rises where it is"
                ' negative: one of them is clockwise: theta = "-COLUMN" in columns'
            )
        elif body.name in hung[:1] and any(scene.gravity) and not action.any():
            rest = _rest(angles)
            off = float(wrapped(np.asarray(rest - zero_angle(scene, body.name, "hanging"))))
            if abs(off) > 0.5:
                sentences.append(
                    f"{body.name} comes to rest {np.degrees(off):.0f} degrees from hanging: say"
                    " what the angle's zero is: theta = { column = ..., zero = ... } in columns,"
                    ' "hanging", "horizontal", "upright" or the number of the column at theta 0'
                )
    return sentences


def _degrees(angles: list[Floats], *, hinged: bool) -> str:
    """Return why angles in rad look like degrees or counts; empty if they do not."""
    steps = np.concatenate([np.abs(np.diff(run)) for run in angles])
    every = np.concatenate(angles)
    if (every == np.round(every)).all() and np.ptp(every) > _COUNTS:
        return (
            f"goes from {every.min():.6g} to {every.max():.6g} rad in whole numbers: looks like"
            ' counts: say how many there are to a turn: units = { theta = "8192/turn" }'
        )
    wraps = (steps > 340.0) & (steps < 360.5)
    if wraps.any() and np.median(steps) < 36.0:
        return 'jumps by 360 between rows: looks like deg: units = { theta = "deg" }'
    middle = float(np.median(every))
    size = float(np.quantile(np.abs(every - middle), 0.9))
    turned = np.ptp(every) > 2.0 * np.pi  # not an angle in rad that wraps at 0 or half a turn
    crossings = sum(int((np.diff(np.sign(run - middle)) != 0).sum()) for run in angles)
    if hinged and turned and np.pi < size <= 180.0 and crossings >= 4 and _hangs(angles):
        return (
            f'swings to both sides by {size:.2g} rad: looks like deg: units = {{ theta = "deg" }}'
        )
    return ""


def _hangs(angles: list[Floats], better: float = 2.0) -> bool:
    """Return whether angles accelerate as a pendulum's do in degrees, not as in radians.

    Differences are over as many rows as either explains best: of few they are noise.

    ``better``: by this factor of the squared residual.
    """
    left = [(np.inf, np.inf)]
    for lag in (1, 2, 4, 8, 16):
        long = [run for run in angles if len(run) > 2 * lag + 4]
        parts = [(run[: -2 * lag], run[lag:-lag], run[2 * lag :]) for run in long]
        if not parts:
            break
        before, place, after = (np.concatenate(part) for part in zip(*parts, strict=True))
        y, ahead = before - 2.0 * place + after, after - before
        rest = []
        for turn in (place, np.radians(place)):
            design = np.column_stack([np.sin(turn), np.cos(turn), ahead, np.ones(len(y))])
            off = y - design @ np.linalg.lstsq(design, y, rcond=1e-9)[0]
            rest.append(float(off @ off) / max(float(y @ y), 1e-300))
        left.append((rest[0], rest[1]))
    radians, degrees = min(left, key=min)
    return radians > better * degrees


def _rest(angles: list[Floats], steady: float = 0.05) -> float:
    """Return the angle that trajectories end at, at rest; NaN where they do not."""
    ends = [run[-max(len(run) // 10, 4) :] for run in angles]
    both = zip(angles, ends, strict=True)
    places = [float(np.median(end)) for run, end in both if np.ptp(end) < steady * np.ptp(run)]
    return float(np.median(places)) if places and np.ptp(places) < 0.3 else float("nan")
