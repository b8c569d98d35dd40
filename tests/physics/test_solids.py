"""In which intervals bodies touch, from where they are at the ends."""

import numpy as np
import pytest

from pbrl_ppl.physics import touching
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall

pytestmark = pytest.mark.one_stack

BOX, DISC = Shape.box(0.6, 0.2), Shape.circle(0.1)


def scene(*bodies: Body, joints: tuple[Joint, ...] = ()) -> Scene:
    return Scene(time_step=0.1, bodies=bodies, joints=joints)


TWO = scene(Body("box", BOX), Body("disc", DISC))


def at(*states: tuple[float, ...]) -> np.ndarray:
    """States of bodies, at rest where velocities are left out, shape (1, body, 6)."""
    return np.array([[(*state, *[0.0] * (6 - len(state))) for state in states]])


STILL = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("begin", "end", "expected"),
    [
        ((0.0, 0.45, 0.0), (0.0, 0.45, 0.0), False),  # beside it, 0.25 m apart
        ((0.0, 0.205, 0.0), (0.0, 0.205, 0.0), True),  # within what outlines are known to
        ((0.0, 0.45, 0.0, 0.0, -3.0), (0.0, 0.4, 0.0, 0.0, 1.0), True),  # a blow in between
        ((0.0, 0.45, 0.0, 0.0, -3.0), (0.0, 0.45, 0.0), True),  # on its way on
        ((0.0, 0.45, 0.0), (0.0, 0.4, 0.0, 0.0, 2.0), True),  # on its way back
        ((0.0, 0.45, 0.0, 0.0, 2.0), (0.0, 0.65, 0.0, 0.0, 2.0), False),  # away from it
        ((-0.5, 0.3, 0.0, 10.0, -1.5), (0.5, 0.15, 0.0, 10.0, -1.5), True),  # past its corner
        ((2.0, 0.0, 0.0, 5.0), (2.5, 0.0, 0.0, 5.0), False),
    ],
)
def test_a_disc_passes_a_box(begin, end, expected) -> None:
    assert touching(TWO, at(STILL, begin), at(STILL, end)) == [expected]


def test_a_turning_box_sweeps_a_circle() -> None:
    """At rest 0.1 m beside its long side; a quarter turn brings its end there."""
    disc, rate = (0.0, 0.3, 0.0), 0.5 * np.pi / TWO.time_step
    flat, upright = (*STILL, 0.0, 0.0, rate), (0.0, 0.0, np.pi / 2, 0.0, 0.0, rate)
    assert not touching(TWO, at(STILL, disc), at(STILL, disc))
    assert touching(TWO, at(flat, disc), at(upright, disc))
    away = (0.0, 0.6, 0.0)
    assert not touching(TWO, at((*STILL, 0.0, 0.0, 500.0), away), at((0.0, 0.0, 50.0), away))


def test_walls_and_static_bodies_are_touched_too() -> None:
    wall = Wall((1.0, -5.0), (1.0, 5.0))
    post = Body("post", DISC, static=True, pose=(0.0, -1.0, 0.0))
    room = Scene(time_step=0.1, bodies=(Body("box", BOX), post), walls=(wall,))
    middle = at((0.0, 0.0, 0.0))
    assert not touching(room, middle, middle)
    assert touching(room, middle, at((0.75, 3.0, 0.0)))  # its end is over the wall
    assert touching(room, middle, at((0.0, -0.81, 0.0)))  # beside the post
    assert not touching(room, middle, at((0.0, 0.5, np.pi / 2)))


def test_bodies_that_follow_a_path_or_are_joined_are_no_matter() -> None:
    together = at((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert touching(TWO, together, together)
    finger = scene(Body("box", BOX), Body("disc", DISC, kinematic=True))
    assert not touching(finger, together, together)
    hinge = Joint("hinge", ("box", "disc"), (0.0, 0.0), (0.0, 0.0))
    joined = TWO.replace(joints=(hinge,))
    assert not touching(joined, together, together)
