"""Independent parts of a scene, and how near two bodies come in an interval."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from pbrl_ppl.history import History
from pbrl_ppl.physics.solids import to_segment
from pbrl_ppl.scene import WORLD, Scene
from pbrl_ppl.state import Floats

#: Distance that bodies of different parts must keep: a share of their size plus the same share of
#: their relative motion in an interval, since paths are not straight.
SHARE = 0.25

Parts = tuple[tuple[str, ...], ...]


def joined_parts(parts: Parts, together: Collection[str]) -> Parts:
    """Return the parts, with those that contain any of the bodies ``together`` merged.

    Examples
    --------
    >>> joined_parts((("a", "b"), ("c",), ("d",)), ["b", "d"])
    (('a', 'b', 'd'), ('c',))
    """
    joined = tuple(name for part in parts if set(part) & set(together) for name in part)
    if not joined:
        return parts
    first = next(part for part in parts if part[0] == joined[0])
    return tuple(
        joined if part is first else part
        for part in parts
        if part is first or not set(part) & set(together)
    )


def independent_parts(scene: Scene, history: History | None = None) -> Parts:
    """Return the moving bodies in parts that never come near and share no joint or parameters.

    A kinematic body counts as any other: all bodies that it meets are in its part.

    Given the noise, the likelihood factorises over the parts, so that many bodies cost the sum of
    their costs alone. Bodies that were apart in the data may meet in a prediction, for which there
    is :class:`OneWorld`.

    Parameters
    ----------
    scene : Scene
        Shapes, joints and classes. A joint of unknown bodies may join any two.
    history : History, optional
        Measured places, without which bodies come near no others; a body whose place is missing at
        some time may have been anywhere.

    Returns
    -------
    tuple of tuple of str
        Names, in the order of ``scene.moving``.

    Examples
    --------
    >>> import pandas as pd
    >>> from pbrl_ppl.scene import Body, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.1)) for name in "abc")
    >>> scene = Scene(time_step=0.1, bodies=pucks)
    >>> rows = [
    ...     {"trajectory": 0, "time": 0.1 * t, "body": name, "x": x, "vx": 0.0} for t in range(2)
    ...     for name, x in zip("abc", (0.0, 0.21, 3.0))
    ... ]
    >>> rest = dict.fromkeys(["y", "theta", "vy", "omega", "force_x", "force_y", "torque"], 0.0)
    >>> independent_parts(scene, History.from_dataframe(pd.DataFrame(rows).assign(**rest), scene))
    (('a', 'b'), ('c',))
    """
    names = [body.name for body in scene.moving]
    k = len(names)
    together = np.zeros((k, k), dtype=bool)
    for joint in scene.joints:
        if joint.bodies is None:
            return (tuple(names),)
        if all(name in names for name in joint.bodies) and WORLD not in joint.bodies:
            i, j = (names.index(name) for name in joint.bodies)
            together[i, j] = True
    for sharing in scene.owners.values():
        for name in sharing[1:]:
            together[names.index(name), names.index(sharing[0])] = True
    if history is not None:
        place = history.dataset["start"].to_numpy()[..., :2]
        intervals = history.dataset["n_rows"].to_numpy() - 1
        inside = np.arange(place.shape[1] - 1) < intervals[:, None]
        begin, end = place[:, :-1][inside], place[:, 1:][inside]  # (interval, body, 2)
        reach = [body.shape.bounding_radius for body in scene.moving]
        for i in range(k):
            for j in range(i):
                least = (1.0 + SHARE) * (reach[i] + reach[j])
                near = come_near(begin[:, i] - begin[:, j], end[:, i] - end[:, j], least)
                together[i, j] |= near.any()
    count, part = connected_components(together, directed=False)
    kinematic = np.array([body.kinematic for body in scene.moving])
    for label in range(count):  # a kinematic body that meets none joins the first dynamic one
        if kinematic[part == label].all():
            part[part == label] = part[~kinematic][0]
    return tuple(tuple(np.array(names)[part == label].tolist()) for label in np.unique(part))


def come_near(begin: Floats, end: Floats, least: float) -> NDArray[np.bool_]:
    """Return whether two bodies come nearer than ``least`` (m), or may where places are missing.

    Parameters
    ----------
    begin, end : ndarray
        Place of one relative to the other before and after an interval, shape (..., 2), m.
    """
    path = end - begin
    nearest = to_segment(-begin, path)
    return np.asarray(~(nearest >= least + SHARE * np.linalg.norm(path, axis=-1)))
