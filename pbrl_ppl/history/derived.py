"""Columns that follow from others of a table: stamps of two parts, and yaw from quaternions."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pandas as pd

from pbrl_ppl.state import Floats

#: Names of the parts of a stamp (seconds, nanoseconds), in lower case.
_STAMPS = (("secs", "nsecs"), ("sec", "nanosec"), ("sec", "nsec"))
#: Names of a quaternion's parts, in the order x, y, z, w.
_QUATERNIONS = ("x y z w", "qx qy qz qw", "q_x q_y q_z q_w", "q1 q2 q3 q0")


def with_derived(frame: pd.DataFrame, say: Callable[[str], None]) -> pd.DataFrame:
    """Return a table with ``stamp`` of a message's header and ``yaw`` of each quaternion.

    Stamps of two columns, such as ``header.stamp.secs`` and ``header.stamp.nsecs``, become
    ``header.stamp`` (s); the columns of a quaternion, such as ``pose.orientation.x`` to ``w``,
    become ``yaw`` (rad, unwrapped; NaN where the quaternion is not of length 1); of further ones
    ``<their prefix>.yaw``.

    Parameters
    ----------
    frame : pandas.DataFrame
        Any columns.
    say : callable
        Takes a sentence where a quaternion's order is not that of its names.
    """
    added = {}
    for name, parts in derived_columns(frame).items():
        numbers = _numbers(frame, parts)
        if len(parts) == 2:
            added[name] = numbers @ [1.0, 1e-9]
            continue
        yaw, order = planar_yaw(numbers)
        if order:
            say(f"{', '.join(parts)} are not x, y, z, w: yaw is of their order {order}")
        if np.isfinite(yaw).any():
            added[name] = yaw
    return frame.assign(**added) if added else frame


def derived_columns(frame: pd.DataFrame) -> dict[str, list[str]]:
    """Return the columns that each stamp and yaw follows from; names of the table are left out."""
    found = {
        prefix.rstrip("._ ") or "stamp": parts
        for names in _STAMPS
        for prefix, parts in _groups(frame, names)
    }
    for names in map(str.split, _QUATERNIONS):
        for prefix, parts in _groups(frame, names):
            found["yaw" if "yaw" not in found else f"{prefix}yaw"] = parts
    return {name: parts for name, parts in found.items() if name not in frame}


def _groups(frame: pd.DataFrame, names: tuple[str, ...] | list[str]) -> list[tuple[str, list[str]]]:
    """Return the prefixes that all these names follow, with the columns, in the table's order."""
    lower = {str(column).strip().lower(): str(column) for column in frame.columns}
    ends = re.escape(names[-1])
    found = (re.fullmatch(rf"(.*?[._ /]|){ends}", column) for column in lower)
    prefixes = [match[1] for match in found if match]
    groups = [(prefix, [lower.get(prefix + name, "") for name in names]) for prefix in prefixes]
    return [(prefix, parts) for prefix, parts in groups if all(parts)]


def _numbers(frame: pd.DataFrame, columns: list[str]) -> Floats:
    return np.asarray(frame[columns].apply(pd.to_numeric, errors="coerce"), dtype=float)


def planar_yaw(quaternions: Floats, flat: float = 0.2) -> tuple[Floats, str]:
    """Return the yaw of quaternions, and the order of their columns where it is not x, y, z, w.

    A body in a plane turns about one axis: the parts along the other two are small. The named order
    and the axis z are kept unless these parts are more than ``flat`` (root mean square) and
    another order or axis has them at a third.

    Parameters
    ----------
    quaternions : ndarray
        Shape (n, 4); NaN or zeros where missing.

    Returns
    -------
    yaw : ndarray
        Unwrapped, NaN where the quaternion is not of length 1, shape (n,), rad.
    order : str
        Such as ``"w x y z"``, with the axis where it is not z; empty for x, y, z, w about z.

    Examples
    --------
    >>> half = 0.5 * np.array([0.1, 0.2, 0.3])
    >>> w_first = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    >>> planar_yaw(w_first)
    (array([0.1, 0.2, 0.3]), 'w x y z')
    """
    whole = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < 0.05
    yaw = np.full(len(quaternions), np.nan)
    if not whole.any():
        return yaw, ""
    seen = quaternions[whole]
    orders = {"x y z w": (0, 1, 2, 3), "w x y z": (1, 2, 3, 0)}
    # a turn about x reads as one about z with w first: w begins near 1
    axes = [("x y z w", 2), ("w x y z", 2), ("x y z w", 0), ("x y z w", 1)]
    axes = axes if abs(seen[0, 0]) > abs(seen[0, 3]) else [axes[i] for i in (0, 2, 3, 1)]
    off = {
        (order, axis): float(
            np.sqrt((np.delete(seen[:, orders[order][:3]], axis, axis=1) ** 2).mean())
        )
        for order, axis in axes
    }
    least = min(off.values())
    order, axis = axes[0]
    if off[axes[0]] > flat and least < off[axes[0]] / 3:
        order, axis = next(one for one in axes if off[one] < least + 0.02)
    columns = orders[order]
    yaw[whole] = np.unwrap(2.0 * np.arctan2(seen[:, columns[axis]], seen[:, columns[3]]))
    about = "" if axis == 2 else f", about {'xyz'[axis]}"
    return yaw, "" if (order, axis) == axes[0] else order + about
