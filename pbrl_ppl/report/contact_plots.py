"""Picture of sector contact predicates (Fig. 1 of the paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Wedge
from numpy.typing import NDArray

from pbrl_ppl.errors import SceneError
from pbrl_ppl.oomdp import SectorContacts
from pbrl_ppl.report.scene_plots import draw_scene
from pbrl_ppl.report.style import AFTER, BEFORE
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]


def draw_contacts(
    axes: Axes, scene: Scene, states: Array, body: str, contacts: SectorContacts | None = None
) -> None:
    """Draw a body's sectors and rays, and what touches them, as Fig. 1 of the paper does.

    The axes end a little beyond the sectors.

    Parameters
    ----------
    axes : Axes
        Drawn on; its aspect becomes equal.
    scene : Scene
        Shapes, walls and joints.
    states : ndarray
        Shape (body, 6 or 3), moving bodies in the scene's order, SI units.
    body : str
        The moving body whose sectors are drawn.
    contacts : SectorContacts, optional
        Numbers of sectors and rays, and the collision radius; Table 2's by default.

    Raises
    ------
    SceneError
        If no moving body has the name.
    HistoryError
        If the states have another shape, or a pose is not finite.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from pbrl_ppl.scene import Body, Shape, Wall
    >>> wall = Wall((0.6, -2.0), (0.6, 2.0))
    >>> scene = Scene(time_step=0.1, bodies=(Body("cart", Shape.box(1.0, 0.6)),), walls=(wall,))
    >>> axes = Figure().subplots()
    >>> draw_contacts(axes, scene, np.zeros((1, 6)), "cart")
    >>> axes.get_title()
    'cart: world in sector 0'
    """
    contacts = SectorContacts() if contacts is None else contacts
    names = [each.name for each in scene.moving]
    if body not in names:
        raise SceneError(f"no moving body is named {body!r}; there are {', '.join(names)}")
    i = names.index(body)
    states = np.asarray(states, dtype=float)
    contacts = replace(contacts, by_object=True)  # for the title
    objects, flags = contacts.objects(scene), contacts.of(scene, states[None])[0, i]
    met = [(objects[j], int(sector)) for j, sector in np.argwhere(flags)]
    draw_scene(axes, scene, states)
    x, y, turn = states[i, :3]
    reach = scene.moving[i].shape.bounding_radius + contacts.radius
    touched = {sector for _, sector in met}
    width = 360.0 / contacts.sectors
    for sector in range(contacts.sectors):
        middle = np.degrees(turn) + width * sector
        colour = BEFORE if sector in touched else AFTER
        axes.add_patch(
            Wedge(
                (x, y), reach, middle - width / 2, middle + width / 2, facecolor=colour,
                edgecolor=colour, alpha=0.25, zorder=2.5,
            )
        )  # fmt: skip
        at = np.radians(middle)
        axes.annotate(
            f"{sector}", (x + 1.08 * reach * np.cos(at), y + 1.08 * reach * np.sin(at)),
            ha="center", va="center", fontsize=9,
        )  # fmt: skip
    c, s = np.cos(turn), np.sin(turn)
    ends = contacts.directions @ np.array([[c, s], [-s, c]]) * reach
    for dx, dy in ends:
        axes.plot([x, x + dx], [y, y + dy], color="black", linewidth=0.4, alpha=0.6, zorder=2.6)
    axes.set(xlim=(x - 1.5 * reach, x + 1.5 * reach), ylim=(y - 1.5 * reach, y + 1.5 * reach))
    said = ", ".join(f"{name} in sector {sector}" for name, sector in sorted(met))
    axes.set_title(f"{body}: {said or 'nothing in contact'}")
