"""Drawn contact predicates: sectors turn with the body, those that something touches stand out."""

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Wedge

from pbrl_ppl.errors import SceneError
from pbrl_ppl.oomdp import SectorContacts
from pbrl_ppl.report import draw_contacts
from pbrl_ppl.report.style import AFTER, BEFORE
from pbrl_ppl.scene import Body, Scene, Shape, Wall

ROOM = Scene(
    time_step=0.1,
    bodies=(Body("cart", Shape.box(0.9, 0.5)), Body("can", Shape.circle(0.1))),
    walls=(Wall((0.6, -3.0), (0.6, 3.0)),),
)


def drawn(heading: float, **options) -> tuple[list[Wedge], str]:
    axes = Figure().subplots()
    states = np.array([[0.0, 0.0, heading, 0, 0, 0], [0.0, -2.0, 0.0, 0, 0, 0]])
    draw_contacts(axes, ROOM, states, "cart", SectorContacts(**options))
    return [each for each in axes.patches if isinstance(each, Wedge)], axes.get_title()


@pytest.mark.parametrize(("heading", "sector"), [(0.0, 0), (np.pi, 2)])
def test_the_sector_at_the_wall_stands_out(heading, sector) -> None:
    wedges, title = drawn(heading)
    assert title == f"cart: world in sector {sector}"
    touched = [to_hex(each.get_facecolor()) == BEFORE.lower() for each in wedges]
    assert touched == [i == sector for i in range(4)]
    assert to_hex(wedges[sector - 1].get_facecolor()) == AFTER.lower()
    # the first sector's middle is where the body's x axis points
    assert (wedges[0].theta1 + wedges[0].theta2) / 2 == pytest.approx(np.degrees(heading))


def test_nothing_in_contact() -> None:
    wedges, title = drawn(0.0, radius=0.1, sectors=6)
    assert title == "cart: nothing in contact" and len(wedges) == 6


def test_an_unknown_body_is_named() -> None:
    with pytest.raises(SceneError, match="no moving body is named 'chair'; there are cart, can"):
        draw_contacts(Figure().subplots(), ROOM, np.zeros((2, 6)), "chair")
