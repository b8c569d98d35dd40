"""Zeros of the angles of bodies on hinges."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.kinematics import joint_order
from pbrl_ppl.scene import Recording, Scene, nearest
from pbrl_ppl.state import wrapped

#: Where an arm points when its angle is 0, from the direction of gravity (rad).
ZEROS = {"hanging": 0.0, "horizontal": np.pi / 2, "upright": np.pi}


def zero_angle(scene: Scene, body: str, zero: str) -> float:
    """Return the angle theta (rad) of a hinged body whose arm points this way.

    Parameters
    ----------
    scene : Scene
        Has the hinge, and gravity; without gravity, down is -y.
    body : str
        Its arm leads from the hinge to its centre.
    zero : str
        ``"hanging"``, ``"horizontal"`` (a quarter turn counter-clockwise from it) or ``"upright"``.

    Raises
    ------
    HistoryError
        If the word is another, or the body hangs on no hinge.
    """
    if zero not in ZEROS:
        raise HistoryError(
            f"[recording]: zero of {body}'s theta is {zero!r}, expected a number or one of"
            f" {', '.join(ZEROS)}{nearest(zero, ZEROS)}"
        )
    held = (edge for edge in joint_order(scene) if edge[1] == body)
    anchor = next((edge[3] for edge in held if edge[4].traits.pins_anchors), (0.0, 0.0))
    if not np.any(anchor):
        raise HistoryError(
            f'[recording]: zero of {body}\'s theta is "{zero}", and {body} hangs on no hinge beside'
            " its centre: declare it as [[joint]], or give the number of the column at theta 0"
        )
    down = np.arctan2(scene.gravity[1], scene.gravity[0]) if any(scene.gravity) else -np.pi / 2
    arm = np.arctan2(-anchor[1], -anchor[0])
    return float(wrapped(np.asarray(down + ZEROS[zero] - arm)))


def with_zeros(frame: pd.DataFrame, scene: Scene, layout: Recording, source: str) -> pd.DataFrame:
    """Return a table whose angles are a body's theta, where a word says what their zero is."""
    for key, column in layout.columns:
        zero = dict(column).get("zero") if isinstance(column, tuple) else None
        if not isinstance(zero, str):
            continue
        name, _, coordinate = key.rpartition(".")
        if coordinate != "theta" or "body" not in frame:
            raise HistoryError(f"{source}: {key} has a zero, which angles of bodies have alone")
        bodies = [name] if name else list(frame["body"].dropna().unique())
        offset = frame["body"].map({body: zero_angle(scene, body, zero) for body in bodies})
        angle = pd.to_numeric(frame["theta"], errors="coerce")
        frame = frame.assign(theta=angle + offset.fillna(0.0))
    return frame
