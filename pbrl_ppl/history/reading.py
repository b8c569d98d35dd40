"""Recordings as commands read them: with warnings, and with options in place of the scene's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Unpack

from pbrl_ppl.errors import warn
from pbrl_ppl.history.conventions import angle_warnings
from pbrl_ppl.history.conversion import Reading
from pbrl_ppl.history.ends import trimmed, unmodelled_ends
from pbrl_ppl.history.history import History
from pbrl_ppl.history.units import unit_mismatches
from pbrl_ppl.scene import Scene


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
    path: Path,
    scene: Scene,
    *,
    trim: bool = False,
    estimate_velocities: bool = False,
    most_ends: int = 4,
    **reading: Unpack[Reading],
) -> History:
    """Return the history of a file as `History.load` does, and warn of what looks wrong.

    Warns where velocities and changes of positions differ by the factor of a unit, and of rows at
    trajectory ends that belong to no model. With ``trim``, here or in the scene's ``[recording]``,
    these are left out. A warning names ``most_ends`` of them.
    """
    history = History.load(path, scene, estimate_velocities=estimate_velocities, **reading)
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
